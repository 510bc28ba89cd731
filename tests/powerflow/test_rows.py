"""Flows of rows and of outages equal cold flows one by one and LightSim2Grid's batches, whatever is beside them."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
from grid2op_copies import copied_environment

from rl2grid.errors import UsageError
from rl2grid.grids import Grid, load_grid
from rl2grid.powerflow import rows
from rl2grid.powerflow.ac import (
    CONVERGED,
    DISCONNECTED,
    DIVERGED,
    forget_flow,
    new_flow_state,
    run_flow,
    write_currents,
    write_flow,
)
from rl2grid.powerflow.bridges import find_bridges, find_cuts
from rl2grid.powerflow.model import load_network
from rl2grid.powerflow.rows import RowFlows, RowSolver
from rl2grid.scenarios.library import list_scenarios, load_scenario

GRID_IDS = ("bus14", "bus118-M", "bus118-MOB-v1")
CURRENT_TOLERANCE = 1e-4  # A; beside it float32 is allowed two units in the last place
POWER_TOLERANCE = 1e-4  # MW; likewise
FLOAT32 = 2 * float(np.finfo(np.float32).eps)

Rows = list[Any]
"""Arguments of :meth:`RowSolver.flows`."""


@functools.cache
def bundled_rows(grid_id: str) -> Rows:
    """All rows of the first bundled series, with storage idle."""
    grid, series = load_grid(grid_id), load_scenario(grid_id, list_scenarios(grid_id, "bundled")[0])
    network, n = load_network(grid), series.n_rows
    setpoints = (
        np.repeat(network.gen_setpoint[None], n, 0) if series.prod_v is None else series.prod_v / network.gen_kilovolt
    )
    return [
        np.array(series.load_p),
        np.array(series.load_q),
        np.array(series.prod_p),
        np.array(setpoints, np.float64),
        np.zeros((n, grid.n_storage), np.float32),
    ]


def random_rows(grid_id: str, n: int, lowest: float, highest: float) -> Rows:
    """Rows of the series, scaled, with noise on loads and set-points; the first as it is."""
    draw, every = np.random.default_rng(0), bundled_rows(grid_id)
    chosen = draw.integers(0, len(every[0]), n)
    load_p, load_q, gen_p, gen_v, storage_p = (array[chosen] for array in every)
    scale = np.concatenate(([1.0], draw.uniform(lowest, highest, n - 1))).astype(np.float32)[:, None]
    load_p = load_p * scale * draw.normal(1, 0.03, load_p.shape).astype(np.float32)
    gen_v = gen_v * draw.normal(1, 0.002, (n, 1))
    return [load_p, load_q * scale, gen_p * scale, gen_v, storage_p + draw.normal(0, 2, storage_p.shape)]


def divided_topology(grid: Grid) -> Any:
    """Two substations divided and a line open, none of which cuts the grid in two."""
    network, topo_vect = load_network(grid), np.ones(grid.dim_topo, np.int32)
    flow, row = new_flow_state(network, 1), [array[0] for array in bundled_rows(grid.id)]
    draw, divided = np.random.default_rng(3), 0
    line = int(np.flatnonzero(~find_bridges(network, topo_vect))[2])
    topo_vect[[grid.line_or_pos_topo_vect[line], grid.line_ex_pos_topo_vect[line]]] = -1
    while divided < 2:
        tried = topo_vect.copy()
        here = np.flatnonzero(grid.element_to_subid == draw.choice(np.flatnonzero(grid.sub_info >= 5)))
        tried[here] = np.where(tried[here] > 0, draw.integers(1, 3, len(here)), -1)
        arguments = (row[2], row[3], row[0], row[1], row[4])
        if tried.max() == 2 and run_flow(network, flow, 0, tried, *arguments) == CONVERGED:
            topo_vect, divided = tried, divided + 1
    return topo_vect


class ColdFlows:
    """The cold recipe, one flow after another."""

    def __init__(self, grid: Grid, topo_vect: Any) -> None:
        self.grid, self.network, self.topo_vect = grid, load_network(grid), topo_vect
        self.flow = new_flow_state(self.network, 1)

    def check(self, found: RowFlows, case: int, row: Rows, line: int | None = None) -> int:
        """See that a flow is what the cold recipe finds; its status."""
        grid, topo_vect, (load_p, load_q, gen_p, gen_v, storage_p) = self.grid, self.topo_vect.copy(), row
        if line is not None:
            topo_vect[[grid.line_or_pos_topo_vect[line], grid.line_ex_pos_topo_vect[line]]] = -1
        forget_flow(self.flow, 0)
        arguments = (gen_p, gen_v, load_p, load_q, np.asarray(storage_p, np.float32))
        status = run_flow(self.network, self.flow, 0, topo_vect, *arguments)
        assert found.status[case] == status
        a_or, p_or = np.zeros(grid.n_line, np.float32), np.zeros(grid.n_line, np.float32)
        produced = np.zeros(grid.n_gen, np.float32)
        if status == CONVERGED:
            unused = (np.zeros(n, np.float32) for n in (grid.n_gen, grid.n_load, grid.n_storage))
            write_currents(self.network, self.flow, 0, a_or)
            write_flow(self.network, self.flow, 0, p_or, produced, *unused)
        np.testing.assert_allclose(found.a_or[case], a_or, FLOAT32, CURRENT_TOLERANCE)
        np.testing.assert_allclose(found.p_or[case], p_or, FLOAT32, POWER_TOLERANCE)
        np.testing.assert_allclose(found.slack_p[case], produced[grid.slack_gen], FLOAT32, POWER_TOLERANCE)
        return int(status)


@pytest.mark.parametrize("grid_id", GRID_IDS)
@pytest.mark.parametrize("divided", [False, True])
def test_rows_equal_cold_flows(grid_id: str, divided: bool) -> None:
    """Everyday rows are solved in lanes, with the cold recipe's results."""
    grid = load_grid(grid_id)
    topo_vect = divided_topology(grid) if divided else np.ones(grid.dim_topo, np.int32)
    given = random_rows(grid_id, 45, 0.8, 1.1)
    found, cold = RowSolver(grid, topo_vect=topo_vect).flows(*given), ColdFlows(grid, topo_vect)
    for k, row in enumerate(zip(*given, strict=True)):
        cold.check(found, k, list(row))
    assert found.cold.mean() < 0.1


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_rows_without_solution_have_the_cold_recipes_verdict(grid_id: str) -> None:
    """From everyday rows to ones far beyond collapse."""
    grid, given = load_grid(grid_id), random_rows(grid_id, 60, 1.0, 9.0)
    topo_vect = np.ones(grid.dim_topo, np.int32)
    found, cold = rows.flows(grid_id, *given), ColdFlows(grid, topo_vect)
    statuses = [cold.check(found, k, list(row)) for k, row in enumerate(zip(*given, strict=True))]
    assert {CONVERGED, DIVERGED} == set(statuses)
    assert found.cold[found.status != CONVERGED].all()


@pytest.mark.parametrize("grid_id", GRID_IDS)
@pytest.mark.parametrize("divided", [False, True])
def test_outages_equal_cold_flows(grid_id: str, divided: bool) -> None:
    """The loss of every line, and of one that is open."""
    grid = load_grid(grid_id)
    topo_vect = divided_topology(grid) if divided else np.ones(grid.dim_topo, np.int32)
    row = [array[0] for array in random_rows(grid_id, 1, 1.0, 1.0)]
    found, cold = rows.outages(grid_id, *row, topo_vect=topo_vect), ColdFlows(grid, topo_vect)
    statuses = [cold.check(found, line, row, line) for line in range(grid.n_line)]
    bridges = find_bridges(cold.network, topo_vect)
    assert DISCONNECTED in statuses
    cuts = find_cuts(cold.network, topo_vect)
    assert cuts.tolist() == [status == DISCONNECTED for status in statuses]
    assert (found.cold[bridges] == ~cuts[bridges]).all()
    assert found.cold[~bridges].mean() < 0.3


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_a_flow_does_not_depend_on_its_company(grid_id: str) -> None:
    """Rows and outages in another order, and fewer of them, have the same bits."""
    solver, given = RowSolver(load_grid(grid_id)), random_rows(grid_id, 45, 0.5, 4.0)
    every = solver.flows(*given)
    order = np.concatenate(([0], 1 + np.random.default_rng(1).permutation(44)[:30]))
    some = RowSolver(solver.grid).flows(*(array[order] for array in given))
    for name in RowFlows._fields:
        assert getattr(every, name)[order].tobytes() == getattr(some, name).tobytes()
    row = [array[0] for array in given]
    lines = np.random.default_rng(1).permutation(solver.grid.n_line)[:13]
    every, some = solver.outages(*row), solver.outages(*row, lines=lines)
    for name in RowFlows._fields:
        assert getattr(every, name)[lines].tobytes() == getattr(some, name).tobytes()


@pytest.mark.parametrize("grid_id", ["bus14", "bus118-M"])
def test_flows_equal_lightsim2grid(grid_id: str) -> None:
    """Currents beside the batches of LightSim2Grid."""
    from lightsim2grid.contingencyAnalysis import ContingencyAnalysisCPP
    from lightsim2grid.timeSerie import TimeSeriesCPP

    grid, (load_p, load_q, gen_p, _, _) = load_grid(grid_id), [array[:40] for array in bundled_rows(grid_id)]
    backend = copied_environment(grid.bundled_names[0]).backend
    model, recipe = backend._grid.copy(), (backend.max_it, backend.tol)
    model.update_gens_p(np.ones(grid.n_gen, bool), gen_p[0])
    model.update_loads_p(np.ones(grid.n_load, bool), load_p[0])
    model.update_loads_q(np.ones(grid.n_load, bool), load_q[0])
    model.update_gens_v(np.ones(grid.n_gen, bool), load_network(grid).gen_setpoint.astype(np.float32))
    base = model.ac_pf(np.ones(2 * grid.n_sub, complex), *recipe)
    setpoints = load_network(grid).gen_setpoint.astype(np.float32)

    series = TimeSeriesCPP(model)
    doubles = [np.ascontiguousarray(array, np.float64) for array in (gen_p, np.zeros((40, 0)), load_p, load_q)]
    series.compute_Vs(*doubles, base, *recipe)
    ours = rows.flows(grid_id, load_p, load_q, gen_p, np.repeat(setpoints[None], 40, 0))
    np.testing.assert_allclose(ours.a_or, 1000 * np.asarray(series.compute_flows()), FLOAT32, CURRENT_TOLERANCE)

    analysis = ContingencyAnalysisCPP(model)
    analysis.add_all_n1()
    analysis.compute(base, *recipe)
    after = rows.outages(grid_id, load_p[0], load_q[0], gen_p[0], setpoints)
    theirs = 1000 * np.asarray(analysis.compute_flows())
    solved = after.status == CONVERGED
    assert (solved == (np.abs(theirs).max(axis=1) > 0)).all()
    np.testing.assert_allclose(after.a_or[solved], theirs[solved], FLOAT32, CURRENT_TOLERANCE)


def test_what_is_no_flow() -> None:
    """Rows with numbers that are none, generators that disagree, and topologies in pieces."""
    grid_id, given = "bus36-M", random_rows("bus36-M", 12, 1.0, 1.0)
    grid = load_grid(grid_id)
    expected = rows.flows(grid_id, *given)
    spoiled = [array.copy() for array in given]
    at_slack = int(np.flatnonzero(grid.load_to_subid == grid.gen_to_subid[grid.slack_gen])[0])
    spoiled[0][1, at_slack], spoiled[1][3, 0], spoiled[2][5, 0] = np.nan, np.inf, np.nan
    assert grid.gen_to_subid[2] == grid.gen_to_subid[3]
    spoiled[3][7, 3] += 1e-3
    spoiled[3][9, 1] = np.nan
    found = rows.flows(grid_id, *spoiled)
    bad = [1, 3, 5, 7, 9]
    assert (found.status[bad] == DIVERGED).all()
    assert not found.a_or[bad].any()
    assert not found.slack_p[bad].any()
    good = np.setdiff1d(np.arange(12), bad)
    assert found.a_or[good].tobytes() == expected.a_or[good].tobytes()

    assert (rows.flows(grid_id, *(array[[1, 3]] for array in spoiled)).status == DIVERGED).all()
    topo_vect = np.ones(grid.dim_topo, np.int32)
    topo_vect[grid.load_pos_topo_vect[0]] = -1
    assert (rows.flows(grid_id, *given, topo_vect=topo_vect).status == DISCONNECTED).all()
    assert (rows.outages(grid_id, *(array[0] for array in given), topo_vect=topo_vect).status == DISCONNECTED).all()
    assert rows.flows(grid_id, *(array[:0] for array in given)).a_or.shape == (0, grid.n_line)


def test_disconnected_storage_must_be_idle() -> None:
    """As LightSimBackend has it."""
    grid, given = load_grid("bus118-MOB-v1"), [array[:9] for array in bundled_rows("bus118-MOB-v1")]
    topo_vect = np.ones(grid.dim_topo, np.int32)
    topo_vect[grid.storage_pos_topo_vect[0]] = -1
    given[4] = given[4].copy()
    given[4][3, 0] = 1.0
    found = rows.flows(grid.id, *given, topo_vect=topo_vect)
    assert found.status.tolist() == [CONVERGED] * 3 + [DISCONNECTED] + [CONVERGED] * 5
    assert np.flatnonzero(found.cold).tolist() == [3]


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_bridges_are_the_lines_that_cut(grid_id: str) -> None:
    """Beside counting the parts without each line."""
    grid = load_grid(grid_id)
    topo_vect = divided_topology(grid)
    origins = grid.line_or_to_subid + grid.n_sub * (topo_vect[grid.line_or_pos_topo_vect] - 1)
    extremities = grid.line_ex_to_subid + grid.n_sub * (topo_vect[grid.line_ex_pos_topo_vect] - 1)
    closed = set(np.flatnonzero(topo_vect[grid.line_or_pos_topo_vect] > 0).tolist())

    def n_parts(lines: set[int]) -> int:
        part = list(range(2 * grid.n_sub))
        for _ in part:
            before = part.copy()
            for line in lines:
                part[origins[line]] = part[extremities[line]] = min(part[origins[line]], part[extremities[line]])
            if part == before:
                break
        return len(set(part))

    whole = n_parts(closed)
    expected = [line in closed and n_parts(closed - {line}) > whole for line in range(grid.n_line)]
    assert find_bridges(load_network(grid), topo_vect).tolist() == expected


def test_bad_input_gets_one_sentence() -> None:
    """Which array, and what is allowed."""
    load_p, load_q, gen_p, gen_v, storage_p = (array[:3] for array in bundled_rows("bus14"))
    with pytest.raises(UsageError, match="does not exist"):
        rows.flows("bus15", load_p, load_q, gen_p)
    with pytest.raises(UsageError, match=r"load_p must have 3 rows with 11 entries each, got shape \(2, 11\)"):
        rows.flows("bus14", load_p[:2], load_q, gen_p)
    with pytest.raises(UsageError, match=r"gen_p must have any number of rows with 6 entries each, got shape \(6,\)"):
        rows.flows("bus14", load_p, load_q, gen_p[0])
    with pytest.raises(UsageError, match="gen_v must be an array of numbers"):
        rows.flows("bus14", load_p, load_q, gen_p, "high")
    with pytest.raises(UsageError, match="topo_vect must hold the busbar 1 or 2, or -1, of each of the"):
        rows.flows("bus14", load_p, load_q, gen_p, topo_vect=[1, 2])
    with pytest.raises(UsageError, match="lines must be numbers from 0 to 19 on bus14"):
        rows.outages("bus14", load_p[0], load_q[0], gen_p[0], lines=[20])
    with pytest.raises(UsageError, match="lines must be a list of line numbers"):
        rows.outages("bus14", load_p[0], load_q[0], gen_p[0], lines=[0.5])
    single = rows.outages("bus14", load_p[0], load_q[0], gen_p[0], gen_v[0], storage_p[0], lines=[3])
    assert single.a_or.shape == (1, 20)
    assert single.a_or[0, 3] == 0.0
