"""Recordings of episodes."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from fake_grid import FakeGrid

from rl2grid.agents.do_nothing import DoNothing
from rl2grid.agents.greedy import Greedy
from rl2grid.agents.random_agent import RandomAgent
from rl2grid.engines import ENGINES
from rl2grid.envs.registration import register_all
from rl2grid.evaluation.recording import record_episode
from rl2grid.scenarios.library import list_scenarios


def test_every_grid_step_is_recorded_heuristic_ones_included():
    env = FakeGrid(heuristic="idle")
    agent = RandomAgent()
    agent.bind(env)
    recorded = record_episode(agent, env, scenario="april", seed=2)
    assert env.step_listeners == []
    assert recorded.rho.shape == (recorded.n_steps + 1, 3)
    assert 0 < len(recorded.decision_steps) < recorded.n_steps
    assert recorded.rho.max() <= 3.0  # the lost step, above, has no flows
    np.testing.assert_allclose(recorded.rho[:, 2], 3 * recorded.rho[:, 0], rtol=1e-6)
    # At a decision the agent saw a stressed grid.
    assert (recorded.rho[list(recorded.decision_steps), 0] >= 0.4).all()
    assert any(recorded.actions)
    assert len(recorded.actions) == len(recorded.decision_steps)


def test_an_episode_lost_inside_reset_is_recorded():
    env = FakeGrid(heuristic="idle")
    agent = DoNothing()
    agent.bind(env)
    recorded = record_episode(agent, env, scenario="doomed", seed=0)
    assert recorded.game_over
    assert recorded.decision_steps == ()
    assert recorded.n_steps >= 1


def test_joint_actions_are_told_in_words_with_what_they_promised():
    register_all()
    env = gymnasium.make("rl2grid/bus14-H0-v0", disable_env_checker=True, heuristic="idle", split="validation")
    agent = Greedy()
    agent.bind(env)
    recorded = record_episode(agent, env, scenario=list_scenarios("bus14", "validation")[0], steps=600)
    acts = [words for words in recorded.actions if words]
    assert acts
    assert all("redispatch" in words or "substation" in words or "line" in words for words in acts)
    for reason in recorded.reasons:
        (chosen,) = (each for each in reason.alternatives if each.chosen)
        assert np.isfinite(chosen.promised)
        assert any(each.action == "" for each in reason.alternatives)  # doing nothing is always among them


@pytest.mark.parametrize("engine", ENGINES)
def test_bus14(engine):
    register_all()
    keywords = {"engine": engine, "split": "validation", "heuristic": "idle"}
    env = gymnasium.make("rl2grid/bus14-T0-v0", disable_env_checker=True, **keywords)
    agent = DoNothing()
    agent.bind(env)
    scenario = list_scenarios("bus14", "validation")[0]
    recorded = record_episode(agent, env, scenario=scenario)
    assert recorded.line_names == env.unwrapped.grid.name_line
    assert recorded.rho.shape == (recorded.n_steps + 1, 20)
    assert (recorded.rho[recorded.line_status] > 0).all()
    busy = recorded.rho.max(axis=1) >= np.float32(0.95)
    assert set(recorded.decision_steps) <= set(np.flatnonzero(busy).tolist())
    assert (recorded.n_steps == recorded.episode_length) == (not recorded.game_over)
    env.close()
