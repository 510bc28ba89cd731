"""The agent that rehearses crises: it knows no future, outlives its guide, and keeps to what went well."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from sample_guides import Shifting, survived

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.agents.do_nothing import DoNothing
from rl2grid.agents.planner import Planner
from rl2grid.agents.rehearsal import Rehearsal
from rl2grid.errors import UsageError
from rl2grid.mdp.heuristics import is_safe


def rehearsal(**options: Any) -> Rehearsal:
    return Rehearsal(DoNothing(), **{"candidates": 6, "attempts": 60, **options})


class Told(DoNothing):
    """Remembers by what it was overruled."""

    def __init__(self) -> None:
        self.by: list[Any] = []

    def overruled(self, played: Any) -> None:
        self.by.append(played)


def in_danger(agent: Rehearsal, task: str = "bus14-T0") -> tuple[Any, Any, Any]:
    """An environment that the agent plays, in the first state that is not safe, and what the last step returned."""
    env: Any = gymnasium.make(f"rl2grid/{task}-v0", split="validation")
    agent.bind(env)
    observation, info = env.reset(seed=1)
    agent.reset(0)
    while is_safe(env.unwrapped.state, 0):
        action = agent.act(observation, info)
        observation, _, terminated, _, info = env.step(action)
        assert not terminated
    return env, observation, info


@pytest.mark.parametrize("task", ["bus14-T0", "bus14-H0"])
def test_it_outlives_its_guide_and_knows_no_future(task):
    rehearsing, alone = survived(rehearsal(), task), survived(DoNothing(), task)
    assert rehearsing.grid_steps > alone.grid_steps
    assert rehearsing.foresight == 0


def test_nothing_that_comes_is_looked_at(monkeypatch):
    # Worlds in which crises are rehearsed are imagined ones; a true one would count as foresight, and is never saved.
    agent = rehearsal()
    env, observation, info = in_danger(agent)
    played, imagined = agent._courses.play, []

    def watched(world, *first, **until):
        imagined.append(world)
        return played(world, *first, **until)

    monkeypatch.setattr(agent._courses, "play", watched)
    agent.act(observation, info)
    assert imagined
    assert all(world.imagined for world in imagined)
    assert env.unwrapped.foresight == 0


def test_while_the_grid_is_safe_the_guide_decides():
    agent = Rehearsal(Shifting(), candidates=3, attempts=5)
    env: Any = gymnasium.make("rl2grid/bus14-H0-v0", split="validation")
    agent.bind(env)
    observation, info = env.reset(seed=1)
    agent.reset(0)
    assert is_safe(env.unwrapped.state, 0)
    assert agent.act(observation, info)["injection"] is Shifting.injection
    assert agent.explain() is None


def test_what_went_well_is_rehearsed_again_and_played():
    agent = rehearsal()
    env, observation, info = in_danger(agent)
    action = agent.act(observation, info)
    kept = list(agent._kept)
    observation, *_, info = env.step(action)
    assert not is_safe(env.unwrapped.state, 0)
    assert agent.act(observation, info) == kept[0]
    assert "still goes well" in agent.explain().why  # type: ignore[union-attr]


def test_a_course_is_forgotten_where_another_action_was_played():
    agent = rehearsal()
    _, observation, info = in_danger(agent)
    agent.act(observation, info)
    agent.overruled(7)
    assert agent._kept == []


def test_in_a_joint_task_the_guide_injects_and_is_told_when_its_topology_is_not_played():
    guide = Told()
    agent = Rehearsal(guide, candidates=6, attempts=60)
    env, observation, info = in_danger(agent, "bus14-H0")
    terminated = False
    while not guide.by and not terminated:
        action = agent.act(observation, info)
        np.testing.assert_array_equal(action["injection"], 0.0)
        observation, _, terminated, _, info = env.step(action)
    assert guide.by
    assert guide.by[0]["topology"] != 0
    assert env.action_space.contains(guide.by[0])


def test_it_is_bound_to_one_environment_after_the_other():
    agent = Rehearsal()
    for _ in range(2):
        agent.bind(gymnasium.make("rl2grid/bus14-H0-v0", split="bundled"))


def test_attempts_of_a_crisis_are_bounded():
    agent = rehearsal(candidates=2, attempts=3)
    env: Any = gymnasium.make("rl2grid/bus14-T0-v0", split="validation")
    agent.bind(env)
    observation, info = env.reset(seed=1)
    agent.reset(0)
    left, over = {True: set[int](), False: set[int]()}, False
    while not over:
        is_calm = is_safe(env.unwrapped.state, 0)
        action = agent.act(observation, info)
        left[is_calm].add(agent._left)
        observation, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    assert left[True] == {3}
    assert min(left[False]) == 0


def test_it_refuses_what_it_cannot_play():
    with pytest.raises(UsageError, match='choose engine="native"'):
        rehearsal().bind(gymnasium.make("rl2grid/bus14-T0-v0", split="bundled", engine="reference"))
    with pytest.raises(UsageError, match="cannot play a redispatching task"):
        rehearsal().bind(gymnasium.make("rl2grid/bus14-R-v0", split="bundled"))


def test_another_guide_or_another_reach_is_another_name():
    assert Rehearsal().name == Rehearsal(Planner()).name.removesuffix(" (guided by planner)") == "rehearsal"
    assert Rehearsal(ahead=48).name == "rehearsal (ahead 48)"
