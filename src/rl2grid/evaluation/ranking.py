"""The ranking of a grid's topology actions: which of them keep the grid alive, and with what margin.

After the paper's ranking (Section 3.3, "Action spaces"), exhaustive instead of sampled:

1. Episodes of training months are played, with planned outages and the opponent: one does nothing, one acts greedily
   when stressed, one also breaks things on purpose. Operating points are kept from all months and hours: mostly
   stressed ones (some loading of at least 0.95, where an agent behind the idle heuristic is asked to act), some
   nearly stressed or with lines out, some calm.
2. In each of them every action of the catalogue is tried with the AC power flow
   (:mod:`rl2grid.engines.native.what_if`). A trial is an operating point where the cooldowns allow the action; the
   grid survives it unless a load or generator is cut off, the grid falls apart, no flow is found, or a line is loaded
   above the hard limit (twice its thermal limit), where its protection trips it at once and a cascade begins. Sampled
   uniformly, as in the paper, only some actions are tried in each.
3. Actions are ordered by survival rate, the share of trials that the grid survives, to the percent.
4. Among equals the resulting margin decides. Relief is what an action adds to the margin, 1 less the worst loading,
   within [-1, 1]. Its share in an operating point is its relief, if positive, over the largest relief that any action
   brings there. The actions of levels 0 and 1 are chosen one by one to cover the stressed operating points, each by
   more than one action; each choice maximises

       sum over operating points of 0.7 · share · (what is left of it) + 0.001 · relief,

   where at first all of an operating point is left, and 1 - 0.7 · share of what was left before an action is chosen.
   (Only those loaded to 0.9 or more in which relief of 0.02 is possible are to be covered.) All other actions follow
   by mean relief. Level 0 is so the best small set that we know, not the 49 best actions, which are much alike.

The result is a function of the seed. Every episode and every operating point's results are saved as soon as
they are there; a run that was interrupted continues where it was.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import platformdirs
from numpy.typing import NDArray
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from rl2grid.arrays import F32, F64, I32, Flags
from rl2grid.compile import cache_directory
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.what_if import WhatIf, snapshot_of
from rl2grid.errors import UsageError, one_of
from rl2grid.grids import Grid, load_grid
from rl2grid.mdp.actions import DO_NOTHING, ActionCatalogue, ActionKind, StepAction, full_catalogue
from rl2grid.powerflow.batch import Snapshot
from rl2grid.records.files import make_folder
from rl2grid.scenarios.episodes import plan_episode
from rl2grid.scenarios.library import scenario_pack_hash
from rl2grid.streams import Purpose, Stream

VERSION = "1"
"""Names the method; it changes when the method does."""
SAMPLINGS = ("exhaustive", "uniform")
"""Every action in every operating point, or some of them, drawn uniformly as in the paper."""
UNIFORM_SHARE = 0.1
"""Share of the actions that are tried in an operating point when they are sampled."""

STRESSED, NEAR = 0.95, 0.9
"""Worst loadings from which an operating point is stressed, or nearly."""
_KINDS = ("stressed", "near", "calm")
_SHARES = {"stressed": 0.7, "near": 0.15, "calm": 0.15}
_PER_EPISODE = {"stressed": 6, "near": 2, "calm": 2}
_GAP = 4  # steps between two operating points of an episode
_EPISODE_STEPS = 2016  # a week
_EPISODES_PER_YEAR = 4  # making a year takes longer than playing a week of it
_POLICIES = ("nothing", "greedy", "disturbed")
_TRIED_BY_GREEDY = 1000
_COVERED, _WORTHWHILE = 0.9, 0.02
_TRUST, _RELIEF_WEIGHT = 0.7, 0.001
_COVERED_WITHOUT_LEVELS = 302  # the size of level 1 on 36 substations
_CHUNK = 4096  # actions whose statistics are computed at once
_UNTRIED = np.float16(np.nan)


class Trials(NamedTuple):
    """What was tried: worst loadings after each action in each operating point."""

    loadings: F32
    """[point, action]; infinite on a collapse, not a number where the action was not tried or not allowed."""
    base: F64
    """[point] worst loading before."""


class Scores(NamedTuple):
    """What came of the trials of each action."""

    trials: NDArray[np.uint32]  # [action]
    survived: NDArray[np.uint32]  # [action] trials without a collapse
    margin: F32
    """[action] mean of 1 less the worst loading, within [-1, 1], over the survived trials; 0 where there is none."""
    relief: F64
    """[action] mean gain of margin over all operating points: -1 for a collapse, 0 where it was not tried."""


def run_ranking(
    grid_id: str,
    states: int = 1000,
    seed: int = 0,
    sampling: str = "exhaustive",
    output: Path | None = None,
    work: Path | None = None,
    num_threads: int | None = None,
) -> Path:
    """Rank the topology actions of a grid and write ``<output>/<grid>.ranking.npz``.

    Args:
        grid_id: a registered grid (:func:`rl2grid.grids.system_ids`).
        states: number of operating points.
        seed: which episodes are played.
        sampling: one of :data:`SAMPLINGS`.
        output: folder of the result; by default ``rankings`` in the current folder.
        work: folder of the intermediate results; by default in the user's cache.
        num_threads: threads that try actions; None: one per processor core. No influence on the result.

    Returns:
        The file written.

    Raises:
        UsageError: no such grid or sampling, a number that is too small, or an output folder that cannot be made.
    """
    grid = load_grid(grid_id)
    if states < 2:
        raise UsageError(f"states={states} is not allowed: give at least 2.")
    if seed < 0:
        raise UsageError(f"seed={seed} is not allowed: give 0 or more.")
    if sampling not in SAMPLINGS:
        raise one_of("Sampling", sampling, SAMPLINGS)
    output = output or Path("rankings")
    make_folder(output)
    pack = scenario_pack_hash(grid_id, "train")
    folder = _work_folder(grid, work, f"{pack} {states} {seed} {sampling}")
    with _progress(grid_id) as progress:
        laboratory = _Laboratory(grid, num_threads or os.cpu_count() or 1)
        points, counts = _collect(laboratory, states, seed, folder, progress)
        trials = _try(laboratory, points, seed, sampling, folder, progress)
    scores = score(trials)
    order = rank(trials, scores, _n_covered(grid))
    metadata = {
        "version": VERSION,
        "command": f"rl2grid rank {grid_id} --states {states} --seed {seed} --sampling {sampling}",
        "grid": grid_id,
        "grid_hash": grid.hash,
        "split": "train",
        "scenario_pack": pack,
        "seed": seed,
        "sampling": sampling,
        "states": counts,
        "trials": int(scores.trials.sum()),
        "levels_shared_by_halves": _stability(grid, trials),
        "packages": {name: version(name) for name in ("numpy", "numba")},
    }
    return _write(output, grid_id, order, scores, metadata)


def score(trials: Trials) -> Scores:
    """Count and average the trials of each action."""
    n_actions = trials.loadings.shape[1]
    result = Scores(
        np.zeros(n_actions, np.uint32), np.zeros(n_actions, np.uint32), np.zeros(n_actions, np.float32),
        np.zeros(n_actions),
    )  # fmt: skip
    for first in range(0, n_actions, _CHUNK):
        part = slice(first, min(first + _CHUNK, n_actions))
        loadings = trials.loadings[:, part]
        survived = np.isfinite(loadings)
        margin = np.where(survived, np.clip(1.0 - np.where(survived, loadings, 1.0), -1.0, 1.0), 0.0)
        result.trials[part] = (~np.isnan(loadings)).sum(axis=0)
        result.survived[part] = survived.sum(axis=0)
        result.margin[part] = margin.sum(axis=0) / np.maximum(survived.sum(axis=0), 1)
        result.relief[part] = relief(trials, part).mean(axis=0, dtype=np.float64)
    return result


def relief(trials: Trials, actions: slice | I32) -> F32:
    """Gain of margin, float32 [point, action] within [-1, 1]: -1 for a collapse, 0 where an action was not tried."""
    gained = np.clip(trials.base.astype(np.float32)[:, None] - trials.loadings[:, actions], -1.0, 1.0)
    return np.where(np.isnan(gained), np.float32(0.0), gained)


def rank(trials: Trials, scores: Scores, n_covered: int) -> I32:
    """Order actions by the rule in this module's docstring.

    Args:
        trials: what was tried; action 0 is do nothing.
        scores: of these trials.
        n_covered: how many actions are chosen for coverage.

    Returns:
        Ids, best first, without do nothing, int32 [action - 1].
    """
    rate = np.where(scores.trials > 0, scores.survived / np.maximum(scores.trials, 1), -1.0)
    percent = np.floor(100.0 * rate + 0.5)
    ids = np.arange(1, len(percent), dtype=np.int32)
    ids = ids[np.lexsort((ids, -scores.relief[ids], -percent[ids]))]
    chosen: list[int] = []
    left = np.ones(len(trials.base))
    best = relief(trials, slice(1, None)).max(axis=1)
    counted = (trials.base >= _COVERED) & (best >= _WORTHWHILE)
    for level in np.unique(percent[ids])[::-1]:
        if len(chosen) >= n_covered:
            break
        equals = ids[percent[ids] == level]
        chosen += _cover(trials, scores, equals, best, counted, left, n_covered - len(chosen))
    rest = ids[~np.isin(ids, chosen)]
    return np.concatenate((np.array(chosen, np.int32), rest)).astype(np.int32)


def _cover(trials: Trials, scores: Scores, ids: I32, best: F32, counted: Flags, left: F64, n_wanted: int) -> list[int]:
    """Choose up to ``n_wanted`` of ``ids`` that cover the counted operating points together; ``left`` is updated."""
    share = np.maximum(relief(trials, ids)[counted], 0.0) / best[counted, None]
    worth = _RELIEF_WEIGHT * len(trials.base) * scores.relief[ids]
    remaining = left[counted].astype(np.float32)
    chosen: list[int] = []
    for _ in range(min(n_wanted, len(ids))):
        k = int((_TRUST * (remaining @ share) + worth).argmax())
        chosen.append(int(ids[k]))
        remaining *= 1.0 - np.float32(_TRUST) * share[:, k]
        worth[k] = -np.inf
    left[counted] = remaining
    return chosen


def _stability(grid: Grid, trials: Trials) -> dict[str, float]:
    """For each level, the share of its actions that two rankings, of every other operating point each, have in common.

    The highest level, which holds all actions, is left out.
    """
    halves = [Trials(trials.loadings[k::2], trials.base[k::2]) for k in range(2)]
    orders = [rank(half, score(half), _n_covered(grid)) for half in halves]
    return {
        str(size): round(len(set(orders[0][: size - 1]) & set(orders[1][: size - 1])) / (size - 1), 3)
        for size in grid.level_sizes[:-1]
    }


@dataclass
class _Laboratory:
    """A grid with what it takes to play it and to ask what-if questions."""

    grid: Grid
    num_threads: int
    engine: NativeEngine = field(init=False)
    what_if: WhatIf = field(init=False)
    catalogue: ActionCatalogue = field(init=False)

    def __post_init__(self) -> None:
        self.engine = NativeEngine(self.grid, 1)
        self.what_if = WhatIf(self.grid, num_threads=self.num_threads)
        self.catalogue = full_catalogue(self.grid)

    def loadings(self, point: Snapshot, ids: I32) -> F32:
        """Worst loading after each of ``ids``: infinite on a collapse, not a number where it is not allowed."""
        outcomes = self.what_if.actions(point, self.catalogue, ids)
        return np.where(outcomes.legal, outcomes.worst_loading, np.float32(np.nan))


def _collect(
    laboratory: _Laboratory, states: int, seed: int, folder: Path, progress: Progress
) -> tuple[list[Snapshot], dict[str, int]]:
    """Operating points of training episodes, and how many there are of each kind."""
    task = progress.add_task("playing episodes", total=states)
    wanted = {kind: round(share * states) for kind, share in _SHARES.items()}
    wanted["stressed"] += states - sum(wanted.values())
    found: dict[str, list[Snapshot]] = {kind: [] for kind in _KINDS}
    spare: dict[str, list[Snapshot]] = {kind: [] for kind in _KINDS}
    for number in range(4 * states):
        for kind, point in _episode(laboratory, seed, number, folder):
            (found if len(found[kind]) < wanted[kind] else spare)[kind].append(point)
        progress.update(task, completed=sum(map(len, found.values())))
        if all(len(found[kind]) == wanted[kind] for kind in _KINDS):
            break
    for kind in _KINDS:  # a grid that is never stressed, or always, gives what it has
        missing = states - sum(map(len, found.values()))
        found[kind] += spare[kind][:missing]
    progress.update(task, completed=states)
    return [point for kind in _KINDS for point in found[kind]], {kind: len(found[kind]) for kind in _KINDS}


def _episode(laboratory: _Laboratory, seed: int, number: int, folder: Path) -> list[tuple[str, Snapshot]]:
    """Operating points of one episode with their kinds, from the saved file if there is one."""
    file = folder / f"episode_{number:04d}.npz"
    if not file.exists():
        recorded = list(_play(laboratory, seed, number))
        arrays = {name: np.array([getattr(point, name) for _, point in recorded]) for name in Snapshot._fields}
        _save(file, kinds=np.array([kind for kind, _ in recorded], dtype="U8"), **arrays)
    with np.load(file) as arrays:
        kinds = arrays["kinds"].tolist()
        columns = [arrays[name] for name in Snapshot._fields]
    return [(kind, Snapshot(*(column[k] for column in columns))) for k, kind in enumerate(kinds)]


def _play(laboratory: _Laboratory, seed: int, number: int) -> Iterator[tuple[str, Snapshot]]:
    """Play one episode and yield the operating points to keep."""
    engine, policy = laboratory.engine, _POLICIES[number % len(_POLICIES)]
    plan = plan_episode(
        laboratory.grid, "train", _episode_seed(seed, number // _EPISODES_PER_YEAR), number % _EPISODES_PER_YEAR
    )
    draws = Stream(seed, number, Purpose.AGENT)
    engine.reset(0, plan)
    kept = dict.fromkeys(_KINDS, 0)
    last = -_GAP
    for step in range(min(plan.n_steps, _EPISODE_STEPS)):
        if engine.state.terminated[0] or engine.state.truncated[0]:
            return
        kind = _kind(engine.state)
        if step >= last + _GAP and kept[kind] < _PER_EPISODE[kind]:
            kept[kind] += 1
            last = step
            yield kind, snapshot_of(engine, 0)
        if kept["stressed"] == _PER_EPISODE["stressed"]:
            return
        engine.step(0, _policy_action(laboratory, policy, kind, draws))


def _episode_seed(seed: int, block: int) -> int:
    """A seed for episodes of one year; those of different blocks lie apart, and so play different years."""
    return int.from_bytes(hashlib.sha256(f"ranking {seed} {block}".encode()).digest()[:6], "big")


def _kind(state: Any) -> str:
    worst = float(state.rho[0].max())
    if worst >= STRESSED:
        return "stressed"
    return "near" if worst >= NEAR or not state.line_status[0].all() else "calm"


def _policy_action(laboratory: _Laboratory, policy: str, kind: str, draws: Stream) -> StepAction:
    """What a policy plays: nothing; the best of some actions when stressed; or that with disturbances.

    A disturbance is a random action that does no harm at once.
    """
    whim, pick = draws.uniform(2)
    disturb = policy == "disturbed" and whim < (0.2 if kind == "stressed" else 0.02)
    if policy == "nothing" or not (disturb or kind == "stressed"):
        return DO_NOTHING
    catalogue = laboratory.catalogue
    moves = 1 + (draws.uniform(_TRIED_BY_GREEDY) * (len(catalogue) - 1)).astype(np.int32)
    switches = np.flatnonzero(catalogue.kind == ActionKind.SWITCH).astype(np.int32)
    ids = np.unique(np.concatenate((np.zeros(1, np.int32), moves, switches)))
    loadings = laboratory.loadings(snapshot_of(laboratory.engine, 0), ids)
    if disturb:
        harmless = ids[loadings <= max(NEAR, float(loadings[0]))]
        return catalogue[int(harmless[int(pick * len(harmless))])] if len(harmless) else DO_NOTHING
    return catalogue[int(ids[int(np.nanargmin(loadings))])]


def _try(
    laboratory: _Laboratory, points: list[Snapshot], seed: int, sampling: str, folder: Path, progress: Progress
) -> Trials:
    """Try the actions in every operating point."""
    n_actions = len(laboratory.catalogue)
    task = progress.add_task(f"trying {n_actions} actions", total=len(points))
    loadings = np.full((len(points), n_actions), _UNTRIED, np.float16)
    base = np.zeros(len(points))
    for k, point in enumerate(points):
        file = folder / f"trials_{k:04d}.npz"
        if not file.exists():
            ids = _to_be_tried(n_actions, seed, k, sampling)
            row = np.full(n_actions, np.nan, np.float32)
            row[ids] = laboratory.loadings(point, ids)
            before = laboratory.loadings(point, np.zeros(1, np.int32))[0]
            _save(file, loadings=row.astype(np.float16), base=before)
        with np.load(file) as arrays:
            loadings[k], base[k] = arrays["loadings"], arrays["base"]
        progress.advance(task)
    tried = loadings.astype(np.float32)
    tried[tried > laboratory.grid.rules.hard_overflow] = np.inf
    return Trials(tried, base)


def _to_be_tried(n_actions: int, seed: int, point: int, sampling: str) -> I32:
    everything = np.arange(n_actions, dtype=np.int32)
    if sampling == "exhaustive":
        return everything
    drawn = Stream(seed, point, Purpose.START).uniform(n_actions) < UNIFORM_SHARE
    return everything[drawn]


def _n_covered(grid: Grid) -> int:
    """Actions chosen for coverage: levels 0 and 1, level 0 where level 1 is the whole catalogue, and where there is no
    level below it as many as a first one is likely to hold.
    """
    if len(grid.level_sizes) == 1:
        return min(_COVERED_WITHOUT_LEVELS, grid.level_sizes[0]) - 1
    return grid.level_sizes[min(1, len(grid.level_sizes) - 2)] - 1


def _work_folder(grid: Grid, work: Path | None, request: str) -> Path:
    """Where intermediate results are kept, apart for everything that decides them."""
    root = work or Path(platformdirs.user_cache_dir("rl2grid")) / "rankings"
    digest = hashlib.sha256(f"{VERSION} {grid.hash} {request} {cache_directory().name}".encode()).hexdigest()[:12]
    folder = root / f"{grid.id}-{digest}"
    make_folder(folder)
    return folder


def _write(folder: Path, grid_id: str, ids: I32, scores: Scores, metadata: dict[str, Any]) -> Path:
    file = folder / f"{grid_id}.ranking.npz"
    _save(
        file,
        ids=ids,
        trials=scores.trials,
        survived=scores.survived,
        margin=np.round(scores.margin, 4),
        metadata=np.array(json.dumps(metadata)),
    )
    return file


def _save(file: Path, **arrays: Any) -> None:
    """Write all or nothing."""
    temporary = file.with_suffix(f".{os.getpid()}.tmp")
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
