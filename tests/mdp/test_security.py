"""What the losses do that may be expected, against dense algebra and against the AC flow, and who decides then."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.agents.contingencies import expected
from rl2grid.agents.dc_flow import buses, dc_point, is_connected, outage_factors, sensitivities
from rl2grid.engines.native.what_if import WhatIf, snapshot_of
from rl2grid.grids import load_grid
from rl2grid.handles import AsOpened
from rl2grid.mdp.heuristics import is_at_rest, is_safe
from rl2grid.mdp.security import Security, is_expected, is_secure, loading_after_loss, new_security
from rl2grid.mdp.state import GridState
from rl2grid.powerflow.model import load_network

ROUNDING = 1e-9
"""Of loadings: both sides solve the same equations in double precision, in another order."""
BY_DC = 0.05
"""Median distance of a worst loading after a loss from that of the AC flow."""


def may_be_lost(grid_id: str, attacks: bool = True) -> Security:
    grid = load_grid(grid_id)
    return new_security(grid, load_network(grid), attacks)


def loadings(security: Security, state: GridState, i: int) -> dict[int, float]:
    """Worst loading after the loss of each line that may be lost and is in service."""
    opened, state_opened = AsOpened[Security]()(security), AsOpened[GridState]()(state)
    lines = {k: int(line) for k, line in enumerate(security.line) if state.line_status[i, line]}
    return {line: loading_after_loss(opened, state_opened, i, k) for k, line in lines.items()}


def played(task: str, steps: int, seed: int) -> Any:
    """An environment after some steps at random, in an episode."""
    env = gymnasium.make(f"rl2grid/{task}-v0", disable_env_checker=True).unwrapped
    rng = np.random.default_rng(seed)
    env.reset(seed=seed)
    for _ in range(steps):
        _, _, terminated, truncated, _ = env.step(int(rng.choice(np.flatnonzero(env.action_masks()))))
        if terminated or truncated:
            env.reset()
    return env


def by_dense_algebra(grid, network, security, state, i):
    point = dc_point(state, i, grid, network)
    table, bus = sensitivities(grid, point), buses(grid, point.busbar)
    worst = {}
    for line in security.line[state.line_status[i, security.line]].tolist():
        factors = outage_factors(grid, table, bus, line)
        if factors is None:
            worst[line] = np.inf
            continue
        before = state.p_or[i].astype(np.float64)
        after = before + factors * before[line]
        square = state.rho[i].astype(np.float64) ** 2 + security.loading_per_mw**2 * (after**2 - before**2)
        worst[line] = float(np.sqrt(max(0.0, np.delete(square, line).max())))
    return worst


def test_losses_equal_those_of_dense_algebra_on_random_topologies(grid, random_rows):
    network, security = load_network(grid), may_be_lost(grid.id)
    compared = 0
    for i in np.flatnonzero(random_rows.line_status.any(axis=1)).tolist():
        if not is_connected(grid, random_rows.topo_vect[i]):
            continue
        found = loadings(security, random_rows, i)
        assert found == pytest.approx(by_dense_algebra(grid, network, security, random_rows, i), rel=ROUNDING)
        compared += len(found)
    assert compared >= len(security.line)


def test_nothing_may_be_lost_of_a_grid_that_is_in_two_parts(calm):
    grid = load_grid("bus36-MO-v0")
    state, security = calm(grid), may_be_lost(grid.id)
    pair = (grid.line_or_to_subid[0], grid.line_ex_to_subid[0])
    around = np.isin(grid.line_or_to_subid, pair) ^ np.isin(grid.line_ex_to_subid, pair)
    state.line_status[0, around] = False
    state.topo_vect[0, [*grid.line_or_pos_topo_vect[around], *grid.line_ex_pos_topo_vect[around]]] = -1
    assert set(loadings(security, state, 0).values()) == {np.inf}


def test_a_line_without_which_the_grid_falls_apart_may_not_be_lost(calm):
    grid = load_grid("bus36-MO-v0")
    state, security = calm(grid), may_be_lost(grid.id)
    last = int(security.line[0])
    others = grid.line_or_to_subid == grid.line_or_to_subid[last]
    others |= grid.line_ex_to_subid == grid.line_or_to_subid[last]
    others[last] = False
    state.line_status[0, others] = False
    state.topo_vect[0, [*grid.line_or_pos_topo_vect[others], *grid.line_ex_pos_topo_vect[others]]] = -1
    found = loadings(security, state, 0)
    assert found.pop(last) == np.inf
    assert max(found.values()) < np.inf


def test_a_topology_of_before_leaves_nothing_behind(random_rows, grid):
    rows = [i for i in range(len(random_rows.step)) if random_rows.line_status[i].any()][:4]
    used = may_be_lost(grid.id)
    for i in [*rows, *reversed(rows)]:
        assert loadings(used, random_rows, i) == loadings(may_be_lost(grid.id), random_rows, i)


@pytest.mark.parametrize("task", ["bus36-MO-v0-T1", "bus118-MOB-v1-T0"])
def test_losses_are_near_to_those_of_the_ac_flow(task):
    distances = []
    for seed in range(6):
        env = played(task, 4, seed)
        security = may_be_lost(env.grid.id)
        found = loadings(security, env.state, 0)
        outcomes = WhatIf(env.grid).outages(snapshot_of(env.engine, 0), np.array(list(found), np.int32))
        solved = outcomes.verdict == 0
        distances += list(np.abs(np.array(list(found.values())) - outcomes.worst_loading)[solved])
    assert len(distances) > 30
    assert np.median(distances) < BY_DC


@pytest.mark.parametrize("grid_id", ["bus14", "bus36-MO-v0", "bus118-MOB-v0", "bus118-MOB-v1"])
@pytest.mark.parametrize("attacked", [False, True])
def test_what_is_expected_is_what_planners_expect(grid_id, attacked):
    env = gymnasium.make(f"rl2grid/{grid_id}-T0-v0", disable_env_checker=True).unwrapped
    env.reset(seed=3)
    security, state = may_be_lost(grid_id), env.state
    state.time_next_maintenance[0] = -1
    state.time_next_maintenance[0, security.line[:3]] = 60, 61, 0
    state.line_status[0, security.line[3]] = False
    state.attacked[0, security.line[-1]] = attacked
    opened, state_opened = AsOpened[Security]()(security), AsOpened[GridState]()(state)
    found = {int(line) for k, line in enumerate(security.line) if is_expected(opened, state_opened, 0, k)}
    in_service = set(np.flatnonzero(state.line_status[0]).tolist())
    assert found & in_service == set(expected(env.grid, state).lines.tolist())


def test_without_attacks_only_announced_outages_are_expected():
    assert len(may_be_lost("bus36-MO-v0", attacks=False).line) == 0
    security = may_be_lost("bus118-MOB-v0", attacks=False)
    assert security.line.tolist() == sorted(load_grid("bus118-MOB-v0").maintenance.lines)
    assert not security.attackable.any()


def test_a_grid_on_which_nothing_can_be_lost_is_secure(calm):
    grid = load_grid("bus118-M")
    assert is_secure(AsOpened[Security]()(may_be_lost("bus118-M")), *2 * (AsOpened[GridState]()(calm(grid)), 0))


def test_the_agent_decides_until_units_are_back_at_rest():
    """Where the grid would bear every loss as well; that engines agree is compared elsewhere."""
    env = gymnasium.make("rl2grid/bus36-MO-v0-R-v0", heuristic="secure", disable_env_checker=True).unwrapped
    opened, row = AsOpened[Security]()(may_be_lost("bus36-MO-v0")), (AsOpened[GridState]()(env.state), 0)
    shift, asked_by_dispatch, longest = np.zeros(env.action_space.shape, np.float32), 0, 0
    shift[0] = 1.0
    for seed in range(4):
        env.reset(seed=seed)
        for action in (shift, *[0 * shift] * 150, -shift, *[0 * shift] * 150):
            _, _, terminated, truncated, info = env.step(action)
            if terminated or truncated:
                break
            at_ease = is_safe(*row) and is_secure(opened, *row, *row)
            assert not (at_ease and is_at_rest(*row))
            asked_by_dispatch += at_ease
            longest = max(longest, info["n_steps"])
    assert asked_by_dispatch > 0
    assert longest > 10, "at rest nobody is asked for long"


def test_the_agent_decides_while_a_loss_would_overload_a_line():
    """And nowhere else, but where the grid is unsafe already."""
    env = gymnasium.make("rl2grid/bus36-MO-v0-T0-v0", heuristic="secure", disable_env_checker=True).unwrapped
    security, state = may_be_lost("bus36-MO-v0"), env.state
    opened, row = AsOpened[Security]()(security), (AsOpened[GridState]()(state), 0)
    safe = 0
    for seed in range(4):
        _, info = env.reset(seed=seed)
        while not info["over"] and info["step"] < 300:
            assert not (is_safe(*row) and is_secure(opened, *row, *row))
            safe += bool(is_safe(*row))
            _, _, terminated, truncated, info = env.step(0)
            if terminated or truncated:
                break
    assert safe > 10
