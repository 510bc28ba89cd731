"""What-if and N-1 beside LightSim2Grid, interleaved in one run, one thread.

``python benchmarks/what_if.py`` asks for many actions of everyday states (every element on busbar 1, rows of a
bundled series), and for the loss of every line. LightSim2Grid's actions are solved one at a time, the way its Grid2Op
backend drives its model: new topology, start, AC flow, currents; once from its DC solution and once from the
voltages of the base case, the faster of which counts. Its outages are ``ContingencyAnalysisCPP`` with flows. It
writes ``benchmarks/results/what_if.json``.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import lightsim2grid
import numba
import numpy as np

from rl2grid.arrays import I32
from rl2grid.engines.native.what_if import WhatIf
from rl2grid.engines.reference.extract import make_environment
from rl2grid.grids import Grid, load_grid
from rl2grid.mdp.actions import ActionCatalogue, ActionKind, full_catalogue, level_catalogue, moved_elements
from rl2grid.powerflow.batch import Snapshot
from rl2grid.powerflow.model import load_network
from rl2grid.scenarios.library import list_scenarios, load_scenario

GRIDS = ("bus14", "bus36-MO-v0", "bus118-M")
MOST_ACTIONS = 4000
"""Actions of the catalogue that are asked of both sides, drawn evenly; LightSim2Grid gets every tenth of them."""
_REPEATS = 3
"""How often every question is asked in a round, on either side."""


class LightSim:
    """The grid model behind a Grid2Op environment, driven as its backend drives it."""

    def __init__(self, grid: Grid, snapshot: Snapshot) -> None:
        from lightsim2grid.contingencyAnalysis import ContingencyAnalysisCPP

        self._grid, self._analysis = grid, ContingencyAnalysisCPP
        backend = make_environment(grid.bundled_names[0]).backend
        self._model, self._recipe = backend._grid.copy(), (backend.max_it, backend.tol)
        self._every = np.ones(grid.dim_topo, bool)
        self._cold = np.ones(2 * grid.n_sub, np.complex128)
        model = self._model
        model.update_topo(self._every, snapshot.topo_vect)
        model.update_gens_p(np.ones(grid.n_gen, bool), snapshot.gen_p)
        model.update_gens_v(np.ones(grid.n_gen, bool), snapshot.gen_v)
        model.update_loads_p(np.ones(grid.n_load, bool), snapshot.load_p)
        model.update_loads_q(np.ones(grid.n_load, bool), snapshot.load_q)
        self._base = model.ac_pf(model.dc_pf(self._cold.copy(), *self._recipe), *self._recipe)
        self._warm = np.where(self._base == 0, 1.0, self._base)
        self._topology = snapshot.topo_vect

    def actions(self, topologies: list[I32], warm: bool) -> list[float]:
        """Worst loadings, one topology at a time."""
        model, limit, worst = self._model, self._grid.thermal_limit, []
        for topo_vect in topologies:
            model.update_topo(self._every, topo_vect)
            if warm:
                start = self._warm.copy()
            else:
                model.deactivate_result_computation()
                start = model.dc_pf(self._cold.copy(), *self._recipe)
                model.reactivate_result_computation()
            if not len(start) or not len(model.ac_pf(start, *self._recipe)):
                model.tell_solver_need_reset()
                worst.append(np.inf)
                continue
            current = np.concatenate((model.get_line_res1()[3], model.get_trafo_res1()[3]))
            worst.append(float((current * 1000 / limit).max()))
        model.update_topo(self._every, self._topology)
        return worst

    def outages(self) -> Any:
        """Loadings after each outage, [outage, line]."""
        analysis = self._analysis(self._model)
        analysis.add_all_n1()
        analysis.compute(self._base, *self._recipe)
        return np.asarray(analysis.compute_flows()) * 1000 / self._grid.thermal_limit


def everyday_snapshot(grid: Grid, row: int) -> Snapshot:
    """A row of the first bundled series with every element on busbar 1."""
    series, network = load_scenario(grid.id, list_scenarios(grid.id, "bundled")[0]), load_network(grid)
    row %= series.n_rows
    setpoints = network.gen_setpoint if series.prod_v is None else series.prod_v[row] / network.gen_kilovolt
    return Snapshot(
        np.ones(grid.dim_topo, np.int32), np.ones(grid.dim_topo, np.int32), np.zeros(grid.n_line, np.int32),
        np.zeros(grid.n_sub, np.int32), np.array(series.prod_p[row]), np.asarray(setpoints, np.float32),
        np.array(series.load_p[row]), np.array(series.load_q[row]), np.zeros(grid.n_storage, np.float32),
    )  # fmt: skip


def topologies_after(grid: Grid, snapshot: Snapshot, catalogue: ActionCatalogue, ids: I32) -> list[I32]:
    """Topology vectors after actions from an undivided grid."""
    found = []
    for action in (catalogue[int(k)] for k in ids):
        topo_vect = snapshot.topo_vect.copy()
        for kind, target, mask in action.changes:
            if kind == ActionKind.MOVE:
                topo_vect[moved_elements(grid, target, mask)] = 2
            elif kind == ActionKind.SWITCH:
                topo_vect[[grid.line_or_pos_topo_vect[target], grid.line_ex_pos_topo_vect[target]]] = -1
        found.append(topo_vect)
    return found


def timed(samples: dict[str, list[float]], name: str, n: int, ask: Callable[..., Any], *arguments: Any) -> Any:
    """The answer; its processor time, microseconds for each of ``n`` questions, goes to the samples."""
    begin = time.thread_time_ns()
    for _ in range(_REPEATS):
        answer = ask(*arguments)
    samples.setdefault(name, []).append((time.thread_time_ns() - begin) / n / 1000 / _REPEATS)
    return answer


def measure(grid_id: str, rounds: int) -> dict[str, Any]:
    """All sides in turn, ``rounds`` times, another row of the series in each."""
    grid = load_grid(grid_id)
    solver, catalogue, small = WhatIf(grid), full_catalogue(grid), level_catalogue(grid, 0)
    draw = np.random.default_rng(0)
    ids = np.sort(draw.choice(len(catalogue), min(len(catalogue), MOST_ACTIONS), replace=False)).astype(np.int32)
    their_ids = ids if len(ids) < 1000 else ids[::10]
    samples: dict[str, list[float]] = {}
    worst_difference = worst_outage_difference = 0.0
    verdict_differences = 0
    for k in range(rounds):
        snapshot = everyday_snapshot(grid, 20 * k)
        lightsim = LightSim(grid, snapshot)
        topologies = topologies_after(grid, snapshot, catalogue, their_ids)
        rho = np.zeros((grid.n_line, grid.n_line), np.float32)
        solver.outages(snapshot)
        timed(samples, "ours_us", len(ids), solver.actions, snapshot, catalogue, ids)
        theirs = timed(samples, "dc_start_us", len(topologies), lightsim.actions, topologies, False)
        timed(samples, "warm_start_us", len(topologies), lightsim.actions, topologies, True)
        timed(samples, "level_0_us", len(small), solver.actions, snapshot, small)
        ours = solver.actions(snapshot, catalogue, their_ids).worst_loading
        timed(samples, "outages_us", grid.n_line, solver.outages, snapshot)
        outages = timed(samples, "contingency_analysis_us", grid.n_line, lightsim.outages)
        solver.outages(snapshot, rho=rho)
        finite = np.isfinite(ours)
        verdict_differences += int((finite != np.isfinite(theirs)).sum())
        both = finite & np.isfinite(theirs)
        worst_difference = max(worst_difference, float(np.abs(ours[both] - np.array(theirs)[both]).max()))
        solved = np.isfinite(rho[:, 0])
        verdict_differences += int((solved != (np.abs(outages).max(axis=1) > 0)).sum())
        worst_outage_difference = max(worst_outage_difference, float(np.abs(rho[solved] - outages[solved]).max()))
    row: dict[str, Any] = {name: _summary(values) for name, values in samples.items()}
    theirs_us = [min(pair) for pair in zip(samples["dc_start_us"], samples["warm_start_us"], strict=True)]
    row["ratio"] = _ratio(theirs_us, samples["ours_us"])
    row["ratio_level_0"] = _ratio(theirs_us, samples["level_0_us"])
    row["ratio_outages"] = _ratio(samples["contingency_analysis_us"], samples["outages_us"])
    return row | {
        "actions": len(ids),
        "verdict_differences": verdict_differences,
        "worst_difference": worst_difference,
        "worst_outage_difference": worst_outage_difference,
    }


def _ratio(theirs: list[float], ours: list[float]) -> dict[str, float]:
    return _summary([a / b for a, b in zip(theirs, ours, strict=True)])


def _summary(values: list[float]) -> dict[str, float]:
    return {"median": round(statistics.median(values), 2), "min": round(min(values), 2), "max": round(max(values), 2)}


def main() -> None:
    """Measure the grids and write the result."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--rounds", type=int, default=11)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "what_if.json")
    arguments = parser.parse_args()
    record: dict[str, Any] = {
        "command": "python benchmarks/what_if.py",
        "python": platform.python_version(),
        "numba": numba.__version__,
        "lightsim2grid": lightsim2grid.__version__,
        "processor": platform.machine(),
    }
    for grid_id in GRIDS:
        record[grid_id] = row = measure(grid_id, arguments.rounds)
        print(
            f"{grid_id:12} action {row['ours_us']['median']:5.2f} us, LightSim2Grid {row['dc_start_us']['median']:.0f} "
            f"(DC start), {row['warm_start_us']['median']:.0f} (warm): ratio {row['ratio']['median']:.1f}; level 0 "
            f"{row['level_0_us']['median']:.1f} us, ratio {row['ratio_level_0']['median']:.1f}; outage "
            f"{row['outages_us']['median']:.2f} us, LightSim2Grid {row['contingency_analysis_us']['median']:.1f}: "
            f"ratio {row['ratio_outages']['median']:.1f}; differing verdicts {row['verdict_differences']}, loadings by "
            f"{row['worst_difference']:.0e} and {row['worst_outage_difference']:.0e}"
        )
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
