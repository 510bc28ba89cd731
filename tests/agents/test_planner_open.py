"""The planner that leaves a line open where this disarms the opponent."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.agents.contingencies import areas_to_attack, expected
from rl2grid.agents.planner import Planner
from rl2grid.agents.planner_open import PlannerOpen
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import kinds_of, make_agent
from rl2grid.mdp.actions import ActionKind, full_catalogue


def begun(task: str, **keywords: Any) -> Any:
    env = gymnasium.make(f"rl2grid/{task}-v0", split="bundled", disable_env_checker=True, **keywords)
    env.reset(seed=0)
    return env


def still_open(agent: Planner, lines: list[int], steps: int = 12) -> list[int]:
    """Which of some lines are open after the agent has played on a safe grid in which they were opened."""
    env = begun("bus36-MO-v1-T0", maintenance=False, opponent=False)
    base: Any = env.unwrapped
    agent.bind(env)
    agent.reset(0)
    catalogue = full_catalogue(base.grid).take(base.action_catalogue_ids)
    for line in lines:
        (entry,) = np.flatnonzero((catalogue.kind == ActionKind.SWITCH) & (catalogue.target == line))
        observation, _, _, _, info = env.step(int(entry))
        assert not base.state.line_status[0, line]
    for _ in range(steps):
        observation, _, terminated, _, info = env.step(agent.act(observation, info))
        assert not terminated
        assert base.state.rho[0].max() < 0.95
    return [line for line in lines if not base.state.line_status[0, line]]


def attackable(number: int) -> list[int]:
    """The least loaded lines that may be attacked."""
    base = begun("bus36-MO-v1-T0").unwrapped
    return sorted(base.grid.opponent.areas[0], key=lambda line: float(base.state.rho[0, line]))[:number]


def test_the_last_line_is_left_open_and_no_other():
    one, two = attackable(1), attackable(2)
    assert still_open(Planner(), one) == []
    assert still_open(PlannerOpen(), one) == one
    assert still_open(Planner(), two) == []
    assert len(still_open(PlannerOpen(), two)) == 1


def test_lines_that_nobody_attacks_are_closed():
    grid = begun("bus36-MO-v1-T0").unwrapped.grid
    catalogue = full_catalogue(grid).take(begun("bus36-MO-v1-T0").unwrapped.action_catalogue_ids)
    switches = catalogue.target[catalogue.kind == ActionKind.SWITCH]
    other = next(int(line) for line in switches if line not in grid.opponent.areas[0])
    assert still_open(PlannerOpen(), [other]) == []


def test_an_area_is_disarmed_by_a_line_of_its_own():
    env = begun("bus118-MOB-v1-T0").unwrapped
    areas = env.grid.opponent.areas
    assert areas_to_attack(env.grid, env.state) == list(areas)
    env.state.line_status[0, areas[1][0]] = False
    assert areas_to_attack(env.grid, env.state) == [areas[0], areas[2]]
    env.state.time_next_maintenance[0] = -1
    lines = set(expected(env.grid, env.state, [areas[0], areas[2]]).lines.tolist())
    assert lines == set(areas[0]) | set(areas[2])


def test_a_weighted_opponent_is_disarmed_by_nothing():
    env = begun("bus36-MO-v0-T0").unwrapped
    env.state.line_status[0, env.grid.opponent.areas[0][0]] = False
    assert areas_to_attack(env.grid, env.state) == list(env.grid.opponent.areas)


@pytest.mark.parametrize("task", ["bus36-MO-v0-T0", "bus14-H0"])
def test_against_others_it_plays_what_the_planner_plays(task: str):
    played = []
    for agent in (Planner(), PlannerOpen()):
        env = begun(task)
        agent.bind(env)
        observation, info = env.reset(seed=3)
        agent.reset(0)
        actions = []
        for _ in range(200):
            actions.append(agent.act(observation, info))
            observation, _, terminated, truncated, info = env.step(actions[-1])
            if terminated or truncated:
                break
        played.append(repr(actions))
    assert played[0] == played[1]


def test_tasks_without_topology_are_refused():
    with pytest.raises(UsageError, match="where no line can be closed: choose planner"):
        PlannerOpen().bind(begun("bus14-R"))


def test_it_is_found_by_name():
    assert isinstance(make_agent("planner-open"), PlannerOpen)
    assert make_agent("planner-open").name == "planner-open"
    assert kinds_of("planner-open") == ("T", "H")
