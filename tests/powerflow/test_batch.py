"""Batched flows equal cold flows of the same topologies, one by one: verdict, reason and loadings."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest

from rl2grid.grids import GRID_IDS, Grid, load_grid
from rl2grid.handles import Handle
from rl2grid.mdp.actions import full_catalogue, mask_integer, moved_elements
from rl2grid.mdp.state import new_state
from rl2grid.mdp.termination import GameOver, game_over_reason
from rl2grid.powerflow import batch
from rl2grid.powerflow.ac import CONVERGED, forget_flow, new_flow_state, run_flow, write_currents
from rl2grid.powerflow.batch import (
    MOVE,
    NOTHING,
    SWITCH,
    UNASKED,
    BatchSolver,
    Changes,
    Snapshot,
    new_outcomes,
    new_snapshot,
    new_wiring,
)
from rl2grid.powerflow.model import load_network
from rl2grid.scenarios.library import list_scenarios, load_scenario

LOADING_TOLERANCE = 1e-4  # of the thermal limit
STRESS = (1.0, 1.0, 1.3, 1.7, 2.2, 3.0)
"""Factors on all injections: from everyday states to ones without any solution."""


class Case:
    """A grid, its batched flows, and the cold flow beside them."""

    def __init__(self, grid_id: str) -> None:
        self.grid: Grid = load_grid(grid_id)
        self.network = load_network(self.grid)
        self.snapshot = new_snapshot(self.grid)
        self.solver = BatchSolver(self.grid, self.network, new_wiring(self.grid, self.network), self.snapshot)
        self.flow = new_flow_state(self.network, 1)
        self.state = new_state(self.grid, 1)
        self.scenario = load_scenario(grid_id, list_scenarios(grid_id, "bundled")[0])

    def load(self, snapshot: Snapshot) -> None:
        for kept, array in zip(self.snapshot, snapshot, strict=True):
            np.copyto(kept, array)

    def random_snapshot(self, draw: np.random.Generator, stress: float) -> Snapshot:
        """A row of the series with some substations divided, lines open and storage in use."""
        grid, series = self.grid, self.scenario
        row, scale = draw.integers(series.n_rows), np.float32(stress)
        setpoints = (
            self.network.gen_setpoint if series.prod_v is None else series.prod_v[row] / self.network.gen_kilovolt
        )
        topo_vect = np.ones(grid.dim_topo, np.int32)
        for sub in draw.choice(grid.n_sub, draw.integers(0, 4)):
            here = np.flatnonzero(grid.element_to_subid == sub)
            if len(here) >= 4:
                topo_vect[here] = draw.integers(1, 3, len(here))
        last_bus = topo_vect.copy()
        for line in draw.choice(grid.n_line, draw.integers(0, 4)):
            topo_vect[[grid.line_or_pos_topo_vect[line], grid.line_ex_pos_topo_vect[line]]] = -1
        storage_p = draw.normal(0, 3, grid.n_storage) * (draw.random() < 0.5)
        return Snapshot(
            topo_vect,
            last_bus,
            np.zeros(grid.n_line, np.int32),
            np.zeros(grid.n_sub, np.int32),
            scale * np.array(series.prod_p[row]),
            np.asarray(setpoints, np.float32),
            scale * np.array(series.load_p[row]),
            scale * np.array(series.load_q[row]),
            storage_p.astype(np.float32),
        )

    def random_changes(self, draw: np.random.Generator, n: int) -> Changes:
        """Nothing, every line, and moves spread evenly over the substations."""
        catalogue, grid = full_catalogue(self.grid), self.grid
        moves = np.flatnonzero(catalogue.kind == MOVE)
        bounds = np.searchsorted(catalogue.target[moves], np.arange(grid.n_sub + 1))
        subs = draw.choice(np.flatnonzero(np.diff(bounds) > 0), n)
        chosen = moves[draw.integers(bounds[subs], bounds[subs + 1])]
        kind = np.repeat([NOTHING, SWITCH, MOVE], [1, grid.n_line, n]).astype(np.int8)
        target = np.concatenate(([0], np.arange(grid.n_line), catalogue.target[chosen])).astype(np.int32)
        mask = np.concatenate((np.zeros((1 + grid.n_line, 1), np.uint64), catalogue.mask[chosen]))
        return Changes(kind, target, mask)

    def solve(self, snapshot: Snapshot, changes: Changes, order: Any = None) -> batch.ChangeOutcomes:
        """All changes, or those of ``order``, in one call."""
        self.load(snapshot)
        n = len(changes.kind)
        outcomes = new_outcomes(n, np.full((n, self.grid.n_line), np.nan, np.float32))
        if order is None:
            order = np.lexsort((changes.target, changes.kind)).astype(np.int32)
        self.solver.solve(Handle(changes), Handle(outcomes), order)
        return outcomes

    def topology_after(self, snapshot: Snapshot, kind: int, target: int, mask: int) -> Any:
        """Written anew, so that it can disagree."""
        grid, topo_vect = self.grid, snapshot.topo_vect.copy()
        if kind == MOVE:
            moved = moved_elements(grid, target, mask)
            moved = moved[topo_vect[moved] > 0]
            topo_vect[moved] = 3 - topo_vect[moved]
        if kind == SWITCH:
            ends = [grid.line_or_pos_topo_vect[target], grid.line_ex_pos_topo_vect[target]]
            topo_vect[ends] = -1 if topo_vect[ends[0]] > 0 else snapshot.last_bus[ends]
        return topo_vect

    def solve_cold(self, snapshot: Snapshot, topo_vect: Any) -> tuple[GameOver, Any]:
        """Reason and loadings of a topology, from a cold flow."""
        forget_flow(self.flow, 0)
        if run_flow(self.network, self.flow, 0, topo_vect, *snapshot[4:]) == CONVERGED:
            current = np.zeros(self.grid.n_line, np.float32)
            write_currents(self.network, self.flow, 0, current)
            return GameOver.NONE, current / self.grid.thermal_limit
        self.state.final_topo_vect[0] = topo_vect
        self.state.storage_power[0] = snapshot.storage_p
        return GameOver(game_over_reason(self.state, 0)), np.full(self.grid.n_line, np.inf, np.float32)


@functools.cache
def case_of(grid_id: str) -> Case:
    return Case(grid_id)


def assert_like_cold_flows(case: Case, snapshot: Snapshot, changes: Changes, outcomes: batch.ChangeOutcomes) -> None:
    for k, (kind, target, words) in enumerate(zip(*changes, strict=True)):
        change = int(kind), int(target), mask_integer(words)
        reason, rho = case.solve_cold(snapshot, case.topology_after(snapshot, *change))
        assert GameOver(outcomes.verdict[k]) == reason, change
        np.testing.assert_allclose(outcomes.rho[k], rho, rtol=0, atol=LOADING_TOLERANCE, err_msg=str(change))
        assert outcomes.worst_loading[k] == outcomes.rho[k].max()
        assert outcomes.overloads[k] == (0 if reason else (outcomes.rho[k] > 1).sum())


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_every_verdict_and_loading_is_that_of_a_cold_flow(grid_id: str) -> None:
    case, draw = case_of(grid_id), np.random.default_rng(11)
    verdicts: set[int] = set()
    batched = 0
    for stress in STRESS:
        snapshot, changes = case.random_snapshot(draw, stress), case.random_changes(draw, 120)
        outcomes = case.solve(snapshot, changes)
        assert_like_cold_flows(case, snapshot, changes, outcomes)
        verdicts |= set(outcomes.verdict.tolist())
        batched += int((~outcomes.cold & (outcomes.verdict == 0)).sum())
    assert {GameOver.NONE, GameOver.LOAD_DISCONNECTED, GameOver.ISLAND} <= verdicts
    assert batched > 100, "the sample asks the cold recipe only"


@pytest.mark.slow
@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_more_states(grid_id: str) -> None:
    case, draw = case_of(grid_id), np.random.default_rng(5)
    for k in range(40):
        snapshot, changes = case.random_snapshot(draw, STRESS[k % len(STRESS)]), case.random_changes(draw, 300)
        assert_like_cold_flows(case, snapshot, changes, case.solve(snapshot, changes))


@pytest.mark.parametrize("grid_id", ["bus14", "bus118-MOB-v0"])
def test_a_change_has_the_same_outcome_in_any_company(grid_id: str) -> None:
    case, draw = case_of(grid_id), np.random.default_rng(2)
    snapshot, changes = case.random_snapshot(draw, 1.0), case.random_changes(draw, 80)
    together = case.solve(snapshot, changes)
    for k in range(len(changes.kind)):
        alone = case.solve(snapshot, changes, np.array([k], np.int32))
        for name in together._fields:
            np.testing.assert_array_equal(getattr(alone, name)[k], getattr(together, name)[k], name)
        if k:
            assert np.isnan(alone.rho[k - 1]).all(), "an outcome was written that nobody asked for"


def test_behind_the_first_safe_change_only_its_company_is_solved() -> None:
    case, draw = case_of("bus36-MO-v0"), np.random.default_rng(4)
    snapshot, changes = case.random_snapshot(draw, 1.0), case.random_changes(draw, 60)
    every = case.solve(snapshot, changes)
    for limit in (0.0, float(np.quantile(every.worst_loading, 0.01)), float(every.worst_loading[5]), np.inf):
        outcomes = new_outcomes(len(changes.kind), np.zeros((0, case.grid.n_line), np.float32))
        company = np.zeros(len(changes.kind), np.int32)
        case.load(snapshot)
        found = case.solver.find_safe(Handle(changes), Handle(outcomes), limit, company)
        safe = np.flatnonzero(every.worst_loading < limit)
        assert found == (safe[0] if len(safe) else every.worst_loading.argmin())
        groups = [(kind, target if kind == MOVE else 0) for kind, target in zip(*changes[:2], strict=True)]
        tried = set(groups if not len(safe) else groups[: found + 1])
        asked = np.array([group in tried for group in groups])
        np.testing.assert_array_equal(outcomes.verdict != UNASKED, asked)
        np.testing.assert_array_equal(outcomes.worst_loading[asked], every.worst_loading[asked])


def test_most_changes_of_an_everyday_state_need_no_cold_flow() -> None:
    for grid_id, most in (("bus14", 0.1), ("bus36-MO-v0", 0.03), ("bus118-M", 0.05)):
        case, draw = case_of(grid_id), np.random.default_rng(0)
        snapshot = case.random_snapshot(draw, 1.0)
        snapshot = snapshot._replace(topo_vect=np.ones_like(snapshot.topo_vect))
        outcomes = case.solve(snapshot, case.random_changes(draw, 400))
        assert outcomes.cold.mean() < most


def test_without_a_base_case_every_change_is_solved_cold() -> None:
    case, draw = case_of("bus14"), np.random.default_rng(3)
    snapshot = case.random_snapshot(draw, 1.0)
    topo_vect = np.ones_like(snapshot.topo_vect)
    sub = int(case.grid.load_to_subid[0])
    here = np.flatnonzero(case.grid.element_to_subid == sub)
    topo_vect[here] = 2
    topo_vect[case.grid.load_pos_topo_vect[0]] = 1  # the load is alone on its busbar
    snapshot = snapshot._replace(topo_vect=topo_vect, last_bus=topo_vect)
    changes = case.random_changes(draw, 60)
    outcomes = case.solve(snapshot, changes)
    assert outcomes.cold.all()
    assert outcomes.verdict[0] == GameOver.LOAD_DISCONNECTED
    assert (outcomes.verdict == 0).any(), "no move brings the load back"
    assert_like_cold_flows(case, snapshot, changes, outcomes)


def test_verdicts_are_numbered_as_game_overs() -> None:
    names = ("SOLVED", "LOAD_CUT_OFF", "GENERATOR_CUT_OFF", "STORAGE_CUT_OFF", "ISLAND", "NO_SOLUTION")
    assert [getattr(batch, name) for name in names] == [int(reason) for reason in list(GameOver)[: len(names)]]
