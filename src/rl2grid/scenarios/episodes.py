"""Which scenario an episode plays, from which row, for how many steps, with which outages.

All of it is a function of the seed and the episode's number, and of nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import UsageError
from rl2grid.grids import Grid, find_system
from rl2grid.scenarios.library import check_in_split, draw_scenario, open_series
from rl2grid.scenarios.maintenance import clipped_outages, matrix_of, outages_of, sample_outages
from rl2grid.scenarios.scenario import Scenario
from rl2grid.scenarios.splits import TRAIN
from rl2grid.streams import Purpose, Stream

if TYPE_CHECKING:
    from rl2grid.scenarios.training_years import TrainingMonths

MAX_STEPS = 8064
"""Steps of a completed episode where the series is that long: four weeks (paper, Section 4)."""
MIN_TRAINING_STEPS = 288
"""A random start leaves at least this many steps to play, or half the window if that is shorter."""
MAX_REDRAWS = 100
"""After so many overloaded rows an episode starts in the first one of its month, which the generator keeps secure."""


class EpisodePlan(NamedTuple):
    """One episode, decided before it begins."""

    seed: int
    """Seed of the environment."""
    number: int
    """Episodes of this seed before this one."""
    scenario_id: str
    """Argument of :func:`rl2grid.scenarios.library.load_scenario`."""
    start: int
    """Row of the scenario that the reset shows."""
    n_steps: int
    """Steps of the completed episode, T."""
    maintenance: bool = True
    """Whether planned outages happen."""
    redraws: int = 0
    """Rows that were drawn as the start before, and overload a line with nothing done."""


class PlannedStarts(NamedTuple):
    """What is drawn of several episodes, one entry each; see :class:`EpisodePlan`."""

    scenario_ids: NDArray[np.object_]
    """object [k]."""
    rows: NDArray[np.int64]
    """int64 [k], of the scenario, that the resets show."""
    redraws: NDArray[np.int64]
    """int64 [k], rows that were drawn before."""


class _Start(NamedTuple):
    row: int
    redraws: int


def plan_episode(
    grid: Grid,
    split: str,
    seed: int,
    number: int,
    *,
    scenario: str | None = None,
    start: int | None = None,
    maintenance: bool = True,
    episode_length: int | None = None,
) -> EpisodePlan:
    """Decide episode ``number`` of the stream of episodes of ``seed``.

    Training draws a year of the library, a month of it and a row of that month, again where nothing done overloads a
    line in that row (in the reference topology, with everything in service), and the episode goes on in the next month;
    of the full dataset, a scenario and a row with enough left to play (:data:`MIN_TRAINING_STEPS`). The other splits
    are enumerated: episode ``number`` of seed ``seed`` plays scenario ``seed + number`` of the list (beginning again at
    its end) from row 0. ``scenario`` and ``start`` replace what would be drawn and leave every other draw as it was.

    Args:
        grid: the grid.
        split: of the scenarios.
        seed: of the stream of episodes.
        number: episodes of the stream before this one.
        scenario: id; None: drawn, or the next one of the list.
        start: row that the reset shows; None: drawn in training, else 0.
        maintenance: whether planned outages happen.
        episode_length: steps of the completed episode; None: as many as there are, up to :data:`MAX_STEPS`.

    Raises:
        UsageError: ``split`` is unknown, ``scenario`` is not in it, ``start`` leaves nothing to play, or the scenario
            has fewer steps than ``episode_length``.
    """
    if scenario is not None:
        check_in_split(grid.id, split, scenario)
    else:
        scenario = draw_scenario(grid.id, split, seed, number)
    series = open_series(grid.id, scenario)
    redraws = 0
    if start is None:
        check_length(scenario, series.n_steps, episode_length)
        is_drawn = split == TRAIN
        start, redraws = _draw_start(grid, series, seed, number, episode_length) if is_drawn else _Start(0, 0)
    _check_start(start, scenario, series.n_steps)
    check_length(scenario, series.n_steps, episode_length, int(start))
    n_steps = min(MAX_STEPS, series.n_steps - int(start)) if episode_length is None else episode_length
    return EpisodePlan(seed, number, scenario, int(start), n_steps, maintenance, redraws)


def starts_of(plans: Sequence[EpisodePlan]) -> PlannedStarts:
    """What was drawn of ``plans``."""
    return PlannedStarts(
        np.array([plan.scenario_id for plan in plans], object),
        np.array([plan.start for plan in plans], np.int64),
        np.array([plan.redraws for plan in plans], np.int64),
    )


def admissible_starts(n_steps: int, episode_length: int | None = None) -> int:
    """Rows at which a training episode may start in a window of ``n_steps`` steps: 0 to this less one.

    An episode of a given length must fit.
    """
    return n_steps - (min(MIN_TRAINING_STEPS, (n_steps + 1) // 2) if episode_length is None else episode_length) + 1


def check_length(scenario_id: str, n_steps: int, episode_length: int | None, start: int = 0) -> None:
    """Refuse a scenario that is too short for an episode.

    Args:
        scenario_id: the scenario.
        n_steps: that can be played from its row 0.
        episode_length: steps of the completed episode; None: as many as there are.
        start: row at which the episode begins.

    Raises:
        UsageError: it is too short.
    """
    if episode_length is not None and n_steps - start < episode_length:
        raise UsageError(
            f"episode_length={episode_length} is longer than scenario {scenario_id}, which has {n_steps - start} steps "
            f"from row {start} on: give at most these, or None."
        )


def planned_outages(grid: Grid, scenario: Scenario | TrainingMonths, plan: EpisodePlan) -> NDArray[np.int32]:
    """The planned outages of an episode.

    Recorded ones where the scenario records them; else sampled as the grid samples them, or, in generated months of
    a grid that does not, as one of the same lines does. A window of a series has the rows that a sample of its whole
    series has there.

    Returns:
        int32 [outage, 3]: line, first row of ``scenario`` (the episode begins in row ``plan.start``), row after the
        last; by line and row.
    """
    if not plan.maintenance:
        return np.zeros((0, 3), np.int32)
    if scenario.maintenance is not None:
        return outages_of(scenario.maintenance)
    stream = Stream(plan.seed, plan.number, Purpose.MAINTENANCE)
    config = find_system(grid.id).scenarios.maintenance(grid, scenario.source)
    sampled = sample_outages(config, scenario.series_start_datetime, scenario.series_rows, stream)
    return clipped_outages(sampled, scenario.first_row, scenario.n_rows)


def maintenance_matrix(grid: Grid, scenario: Scenario, plan: EpisodePlan) -> NDArray[np.bool_]:
    """:func:`planned_outages` as bool [rows, line] for all rows of ``scenario``, read-only where recorded."""
    if plan.maintenance and scenario.maintenance is not None:
        return scenario.maintenance
    return matrix_of(planned_outages(grid, scenario, plan), scenario.n_rows, grid.n_line)


def _draw_start(
    grid: Grid, series: Scenario | TrainingMonths, seed: int, number: int, episode_length: int | None = None
) -> _Start:
    starts = admissible_starts(series.n_steps, episode_length)
    stream = Stream(seed, number, Purpose.START)
    if series.source != "generated":
        return _Start(stream.integer(starts), 0)
    starts = min(starts, MAX_STEPS)  # What follows is there to go on in.
    for redraws in range(MAX_REDRAWS):
        row = stream.integer(starts)
        if _is_secure(grid, series, row):
            return _Start(row, redraws)
    return _Start(0, MAX_REDRAWS)


def _is_secure(grid: Grid, series: Scenario | TrainingMonths, row: int) -> bool:
    """Whether no line is overloaded in a row, in the reference topology with everything in service."""
    # Imported where it is needed: compiling takes long, and planning recorded series compiles nothing.
    from rl2grid.scenarios.generator.constants import load_constants
    from rl2grid.scenarios.generator.security import assess

    if isinstance(series, Scenario):
        tenths = [np.rint(10 * array[row : row + 1]) for array in (series.load_p, series.load_q, series.prod_p)]
    else:
        tenths = [*series.rows(row, row + 1)]
    load_p, load_q, prod_p = (array.astype(np.int32) for array in tenths)
    verdict = assess(grid, load_constants(grid.id).voltage, load_p, load_q, prod_p)
    return verdict.converged and bool(verdict.loading[0] <= 1)


def _check_start(start: object, scenario_id: str, n_steps: int) -> None:
    allowed = f"choose an integer from 0 to {n_steps - 1}"
    if not isinstance(start, (int, np.integer)) or isinstance(start, bool):
        raise UsageError(f"Start {start!r} is no row of scenario {scenario_id}: {allowed}.")
    if not 0 <= start < n_steps:
        raise UsageError(f"Start {start} leaves nothing to play of scenario {scenario_id}: {allowed}.")
