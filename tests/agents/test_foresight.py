"""The agent that knows the future: it keeps what it foresees, outlives its guide, and is marked."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from sample_guides import Shifting, survived

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.agents.do_nothing import DoNothing
from rl2grid.agents.foresight import Foresight, _Telling
from rl2grid.agents.planner import Planner
from rl2grid.errors import UsageError
from rl2grid.evaluation.protocol import evaluate
from rl2grid.ledger import subjects

MONTH = "bundled/0000"


def foresight(**options: Any) -> Foresight:
    return Foresight(DoNothing(), **{"ahead": 24, "candidates": 6, "attempts": 60, **options})


def begun(agent: Foresight, task: str = "bus14-T0") -> tuple[Any, Any, Any]:
    """An environment that the agent plays, with what its reset returned."""
    env: Any = gymnasium.make(f"rl2grid/{task}-v0", split="bundled")
    agent.bind(env)
    observation, info = env.reset(seed=0, options={"scenario": MONTH})
    agent.reset(0)
    return env, observation, info


@pytest.mark.parametrize("task", ["bus14-T0", "bus14-H0"])
def test_it_outlives_its_guide_and_is_marked(task):
    guided, alone = survived(foresight(), task), survived(DoNothing(), task)
    assert guided.grid_steps > alone.grid_steps
    assert guided.foresight > 0 == alone.foresight


def test_what_it_plays_is_what_it_foresaw():
    agent = foresight()
    env, observation, info = begun(agent)
    over = False
    while not over and info["step"] < 150:
        action = agent.act(observation, info)
        foreseen = [decision.step for decision in agent._course][:1]
        observation, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
        assert foreseen == ([] if over else [info["step"]])


def test_in_a_joint_task_another_topology_action_keeps_the_injection_of_the_guide():
    agent = Foresight(Shifting(), ahead=12, candidates=3, attempts=5)
    env, observation, info = begun(agent, "bus14-H0")
    agent.act(observation, info)
    tried = [attempt.action for attempt in agent._courses.attempts_at(list(agent._course))]
    assert tried
    for action in tried:
        assert env.action_space.contains(action)
        assert action["topology"] != 0
        np.testing.assert_array_equal(action["injection"], Shifting.injection)


def test_it_forgets_the_future_of_an_action_that_was_not_played():
    agent = foresight()
    env, observation, info = begun(agent)
    agent.act(observation, info)
    agent.overruled(7)
    observation, *_, info = env.step(7)
    agent.act(observation, info)
    assert agent._course[0].step == info["step"] + 1


@pytest.mark.parametrize(("task", "first_is_told"), [("bus14-R", True), ("bus14-H0", True), ("bus14-T0", False)])
def test_where_power_is_dispatched_the_planner_is_told_what_comes(task, first_is_told):
    agent = Foresight(Planner(), ahead=12, candidates=3, attempts=5)
    _, observation, info = begun(agent, task)
    agent.act(observation, info)
    decisions = list(agent._course)
    attempts = list(agent._courses.attempts_at(decisions))
    assert isinstance(attempts[0], _Telling) is first_is_told
    told = [attempt.foretold for attempt in attempts if isinstance(attempt, _Telling)]
    assert all(each.step == decisions[-1].step for each in told)
    assert all(isinstance(attempt, _Telling) for attempt in attempts) is (task == "bus14-R")


@pytest.mark.slow
def test_redispatching_it_outlives_nobody_by_less():
    bound, alone = survived(Foresight(ahead=48), "bus14-R"), survived(Planner(), "bus14-R")
    assert bound.grid_steps >= alone.grid_steps
    assert bound.foresight > 0


def test_tasks_without_topology_are_refused_with_another_guide():
    with pytest.raises(UsageError, match="no topology actions to try, and only the planner"):
        foresight().bind(gymnasium.make("rl2grid/bus14-R-v0", split="bundled"))


def test_another_guide_or_another_reach_is_another_name():
    assert Foresight().name == "foresight"
    assert Foresight(attempts=20).name == "foresight (attempts 20)"
    assert foresight().name == "foresight (guided by do-nothing, ahead 24, candidates 6, attempts 60)"


def test_who_knows_the_future_has_no_test(monkeypatch):
    monkeypatch.setattr(subjects, "evaluate", lambda agent, task, **_: evaluate(
        foresight(), task, split="bundled", scenarios=[MONTH], episode_length=100))  # fmt: skip
    with pytest.raises(UsageError, match="knows the future: it is not ranked"):
        subjects.find_subject("foresight@bus14-T0", months=1)
    subject = subjects.find_subject("greedy@bus14-T0", months=1)  # another whose months show that it knew
    with pytest.raises(UsageError, match="who knows the future is not ranked"):
        subjects.play_test(subject)
