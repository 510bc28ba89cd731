"""The provisional ranking of a grid's topology actions: a one-step what-if screen.

1. Episodes of the training split are played by three simple policies, and snapshots are kept: mostly
   stressed ones (some loading of at least 0.95, where an agent behind the idle heuristic is asked to
   act), some nearly stressed or with lines out, some calm.
2. In each snapshot the DC what-if (:mod:`rl2grid.powerflow.what_if`) gives the worst loading after
   every action of the catalogue.
3. The actions that are among the best of some snapshot, those with the best mean and all line
   switches form a pool, whose actions are tried in every snapshot with the AC power flow
   (:mod:`rl2grid.powerflow.lightsim`).
4. Relief of an action in a snapshot is the decrease of the worst loading it brings, within [-1, 1]; -1
   for a collapse, 0 where the rules forbid the action. Its share is its relief, if positive, over the
   largest relief that any action brings there. The first actions, those of levels 0 and 1, are chosen
   one by one to cover the snapshots, each by more than one action; each choice maximises

       sum over snapshots of 0.7 · share · (what is left of the snapshot)
           - 0.02 · collapses + 0.001 · total relief,

   where what is left of a snapshot begins at 1 and is multiplied by (1 - 0.7 · share) with every action
   chosen. (Only snapshots loaded to 0.9 or more in which relief of 0.02 is possible are to be covered.)
   All other actions follow by mean relief.

The result is a function of the seed. Every episode and every snapshot's results are saved as soon as
they are there; a run that was interrupted continues where it was.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
from numpy.typing import NDArray
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from rl2grid.compile import cache_directory
from rl2grid.errors import UsageError
from rl2grid.grids import Grid, load_grid
from rl2grid.mdp.actions import DO_NOTHING, ActionKind, StepAction, full_catalogue, moved_elements
from rl2grid.powerflow.lightsim import AcCheck, read_snapshot
from rl2grid.powerflow.network import Snapshot, read_branches, stack, unstack
from rl2grid.powerflow.what_if import WhatIf
from rl2grid.scenarios.episodes import plan_episode
from rl2grid.scenarios.library import scenario_pack_hash
from rl2grid.streams import Purpose, Stream

VERSION = "provisional-1"
"""Names the method; it changes when the method does."""
MAX_RANKED = 12_000
"""Most ids a ranking holds: more than the largest level that needs one."""

STRESSED, NEAR = 0.95, 0.9
"""Worst loadings from which a snapshot is stressed, or nearly."""
_KINDS = ("stressed", "near", "calm")
_SHARES = {"stressed": 0.7, "near": 0.15, "calm": 0.15}
_PER_EPISODE = {"stressed": 6, "near": 2, "calm": 2}
_GAP = 4  # steps between two snapshots of an episode
_EPISODE_STEPS = 288  # a day
_POLICIES = ("nothing", "greedy", "disturbed")
_AC_TRIES = 30  # actions that the greedy policy tries in AC
_COVERED, _WORTHWHILE = 0.9, 0.02
_TRUST, _COLLAPSE_PENALTY, _RELIEF_WEIGHT = 0.7, 0.02, 0.001

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
Flags = NDArray[np.bool_]


def run_ranking(
    grid_id: str,
    states: int = 300,
    seed: int = 0,
    pool: int = 2000,
    output: Path | None = None,
    work: Path | None = None,
) -> Path:
    """Rank the topology actions of a grid and write ``<output>/<grid>.ranking.npz``.

    Args:
        grid_id: one of :data:`rl2grid.grids.GRID_IDS`.
        states: number of snapshots.
        seed: which episodes are played.
        pool: about how many actions are tried in AC; all are where the catalogue is no larger.
        output: folder of the result; by default ``rankings`` in the current folder.
        work: folder of the intermediate results; by default in the user's cache.

    Returns:
        The file written.

    Raises:
        UsageError: no such grid, or a number that is too small.
    """
    grid = load_grid(grid_id)
    for name, value in (("states", states), ("pool", pool)):
        if value < 1:
            raise UsageError(f"{name}={value} is not allowed: give at least 1.")
    if seed < 0:
        raise UsageError(f"seed={seed} is not allowed: give 0 or more.")
    folder = work or Path(platformdirs.user_cache_dir("rl2grid")) / "rankings" / cache_directory().name
    folder = folder / f"{grid_id}-{grid.hash}-states{states}-seed{seed}-pool{pool}"
    folder.mkdir(parents=True, exist_ok=True)
    with _progress(grid_id) as progress:
        laboratory = _Laboratory(grid)
        try:
            snapshots, counts = _collect(laboratory, states, seed, folder, progress)
            screened = _screen(laboratory, snapshots, folder, progress)
            ids = _pool(laboratory, snapshots, screened, pool)
            checked = _check(laboratory, snapshots, screened, ids, folder, progress)
        finally:
            laboratory.close()
    base = np.array([snapshot.loading().max() for snapshot in snapshots])
    legal = np.stack([laboratory.legal(snapshot) for snapshot in snapshots])
    loadings = screened.copy()
    loadings[:, ids] = checked
    order = rank_actions(loadings, legal, base, ids, _n_covered(grid), MAX_RANKED)
    metadata = {
        "version": VERSION,
        "command": f"rl2grid rank {grid_id} --provisional --states {states} --seed {seed} --pool {pool}",
        "grid": grid_id,
        "grid_hash": grid.hash,
        "split": "train",
        "scenario_pack": scenario_pack_hash(grid_id, "train"),
        "seed": seed,
        "states": counts,
        "pool": len(ids),
        "screen": _screen_quality(screened[:, ids], checked, base),
        "packages": {name: version(name) for name in ("grid2op", "lightsim2grid", "numpy")},
    }
    return _write(output or Path("rankings"), grid_id, order, metadata)


def rank_actions(loadings: F32, legal: Flags, base: F64, pool: I32, n_covered: int, n_ranked: int) -> I32:
    """Order actions by the rule in this module's docstring.

    Args:
        loadings: worst loading after each action, float32 [snapshot, action]; infinite on a collapse; action 0 is
            do nothing.
        legal: where the rules allow the action, bool [snapshot, action].
        base: worst loading of each snapshot, [snapshot].
        pool: the actions from which the first ``n_covered`` are chosen.
        n_covered: how many actions are chosen for coverage.
        n_ranked: how many ids to return at most.

    Returns:
        Ids, best first, without do nothing, int32.
    """
    n_snapshots, n_actions = loadings.shape
    relief = np.clip(base.astype(np.float32)[:, None] - loadings, -1.0, 1.0)
    relief[~legal] = 0.0
    score = relief.mean(axis=0, dtype=np.float64)
    score[0] = -np.inf

    pool = pool[pool != 0]
    best = relief.max(axis=1)
    counted = (base >= _COVERED) & (best >= _WORTHWHILE)
    share = np.maximum(relief[np.ix_(counted, pool)], 0.0).astype(np.float64) / best[counted, None]
    collapses = (np.isinf(loadings[:, pool]) & legal[:, pool]).sum(axis=0)
    worth = _RELIEF_WEIGHT * n_snapshots * score[pool] - _COLLAPSE_PENALTY * collapses
    left = np.ones(len(share))
    chosen: list[int] = []
    for _ in range(min(n_covered, len(pool))):
        k = int((_TRUST * (left @ share) + worth).argmax())
        chosen.append(int(pool[k]))
        left *= 1.0 - _TRUST * share[:, k]
        worth[k] = -np.inf
    rest = np.argsort(-score, kind="stable")
    rest = rest[~np.isin(rest, [0, *chosen])]
    return np.concatenate((chosen, rest))[: min(n_ranked, n_actions - 1)].astype(np.int32)


@dataclass
class _Laboratory:
    """A grid with what it takes to play it and to ask what-if questions."""

    grid: Grid
    engine: Any = field(init=False)
    what_if: WhatIf = field(init=False)
    ac: AcCheck = field(init=False)

    def __post_init__(self) -> None:
        from rl2grid.engines.reference.engine import ReferenceEngine

        self.engine = ReferenceEngine(self.grid, 1)
        backend = self.environment.backend
        self.what_if = WhatIf(self.grid, read_branches(self.grid, backend._grid))
        self.ac = AcCheck(self.grid, backend)
        catalogue = full_catalogue(self.grid)
        self._moves = catalogue.kind == ActionKind.MOVE
        self._switches = catalogue.kind == ActionKind.SWITCH

    @property
    def environment(self) -> Any:
        """The Grid2Op environment behind the engine."""
        return self.engine.grid2op_environment(0)

    def close(self) -> None:
        self.engine.close()

    def legal(self, snapshot: Snapshot) -> Flags:
        """Which actions the cooldowns allow, bool [action]."""
        target = full_catalogue(self.grid).target
        legal = np.ones(len(target), np.bool_)
        legal[self._moves] = snapshot.cooldown_sub[target[self._moves]] == 0
        legal[self._switches] = snapshot.cooldown_line[target[self._switches]] == 0
        return legal

    def topology_after(self, snapshot: Snapshot, action: StepAction) -> I32:
        """``topo_vect`` after an action of the catalogue."""
        topology = snapshot.topo_vect.copy()
        if action.kind == ActionKind.MOVE:
            moved = moved_elements(self.grid, action.target, action.mask)
            moved = moved[topology[moved] > 0]
            topology[moved] = 3 - topology[moved]
        elif action.kind == ActionKind.SWITCH:
            ends = [self.grid.line_or_pos_topo_vect[action.target], self.grid.line_ex_pos_topo_vect[action.target]]
            topology[ends] = -1 if topology[ends[0]] > 0 else snapshot.last_bus[ends]
        return topology

    def check(self, snapshot: Snapshot, ids: I32) -> F64:
        """AC worst loadings after the actions ``ids``, float64 [action]."""
        catalogue = full_catalogue(self.grid)
        self.ac.load(snapshot)
        return np.array([self.ac.worst_loading(self.topology_after(snapshot, catalogue[int(k)])) for k in ids])


def _collect(
    laboratory: _Laboratory, states: int, seed: int, folder: Path, progress: Progress
) -> tuple[list[Snapshot], dict[str, int]]:
    """Snapshots of training episodes, and how many there are of each kind."""
    task = progress.add_task("playing episodes", total=states)
    wanted = {kind: round(share * states) for kind, share in _SHARES.items()}
    wanted["stressed"] += states - sum(wanted.values())
    found: dict[str, list[Snapshot]] = {kind: [] for kind in _KINDS}
    spare: dict[str, list[Snapshot]] = {kind: [] for kind in _KINDS}
    for number in range(4 * states):
        for kind, snapshot in _episode(laboratory, seed, number, folder):
            (found if len(found[kind]) < wanted[kind] else spare)[kind].append(snapshot)
        progress.update(task, completed=sum(map(len, found.values())))
        if all(len(found[kind]) == wanted[kind] for kind in _KINDS):
            break
    for kind in _KINDS:  # a grid that is never stressed, or always, gives what it has
        missing = states - sum(map(len, found.values()))
        found[kind] += spare[kind][:missing]
    progress.update(task, completed=states)
    return [snapshot for kind in _KINDS for snapshot in found[kind]], {kind: len(found[kind]) for kind in _KINDS}


def _episode(laboratory: _Laboratory, seed: int, number: int, folder: Path) -> list[tuple[str, Snapshot]]:
    """Snapshots of one episode with their kinds, from the saved file if there is one."""
    file = folder / f"episode_{number:04d}.npz"
    if not file.exists():
        recorded = list(_play(laboratory, seed, number))
        arrays = stack([snapshot for _, snapshot in recorded]) if recorded else {}
        _save(file, kinds=np.array([kind for kind, _ in recorded], dtype="U8"), **arrays)
    with np.load(file) as arrays:
        kinds = arrays["kinds"].tolist()
        return list(zip(kinds, unstack(arrays), strict=True)) if kinds else []


def _play(laboratory: _Laboratory, seed: int, number: int) -> Iterator[tuple[str, Snapshot]]:
    """Play one episode and yield the snapshots to keep."""
    engine, policy = laboratory.engine, _POLICIES[number % len(_POLICIES)]
    plan = plan_episode(laboratory.grid, "train", seed, number)
    draws = Stream(seed, number, Purpose.AGENT)
    engine.reset(0, plan)
    kept = dict.fromkeys(_KINDS, 0)
    last = -_GAP
    for step in range(min(plan.n_steps, _EPISODE_STEPS)):
        if engine.state.terminated[0] or engine.state.truncated[0]:
            return
        kind = _kind(engine.state)
        snapshot = read_snapshot(laboratory.environment)
        if step >= last + _GAP and kept[kind] < _PER_EPISODE[kind]:
            kept[kind] += 1
            last = step
            yield kind, snapshot
        if kept["stressed"] == _PER_EPISODE["stressed"]:
            return
        engine.step(0, _policy_action(laboratory, policy, kind, snapshot, draws))


def _kind(state: Any) -> str:
    worst = float(state.rho[0].max())
    if worst >= STRESSED:
        return "stressed"
    return "near" if worst >= NEAR or not state.line_status[0].all() else "calm"


def _policy_action(laboratory: _Laboratory, policy: str, kind: str, snapshot: Snapshot, draws: Stream) -> StepAction:
    """What a policy plays: nothing; the best action when stressed; or that with disturbances.

    A disturbance is a random action that the DC what-if holds for harmless: every line and every
    substation is as likely, however many actions it has.
    """
    whim, place, pick = draws.uniform(3)
    disturb = policy == "disturbed" and whim < (0.2 if kind == "stressed" else 0.02)
    if policy == "nothing" or not (disturb or kind == "stressed"):
        return DO_NOTHING
    loadings = np.where(laboratory.legal(snapshot), laboratory.what_if.worst_loadings(snapshot), np.inf)
    catalogue = full_catalogue(laboratory.grid)
    if disturb:
        harmless = np.flatnonzero(loadings <= max(NEAR, float(loadings[0])))
        targets = catalogue.target[harmless] + np.where(
            catalogue.kind[harmless] == ActionKind.SWITCH, laboratory.grid.n_sub, 0
        )
        places = np.unique(targets)
        harmless = harmless[targets == places[int(place * len(places))]]
        return catalogue[int(harmless[int(pick * len(harmless))])]
    tried = np.argsort(loadings, kind="stable")[:_AC_TRIES].astype(np.int32)
    checked = laboratory.check(snapshot, tried)
    k = int(checked.argmin())
    return catalogue[int(tried[k])] if checked[k] < loadings[0] else DO_NOTHING


def _screen(laboratory: _Laboratory, snapshots: list[Snapshot], folder: Path, progress: Progress) -> F32:
    """DC worst loadings, float32 [snapshot, action]."""
    task = progress.add_task("what-if of every action (DC)", total=len(snapshots))
    rows = []
    for k, snapshot in enumerate(snapshots):
        file = folder / f"dc_{k:04d}.npz"
        if not file.exists():
            _save(file, loadings=laboratory.what_if.worst_loadings(snapshot).astype(np.float16))
        with np.load(file) as arrays:
            rows.append(arrays["loadings"].astype(np.float32))
        progress.advance(task)
    return np.stack(rows)


def _pool(laboratory: _Laboratory, snapshots: list[Snapshot], screened: F32, size: int) -> I32:
    """The actions to be tried in AC, ascending: do nothing, switches, best by mean, best of each snapshot."""
    n_actions = screened.shape[1]
    everything = np.arange(n_actions, dtype=np.int32)
    if n_actions <= size:
        return everything
    legal = np.stack([laboratory.legal(snapshot) for snapshot in snapshots])
    ranks = np.argsort(np.where(legal, screened, np.inf), axis=1, kind="stable")[:, :size]
    relief = np.clip(screened[:, :1] - screened, -1.0, 1.0)
    relief[~legal] = 0.0
    switches = everything[n_actions - laboratory.grid.n_line :]
    by_mean = np.argsort(-relief.mean(axis=0, dtype=np.float64), kind="stable")[: size // 5]
    chosen = {0, *switches.tolist(), *by_mean.tolist()}
    for column in ranks.T:
        if len(chosen) >= size:
            break
        chosen.update(column.tolist())
    return np.array(sorted(chosen), np.int32)


def _check(
    laboratory: _Laboratory, snapshots: list[Snapshot], screened: F32, ids: I32, folder: Path, progress: Progress
) -> F64:
    """AC worst loadings of the pool, float64 [snapshot, action]; what falls apart in DC does so in AC."""
    task = progress.add_task(f"{len(ids)} best actions (AC)", total=len(snapshots))
    rows = []
    for k, snapshot in enumerate(snapshots):
        file = folder / f"ac_{k:04d}.npz"
        if not file.exists():
            loadings = np.full(len(ids), np.inf)
            whole = np.isfinite(screened[k, ids])
            loadings[whole] = laboratory.check(snapshot, ids[whole])
            _save(file, loadings=loadings)
        with np.load(file) as arrays:
            rows.append(arrays["loadings"])
        progress.advance(task)
    return np.stack(rows)


def _screen_quality(screened: F32, checked: F64, base: F64) -> dict[str, float]:
    """How well DC agrees with AC on the pool: share and size of errors, and whether the best was seen."""
    both = np.isfinite(screened) & np.isfinite(checked)
    error = np.abs(screened[both] - checked[both])
    possible = base - np.minimum(checked.min(axis=1), base)
    first = np.take_along_axis(checked, np.argsort(screened, axis=1)[:, :20], axis=1).min(axis=1)
    worthwhile = possible >= _WORTHWHILE
    reached = np.clip((base - first)[worthwhile] / possible[worthwhile], 0.0, 1.0)
    return {
        "median_error": round(float(np.median(error)), 5),
        "error_95_percent": round(float(np.quantile(error, 0.95)), 5),
        "collapse_only_in_ac": round(float((np.isfinite(screened) & ~np.isfinite(checked)).mean()), 5),
        "relief_reached_by_dc_best_20": round(float(reached.mean()), 4) if len(reached) else 1.0,
    }


def _n_covered(grid: Grid) -> int:
    """Actions chosen for coverage: levels 0 and 1, or level 0 where level 1 is the whole catalogue."""
    return grid.level_sizes[min(1, len(grid.level_sizes) - 2)] - 1


def _write(folder: Path, grid_id: str, ids: I32, metadata: dict[str, Any]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{grid_id}.ranking.npz"
    _save(file, ids=ids, metadata=np.array(json.dumps(metadata)))
    return file


def _save(file: Path, **arrays: Any) -> None:
    """Write all or nothing."""
    temporary = file.with_suffix(".tmp")
    with temporary.open("wb") as stream:
        np.savez_compressed(stream, **arrays)
    os.replace(temporary, file)


def _progress(grid_id: str) -> Progress:
    return Progress(
        TextColumn(grid_id + " {task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
