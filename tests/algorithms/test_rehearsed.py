"""A policy whose crises are rehearsed: it plays as the policy does while the grid is safe, and outlives it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import rl2grid
from rl2grid.agents.rehearsal import Rehearsal
from rl2grid.algorithms.policy_agent import PolicyAgent, load_agent
from rl2grid.algorithms.rehearsed import Rehearsed
from rl2grid.envs.registration import register_all
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import make_agent
from rl2grid.evaluation.episode import Episode, play_episode
from rl2grid.mdp.heuristics import is_safe

POLICY = "pretrained/bus14-T0-idle"
MONTH = "generated/710004-04"
INJECTING, LOST_ALONE = "pretrained/bus118-M-R", "generated/710005-11"


def survived(agent: Any, heuristic: str | None) -> Episode:
    """A month of bus14-T0, played until its end or a game over."""
    register_all()
    env = gymnasium.make("rl2grid/bus14-T0-v0", split="validation", heuristic=heuristic)
    agent.bind(env)
    return play_episode(agent, env, scenario=MONTH, seed=0)


def test_it_outlives_a_policy_that_meets_its_limits_and_knows_no_future():
    # Without the heuristic that it was trained with the policy acts at every step, and loses the month.
    alone, rehearsing = survived(make_agent(POLICY), None), survived(make_agent(POLICY, rehearse=24), None)
    assert rehearsing.grid_steps > alone.grid_steps
    assert rehearsing.foresight == 0


def test_while_the_grid_is_safe_the_policy_decides():
    register_all()
    env: Any = gymnasium.make("rl2grid/bus14-T0-v0", split="validation")
    policy, agent = make_agent(POLICY), make_agent(POLICY, rehearse=24)
    for each in (policy, agent):
        each.bind(env)
    observation, info = env.reset(seed=1)
    agent.reset(0)
    decisions = 0
    while is_safe(env.unwrapped.state, 0) and decisions < 200:
        action = agent.act(observation, info)
        assert action == policy.act(observation, info)
        observation, _, terminated, _, info = env.step(action)
        assert not terminated
        decisions += 1
    assert decisions > 10


def test_it_does_with_a_policy_what_rehearsal_does_with_a_guide():
    plain = Rehearsal(make_agent(POLICY), ahead=12)
    one, other = survived(make_agent(POLICY, rehearse=12), None), survived(plain, None)
    assert (one.grid_steps, one.episode_return) == (other.grid_steps, other.episode_return)


def drawing_nothing(folder: Path) -> PolicyAgent:
    """A policy of TD3 that has learned nothing."""
    changes = {"total_timesteps": 64, "num_envs": 4, "num_steps": 16, "actor_layers": (4,), "critic_layers": (4,)}
    run = rl2grid.train("td3", "bus14-R", hyperparameters=changes, folder=folder / "run", validation_months=0)
    return load_agent(run)


def test_of_a_redispatching_policy_injections_are_rehearsed():
    register_all()
    policy, rehearsing = make_agent(INJECTING), make_agent(INJECTING, rehearse=24)
    env: Any = gymnasium.make("rl2grid/bus118-M-R-v0", split="validation", **policy.env_keywords)  # type: ignore[attr-defined]
    for agent in (policy, rehearsing):
        agent.bind(env)
    alone = play_episode(policy, env, scenario=LOST_ALONE, seed=0)
    rehearsed = play_episode(rehearsing, env, scenario=LOST_ALONE, seed=0)
    assert alone.survival < 1.0
    assert rehearsed.survival == 1.0
    assert rehearsed.foresight == 0


@pytest.mark.parametrize("top_k", [None, 5])
def test_what_it_draws_does_not_depend_on_what_was_played_before(top_k: int | None):
    register_all()
    agent: Any = make_agent(INJECTING, top_k=top_k, rehearse=24)
    env = gymnasium.make("rl2grid/bus118-M-R-v0", split="validation", **agent.env_keywords)
    agent.bind(env)
    observation, info = env.reset(seed=0)

    def drawn(episode: int) -> list[Any]:
        agent.seed_episode(0, episode)
        return [policy.proposals(observation, info)[1:] for policy in (agent._guide, agent._understudy)]

    first, other, again = drawn(6), drawn(8), drawn(6)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    assert not np.array_equal(first[0], first[1]), "rehearsals draw otherwise than what is played"


def test_it_is_named_identified_and_made_by_its_run():
    agent, policy = make_agent(POLICY, top_k=3, rehearse=12), make_agent(POLICY)
    assert isinstance(agent, Rehearsed)
    assert agent.name == "pretrained-bus14-T0-idle, best of 3, rehearsing 12 steps"
    assert agent.identity == {**policy.identity, "top_k": 3, "rehearse": 12}  # type: ignore[attr-defined]
    result = rl2grid.evaluate(make_agent(POLICY, rehearse=12), "bus14-T0", scenarios=[MONTH], episode_length=20)
    assert result.identity["heuristic"] == "idle"
    assert result.summary.agent == "pretrained-bus14-T0-idle, rehearsing 12 steps"


def test_what_has_no_crisis_to_rehearse_is_refused(tmp_path: Path):
    with pytest.raises(UsageError, match="rehearse=0 is not allowed: give a number of grid steps, at least 1"):
        make_agent(POLICY, rehearse=0)
    with pytest.raises(UsageError, match="leave it out for greedy"):
        make_agent("greedy", rehearse=24)
    with pytest.raises(UsageError, match="TD3's policy draws no other actions to rehearse"):
        Rehearsed(drawing_nothing(tmp_path), 24)
