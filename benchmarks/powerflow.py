"""Our AC power flow beside LightSim2Grid's, interleaved in one run, one thread.

``python benchmarks/powerflow.py`` solves consecutive rows of a bundled series, without and with another random
division of a substation before every flow. Ours includes currents, line powers and angles; LightSim2Grid's is what
its Grid2Op backend asks of it: injections (and topology, where it changes), DC start and AC flow, whose results
include currents and angles. It writes ``benchmarks/results/powerflow.json``.
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

from rl2grid.arrays import F32, I32
from rl2grid.engines.reference.extract import make_environment
from rl2grid.grids import Grid, load_grid
from rl2grid.powerflow.ac import CONVERGED, FlowState, new_flow_state, run_flow, write_currents, write_flow
from rl2grid.powerflow.model import Network, load_network
from rl2grid.scenarios.library import list_scenarios, load_scenario

GRIDS = ("bus14", "bus36-M", "bus118-M", "bus118-MOB-v1")
Rows = tuple[F32, Any, F32, F32, F32]


@numba.njit(nogil=True)  # type: ignore[untyped-decorator]
def solve_rows(network: Network, flow: FlowState, topo_vects: I32, rows: Rows, results: tuple[F32, ...]) -> int:
    """Solve every row with the topologies in turn; how many converged."""
    gen_p, gen_v, load_p, load_q, storage_p = rows
    converged = 0
    for t in range(gen_p.shape[0]):
        topo_vect = topo_vects[t % topo_vects.shape[0]]
        status = run_flow(network, flow, 0, topo_vect, gen_p[t], gen_v[t], load_p[t], load_q[t], storage_p[t])
        if status == CONVERGED:
            converged += 1
            write_currents(network, flow, 0, results[0])
            write_flow(network, flow, 0, results[1], results[2], results[3], results[4], results[5])
    return converged


class LightSim:
    """The grid model behind a Grid2Op environment, driven as its backend drives it."""

    def __init__(self, grid: Grid) -> None:
        backend = make_environment(grid.bundled_names[0]).backend
        self._model = backend._grid.copy()
        self._recipe = (backend.max_it, backend.tol)
        self._start = np.ones(2 * grid.n_sub, np.complex128)
        self._every = [np.ones(n, bool) for n in (grid.dim_topo, grid.n_gen, grid.n_load, grid.n_storage)]

    def solve_rows(self, topo_vects: I32, rows: Rows) -> int:
        """Solve every row with the topologies in turn; how many converged."""
        model = self._model
        every_element, every_gen, every_load, every_storage = self._every
        converged = 0
        for t, (gen_p, gen_v, load_p, load_q, storage_p) in enumerate(zip(*rows, strict=True)):
            if len(topo_vects) > 1 or t == 0:
                model.update_topo(every_element, topo_vects[t % len(topo_vects)])
            model.update_gens_p(every_gen, gen_p)
            model.update_gens_v(every_gen, gen_v)
            model.update_loads_p(every_load, load_p)
            model.update_loads_q(every_load, load_q)
            if len(storage_p):
                model.update_storages_p(every_storage, storage_p)
            model.deactivate_result_computation()
            start = model.dc_pf(self._start.copy(), *self._recipe)
            model.reactivate_result_computation()
            converged += bool(len(model.ac_pf(start, *self._recipe)))
        return converged


def injections(grid: Grid, network: Network, n_rows: int) -> Rows:
    """Consecutive rows of the first bundled series."""
    scenario = load_scenario(grid.id, list_scenarios(grid.id, "bundled")[0])
    n = min(n_rows, scenario.n_rows)
    setpoint = np.repeat(network.gen_setpoint[None].astype(np.float32), n, 0)
    gen_v = setpoint if scenario.prod_v is None else np.array(scenario.prod_v[:n] / network.gen_kilovolt)
    storage_p = np.zeros((n, grid.n_storage), np.float32)
    return np.array(scenario.prod_p[:n]), gen_v, np.array(scenario.load_p[:n]), np.array(scenario.load_q[:n]), storage_p


def divided_topologies(grid: Grid, solve: Callable[[I32], int], n: int) -> I32:
    """``n`` random divisions of one substation, each with a solution."""
    draw = np.random.default_rng(0)
    large = np.flatnonzero(grid.sub_info >= 4)
    found: list[I32] = []
    while len(found) < n:
        topo_vect = np.ones(grid.dim_topo, np.int32)
        here = np.flatnonzero(grid.element_to_subid == draw.choice(large))
        topo_vect[here] = draw.integers(1, 3, len(here))
        if topo_vect.max() == 2 and solve(topo_vect[None]):
            found.append(topo_vect)
    return np.array(found)


def microseconds(solve: Callable[[], int], n_flows: int) -> float:
    """Processor time of one flow."""
    begin = time.thread_time_ns()
    converged = solve()
    duration = time.thread_time_ns() - begin
    if converged != n_flows:
        raise RuntimeError(f"{n_flows - converged} of {n_flows} flows did not converge")
    return duration / n_flows / 1000


def measure(grid_id: str, rounds: int, n_rows: int) -> dict[str, Any]:
    """Both solvers in turn, ``rounds`` times."""
    grid = load_grid(grid_id)
    network = load_network(grid)
    rows = injections(grid, network, n_rows)
    flow = new_flow_state(network, 1)
    sizes = (grid.n_line, grid.n_line, grid.n_gen, grid.n_gen, grid.n_load, grid.n_storage)
    results = tuple(np.zeros(size, np.float32) for size in sizes)
    one_row: Any = tuple(array[:1] for array in rows)
    lightsim = LightSim(grid)

    fixed = np.ones((1, grid.dim_topo), np.int32)
    divided = divided_topologies(grid, lambda topologies: solve_rows(network, flow, topologies, one_row, results), 64)
    samples: dict[str, list[float]] = {}
    n = len(rows[0])
    for _ in range(rounds):
        for name, topologies in (("", fixed), ("_divided", divided)):
            pair: dict[str, Callable[[], int]] = {
                "ours": lambda chosen=topologies: solve_rows(network, flow, chosen, rows, results),
                "lightsim2grid": lambda chosen=topologies: lightsim.solve_rows(chosen, rows),
            }
            for solver, solve in pair.items():
                samples.setdefault(f"{solver}{name}_us", []).append(microseconds(solve, n))
    summary: dict[str, Any] = {name: _summary(values) for name, values in samples.items()}
    for name in ("", "_divided"):
        pairs = zip(samples[f"lightsim2grid{name}_us"], samples[f"ours{name}_us"], strict=True)
        summary[f"ratio{name}"] = _summary([theirs / ours for theirs, ours in pairs])
    summary["kb_per_environment"] = round(sum(array.nbytes for array in flow) / 1000, 1)
    return summary


def _summary(values: list[float]) -> dict[str, float]:
    return {"median": round(statistics.median(values), 2), "min": round(min(values), 2), "max": round(max(values), 2)}


def main() -> None:
    """Measure the grids and write the result."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--rows", type=int, default=250)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "powerflow.json")
    arguments = parser.parse_args()
    record: dict[str, Any] = {
        "command": "python benchmarks/powerflow.py",
        "python": platform.python_version(),
        "numba": numba.__version__,
        "lightsim2grid": lightsim2grid.__version__,
        "processor": platform.machine(),
    }
    for grid_id in GRIDS:
        record[grid_id] = row = measure(grid_id, arguments.rounds, arguments.rows)
        print(
            f"{grid_id:14} ours {row['ours_us']['median']:6.2f} us, LightSim2Grid "
            f"{row['lightsim2grid_us']['median']:6.1f} us, ratio {row['ratio']['median']:.1f}; divided anew each time "
            f"{row['ours_divided_us']['median']:6.2f} us against {row['lightsim2grid_divided_us']['median']:6.1f} us, "
            f"ratio {row['ratio_divided']['median']:.1f}; {row['kb_per_environment']:.0f} KB per environment"
        )
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
