"""Agents on joint tasks: what they play there, and what they leave alone."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.agents.agent import ExplainingAgent, intervenes
from rl2grid.agents.dispatch import worst_loading
from rl2grid.agents.greedy import Greedy
from rl2grid.agents.greedy_joint import GreedyJoint
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import AGENTS, kinds_of, make_agent


def make(task: str = "bus14-H0", **keywords: Any) -> Any:
    return gymnasium.make(f"rl2grid/{task}-v0", disable_env_checker=True, **keywords)


@pytest.mark.parametrize("name", [name for name in AGENTS if "H" in kinds_of(name)])
def test_all_that_can_play_joint_tasks_do(name):
    env, agent = make(heuristic="idle"), make_agent(name)
    observation, info = env.reset(seed=1)
    agent.bind(env)
    agent.reset(0)
    for _ in range(3):
        action = agent.act(observation, info)
        assert env.action_space.contains({**action, "topology": np.int64(action["topology"])})
        observation, _, terminated, _, info = env.step(action)
        if terminated:
            break


def test_an_agent_without_kinds_plays_all():
    assert kinds_of("do-nothing") == kinds_of("random") == ("T", "R", "H")


@pytest.mark.parametrize(("name", "other"), [("recovery", "T0"), ("milp", "T0"), ("greedy-n1", "T0"), ("dc-opf", "R")])
def test_those_of_one_kind_play_their_part_alone(name, other):
    joint, single = make(heuristic="idle"), make(f"bus14-{other}", heuristic="idle")
    pair = [(env, make_agent(name)) for env in (joint, single)]
    acted = 0
    for seed in range(3):
        begun = [env.reset(seed=seed) for env, _ in pair]
        actions = []
        for (env, agent), (observation, info) in zip(pair, begun, strict=True):
            agent.bind(env)
            agent.reset(0)
            actions.append(agent.act(observation, info))
        part, rest = ("topology", "injection") if other == "T0" else ("injection", "topology")
        np.testing.assert_array_equal(actions[0][part], actions[1])
        assert not np.any(actions[0][rest])
        acted += intervenes(actions[0])
    assert acted or name == "recovery"  # which rests while the grid is not safe


def test_greedy_search_is_no_worse_than_either_part_alone():
    env, agent = make(heuristic="idle"), Greedy()
    helped = 0
    for seed in range(4):
        observation, info = env.reset(seed=seed)
        agent.bind(env)
        base = env.unwrapped
        action = agent.act(observation, info)
        nothing = {"topology": 0, "injection": np.zeros(6, np.float32)}
        played, idle = worst_loading(base, action), worst_loading(base, nothing)
        alone = worst_loading(base, {**action, "injection": nothing["injection"]})
        assert played <= min(idle, alone) + 1e-6
        helped += played < idle
        assert isinstance(agent, ExplainingAgent)
        assert agent.explain() is not None
    assert helped


def test_what_is_not_enough_is_made_up_for_by_dispatch():
    env = make(heuristic="idle")
    observation, info = env.reset(seed=0)
    agent = GreedyJoint([0])  # no topology action helps
    agent.bind(env)
    action = agent.act(observation, info)
    assert action["topology"] == 0
    assert np.any(action["injection"])
    considered = agent.explain()
    assert considered is not None
    assert all(set(tried) == {"topology", "injection"} for tried in considered.actions)


def test_it_is_for_joint_tasks():
    with pytest.raises(UsageError, match="on joint tasks"):
        GreedyJoint().bind(make("bus14-T0"))
