"""What-if questions to the native engine: equal to simulate, to Grid2Op's solver, and the same on any threads."""

from __future__ import annotations

import functools
import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from grid2op_copies import copied_environment

from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.what_if import (
    Moment,
    WhatIf,
    first_safe,
    forecast_of,
    n_minus_1_score,
    snapshot_of,
    what_if,
)
from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.mdp.actions import ActionKind, full_catalogue, legal_actions
from rl2grid.mdp.termination import GameOver
from rl2grid.powerflow.batch import Snapshot
from rl2grid.scenarios.episodes import plan_episode

LOADING_TOLERANCE = 1e-4  # of the thermal limit
HARD_LIMIT = 1.99
"""Loading above which protections may act at once, with which what-ifs do not reckon."""


@functools.cache
def engine_of(grid_id: str) -> NativeEngine:
    return NativeEngine(load_grid(grid_id), 1)


@functools.cache
def solver_of(grid_id: str, num_threads: int = 1) -> WhatIf:
    return WhatIf(load_grid(grid_id), num_threads=num_threads)


def played(grid_id: str, number: int, steps: int = 12) -> NativeEngine:
    """An engine after some random legal topology actions that did not lose the game."""
    engine = engine_of(grid_id)
    grid, catalogue, draw = engine.grid, full_catalogue(engine.grid), np.random.default_rng(number)
    engine.reset(0, plan_episode(grid, "train", 0, number))
    for _ in range(steps):
        ids = draw.integers(len(catalogue), size=40).astype(np.int32)
        outcomes = what_if(engine, 0, catalogue, ids, Moment.NEXT_STEP)
        k = int(np.where(outcomes.legal, outcomes.worst_loading, np.inf).argmin())
        engine.step(0, catalogue[int(ids[k])])
        if engine.state.terminated[0] or engine.state.truncated[0]:
            engine.reset(0, plan_episode(grid, "train", 0, number))
            break
    return engine


def sample(grid_id: str, n: int, seed: int = 0) -> Any:
    """Ids that hold all line switches and moves from all over the catalogue."""
    grid = load_grid(grid_id)
    n_actions = len(full_catalogue(grid))
    draw = np.random.default_rng(seed)
    return np.concatenate((draw.integers(0, n_actions, n), np.arange(n_actions - grid.n_line, n_actions))).astype(
        np.int32
    )


def trips(engine: NativeEngine, rho: Any) -> bool:
    """Whether a protection opens a line in a next step with these loadings, as far as one can tell."""
    exhausted = engine.environments.hidden.protection[0] >= engine.environments.constants.overflow_allowed[0]
    return bool((rho > HARD_LIMIT).any() or (rho[exhausted] > 1 - LOADING_TOLERANCE).any())


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_the_next_step_is_what_simulate_says(grid_id: str) -> None:
    catalogue, ids = full_catalogue(load_grid(grid_id)), sample(grid_id, 150)
    compared = 0
    for number in range(3):
        engine = played(grid_id, number, steps=4 * (number + 1))
        outcomes = what_if(engine, 0, catalogue, ids, Moment.NEXT_STEP)
        forecast = forecast_of(engine, 0)
        assert forecast is not None
        rho = np.zeros((len(ids), engine.grid.n_line), np.float32)
        solver_of(grid_id).actions(forecast, catalogue, ids, rho)
        for k, action in enumerate(ids.tolist()):
            worst = float(outcomes.worst_loading[k])
            if not outcomes.legal[k] or (np.isfinite(worst) and trips(engine, rho[k])):
                continue
            state = engine.simulate(0, catalogue[action], 1)
            assert GameOver(outcomes.verdict[k]) == GameOver(state.game_over[0])
            if not state.terminated[0]:
                assert worst == pytest.approx(float(state.rho[0].max()), abs=LOADING_TOLERANCE)
                assert not state.illegal[0]
            compared += 1
    assert compared > 100


@pytest.mark.parametrize("grid_id", ["bus14", "bus36-MO-v1", "bus118-MOB-v1"])
def test_legality_and_the_present_are_those_observed(grid_id: str) -> None:
    engine = played(grid_id, 3, steps=4)
    catalogue = full_catalogue(engine.grid)
    ids = sample(grid_id, 200)
    outcomes = what_if(engine, 0, catalogue, ids)
    legal = np.zeros(len(ids), np.bool_)
    legal_actions(engine.state, 0, catalogue.kind[ids], catalogue.target[ids], legal)
    np.testing.assert_array_equal(outcomes.legal, legal)
    nothing = what_if(engine, 0, catalogue, np.zeros(1, np.int32))
    assert nothing.worst_loading[0] == pytest.approx(float(engine.state.rho[0].max()), abs=1e-6)
    assert nothing.overloads[0] == (engine.state.rho[0] > 1).sum()


@pytest.mark.parametrize("grid_id", ["bus14", "bus118-M"])
def test_threads_do_not_change_a_bit(grid_id: str) -> None:
    snapshot, catalogue, ids = (
        snapshot_of(played(grid_id, 1), 0),
        full_catalogue(load_grid(grid_id)),
        sample(grid_id, 700),
    )
    results = []
    for num_threads in (1, 2, 3):
        rho = np.zeros((len(ids), load_grid(grid_id).n_line), np.float32)
        results.append([*solver_of(grid_id, num_threads).actions(snapshot, catalogue, ids, rho), rho])
    for other in results[1:]:
        for mine, theirs in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(mine, theirs)


def test_a_small_question_is_answered_as_in_a_large_one_and_stays_answered() -> None:
    engine = played("bus36-MO-v0", 2)
    catalogue, ids = full_catalogue(engine.grid), sample("bus36-MO-v0", 200)
    every = what_if(engine, 0, catalogue, ids)
    answers = [what_if(engine, 0, catalogue, ids[k : k + 4]) for k in range(0, len(ids), 4)]
    for mine, theirs in zip(every, zip(*answers, strict=True), strict=True):
        np.testing.assert_array_equal(mine, np.concatenate(theirs))
    assert len(np.unique(every.worst_loading)) > 50


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_the_first_safe_action_is_the_first_that_the_what_if_calls_safe(grid_id: str) -> None:
    catalogue, random = full_catalogue(load_grid(grid_id)), np.random.default_rng(5)
    places = []
    for number in range(3):
        asked = forecast_of(played(grid_id, number), 0)
        assert asked is not None
        unsolvable = asked._replace(load_p=4 * asked.load_p, gen_p=4 * asked.gen_p)
        for snapshot in (asked, unsolvable):
            ids = random.permutation(np.append(sample(grid_id, 30, number)[:34], 0)).astype(np.int32)
            worst = solver_of(grid_id).actions(snapshot, catalogue, ids).worst_loading.astype(float)
            some = np.unique(worst[np.isfinite(worst)]) if np.isfinite(worst).any() else np.ones(1)
            for limit in (0.0, *np.quantile(some, (0.0, 0.02, 0.1, 0.5)).tolist(), np.inf):
                found = solver_of(grid_id).first_safe(snapshot, catalogue, ids, limit)
                safe = np.flatnonzero(worst < limit)
                expected = int(safe[0]) if len(safe) else int(worst.argmin())
                assert found == (expected, worst[expected], len(safe) > 0)
                places.append(expected)
    assert len(set(places)) > 2


def test_the_environments_first_safe_action_is_of_the_forecast() -> None:
    engine = played("bus118-M", 1)
    catalogue, ids = full_catalogue(engine.grid), sample("bus118-M", 10)
    worst = what_if(engine, 0, catalogue, ids, Moment.NEXT_STEP).worst_loading.astype(float)
    limit = float(np.unique(worst)[1])
    found = first_safe(engine, 0, catalogue, ids, limit)
    assert found == (np.flatnonzero(worst < limit)[0], worst.min(), True)
    present = what_if(engine, 0, catalogue, ids).worst_loading
    assert found.worst_loading not in present


def test_a_safe_action_is_found_among_some() -> None:
    engine = played("bus14", 1)
    with pytest.raises(UsageError, match="give at least one"):
        first_safe(engine, 0, full_catalogue(engine.grid), np.zeros(0, np.int32), 0.95)


def test_what_is_no_topology_action_of_the_catalogue_is_refused() -> None:
    engine = played("bus14", 1)
    catalogue = full_catalogue(engine.grid)
    for wrong in (-1, len(catalogue)):
        with pytest.raises(UsageError, match=f"Action {wrong} is none of the catalogue: give numbers from 0 to"):
            first_safe(engine, 0, catalogue, np.array([0, wrong], np.int32), 0.95)
    other = replace(catalogue, kind=np.full_like(catalogue.kind, ActionKind.RECONNECT))
    with pytest.raises(UsageError, match="others have no topology"):
        first_safe(engine, 0, other, np.array([0], np.int32), 0.95)


def test_a_stored_snapshot_answers_as_the_engine_does() -> None:
    engine = played("bus118-MOB-v0", 2)
    catalogue, ids = full_catalogue(engine.grid), sample("bus118-MOB-v0", 100)
    file = io.BytesIO()
    np.savez(file, **snapshot_of(engine, 0)._asdict())
    file.seek(0)
    with np.load(file) as arrays:
        stored = Snapshot(**dict(arrays))
    assert sum(array.nbytes for array in stored) < 8000
    direct = what_if(engine, 0, catalogue, ids)
    later = solver_of("bus118-MOB-v0").actions(stored, catalogue, ids)
    for mine, theirs in zip(direct, later, strict=True):
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_outages_are_the_switches_of_closed_lines(grid_id: str) -> None:
    engine = played(grid_id, 4)
    grid, catalogue, snapshot = engine.grid, full_catalogue(engine.grid), snapshot_of(engine, 0)
    solver = solver_of(grid_id)
    switches = np.arange(len(catalogue) - grid.n_line, len(catalogue), dtype=np.int32)
    opened, outages = solver.actions(snapshot, catalogue, switches), solver.outages(snapshot)
    closed = engine.state.line_status[0]
    np.testing.assert_array_equal(outages.was_open, ~closed)
    for name in ("worst_loading", "verdict", "overloads"):
        np.testing.assert_array_equal(getattr(outages, name)[closed], getattr(opened, name)[closed])
    assert (outages.worst_loading[~closed] == np.float32(engine.state.rho[0].max())).all()

    security = solver.security(snapshot)
    unsafe = (outages.overloads[closed] > 0) | np.isinf(outages.worst_loading[closed])
    assert security == (outages.worst_loading[closed].max(), unsafe.sum(), closed.sum())
    assert n_minus_1_score(engine, 0) == pytest.approx(1 - unsafe.mean())


@pytest.mark.parametrize("grid_id", ["bus14", "bus36-MO-v0", "bus118-M"])
def test_outages_are_those_of_lightsim2grid(grid_id: str) -> None:
    """Loadings within 1e-4 of the thermal limit; no flow where it finds none or would cut something off."""
    engine = engine_of(grid_id)
    grid = engine.grid
    engine.reset(0, plan_episode(grid, "train", 0, 0))
    snapshot = snapshot_of(engine, 0)
    rho = np.zeros((grid.n_line, grid.n_line), np.float32)
    outages = solver_of(grid_id).outages(snapshot, rho=rho)

    from lightsim2grid.contingencyAnalysis import ContingencyAnalysisCPP

    backend = copied_environment(grid.bundled_names[0]).backend
    model, recipe = backend._grid.copy(), (backend.max_it, backend.tol)
    model.update_topo(np.ones(grid.dim_topo, bool), snapshot.topo_vect)
    model.update_gens_p(np.ones(grid.n_gen, bool), snapshot.gen_p)
    model.update_gens_v(np.ones(grid.n_gen, bool), snapshot.gen_v)
    model.update_loads_p(np.ones(grid.n_load, bool), snapshot.load_p)
    model.update_loads_q(np.ones(grid.n_load, bool), snapshot.load_q)
    start = np.ones(2 * grid.n_sub, np.complex128)
    start = model.ac_pf(model.dc_pf(start, *recipe), *recipe)
    analysis = ContingencyAnalysisCPP(model)
    analysis.add_all_n1()
    analysis.compute(start, *recipe)
    currents = np.asarray(analysis.compute_flows()) * 1000
    found = np.abs(currents).max(axis=1) > 0
    solved = outages.verdict == 0
    np.testing.assert_array_equal(found, solved)
    np.testing.assert_allclose(rho[solved], (currents / grid.thermal_limit)[solved], rtol=0, atol=LOADING_TOLERANCE)


def test_a_forecast_that_generators_cannot_follow_dooms_every_action(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = played("bus14", 0)
    monkeypatch.setattr(engine, "foresee", lambda i, horizon: None)
    assert forecast_of(engine, 0) is None
    outcomes = what_if(engine, 0, full_catalogue(engine.grid), moment=Moment.NEXT_STEP)
    assert (outcomes.verdict == GameOver.DISPATCH).all()
    assert np.isinf(outcomes.worst_loading).all()
    assert first_safe(engine, 0, full_catalogue(engine.grid), sample("bus14", 3), 0.95) == (0, np.inf, False)


def test_looking_ahead_leaves_the_environment_as_it_was() -> None:
    engine = played("bus118-MOB-v1", 0)
    before = [array.copy() for array in (*engine.state, *engine.environments.hidden, *engine.environments.flow)]
    what_if(engine, 0, full_catalogue(engine.grid), sample("bus118-MOB-v1", 10), Moment.NEXT_STEP)
    n_minus_1_score(engine, 0)
    for old, new in zip(before, (*engine.state, *engine.environments.hidden, *engine.environments.flow), strict=True):
        np.testing.assert_array_equal(old, new)


def test_what_cannot_be_asked_is_refused() -> None:
    engine = NativeEngine(load_grid("bus14"), 1)
    grid, catalogue = engine.grid, full_catalogue(engine.grid)
    with pytest.raises(UsageError, match="reset the environment first"):
        snapshot_of(engine, 0)
    snapshot = snapshot_of(played("bus14", 0), 0)
    with pytest.raises(UsageError, match="rho must be"):
        solver_of("bus14").actions(snapshot, catalogue, rho=np.zeros((3, grid.n_line), np.float32))
    restore = type(catalogue)(
        np.array([ActionKind.RESTORE], np.int8), np.zeros(1, np.int32), np.zeros((1, 1), np.uint64)
    )
    with pytest.raises(UsageError, match="NOTHING, MOVE and SWITCH"):
        solver_of("bus14").actions(snapshot, restore)
    with pytest.raises(UsageError, match="num_threads"):
        WhatIf(grid, num_threads=0)


def test_a_game_over_cannot_be_asked_about() -> None:
    engine = engine_of("bus14")
    engine.reset(0, plan_episode(engine.grid, "train", 0, 0))
    catalogue = full_catalogue(engine.grid)
    fatal = int(np.isinf(what_if(engine, 0, catalogue).worst_loading).argmax())
    engine.step(0, catalogue[fatal])
    assert engine.state.terminated[0]
    with pytest.raises(UsageError, match="reset the environment first"):
        snapshot_of(engine, 0)
