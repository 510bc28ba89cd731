"""The MILP's choice beside brute force over all single actions with a dense DC flow of its own."""

import time
from typing import Any

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.agents.agent import Agent
from rl2grid.agents.dc_flow import DcPoint, dc_flow, dc_point, is_connected
from rl2grid.agents.milp import Milp, best_action
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import make_agent
from rl2grid.grids import Grid, load_grid
from rl2grid.mdp.actions import ActionCatalogue, ActionKind, full_catalogue, level_catalogue
from rl2grid.powerflow.model import load_network

TOLERANCE = 1e-5
"""Of a loading: HiGHS meets rows and integers to 1e-6."""


def brute_force_flow(grid: Grid, point: DcPoint, busbar: np.ndarray) -> np.ndarray | None:
    """MW on each line by the bus susceptance matrix; None where the grid is not in one piece."""
    bus = grid.element_to_subid + grid.n_sub * (busbar - 1)
    used = sorted({int(bus[e]) for e in range(grid.dim_topo) if busbar[e] > 0})
    row = {b: k for k, b in enumerate(used)}
    matrix, power = np.zeros((len(used), len(used))), np.zeros(len(used))
    closed = []
    for line in range(grid.n_line):
        a, b = grid.line_or_pos_topo_vect[line], grid.line_ex_pos_topo_vect[line]
        if busbar[a] > 0:
            i, j = row[int(bus[a])], row[int(bus[b])]
            closed.append((line, i, j))
            matrix[[i, j], [i, j]] += point.susceptance[line]
            matrix[[i, j], [j, i]] -= point.susceptance[line]
    for element in range(grid.dim_topo):
        if busbar[element] > 0:
            power[row[int(bus[element])]] += point.injection[element]
    if np.linalg.matrix_rank(matrix) < len(used) - 1:
        return None
    angle = np.linalg.lstsq(matrix, power, rcond=None)[0]
    flow = np.zeros(grid.n_line)
    for line, i, j in closed:
        flow[line] = point.susceptance[line] * (angle[i] - angle[j])
    return flow


def after(grid: Grid, point: DcPoint, catalogue: ActionCatalogue, action: int, last: np.ndarray) -> np.ndarray:
    busbar = point.busbar.copy()
    for kind, target, mask in catalogue[action].changes:
        if kind == ActionKind.MOVE:
            for k in range(int(grid.sub_info[target])):
                element = int(grid.sub_first_element[target]) + k
                if mask >> k & 1 and busbar[element] > 0:
                    busbar[element] = 3 - busbar[element]
        if kind == ActionKind.SWITCH:
            for element in (grid.line_or_pos_topo_vect[target], grid.line_ex_pos_topo_vect[target]):
                busbar[element] = -1 if busbar[element] > 0 else last[element]
    return busbar


def worst_loadings(grid: Grid, point: DcPoint, catalogue: ActionCatalogue, last: np.ndarray) -> np.ndarray:
    loadings = np.full(len(catalogue), np.inf)
    present = brute_force_flow(grid, point, point.busbar)
    for action in range(len(catalogue)):
        busbar = after(grid, point, catalogue, action, last)
        flow = brute_force_flow(grid, point, busbar)
        if flow is not None:
            closed = busbar[grid.line_or_pos_topo_vect] > 0
            loadings[action] = np.max(np.abs(flow + closed * (point.flow - present)) / point.limit)
    return loadings


def played(task: str, seed: int, n_actions: int) -> Any:
    """A state that some random legal actions lead to."""
    env = gymnasium.make(f"rl2grid/{task}-v0", disable_env_checker=True)
    rng = np.random.default_rng(seed)
    env.reset(seed=seed)
    for _ in range(n_actions):
        outcomes = env.unwrapped.what_if()
        survivors = np.flatnonzero(outcomes.legal & (outcomes.worst_loading < 1.9))
        if len(survivors) == 0 or any(env.step(int(rng.choice(survivors)))[2:4]):
            env.reset()
    return env.unwrapped


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("seed", [0, 1, 2, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (3, 4, 5))])
def test_the_optimum_is_that_of_brute_force(level, seed):
    base = played("bus14-T1", seed, 4 * (seed % 3))
    grid, catalogue = base.grid, level_catalogue(base.grid, level)
    point, last = dc_point(base.state, 0, grid, load_network(grid)), np.ones(base.grid.dim_topo, np.int32)
    allowed = np.ones(len(catalogue), np.bool_)
    allowed[np.random.default_rng(seed).integers(1, len(catalogue), 5)] = False
    loadings = worst_loadings(grid, point, catalogue, last)
    np.testing.assert_allclose(dc_flow(grid, point), brute_force_flow(grid, point, point.busbar), atol=1e-9)
    first = best_action(grid, point, catalogue, allowed, last, 60.0)
    np.testing.assert_allclose(loadings[first], loadings[allowed].min(), atol=TOLERANCE)
    if first == 0:
        return
    second = best_action(grid, point, catalogue, allowed, last, 60.0, {first})
    allowed[first] = False
    np.testing.assert_allclose(loadings[second], loadings[allowed].min(), atol=TOLERANCE)


def test_a_line_with_both_ends_alone_is_an_island():
    grid = load_grid("bus14")
    busbar = np.ones(grid.dim_topo, np.int32)
    assert is_connected(grid, busbar)
    busbar[grid.line_or_pos_topo_vect[2]] = 2
    assert is_connected(grid, busbar)
    busbar[grid.line_ex_pos_topo_vect[2]] = 2
    assert not is_connected(grid, busbar)


def test_nothing_is_chosen_where_nothing_may_be_played():
    base = played("bus14-T1", 0, 0)
    point = dc_point(base.state, 0, base.grid, load_network(base.grid))
    catalogue = full_catalogue(base.grid)
    none = np.zeros(len(catalogue), np.bool_)
    assert best_action(base.grid, point, catalogue, none, np.ones(base.grid.dim_topo, np.int32), 60.0) == 0


def test_the_time_limit_is_kept():
    base = played("bus36-M-T2", 0, 0)
    point = dc_point(base.state, 0, base.grid, load_network(base.grid))
    catalogue = level_catalogue(base.grid, 2)
    allowed, last = np.ones(len(catalogue), np.bool_), np.ones(base.grid.dim_topo, np.int32)
    began = time.process_time()  # of a machine that is shared
    action = best_action(base.grid, point, catalogue, allowed, last, 0.2)
    assert 0 <= action < len(catalogue)
    assert time.process_time() - began < 3.0  # the programme is built outside the limit


def test_what_it_plays_is_better_than_nothing_by_the_forecast():
    env = gymnasium.make("rl2grid/bus14-T1-v0", heuristic="idle", disable_env_checker=True)
    agent = Milp()
    agent.bind(env)
    assert isinstance(agent, Agent)
    observation, info = env.reset(seed=3)
    agent.reset(0)
    n_played = 0
    for _ in range(2):
        action = agent.act(observation, info)
        outcomes = env.unwrapped.what_if([0, action])
        assert outcomes.legal[1]
        if action != 0:
            n_played += 1
            assert outcomes.worst_loading[1] < outcomes.worst_loading[0]
        observation, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            break
    assert n_played > 0


def test_redispatching_tasks_are_refused():
    redispatch = gymnasium.make("rl2grid/bus14-R-v0", disable_env_checker=True)
    with pytest.raises(UsageError, match="choose a topology task"):
        Milp().bind(redispatch)


def test_arguments_must_be_positive():
    with pytest.raises(UsageError, match="positive number of seconds"):
        Milp(time_limit=0)
    with pytest.raises(UsageError, match="node_limit=0 is not allowed"):
        Milp(node_limit=0)
    with pytest.raises(UsageError, match="at least 1"):
        Milp(attempts=0)


def test_it_is_made_by_its_name():
    assert isinstance(make_agent("milp"), Milp)
