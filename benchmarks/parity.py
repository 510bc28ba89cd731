"""The native engine beside the reference engine: every value compared after every grid step.

``python benchmarks/parity.py --steps 1000000`` plays the same episodes and actions on both engines, on all
grids, with probes that look for trouble and with policies trained for the purpose, and writes
``benchmarks/results/parity.json``. What was played is kept: an interrupted run goes on where it stopped, and
a longer one begins with what is there. It fails if the engines disagree without a cause (``docs/parity.md``).
``--kinds joint`` compares actions of one kind alone; only topology and continuous ones need trained policies. Of the
kind ``heuristics`` whole transitions are compared, in the compiled loop of one engine; of the kind ``worlds`` the
native engine's environments are saved and brought back on the way.

The result counts the steps that one version of the code has played, named by the hash of its sources. Where the result
is there and its hash is that of the present sources, a run goes on from it, on this machine or another.
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import json
import math
import multiprocessing
import os
import shlex
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

import rl2grid
from rl2grid.algorithms.policy_agent import CHECKPOINT_FILE, load_agent
from rl2grid.engines import HEURISTICS
from rl2grid.engines.differential import CAUSES, TOLERANCES, Detour, SideBySide, TransitionsSideBySide
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.transitions import NativeTransitions
from rl2grid.engines.probes import KINDS, PROBES, Probe, make_probe
from rl2grid.engines.reference.engine import ReferenceEngine
from rl2grid.engines.transition import Transitions
from rl2grid.envs.description import single_spaces
from rl2grid.envs.options import DEFAULTS
from rl2grid.envs.tasks import find_task
from rl2grid.grids import GRID_IDS, Grid, load_grid
from rl2grid.mdp.actions import StepAction, inject, legal_actions, level_catalogue
from rl2grid.mdp.features import observation_size, physical_scale
from rl2grid.mdp.observations import observation_writer
from rl2grid.mdp.rewards import PRESETS
from rl2grid.mdp.state import GridState
from rl2grid.records.files import write_text
from rl2grid.records.versions import library_versions
from rl2grid.scenarios.cache import data_folder
from rl2grid.scenarios.episodes import EpisodePlan
from rl2grid.scenarios.library import list_scenarios, load_scenario, scenario_pack_hash
from rl2grid.training import request, runs

PART_STEPS = 10_000
"""Steps of a part, the least that an interruption loses."""
NATIVE_ROWS = 3
TRAINED = "trained"
TRAINING_DECISIONS = 4096
_EPISODES_OF_A_PART = 1_000_000
_TASKS = {"topology": "T0", "continuous": "R"}
HEURISTIC_KIND, WORLDS_KIND = "heuristics", "worlds"
ALL_KINDS = (*KINDS, HEURISTIC_KIND, WORLDS_KIND)
GAMMA = 0.99


@dataclass(frozen=True)
class Cell:
    """One combination that is compared."""

    grid: str
    kind: str
    """One of :data:`ALL_KINDS`."""
    dispatch: str
    policy: str
    """A probe, or ``trained``; with heuristics, the heuristic and the kind of a probe."""


@dataclass(frozen=True)
class Part:
    """A share of a cell's episodes, the same in every run."""

    cell: Cell
    number: int
    steps: int


class TrainedProbe:
    """A policy trained by PPO, sampled, as a probe."""

    def __init__(self, grid: Grid, kind: str, run: Path) -> None:
        task = find_task(f"rl2grid/{grid.id}-{_TASKS[kind]}-v0")
        self._write = observation_writer(task.kind)
        self._shift, self._scale = physical_scale(grid, task.kind)
        self._observation = np.zeros(observation_size(grid, task.kind), np.float32)
        self._catalogue = level_catalogue(grid, task.level) if task.kind == "T" else None
        self._masks = np.zeros(task.n_actions, np.bool_)
        self._agent = load_agent(run / CHECKPOINT_FILE, deterministic=False)
        observations, actions = single_spaces(task)
        environment = SimpleNamespace(
            task=task,
            options=SimpleNamespace(**DEFAULTS),
            observation_space=observations,
            action_space=actions,
            action_masks=lambda: self._masks,
        )
        environment.unwrapped = environment
        self._agent.bind(environment)  # type: ignore[arg-type]

    def begin(self, random: np.random.Generator) -> None:
        """Begin an episode with samples drawn from ``random``."""
        self._agent.seed_episode(int(random.integers(2**31)), 0)

    def choose(self, state: GridState, i: int) -> StepAction:
        """A sample of the policy."""
        self._write(state, i, self._observation)
        self._observation -= self._shift
        self._observation /= self._scale
        if self._catalogue is None:
            return inject(self._agent.act(self._observation, {}))
        legal_actions(state, i, self._catalogue.kind, self._catalogue.target, self._masks)
        return self._catalogue[self._agent.act(self._observation, {})]


def cells_of(grids: Iterable[str], kinds: Iterable[str]) -> list[Cell]:
    """Everything to be compared; topology actions alone do not meet the dispatch."""
    both = ("exact", "grid2op")
    dispatches = {"continuous": both, "mixed": both, "joint": both}
    return [
        Cell(grid, kind, dispatch, policy)
        for grid in grids
        for kind in kinds
        for dispatch in dispatches.get(kind, ("exact",))
        for policy in policies_of(kind)
    ]


def policies_of(kind: str) -> list[str]:
    """What is played of a kind."""
    if kind == HEURISTIC_KIND:
        return [f"{heuristic} {actions}" for heuristic in HEURISTICS for actions in _TASKS]
    if kind == WORLDS_KIND:
        return ["mixed", "joint"]
    return [*PROBES[kind], *((TRAINED,) if kind in _TASKS else ())]


def parts_of(cells: list[Cell], steps: int) -> Iterator[Part]:
    """Parts that together play ``steps`` steps, the cells in turn."""
    each = math.ceil(steps / len(cells))
    size = min(PART_STEPS, each)
    for number in range(math.ceil(each / size)):
        for cell in cells:
            yield Part(cell, number, size)


def plan(grid: Grid, seed: int, number: int) -> EpisodePlan:
    """An episode in the bundled series, from the first row or from a random one."""
    random = np.random.default_rng((seed, number, 1))
    scenarios = list_scenarios(grid.id, "bundled")
    scenario = scenarios[int(random.integers(len(scenarios)))]
    n_steps = load_scenario(grid.id, scenario).n_steps
    start = 0 if random.random() < 0.25 else int(random.integers(n_steps - 1))
    return EpisodePlan(seed, number, scenario, start, n_steps - start)


@functools.cache
def engines(grid_id: str, dispatch: str) -> tuple[ReferenceEngine, NativeEngine]:
    """Both engines, one pair per process."""
    grid = load_grid(grid_id)
    return ReferenceEngine(grid, 1, dispatch), NativeEngine(grid, NATIVE_ROWS, dispatch)


@functools.cache
def probe_of(grid_id: str, kind: str, policy: str, policies: Path) -> Probe:
    """The cell's probe, one per process."""
    grid = load_grid(grid_id)
    if policy == TRAINED:
        return TrainedProbe(grid, kind, policies / f"{grid_id}-{_TASKS[kind]}")
    if kind == HEURISTIC_KIND:
        return make_probe(grid, policy.partition(" ")[2], "random")
    if kind == WORLDS_KIND:
        return make_probe(grid, policy, "adversarial")
    return make_probe(grid, kind, policy)


def side_by_side(cell: Cell) -> SideBySide:
    """What plays a cell on both engines."""
    reference, native = engines(cell.grid, cell.dispatch)
    if cell.kind == HEURISTIC_KIND:
        heuristic, _, actions = cell.policy.partition(" ")
        setting = heuristic, "T" if actions == "topology" else "R", PRESETS["default"], GAMMA
        return TransitionsSideBySide(Transitions(reference, *setting), NativeTransitions(native, *setting))
    if cell.kind == WORLDS_KIND:
        return SideBySide(reference, Detour(native, make_probe(native.grid, "mixed", "random")))
    return SideBySide(reference, native, dispatch=cell.dispatch)


def compare(part: Part, seed: int, policies: Path) -> dict[str, Any]:
    """Play one part; returns its record."""
    cell = part.cell
    pair, grid = side_by_side(cell), load_grid(cell.grid)
    probe, number = probe_of(cell.grid, cell.kind, cell.policy, policies), part.number * _EPISODES_OF_A_PART
    while pair.tally.steps < part.steps:
        pair.play(plan(grid, seed, number), probe, part.steps - pair.tally.steps)
        number += 1
    tally = pair.tally
    return {
        "cell": asdict(cell),
        "numbers": [part.number],
        "part_steps": part.steps,
        "compared": tally.steps,
        "simulations": tally.simulations,
        "episodes": tally.episodes,
        "completed": tally.completed,
        "game_overs": dict(tally.game_overs),
        "counts": dict(tally.counts),
        "largest": tally.largest,
        "disagreements": [{"cause": each.cause, "what": str(each)} for each in tally.disagreements],
    }


def runs_of(cells: Iterable[Cell]) -> list[str]:
    """Names of the trainings: one per grid and kind of action of which a trained policy is compared."""
    trained = (cell for cell in cells if cell.policy == TRAINED)
    return list(dict.fromkeys(f"{cell.grid}-{_TASKS[cell.kind]}" for cell in trained))


def train_policies(cells: Iterable[Cell], folder: Path) -> None:
    """Train the policies that are not there yet, briefly."""
    for name in runs_of(cells):
        run = folder / name
        if run.exists() and runs.is_finished(run):
            continue
        print(f"training a policy on {name}", flush=True)
        if run.exists():
            runs.resume(run)
            continue
        chosen = request.hyperparameters("ppo", name, total_timesteps=TRAINING_DECISIONS, num_envs=4)
        runs.train(request.RunArgs(name, chosen, folder=run, tensorboard=False))


def source_hash() -> str:
    """Short hash of what plays and compares: parts played with other code do not count."""
    digest, root = hashlib.sha256(), Path(rl2grid.__file__).parent
    below = ("compile.py", "handles.py", "structures.py", "engines", "mdp", "powerflow", "grids")
    for path in sorted(path for path in root.rglob("*") if path.relative_to(root).parts[0] in below):
        if path.suffix in (".py", ".json"):  # rankings, .npz, play no step
            digest.update(f"{path.relative_to(root).as_posix()}\n".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


class Store:
    """What was played: the records of parts, one JSON line each, behind those that an earlier result adds up.

    Args:
        path: of the lines.
        result: an earlier result; None where there is none of these sources and this seed.
    """

    def __init__(self, path: Path, result: dict[str, Any] | None) -> None:
        self._path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = path.read_text().splitlines() if path.exists() else []
        self.records = [] if result is None else [_record_of(row, result) for row in result["cells"] if row["numbers"]]
        self._played = {key for record in self.records for key in _keys(record)}
        for line in lines:
            record = json.loads(line) if line.endswith("}") else None  # the last one may be cut off
            if record is not None and not self._played.issuperset(_keys(record)):
                self._keep(record)

    def add(self, record: dict[str, Any]) -> None:
        """Keep a record."""
        self._keep(record)
        with self._path.open("a") as file:
            file.write(json.dumps(record) + "\n")

    def has(self, part: Part) -> bool:
        """Whether the part was played."""
        return (part.cell, part.number, part.steps) in self._played

    def _keep(self, record: dict[str, Any]) -> None:
        self.records.append(record)
        self._played.update(_keys(record))


def _keys(record: dict[str, Any]) -> list[tuple[Cell, int, int]]:
    """What tells the parts of a record from others."""
    return [(Cell(**record["cell"]), number, record["part_steps"]) for number in record["numbers"]]


def _record_of(row: dict[str, Any], result: dict[str, Any]) -> dict[str, Any]:
    """The parts of a cell, as a result adds them up, as one record."""
    cell = {field.name: row[field.name] for field in fields(Cell)}
    mine = [each for each in result["disagreements"] if all(each[key] == value for key, value in cell.items())]
    return {
        **{key: row[key] for key in ("numbers", "part_steps", "simulations", "episodes", "completed", "game_overs")},
        "cell": cell,
        "compared": row["steps"],
        "counts": row["steps_with"],
        "largest": row["largest"],
        "disagreements": [{"cause": each["cause"], "what": each["what"]} for each in mine],
    }


def earlier_result(path: Path, source: str, seed: int) -> dict[str, Any] | None:
    """The result in a file, if it is of these sources and this seed."""
    if not path.exists():
        return None
    result: dict[str, Any] = json.loads(path.read_text())
    return result if result["hashes"]["source"] == source and result["seed"] == seed else None


def play_parts(parts: list[Part], store: Store, seed: int, policies: Path, deadline: float, processes: int) -> None:
    """Play what is missing, until the deadline or an interruption; parts under way are finished."""
    missing = [part for part in parts if not store.has(part)]
    total = sum(part.steps for part in parts)
    context = multiprocessing.get_context("spawn")
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"))
    with (
        Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(elapsed_when_finished=True)) as progress,
        ProcessPoolExecutor(processes, mp_context=context, initializer=_leave_interrupts_to_the_parent) as pool,
    ):
        done = total - sum(part.steps for part in missing)
        bar = progress.add_task("steps compared", total=total, completed=done, rate="")
        running: set[Future[dict[str, Any]]] = set()
        began, played = time.monotonic(), 0
        try:
            while running or (missing and time.monotonic() < deadline):
                while missing and len(running) < processes and time.monotonic() < deadline:
                    running.add(pool.submit(compare, missing.pop(0), seed, policies))
                ended, running = wait(running, return_when=FIRST_COMPLETED)
                for future in ended:
                    record = future.result()
                    store.add(record)
                    played += record["compared"]
                    rate = f"{played / (time.monotonic() - began):,.0f} steps/s"
                    progress.update(bar, advance=record["compared"], rate=rate)
                    for each in record["disagreements"]:
                        place = f"{record['cell']['grid']} {record['cell']['kind']} {record['cell']['dispatch']}"
                        progress.console.print(f"{place} {record['cell']['policy']}: {each['what']}", markup=False)
        except KeyboardInterrupt:
            progress.console.print("stopping when the parts under way are done")
            for future in running:
                store.add(future.result())


def _leave_interrupts_to_the_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def summary(
    records: list[dict[str, Any]], cells: list[Cell], seed: int, source: str, policies: Path, command: str
) -> dict[str, Any]:
    """What the committed result says."""
    grids = tuple(dict.fromkeys(cell.grid for cell in cells))
    records = [record for record in records if Cell(**record["cell"]) in cells]
    causes = Counter(each["cause"] for record in records for each in record["disagreements"])
    return {
        "command": command,
        "seed": seed,
        "versions": library_versions(),
        "hashes": {
            "source": source,
            "scenarios": {grid: scenario_pack_hash(grid, "bundled") for grid in grids},
            "policies": {run: _policy_hash(policies / run) for run in runs_of(cells)},
        },
        "steps": sum(record["compared"] for record in records),
        "simulations": sum(record["simulations"] for record in records),
        "episodes": sum(record["episodes"] for record in records),
        "unexplained": causes[""],
        "explained": {cause: causes[cause] for cause in CAUSES},
        "tolerances": TOLERANCES,
        "largest": {grid: _largest([record for record in records if record["cell"]["grid"] == grid]) for grid in grids},
        "cells": [_cell_summary(cell, records) for cell in cells],
        "disagreements": [{**record["cell"], **each} for record in records for each in record["disagreements"]],
    }


def _policy_hash(run: Path) -> str:
    return str(load_agent(run / CHECKPOINT_FILE).identity["policy_hash"])


def _largest(records: list[dict[str, Any]]) -> dict[str, float]:
    largest = {name: max((record["largest"].get(name, 0.0) for record in records), default=0.0) for name in TOLERANCES}
    return {name: float(f"{value:.2g}") for name, value in largest.items() if value}


def _cell_summary(cell: Cell, records: list[dict[str, Any]]) -> dict[str, Any]:
    mine = [record for record in records if record["cell"] == asdict(cell)]
    totals: Counter[str] = Counter()
    game_overs: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    for record in mine:
        totals.update(
            steps=record["compared"],
            simulations=record["simulations"],
            episodes=record["episodes"],
            completed=record["completed"],
            explained=sum(bool(each["cause"]) for each in record["disagreements"]),
            unexplained=sum(not each["cause"] for each in record["disagreements"]),
        )
        game_overs.update(record["game_overs"])
        counts.update(record["counts"])
    return {
        **asdict(cell),
        "numbers": sorted(number for record in mine for number in record["numbers"]),
        "part_steps": mine[0]["part_steps"] if mine else 0,
        **{
            name: totals[name] for name in ("steps", "simulations", "episodes", "completed", "explained", "unexplained")
        },
        "game_overs": dict(sorted(game_overs.items())),
        "steps_with": dict(counts),
        "largest": _largest(mine),
    }


def write(result: dict[str, Any], path: Path) -> None:
    """Write the result, one line per cell and per disagreement."""
    blocks = []
    for key, value in result.items():
        if isinstance(value, list):
            rows = ",\n".join(f"  {json.dumps(row)}" for row in value)
            blocks.append(f" {json.dumps(key)}: [\n{rows}\n ]" if value else f" {json.dumps(key)}: []")
        else:
            blocks.append(f" {json.dumps(key)}: {json.dumps(value)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, "{\n" + ",\n".join(blocks) + "\n}\n")


def main() -> int:
    """Compare, write the result, and say whether the engines agree."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--steps", type=int, default=1_000_000, help="grid steps to compare, over all grids")
    parser.add_argument("--grids", nargs="+", default=list(GRID_IDS), choices=GRID_IDS)
    parser.add_argument(
        "--kinds", nargs="+", default=list(ALL_KINDS), choices=ALL_KINDS, help="kinds of actions to compare"
    )
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=math.inf, help="begin no part after this time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "parity.json")
    arguments = parser.parse_args()
    for number in (signal.SIGINT, signal.SIGTERM):  # shells make processes in the background ignore the first
        signal.signal(number, signal.default_int_handler)
    deadline = time.monotonic() + 60 * arguments.minutes
    folder = data_folder() / "parity"
    cells = cells_of(arguments.grids, arguments.kinds)
    train_policies(cells, folder / "policies")
    parts = list(parts_of(cells, arguments.steps))
    source = source_hash()  # now: the code may be edited while it is compared
    earlier = earlier_result(arguments.output, source, arguments.seed)
    store = Store(folder / f"{source}-{arguments.seed}.jsonl", earlier)
    play_parts(parts, store, arguments.seed, folder / "policies", deadline, arguments.processes)
    command = shlex.join(["python", "benchmarks/parity.py", *sys.argv[1:]])
    result = summary(store.records, cells, arguments.seed, source, folder / "policies", command)
    write(result, arguments.output)
    explained = ", ".join(f"{count} {cause}" for cause, count in result["explained"].items() if count) or "none"
    print(
        f"{result['steps']:,} steps and {result['simulations']:,} simulations of {result['episodes']:,} episodes "
        f"compared: {result['unexplained']} unexplained disagreements; explained: {explained}"
    )
    return 1 if result["unexplained"] else 0


if __name__ == "__main__":
    sys.exit(main())
