"""AC power flows of given rows and of N-1 outages beside the fastest batches, interleaved in one run, one thread.

``python benchmarks/flows.py`` gives the same rows, set-points and tolerance (1e-8 MVA) to

- :class:`rl2grid.powerflow.rows.RowSolver`,
- LightSim2Grid's ``TimeSeriesCPP`` and ``ContingencyAnalysisCPP`` (the classes behind ``TimeSerie`` and
  ``ContingencyAnalysis``) with their fastest algorithm, NR by KLU for one slack, in objects that are kept,
- power-grid-model's batch calculation, by each of its two iterative methods that find the same flow.

Grids are bus14 and bus118-M with rows of a bundled series, and case1354pegase of pandapower with made-up rows. All
sides write the currents of all lines; they are compared. power-grid-model has no generators that hold a voltage: it is
given the reactive power that LightSim2Grid found, which spares it the question, and its tolerance is one of voltage.
It is no dependency of rl2grid: ``pip install power-grid-model``. It writes ``benchmarks/results/flows.json``.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import json
import os
import platform
import statistics
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import lightsim2grid
import numba
import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import F32, F64, I64, Flags
from rl2grid.engines.reference.extract import make_environment
from rl2grid.grids import Grid, load_grid
from rl2grid.grids.grid import grid_from_record
from rl2grid.grids.network import Network, network_from_record
from rl2grid.powerflow.bridges import find_bridges
from rl2grid.powerflow.model import load_network, read_network_record
from rl2grid.powerflow.rows import CONVERGED, RowSolver
from rl2grid.scenarios.library import list_scenarios, load_scenario

BUNDLED_GRIDS = ("bus14", "bus118-M")
LARGE_GRID = "case1354pegase"
N_LARGE_ROWS = 192
LARGEST_DIFFERENCE = 0.01
"""A, between the currents of two sides that solve the same flow."""
_SHORTEST_SAMPLE = 0.02
"""Seconds of processor time that a sample takes at least: what is quicker is repeated."""
_STIFF_SOURCE = 1e40
"""VA, short-circuit power of power-grid-model's source: its voltage is then that of the slack."""

Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Case:
    """A grid, and rows of injections; static generators are loads after the loads."""

    grid: Grid
    network: Network
    model: Any
    """LightSim2Grid's, with the injections of the first row."""
    recipe: tuple[int, float]
    """Newton steps and tolerance, MVA."""
    load_p: F32
    load_q: F32
    gen_p: F32
    gen_v: F64
    """[gen], per unit."""
    n_static: int
    """Static generators."""


def bundled_case(grid_id: str) -> Case:
    """A grid of the benchmark with all rows of its first bundled series."""
    grid, series = load_grid(grid_id), load_scenario(grid_id, list_scenarios(grid_id, "bundled")[0])
    backend = make_environment(grid.bundled_names[0]).backend
    model = backend._grid.copy()
    case = Case(
        grid, load_network(grid), model, (backend.max_it, backend.tol), np.array(series.load_p),
        np.array(series.load_q), np.array(series.prod_p), _setpoints(model), 0,
    )  # fmt: skip
    _set_first_row(case)
    return case


def large_case() -> Case:
    """Pandapower's grid of 1,354 buses; loads and generators follow a day, with noise on every load."""
    import pandapower.networks
    from lightsim2grid.network import init_from_pandapower

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        net = pandapower.networks.case1354pegase()
        for name in ("p_mw", "q_mvar"):  # static generators are loads to us, whose powers are float32
            net.sgen[name] = net.sgen[name].astype(np.float32).astype(np.float64)
        model = init_from_pandapower(net)
    recipe = (10, 1e-8)
    record = read_network_record(model, recipe[1], recipe[0])
    loads, static, gens = (
        list(each) for each in (model.get_loads(), model.get_static_generators(), model.get_generators())
    )
    grid = _grid_of(model, [load.bus_id for load in [*loads, *static]], [gen.bus_id for gen in gens])
    draw = np.random.default_rng(0)
    day = 1 + 0.1 * np.sin(2 * np.pi * np.arange(N_LARGE_ROWS)[:, None] / N_LARGE_ROWS)
    noise = draw.normal(1, 0.01, (N_LARGE_ROWS, len(loads)))
    fixed = np.ones((N_LARGE_ROWS, len(static)))
    load_p = np.array([load.target_p_mw for load in loads]) * day * noise
    load_q = np.array([load.target_q_mvar for load in loads]) * day * noise
    static_p = -np.array([each.target_p_mw for each in static]) * fixed
    static_q = -np.array([each.target_q_mvar for each in static]) * fixed
    gen_p = np.array([gen.target_p_mw for gen in gens]) * day
    case = Case(
        grid, network_from_record(grid, record), model, recipe, np.hstack((load_p, static_p)).astype(np.float32),
        np.hstack((load_q, static_q)).astype(np.float32), gen_p.astype(np.float32), _setpoints(model), len(static),
    )  # fmt: skip
    _set_first_row(case)
    return case


def _setpoints(model: Any) -> F64:
    """Voltages that generators hold, per unit; LightSim2Grid takes float32 ones for new, which would be others."""
    return np.array([generator.target_vm_pu for generator in model.get_generators()])


def _set_first_row(case: Case) -> None:
    n_load = case.load_p.shape[1] - case.n_static
    every_gen, every_load = np.ones(case.grid.n_gen, bool), np.ones(n_load, bool)
    case.model.update_gens_p(every_gen, case.gen_p[0])
    case.model.update_loads_p(every_load, case.load_p[0, :n_load])
    case.model.update_loads_q(every_load, case.load_q[0, :n_load])


def _grid_of(model: Any, load_sub: list[int], gen_sub: list[int]) -> Grid:
    """A grid around a LightSim2Grid model: one substation per bus; what no power flow asks for is made up."""
    lines = [*model.get_lines(), *model.get_trafos()]
    subs = {
        "line_or": [line.bus1_id for line in lines],
        "line_ex": [line.bus2_id for line in lines],
        "gen": gen_sub,
        "load": load_sub,
        "storage": [],
    }
    n_sub = len(model.get_bus_vn_kv())
    ends = np.concatenate([np.array(each, np.int64) for each in subs.values()])
    position = np.empty(len(ends), np.int64)
    position[np.argsort(ends, kind="stable")] = np.arange(len(ends))
    splits = np.cumsum([len(each) for each in subs.values()])[:-1]
    positions = zip(subs, np.split(position, splits), strict=True)
    n_line, n_gen = len(lines), len(gen_sub)
    slack = next(k for k, gen in enumerate(model.get_generators()) if gen.is_slack)
    return grid_from_record(
        {
            "id": LARGE_GRID, "grid2op_name": "", "bundled_names": [], "level_sizes": [],
            "rules": {"cooldown_line": 0, "cooldown_sub": 0, "reconnection": 0, "overflow_allowed": 0,
                      "hard_overflow": 2.0, "max_line_changes": 1, "max_sub_changes": 1},
            "opponent": {"kind": "none"},
            "maintenance": {"lines": [], "monthly_daily_probability": [0.0] * 12, "monthly_max_per_day": [0] * 12,
                            "start_hour": 9, "end_hour": 17},
            **{f"{name}_to_subid": each for name, each in subs.items()},
            **{f"{name}_pos_topo_vect": each.tolist() for name, each in positions},
            "name_sub": [f"sub {k}" for k in range(n_sub)], "name_line": [f"line {k}" for k in range(n_line)],
            "name_gen": [f"gen {k}" for k in range(n_gen)], "name_load": [f"load {k}" for k in range(len(load_sub))],
            "name_storage": [], "layout": [[float(k), 0.0] for k in range(n_sub)], "sub_area": [0] * n_sub,
            "sub_info": np.bincount(ends, minlength=n_sub).tolist(), "thermal_limit": [1000.0] * n_line,
            "gen_type": ["hydro"] * n_gen, "gen_pmin": [0.0] * n_gen, "gen_pmax": [1e4] * n_gen,
            "gen_max_ramp_up": [1e4] * n_gen, "gen_max_ramp_down": [1e4] * n_gen,
            "gen_redispatchable": [True] * n_gen, "gen_renewable": [False] * n_gen, "gen_cost_per_mw": [1.0] * n_gen,
            "slack_gen": slack, "storage_emax": [], "storage_emin": [], "storage_max_p_prod": [],
            "storage_max_p_absorb": [], "storage_charging_efficiency": [], "storage_discharging_efficiency": [],
            "storage_loss": [], "load_p_max": [1000.0] * len(load_sub),
        }
    )  # fmt: skip


@dataclass(frozen=True)
class Question:
    """What one side is asked in a sample."""

    ask: Callable[[], Any]
    n: int
    """Flows."""
    n_asked: int
    """Flows of the benchmark: the side is asked for those alone that it solves."""
    difference: float | None
    """Largest between its currents and ours, A; None: it solves nothing."""


class Ours:
    """Rows and outages in lanes."""

    def __init__(self, case: Case) -> None:
        self._solver = RowSolver(case.grid, case.network)
        gen_v = np.repeat(case.gen_v[None], len(case.gen_p), 0)
        self._rows = (case.load_p, case.load_q, case.gen_p, gen_v)
        self._row = [array[0] for array in self._rows]

    def rows(self) -> F32:
        """Currents, A, [row, line]."""
        return self._solver.flows(*self._rows).a_or

    def outages(self) -> F32:
        """Currents, A, [outage, line]; 0 where there is no flow."""
        return self._solver.outages(*self._row).a_or

    def n_cold(self) -> tuple[int, int]:
        """How many rows, and how many outages with a flow, the cold recipe was asked for."""
        rows, outages = self._solver.flows(*self._rows), self._solver.outages(*self._row)
        return int(rows.cold.sum()), int((outages.cold & (outages.status == CONVERGED)).sum())


class LightSim:
    """LightSim2Grid's batches, in objects that are kept."""

    def __init__(self, case: Case) -> None:
        from lightsim2grid.contingencyAnalysis import ContingencyAnalysisCPP
        from lightsim2grid.timeSerie import TimeSeriesCPP

        self._case, self._new_analysis = case, ContingencyAnalysisCPP
        flat = np.ones(len(case.model.get_bus_vn_kv()), np.complex128)
        self._base = case.model.ac_pf(case.model.dc_pf(flat, *case.recipe), *case.recipe)
        n_load = case.load_p.shape[1] - case.n_static
        doubles = [array.astype(np.float64) for array in (case.gen_p, case.load_p, case.load_q)]
        static_p = np.ascontiguousarray(-doubles[1][:, n_load:])
        loads = (np.ascontiguousarray(array[:, :n_load]) for array in doubles[1:])
        self._rows = (doubles[0], static_p, *loads)
        self.series, self.analysis = TimeSeriesCPP(case.model), ContingencyAnalysisCPP(case.model)
        self.analysis.add_all_n1()

    def rows(self) -> F64:
        """Currents, kA, [row, line]."""
        if self.series.compute_Vs(*self._rows, self._base, *self._case.recipe) != 1:
            raise RuntimeError("LightSim2Grid does not solve all rows.")
        return np.asarray(self.series.compute_flows())

    def outages(self) -> F64:
        """Currents, kA, [outage, line]."""
        return self._flows_of(self.analysis)

    def outages_of_new_object(self) -> F64:
        """The same, with an object that was made for the question."""
        analysis = self._new_analysis(self._case.model)
        analysis.add_all_n1()
        return self._flows_of(analysis)

    def _flows_of(self, analysis: Any) -> F64:
        analysis.compute(self._base, *self._case.recipe)
        return np.asarray(analysis.compute_flows())


class PowerGridModel:
    """power-grid-model's batch calculation of the same network."""

    METHODS = ("newton_raphson", "iterative_current")

    def __init__(self, case: Case, row_voltage: Complex, outage_voltage: Complex, solved: Flags) -> None:
        self._package, self._case = import_power_grid_model(), case
        grid, network = case.grid, case.network
        self._slack = int(network.gen_sub[network.slack_gen[0]])
        self._held = np.setdiff1d(network.gen_sub, self._slack)
        first = np.cumsum([0, grid.n_sub, grid.n_line, 1, grid.n_load, len(self._held)])
        data = {
            "node": self._component("node", first[0], u_rated=network.nominal_voltage * 1e3),
            "generic_branch": self._component("generic_branch", first[1], **self._branch_parameters()),
            "source": self._component(
                "source", first[2], node=[self._slack], status=1, u_ref=case.gen_v[[grid.slack_gen]],
                u_ref_angle=0.0, sk=_STIFF_SOURCE,
            ),
            "sym_load": self._component(
                "sym_load", first[3], node=network.load_sub, status=1, type=0, p_specified=0.0, q_specified=0.0
            ),
            "sym_gen": self._component(
                "sym_gen", first[4], node=self._held, status=1, type=0, p_specified=0.0, q_specified=0.0
            ),
            "shunt": self._component("shunt", first[5], node=network.shunt_sub, status=1, **self._shunt_parameters()),
        }  # fmt: skip
        self._model = self._package.PowerGridModel(data)
        self._rows = self._injections(row_voltage, np.arange(len(case.gen_p)))
        self._solved = np.flatnonzero(solved)
        first_row = np.zeros(len(self._solved), np.int64)
        self._outages = self._injections(outage_voltage[self._solved], first_row, self._solved)
        closed = np.ones((len(self._solved), grid.n_line), np.int8)
        closed[np.arange(len(self._solved)), self._solved] = 0
        self._outages["generic_branch"] = {"from_status": closed, "to_status": closed.copy()}

    def question(self, kind: str, method: str, expected: F32) -> Question:
        """Those of the "rows" or of the "outages" for which a method finds the expected currents, A."""
        batch = self._rows if kind == "rows" else self._outages
        found = self._calculate(batch, method, continue_on_batch_error=True)
        difference = np.abs(found - expected).max(axis=1)
        solved = difference < LARGEST_DIFFERENCE
        chosen = {name: {field: array[solved] for field, array in each.items()} for name, each in batch.items()}
        n = int(solved.sum())
        worst = float(difference[solved].max()) if n else None
        return Question(lambda: self._calculate(chosen, method), n, len(solved), worst)

    def _calculate(self, update: dict[str, Any], method: str, **options: Any) -> F64:
        """Currents, A, [scenario, line]."""
        found = self._model.calculate_power_flow(
            update_data=update, calculation_method=method, error_tolerance=1e-8, max_iterations=100, threading=-1,
            output_component_types={"generic_branch": ["i_from"]}, **options,
        )  # fmt: skip
        return np.asarray(found["generic_branch"]["i_from"])

    def _component(self, kind: str, first: int, **values: Any) -> Any:
        n = next(len(value) for value in values.values() if np.ndim(value) == 1)
        component = self._package.initialize_array("input", kind, n)
        component["id"] = first + np.arange(n)
        for name, value in values.items():
            component[name] = value
        return component

    def _branch_parameters(self) -> dict[str, Any]:
        """Resistance and reactance, ohm, conductance and susceptance, S, of the extremity's side; the ratio."""
        network = self._case.network
        y11, y12, y21, y22 = network.line_admittance.view(np.complex128).T
        ratio, angle = np.sqrt(np.abs(y22 / y11)), np.angle(y12 / y21) / 2
        series = -y12 * ratio * np.exp(-1j * angle)
        shunt = 2 * (y22 - series)
        siemens = network.base_power[0] / network.nominal_voltage[network.line_ex_sub] ** 2
        impedance = 1 / (series * siemens)
        return {
            "from_node": network.line_or_sub, "to_node": network.line_ex_sub, "from_status": 1, "to_status": 1,
            "r1": impedance.real, "x1": impedance.imag, "g1": shunt.real * siemens, "b1": shunt.imag * siemens,
            "k": ratio, "theta": angle, "sn": 1e8,
        }  # fmt: skip

    def _shunt_parameters(self) -> dict[str, Any]:
        network = self._case.network
        siemens = network.base_power[0] / network.nominal_voltage[network.shunt_sub] ** 2
        conductance, susceptance = network.shunt_admittance.T
        return {"g1": conductance * siemens, "b1": susceptance * siemens}

    def _injections(self, voltage: Complex, row: I64, lost: I64 | None = None) -> dict[str, Any]:
        """What loads and generators do in some rows, after the loss of some lines; MVAr are those of ``voltage``."""
        case, network = self._case, self._case.network
        load_p, load_q, gen_p = (array[row].astype(np.float64) for array in (case.load_p, case.load_q, case.gen_p))
        active, reactive = np.zeros(voltage.shape), self._reactive_power(voltage, lost)
        np.add.at(active, (slice(None), network.gen_sub), gen_p)
        np.add.at(reactive, (slice(None), network.load_sub), load_q)
        return {
            "sym_load": {"p_specified": load_p * 1e6, "q_specified": load_q * 1e6},
            "sym_gen": {"p_specified": active[:, self._held] * 1e6, "q_specified": reactive[:, self._held] * 1e6},
        }

    def _reactive_power(self, voltage: Complex, lost: I64 | None) -> F64:
        """MVAr that each bus sends into lines and shunts."""
        network = self._case.network
        y11, y12, y21, y22 = network.line_admittance.view(np.complex128).T
        v1, v2 = voltage[:, network.line_or_sub], voltage[:, network.line_ex_sub]
        at_origin, at_extremity = y11 * v1 + y12 * v2, y21 * v1 + y22 * v2
        if lost is not None:
            at_origin[np.arange(len(lost)), lost] = at_extremity[np.arange(len(lost)), lost] = 0.0
        current = np.zeros(voltage.shape, np.complex128)
        np.add.at(current, (slice(None), network.line_or_sub), at_origin)
        np.add.at(current, (slice(None), network.line_ex_sub), at_extremity)
        shunt = network.shunt_admittance.view(np.complex128)[:, 0]
        np.add.at(current, (slice(None), network.shunt_sub), shunt * voltage[:, network.shunt_sub])
        reactive: F64 = (voltage * current.conj()).imag * network.base_power[0]
        return reactive


def import_power_grid_model() -> Any:
    """The package, or a sentence that asks for it."""
    try:
        return importlib.import_module("power_grid_model")
    except ImportError:
        raise SystemExit(
            "This benchmark needs power-grid-model, which rl2grid does not depend on: pip install power-grid-model, "
            "or pip install --target FOLDER power-grid-model and PYTHONPATH=FOLDER."
        ) from None


def microseconds(ask: Callable[[], Any], n_flows: int) -> float:
    """Processor time of one flow."""
    n_calls, spent = 0, 0.0
    while spent < _SHORTEST_SAMPLE:
        begin = time.thread_time()
        ask()
        spent += time.thread_time() - begin
        n_calls += 1
    return spent / n_calls / n_flows * 1e6


def measure(case: Case, rounds: int) -> dict[str, Any]:
    """All sides in turn, ``rounds`` times; rows, then outages of the first row."""
    ours, lightsim = Ours(case), LightSim(case)
    n_row, n_line = len(case.gen_p), case.grid.n_line
    rows, outages = ours.rows(), ours.outages()
    their_rows, their_outages = 1000 * lightsim.rows(), 1000 * lightsim.outages()
    solved = solved_outages(case, outages, their_outages)
    n_sub = case.grid.n_sub
    voltages = [np.asarray(each.get_voltages())[:, :n_sub] for each in (lightsim.series, lightsim.analysis)]
    third = PowerGridModel(case, voltages[0], voltages[1], solved)
    row_difference = float(np.abs(their_rows - rows).max())
    outage_difference = float(np.abs(their_outages - outages)[solved].max())
    if not max(row_difference, outage_difference) < LARGEST_DIFFERENCE:
        raise RuntimeError(f"LightSim2Grid's currents differ by {row_difference} A and {outage_difference} A.")

    result: dict[str, Any] = {"n_rows": n_row, "n_lines": n_line, "outages_with_a_flow": int(solved.sum())}
    result["rows_solved_cold"], result["outages_solved_cold"] = ours.n_cold()
    questions = {
        "rows": {
            "ours": Question(ours.rows, n_row, n_row, 0.0),
            "time_serie": Question(lightsim.rows, n_row, n_row, row_difference),
        },
        "outages": {
            "ours": Question(ours.outages, n_line, n_line, 0.0),
            "contingency_analysis": Question(lightsim.outages, n_line, n_line, outage_difference),
            "contingency_analysis_new_object": Question(
                lightsim.outages_of_new_object, n_line, n_line, outage_difference
            ),
        },
    }
    for method in PowerGridModel.METHODS:
        for kind, expected in (("rows", rows), ("outages", outages[solved])):
            questions[kind][f"power_grid_model_{method}"] = third.question(kind, method, expected)
    return result | {kind: compare(sides, rounds) for kind, sides in questions.items()}


def solved_outages(case: Case, ours: F32, theirs: F64) -> Flags:
    """After which outages both sides find a flow.

    Where the line was the only one of a bus without elements, that bus is no more for us, and cut off for
    LightSim2Grid.
    """
    by_us, by_them = (np.abs(currents).max(axis=1) > 0 for currents in (ours, theirs))
    bridge = find_bridges(case.network, np.ones(case.grid.dim_topo, np.int32))
    if (by_them & ~by_us).any() or (by_us & ~by_them & ~bridge).any():
        raise RuntimeError("LightSim2Grid solves other outages.")
    return by_us & by_them


def compare(sides: dict[str, Question], rounds: int) -> dict[str, Any]:
    """Microseconds of a flow by side, and how many times as long as ours the fastest of the others takes."""
    timed = {side: question for side, question in sides.items() if question.n}
    samples: dict[str, list[float]] = {side: [] for side in timed}
    for _ in range(rounds):
        for side, question in timed.items():
            samples[side].append(microseconds(question.ask, question.n))
    fastest = min((side for side in timed if side != "ours"), key=lambda side: statistics.median(samples[side]))
    pairs = zip(samples[fastest], samples["ours"], strict=True)
    return {
        "us": {side: summary(values) for side, values in samples.items()},
        "fastest_other": fastest,
        "ratio": summary([theirs / mine for theirs, mine in pairs]),
        "share_solved": {side: round(question.n / question.n_asked, 3) for side, question in sides.items()},
        "largest_difference_a": {
            side: float(f"{question.difference:.1e}") for side, question in timed.items() if side != "ours"
        },
    }


def summary(values: list[float]) -> dict[str, float]:
    """Median and range."""
    return {"median": round(statistics.median(values), 3), "min": round(min(values), 3), "max": round(max(values), 3)}


def main() -> None:
    """Measure the grids and write the result."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "flows.json")
    arguments = parser.parse_args()
    import_power_grid_model()
    record: dict[str, Any] = {
        "command": "python benchmarks/flows.py",
        "python": platform.python_version(),
        "numba": numba.__version__,
        "lightsim2grid": lightsim2grid.__version__,
        "power_grid_model": importlib.metadata.version("power-grid-model"),
        "processor": platform.machine(),
    }
    for name in (*BUNDLED_GRIDS, LARGE_GRID):
        case = large_case() if name == LARGE_GRID else bundled_case(name)
        record[name] = result = measure(case, arguments.rounds)
        for kind in ("rows", "outages"):
            times = ", ".join(f"{side} {each['median']:.2f}" for side, each in result[kind]["us"].items())
            print(f"{name} {kind}, us: {times}; ratio {result[kind]['ratio']['median']:.1f}", flush=True)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    temporary = arguments.output.with_suffix(".partial")
    temporary.write_text(json.dumps(record, indent=1) + "\n")
    temporary.replace(arguments.output)


if __name__ == "__main__":
    main()
