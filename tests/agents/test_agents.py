"""The agents that need no training."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from rl2grid.agents.agent import Agent, RandomizedAgent, intervenes, key_of, no_intervention
from rl2grid.agents.do_nothing import DoNothing
from rl2grid.agents.random_agent import RandomAgent
from rl2grid.agents.recovery import Recovery
from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.mdp.actions import ActionKind, full_catalogue, level_ids, move, switch
from rl2grid.mdp.state import new_state

DISCRETE = gymnasium.spaces.Discrete(5)
BOX = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)
JOINT = gymnasium.spaces.Dict({"topology": DISCRETE, "injection": BOX})
OBSERVATION = np.zeros(2, np.float32)


class Stage(gymnasium.Env[Any, Any]):
    """As much of an environment as these agents look at."""

    def __init__(self, space: gymnasium.Space[Any], mask: list[bool] | None = None, level: int = 1) -> None:
        self.action_space = space
        self.mask = np.array(mask if mask is not None else [True] * 5)
        self.grid = load_grid("bus14")
        self.action_catalogue_ids = level_ids(self.grid, level)
        self.state = new_state(self.grid, 1)

    def action_masks(self) -> np.ndarray[Any, Any]:
        return self.mask


def bound(agent: Agent, env: Stage) -> Agent:
    agent.bind(env)
    agent.reset(0)
    return agent


@pytest.mark.parametrize("agent", [DoNothing(), RandomAgent(), Recovery()])
def test_all_of_them_are_agents(agent):
    assert isinstance(agent, Agent)
    assert isinstance(agent, RandomizedAgent) == isinstance(agent, RandomAgent)


def test_do_nothing_does_nothing():
    assert bound(DoNothing(), Stage(DISCRETE)).act(OBSERVATION, {}) == 0
    action = bound(DoNothing(), Stage(BOX)).act(OBSERVATION, {})
    np.testing.assert_array_equal(action, np.zeros(3, np.float32))
    assert action in BOX
    assert no_intervention(DISCRETE) in DISCRETE


def test_actions_of_joint_tasks_have_both_parts():
    nothing = bound(DoNothing(), Stage(JOINT)).act(OBSERVATION, {})
    assert nothing in JOINT
    assert not intervenes(nothing)
    recovered = bound(Recovery(), Stage(JOINT)).act(OBSERVATION, {})  # all lines of the stage are open
    assert recovered["topology"] > 0
    assert not recovered["injection"].any()
    drawn = bound(RandomAgent(), Stage(JOINT, [False, True, False, False, False])).act(OBSERVATION, {})
    assert drawn in JOINT
    assert drawn["topology"] == 1
    assert intervenes(drawn)
    assert intervenes({**nothing, "topology": 2})
    assert intervenes({**nothing, "injection": np.float32([0, 0, 0.1])})
    assert key_of(drawn) == key_of(dict(reversed(drawn.items()))) != key_of(nothing)


def draws(agent: Agent, n: int) -> list[int]:
    return [agent.act(OBSERVATION, {}) for _ in range(n)]


def test_random_actions_are_legal_and_equally_likely():
    agent = bound(RandomAgent(), Stage(DISCRETE, [True, False, True, False, True]))
    counts = np.bincount(draws(agent, 6000), minlength=5)
    assert counts[[1, 3]].sum() == 0
    # Five standard deviations of a share of a third.
    assert (np.abs(counts[[0, 2, 4]] - 2000) < 5 * np.sqrt(6000 * 2 / 9)).all()


def test_random_actions_fill_the_box():
    agent = bound(RandomAgent(), Stage(BOX))
    actions = np.array(draws(agent, 2000))
    assert actions.dtype == np.float32
    assert all(action in BOX for action in actions[:50])
    assert (actions.min(axis=0) < -0.98).all()
    assert (actions.max(axis=0) > 0.98).all()
    assert (np.abs(actions.mean(axis=0)) < 0.07).all()


def test_random_actions_are_a_function_of_seed_and_episode():
    agent = bound(RandomAgent(), Stage(DISCRETE))
    agent.seed_episode(3, 7)
    agent.reset(0)
    first = draws(agent, 40)
    agent.reset(0)
    assert draws(agent, 40) != first  # episode 8
    agent.seed_episode(3, 7)
    agent.reset(0)
    assert draws(agent, 40) == first
    agent.seed_episode(4, 7)
    agent.reset(0)
    assert draws(agent, 40) != first


class Grid14:
    """A calm bus14 and the recovery agent that looks at it."""

    def __init__(self, level: int = 1) -> None:
        self.env = Stage(DISCRETE, level=level)
        self.agent = Recovery()
        self.agent.bind(self.env)
        self.state = self.env.state
        self.state.rho[0] = 0.5
        self.state.line_status[0] = True
        self.state.topo_vect[0] = 1
        self.actions = full_catalogue(self.env.grid).take(self.env.action_catalogue_ids)

    def act(self) -> int:
        return self.agent.act(OBSERVATION, {})


def test_recovery_leaves_the_reference_alone():
    assert Grid14().act() == 0


def test_recovery_reconnects_the_first_open_line():
    calm = Grid14()
    calm.state.line_status[0, [7, 4]] = False
    calm.state.time_before_cooldown_line[0, 4] = 2
    assert calm.actions[calm.act()] == switch(7)


def test_recovery_moves_exactly_what_is_on_the_second_busbar():
    calm = Grid14()
    sub = int(np.argmax(calm.env.grid.sub_info))
    first, size = int(calm.env.grid.sub_first_element[sub]), int(calm.env.grid.sub_info[sub])
    calm.state.topo_vect[0, [first + 1, first + size - 1]] = 2
    assert calm.actions[calm.act()] == move(sub, 0b10 | 1 << (size - 1))


def test_recovery_waits_while_the_grid_is_not_safe():
    calm = Grid14()
    calm.state.line_status[0, 7] = False
    calm.state.rho[0, 2] = 0.95
    assert calm.act() == 0


def test_recovery_does_nothing_where_the_task_lacks_the_action():
    calm = Grid14(level=0)
    switches = set(calm.actions.target[calm.actions.kind == ActionKind.SWITCH].tolist())
    missing = [line for line in range(calm.env.grid.n_line) if line not in switches]
    assert missing, "level 0 of bus14 holds every switch: this test needs another level"
    calm.state.line_status[0, missing[0]] = False
    assert calm.act() == 0


def test_recovery_refuses_tasks_without_topology_actions():
    with pytest.raises(UsageError, match="cannot play a redispatching task"):
        Recovery().bind(Stage(BOX))
