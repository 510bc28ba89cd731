"""The ranking of a grid's topology actions: which of them keep the grid alive, and with what margin.

After the paper's ranking (Section 3.3, "Action spaces"), exhaustive instead of sampled:

1. Episodes of training months are played, with planned outages and the opponent: one does nothing, one acts greedily
   when stressed, one also breaks things on purpose. Operating points are kept from all months and hours: mostly
   stressed ones (some loading of at least 0.95, where an agent behind the idle heuristic is asked to act), some
   nearly stressed or with lines out, some calm. Of each kind those kept are drawn from all that an episode met, so
   that lines which are out, and may be closed again, are among them as often as play without a heuristic meets them.
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
5. Level 0 holds the switches of all lines that opponent and planned outages open: without them such a line is lost for
   ever where no heuristic closes it. So does it those of the lines that protections have opened in these episodes, most
   often first, as long as switches take at most half of the places. They count as chosen before all others. By their
   trials they would seldom be: most are openings, of lines in service.

The result is a function of the seed. Every episode and every operating point's results are saved as soon as
they are there; a run that was interrupted continues where it was.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import platformdirs
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from rl2grid.arrays import F32, F64, I32, Flags
from rl2grid.compile import cache_directory
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.what_if import WhatIf, snapshot_of
from rl2grid.errors import UsageError, one_of
from rl2grid.grids import Grid, find_system, load_grid
from rl2grid.mdp.actions import DO_NOTHING, ActionCatalogue, ActionKind, StepAction, full_catalogue, one_change
from rl2grid.mdp.heuristics import is_safe, recovery_action
from rl2grid.powerflow.batch import Snapshot
from rl2grid.records.files import make_folder, set_aside, write_bytes
from rl2grid.scenarios.episodes import plan_episode
from rl2grid.scenarios.library import draw_scenario, scenario_pack_hash
from rl2grid.scenarios.splits import TRAIN
from rl2grid.streams import Purpose, Stream

VERSION = "2"
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
_EPISODE_STEPS = 2016  # a week
_POLICIES = ("nothing", "recovering", "greedy", "recovering", "disturbed", "recovering")
_TRIED_BY_GREEDY = 1000
_COVERED, _WORTHWHILE = 0.9, 0.02
_TRUST, _RELIEF_WEIGHT = 0.7, 0.001
_COVERED_WITHOUT_LEVELS = 302  # the size of level 1 on 36 substations
_CLOSING_SHARE = 0.5  # of the places of level 0
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


class Shape(NamedTuple):
    """How many places the first levels have."""

    n_covered: int
    """Actions chosen for coverage."""
    n_first: int
    """Actions of level 0."""
    reserved: I32
    """Catalogue ids that level 0 holds anyway, at most :attr:`n_first`."""


class Play(NamedTuple):
    """What the episodes met."""

    kept: dict[str, int]
    """Operating points of each kind."""
    closable: dict[str, list[float]]
    """By kind: share of operating points, and of all steps played, with a line that is out and may be closed."""
    tripped: I32
    """[line] how often protections opened it."""


def run_ranking(
    grid_id: str,
    states: int = 1000,
    seed: int = 0,
    sampling: str = "exhaustive",
    output: Path | None = None,
    work: Path | None = None,
    num_threads: int | None = None,
    progress: bool = True,
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
        progress: whether to show how far it is.

    Returns:
        The file written.

    Raises:
        UsageError: no such grid or sampling, a number that is too small, or an output folder that cannot be made,
            or that holds a ranking of this grid that was made in another way.
    """
    grid = load_grid(grid_id)
    if states < 2:
        raise UsageError(f"states={states} is not allowed: give at least 2.")
    if seed < 0:
        raise UsageError(f"seed={seed} is not allowed: give 0 or more.")
    if sampling not in SAMPLINGS:
        raise one_of("Sampling", sampling, SAMPLINGS)
    output = output or Path("rankings")
    command = f"rl2grid rank {grid_id} --states {states} --seed {seed} --sampling {sampling}"
    _refuse_another(_ranking_file(output, grid_id), command)
    make_folder(output)
    pack = scenario_pack_hash(grid_id, "train")
    folder = _work_folder(grid, work, f"{pack} {states} {seed} {sampling}")
    with _progress(grid_id, progress) as bar:
        laboratory = _Laboratory(grid, num_threads or os.cpu_count() or 1)
        points, play = _collect(laboratory, states, seed, folder, bar)
        trials = _try(laboratory, points, seed, sampling, folder, bar)
    scores = score(trials)
    closed, left_out = _lines_to_close(grid, play.tripped)
    shape = Shape(_n_covered(grid), grid.level_sizes[0] - 1, _switches(laboratory.catalogue, closed))
    order = rank(trials, scores, shape)
    metadata = {
        "version": VERSION,
        "command": command,
        "grid": grid_id,
        "grid_hash": grid.hash,
        "split": "train",
        "scenario_pack": pack,
        "seed": seed,
        "sampling": sampling,
        "states": play.kept,
        "closable": play.closable,
        "closed_in_level_0": closed,
        "tripped_and_not_closed_in_level_0": left_out,
        "trials": int(scores.trials.sum()),
        "levels_shared_by_halves": _stability(grid, trials, shape),
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


def rank(trials: Trials, scores: Scores, shape: Shape) -> I32:
    """Order actions by the rule in this module's docstring.

    Args:
        trials: what was tried; action 0 is do nothing.
        scores: of these trials.
        shape: of the levels.

    Returns:
        Ids, best first, without do nothing, int32 [action - 1].
    """
    rate = np.where(scores.trials > 0, scores.survived / np.maximum(scores.trials, 1), -1.0)
    percent = np.floor(100.0 * rate + 0.5)
    ids = np.arange(1, len(percent), dtype=np.int32)
    ids = ids[np.lexsort((ids, -scores.relief[ids], -percent[ids]))]
    reserved = shape.reserved[np.lexsort((shape.reserved, -scores.relief[shape.reserved]))]
    ids = ids[~np.isin(ids, reserved)]
    best = relief(trials, slice(1, None)).max(axis=1)
    counted = (trials.base >= _COVERED) & (best >= _WORTHWHILE)
    left = _left_after(trials, reserved, best, counted)
    chosen: list[int] = []
    n_chosen = max(shape.n_covered - len(reserved), 0)
    for level in np.unique(percent[ids])[::-1]:
        if len(chosen) >= n_chosen:
            break
        equals = ids[percent[ids] == level]
        chosen += _cover(trials, scores, equals, best, counted, left, n_chosen - len(chosen))
    order = np.concatenate((np.array(chosen, np.int32), ids[~np.isin(ids, chosen)]))
    n_others = shape.n_first - len(reserved)
    return np.concatenate((order[:n_others], reserved, order[n_others:])).astype(np.int32)


def _left_after(trials: Trials, ids: I32, best: F32, counted: Flags) -> F64:
    """What is left of each operating point after actions were chosen, float64 [point]."""
    left = np.ones(len(trials.base))
    share = np.maximum(relief(trials, ids)[counted], 0.0) / best[counted, None]
    left[counted] = np.prod(1.0 - _TRUST * share, axis=1)
    return left


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


def _stability(grid: Grid, trials: Trials, shape: Shape) -> dict[str, float]:
    """For each level, the share of its actions that two rankings, of every other operating point each, have in common.

    The highest level, which holds all actions, is left out.
    """
    halves = [Trials(trials.loadings[k::2], trials.base[k::2]) for k in range(2)]
    orders = [rank(half, score(half), shape) for half in halves]
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
) -> tuple[list[Snapshot], Play]:
    """Operating points of training episodes, and what these met."""
    task = progress.add_task("playing episodes", total=states)
    wanted = {kind: round(share * states) for kind, share in _SHARES.items()}
    wanted["stressed"] += states - sum(wanted.values())
    found: dict[str, list[Snapshot]] = {kind: [] for kind in _KINDS}
    spare: dict[str, list[Snapshot]] = {kind: [] for kind in _KINDS}
    met, tripped = np.zeros((len(_KINDS), 2), np.int64), np.zeros(laboratory.grid.n_line, np.int32)
    for number in range(4 * states):
        episode = _episode(laboratory, seed, number, folder)
        met += episode.met
        tripped += episode.tripped
        for kind, point in zip(episode.kinds, episode.points, strict=True):
            (found if len(found[kind]) < wanted[kind] else spare)[kind].append(point)
        progress.update(task, completed=sum(map(len, found.values())))
        if all(len(found[kind]) == wanted[kind] for kind in _KINDS):
            break
    for kind in _KINDS:  # a grid that is never stressed, or always, gives what it has
        missing = states - sum(map(len, found.values()))
        found[kind] += spare[kind][:missing]
    progress.update(task, completed=states)
    closable = {
        kind: [
            round(float(np.mean([_closable(laboratory.grid, point) for point in found[kind]] or [False])), 3),
            round(float(met[k, 1] / max(met[k, 0], 1)), 3),
        ]
        for k, kind in enumerate(_KINDS)
    }
    points = [point for kind in _KINDS for point in found[kind]]
    return points, Play({kind: len(found[kind]) for kind in _KINDS}, closable, tripped)


def _closable(grid: Grid, point: Snapshot) -> bool:
    """Whether a line is out that may be closed again."""
    is_out = point.topo_vect[grid.line_or_pos_topo_vect] < 1
    return bool(np.any(is_out & (point.cooldown_line == 0)))


class _Episode(NamedTuple):
    """What is kept of an episode."""

    kinds: list[str]
    """Of each of the operating points."""
    points: list[Snapshot]
    met: NDArray[np.int64]
    """[kind, 2] steps of the episode, and those with a line that is out and may be closed."""
    tripped: I32
    """[line] how often protections opened it."""


def _episode(laboratory: _Laboratory, seed: int, number: int, folder: Path) -> _Episode:
    """One episode, from the saved file if there is one."""
    file = folder / f"episode_{number:04d}.npz"
    if not _is_sound(file):
        played = _play(laboratory, seed, number)
        arrays = {name: np.array([getattr(point, name) for point in played.points]) for name in Snapshot._fields}
        _save(file, kinds=np.array(played.kinds, dtype="U8"), met=played.met, tripped=played.tripped, **arrays)
    with np.load(file) as arrays:
        kinds, met, tripped = arrays["kinds"].tolist(), arrays["met"], arrays["tripped"]
        columns = [arrays[name] for name in Snapshot._fields]
    return _Episode(kinds, [Snapshot(*(column[k] for column in columns)) for k in range(len(kinds))], met, tripped)


def _is_sound(file: Path) -> bool:
    """Whether an intermediate result is there; a damaged one is set aside, to be made again."""
    if not file.exists():
        return False
    try:
        with zipfile.ZipFile(file) as archive:  # which has a checksum of every array
            sound = archive.testzip() is None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError):
        sound = False
    if not sound:
        set_aside(file, f"{file} was damaged and is made again")
    return sound


def _play(laboratory: _Laboratory, seed: int, number: int) -> _Episode:
    """Play one episode; of each kind the operating points to keep are drawn from all of its steps."""
    engine, policy = laboratory.engine, _POLICIES[number % len(_POLICIES)]
    plan = plan_episode(laboratory.grid, "train", _episode_seed(seed, number), number)
    draws, choices = Stream(seed, number, Purpose.AGENT), Stream(seed, number, Purpose.START)
    engine.reset(0, plan)
    state = engine.state
    kept: dict[str, list[Snapshot]] = {kind: [] for kind in _KINDS}
    met, tripped = np.zeros((len(_KINDS), 2), np.int64), np.zeros(laboratory.grid.n_line, np.int32)
    for _ in range(min(plan.n_steps, _EPISODE_STEPS)):
        if state.terminated[0] or state.truncated[0]:
            break
        kind = _kind(state)
        row = _KINDS.index(kind)
        closable = np.any(~state.line_status[0] & (state.time_before_cooldown_line[0] == 0))
        met[row] += 1, closable
        _draw_one(kept[kind], lambda: snapshot_of(engine, 0), int(met[row, 0]), _PER_EPISODE[kind], choices)
        before = state.line_status[0].copy()
        action = _policy_action(laboratory, policy, kind, draws)
        engine.step(0, action)
        if not state.terminated[0]:
            tripped += before & ~state.line_status[0] & ~_opened_otherwise(state, action)
    kinds = [kind for kind in _KINDS for _ in kept[kind]]
    return _Episode(kinds, [point for kind in _KINDS for point in kept[kind]], met, tripped)


def _draw_one(kept: list[Snapshot], take: Callable[[], Snapshot], number: int, most: int, choices: Stream) -> None:
    """Keep the ``number``-th of its kind so that in the end each has the same chance to be among at most ``most``."""
    if len(kept) < most:
        kept.append(take())
        return
    place = choices.integer(number)
    if place < most:
        kept[place] = take()


def _opened_otherwise(state: Any, action: StepAction) -> Flags:
    """Lines that are out for another reason than their protections, bool [line]."""
    opened = state.attacked[0] | (state.time_next_maintenance[0] == 0)
    opened[[change.target for change in action.changes if change.kind == ActionKind.SWITCH]] = True
    return np.asarray(opened)


def _lines_to_close(grid: Grid, tripped: I32) -> tuple[list[int], dict[str, int]]:
    """Lines whose switches level 0 holds anyway; and how often protections opened each of the others that they did."""
    known = {line for area in grid.opponent.areas for line in area}
    source = draw_scenario(grid.id, TRAIN, 0, 0).partition("/")[0]
    known |= set(find_system(grid.id).scenarios.maintenance(grid, source).lines)
    often = [int(line) for line in np.argsort(-tripped, kind="stable") if tripped[line] and line not in known]
    places = int(_CLOSING_SHARE * (grid.level_sizes[0] - 1))
    closed = [*sorted(known), *often][: max(places, min(len(known), grid.level_sizes[0] - 1))]
    return sorted(closed), {str(line): int(tripped[line]) for line in often if line not in closed}


def _switches(catalogue: ActionCatalogue, lines: list[int]) -> I32:
    """Catalogue ids of the switches of lines, int32 [line]."""
    wanted = (catalogue.kind == ActionKind.SWITCH) & np.isin(catalogue.target, lines)
    return np.flatnonzero(wanted).astype(np.int32)


def _episode_seed(seed: int, block: int) -> int:
    """A seed for episodes of one year; those of different blocks lie apart, and so play different years."""
    return int.from_bytes(hashlib.sha256(f"ranking {seed} {block}".encode()).digest()[:6], "big")


def _kind(state: Any) -> str:
    worst = float(state.rho[0].max())
    if worst >= STRESSED:
        return "stressed"
    return "near" if worst >= NEAR or not state.line_status[0].all() else "calm"


def _policy_action(laboratory: _Laboratory, policy: str, kind: str, draws: Stream) -> StepAction:
    """What a policy plays: nothing; the best of some actions when stressed, also with disturbances, or behind recovery.

    A disturbance is a random action that does no harm at once.
    """
    whim, pick = draws.uniform(2)
    disturb = policy == "disturbed" and whim < (0.2 if kind == "stressed" else 0.02)
    if policy == "recovering" and is_safe(laboratory.engine.state, 0):
        return one_change(*recovery_action(laboratory.engine.state, 0))
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
        if not _is_sound(file):
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


def _ranking_file(folder: Path, grid_id: str) -> Path:
    return folder / f"{grid_id}.ranking.npz"


def _refuse_another(file: Path, command: str) -> None:
    """Refuse to replace a ranking that was made in another way."""
    if not file.exists():
        return
    made_by = None
    damage = (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error)
    with contextlib.suppress(*damage), np.load(file) as arrays:
        made_by = json.loads(str(arrays["metadata"])).get("command")
    if made_by != command:
        raise UsageError(
            f"{file} exists already, made by {made_by or 'something else'!r}: choose another folder with --output."
        )


def _write(folder: Path, grid_id: str, ids: I32, scores: Scores, metadata: dict[str, Any]) -> Path:
    file = _ranking_file(folder, grid_id)
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
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    write_bytes(file, content.getvalue())


def _progress(grid_id: str, shown: bool) -> Progress:
    return Progress(
        TextColumn(grid_id + " {task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        disable=not shown,
    )
