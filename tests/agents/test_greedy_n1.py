"""N-1 after an action beside simulation, and the choice by security on made-up outcomes."""

from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.agents.greedy_topology import GreedyN1, effects, insecurity
from rl2grid.envs.outages_after_action import busbars_after
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import make_agent
from rl2grid.grids import load_grid
from rl2grid.mdp.actions import ActionKind, full_catalogue, level_catalogue
from rl2grid.mdp.state import new_state


def stressed() -> Any:
    env = gymnasium.make("rl2grid/bus14-T1-v0", heuristic="idle", disable_env_checker=True)
    env.reset(seed=3)
    return env.unwrapped


def test_n_1_after_doing_nothing_is_what_switching_each_line_would_do():
    base = stressed()
    actions = level_catalogue(base.grid, 1)
    switches = np.flatnonzero(actions.kind == ActionKind.SWITCH)
    lost = base.security(0)
    expected = base.what_if(switches.tolist())
    np.testing.assert_allclose(
        lost.worst_loading[actions.target[switches]], expected.worst_loading, atol=1e-4
    )  # two flows from other starts
    np.testing.assert_array_equal(lost.verdict[actions.target[switches]], expected.verdict)


def test_n_1_after_an_action_is_that_of_the_grid_once_it_was_played():
    env = gymnasium.make("rl2grid/bus14-T1-v0", disable_env_checker=True)
    env.reset(seed=1, options={"start": 10})
    base = env.unwrapped
    moves = np.flatnonzero(level_catalogue(base.grid, 1).kind == ActionKind.MOVE)
    move = int(moves[base.what_if(moves.tolist()).worst_loading.argmin()])
    foreseen = base.security(move)
    env.step(move)
    played = base.security()
    np.testing.assert_array_equal(foreseen.was_open, played.was_open)
    flows = np.isfinite(played.worst_loading)
    np.testing.assert_array_equal(np.isfinite(foreseen.worst_loading), flows)
    # The forecast is not what came: 5% of a limit on bus14.
    np.testing.assert_allclose(foreseen.worst_loading[flows], played.worst_loading[flows], atol=0.05)


def test_an_action_that_does_not_exist_has_no_security():
    with pytest.raises(UsageError, match="give an integer from 0 to 208"):
        stressed().security(209)


def test_insecurity_counts_overloads_up_to_a_collapse():
    outcomes = SimpleNamespace(
        worst_loading=np.array([0.5, 1.25, np.inf, 3.0, 9.0], np.float32), was_open=np.array([False] * 4 + [True])
    )
    np.testing.assert_allclose(insecurity(outcomes), 0.25 + 1.0 + 1.0)


def test_switching_twice_returns_line_ends_to_their_busbars():
    grid = load_grid("bus14")
    busbar, catalogue = np.ones(grid.dim_topo, np.int32), full_catalogue(grid)
    busbar[grid.line_or_pos_topo_vect[4]] = 2
    switch = catalogue[int(np.flatnonzero((catalogue.kind == ActionKind.SWITCH) & (catalogue.target == 4))[0])]
    opened = busbars_after(grid, busbar, busbar, switch)
    assert opened[grid.line_or_pos_topo_vect[4]] == opened[grid.line_ex_pos_topo_vect[4]] == -1
    np.testing.assert_array_equal(busbars_after(grid, opened, busbar, switch), busbar)


def test_effects_know_what_restores_and_what_can_be_undone():
    grid = load_grid("bus14")
    catalogue = full_catalogue(grid)
    state = new_state(grid, 1)
    state.topo_vect[0], state.line_status[0] = 1, True
    moves = np.flatnonzero((catalogue.kind == ActionKind.MOVE) & (catalogue.target == 4))
    first, second = moves[[0, 1]].tolist()
    step = catalogue[first]
    state.topo_vect[0] = busbars_after(grid, state.topo_vect[0], state.topo_vect[0], step)
    state.line_status[0, 7] = False
    close = int(np.flatnonzero((catalogue.kind == ActionKind.SWITCH) & (catalogue.target == 7))[0])
    few = effects(grid, state, catalogue.take(np.array([0, first, second, close], np.int32)))
    assert few.restores.tolist() == [False, True, False, True]
    # The second move leaves both sets on busbar 2, which neither of the two moves brings back.
    assert few.can_be_undone.tolist() == [True, True, False, True]
    assert effects(grid, state, catalogue).can_be_undone.all()


class Stage(gymnasium.Env[Any, Any]):
    """A stressed bus14 whose what-if and security are made up."""

    def __init__(self, loading: list[float], after_outage: list[float]) -> None:
        self.grid = load_grid("bus14")
        self.action_space = gymnasium.spaces.Discrete(len(loading))
        self.action_catalogue_ids = np.arange(len(loading), dtype=np.int32)
        self.state = new_state(self.grid, 1)
        self.state.rho[0], self.state.line_status[0], self.state.topo_vect[0] = 1.1, True, 1
        self.loading, self.after_outage = np.array(loading), after_outage

    def what_if(self, actions: list[int]) -> SimpleNamespace:
        return SimpleNamespace(worst_loading=self.loading[actions], legal=np.ones(len(actions), np.bool_))

    def security(self, action: int) -> SimpleNamespace:
        return SimpleNamespace(worst_loading=np.array([self.after_outage[action]]), was_open=np.array([False]))


def test_of_nearly_equal_margins_the_secure_one_is_played():
    def choice(loading: list[float], after_outage: list[float]) -> int:
        agent = GreedyN1()
        agent.bind(Stage(loading, after_outage))
        return agent.act(np.zeros(1, np.float32), {})

    assert choice([1.1, 0.8, 0.81, 0.82], [2, np.inf, 1.2, 1.4]) == 2
    assert choice([1.1, 0.8, 0.9, 0.82], [2, np.inf, 1.0, 1.4]) == 3  # 0.9 is too far from 0.8
    assert choice([1.1, 1.2, 1.1], [2, 0.5, 0.5]) == 0


def test_redispatching_tasks_are_refused():
    redispatch = gymnasium.make("rl2grid/bus14-R-v0", disable_env_checker=True)
    with pytest.raises(UsageError, match="or the agent 'greedy'"):
        make_agent("greedy-n1").bind(redispatch)
