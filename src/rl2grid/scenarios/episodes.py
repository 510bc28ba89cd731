"""Which scenario an episode plays, from which row, for how many steps, with which outages.

All of it is a function of the seed and the episode's number, and of nothing else.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.scenarios.cache import data_folder
from rl2grid.scenarios.full import full_data_folder, is_full_requested
from rl2grid.scenarios.generated import draw_training_months, maintenance_of
from rl2grid.scenarios.library import check_in_split, list_scenarios, load_scenario
from rl2grid.scenarios.maintenance import sample_maintenance
from rl2grid.scenarios.scenario import Scenario
from rl2grid.scenarios.splits import GENERATED_TRAINING, TRAINING_SPLITS
from rl2grid.streams import Purpose, Stream

MAX_STEPS = 8064
"""Steps of a completed episode where the series is that long: four weeks (paper, Section 4)."""
MIN_TRAINING_STEPS = 288
"""A random start leaves at least this many steps to play, or half the window if that is shorter."""


@dataclass(frozen=True)
class EpisodePlan:
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


def plan_episode(
    grid: Grid,
    split: str,
    seed: int,
    number: int,
    *,
    scenario: str | None = None,
    start: int | None = None,
    maintenance: bool = True,
) -> EpisodePlan:
    """Decide episode ``number`` of the stream of episodes of ``seed``.

    Training draws a random row of the split, uniformly among those with enough left to play
    (:data:`MIN_TRAINING_STEPS`); of the full dataset, whose scenarios have one length, the scenario is drawn
    uniformly, so that planning does not have to read all of them; of generated months, a year, a month and a row of
    it, and the episode goes on in the next month. The other splits are enumerated: episode ``number`` of seed
    ``seed`` plays scenario ``seed + number`` of the list (beginning again at its end) from row 0. ``scenario`` and
    ``start`` replace what would be drawn and leave every other draw as it was.

    Raises:
        UsageError: ``split`` is unknown, ``scenario`` is not in it, or ``start`` leaves nothing to play.
    """
    if scenario is not None:
        check_in_split(grid.id, split, scenario)
    else:
        scenario = _choose_scenario(grid, split, seed, number)
    n_steps = load_scenario(grid.id, scenario).n_steps
    if start is None:
        start = _draw_start(split, n_steps, seed, number) if split in TRAINING_SPLITS else 0
    _check_start(start, scenario, n_steps)
    return EpisodePlan(seed, number, scenario, int(start), min(MAX_STEPS, n_steps - int(start)), maintenance)


def admissible_starts(n_steps: int) -> int:
    """Rows at which a training episode may start in a window of ``n_steps`` steps: 0 to this less one."""
    return n_steps - min(MIN_TRAINING_STEPS, (n_steps + 1) // 2) + 1


def maintenance_matrix(grid: Grid, scenario: Scenario, plan: EpisodePlan) -> NDArray[np.bool_]:
    """The planned outages of an episode.

    Recorded ones where the scenario records them; else sampled as the grid samples them, or, in generated months of
    a grid that does not, as one of the same lines does. A window of a series has the rows that a sample of its whole
    series has there.

    Returns:
        bool [rows, line] for all rows of ``scenario`` (the episode begins in row ``plan.start``), read-only
        where recorded.
    """
    if not plan.maintenance:
        return np.zeros((scenario.n_rows, grid.n_line), np.bool_)
    if scenario.maintenance is not None:
        return scenario.maintenance
    stream = Stream(plan.seed, plan.number, Purpose.MAINTENANCE)
    start, rows = scenario.series_start_datetime, scenario.series_rows
    matrix = sample_maintenance(maintenance_of(grid, scenario), start, rows, grid.n_line, stream)
    return matrix[scenario.first_row : scenario.first_row + scenario.n_rows]


def _choose_scenario(grid: Grid, split: str, seed: int, number: int) -> str:
    if split == GENERATED_TRAINING:
        return f"generated/{draw_training_months(seed, number)}"
    ids = list_scenarios(grid.id, split)
    return _draw_scenario(grid, ids, seed, number) if split in TRAINING_SPLITS else ids[(seed + number) % len(ids)]


def _draw_scenario(grid: Grid, ids: tuple[str, ...], seed: int, number: int) -> str:
    stream = Stream(seed, number, Purpose.SCENARIO)
    if is_full_requested():
        return ids[stream.integer(len(ids))]
    ends = _cumulative_starts(grid, ids, data_folder(), full_data_folder())
    return ids[int(np.searchsorted(ends, stream.integer(int(ends[-1])), side="right"))]


def _draw_start(split: str, n_steps: int, seed: int, number: int) -> int:
    starts = admissible_starts(n_steps)
    if split == GENERATED_TRAINING:
        starts = min(starts, MAX_STEPS)  # What follows is there to go on in.
    return Stream(seed, number, Purpose.START).integer(starts)


@functools.lru_cache(maxsize=32)
def _cumulative_starts(grid: Grid, ids: tuple[str, ...], data: Path, full_data: Path) -> NDArray[np.int64]:
    """Number of rows at which an episode may start in the scenarios up to and with each."""
    return np.cumsum([admissible_starts(load_scenario(grid.id, scenario_id).n_steps) for scenario_id in ids])


def _check_start(start: object, scenario_id: str, n_steps: int) -> None:
    allowed = f"choose an integer from 0 to {n_steps - 1}"
    if not isinstance(start, (int, np.integer)) or isinstance(start, bool):
        raise UsageError(f"Start {start!r} is no row of scenario {scenario_id}: {allowed}.")
    if not 0 <= start < n_steps:
        raise UsageError(f"Start {start} leaves nothing to play of scenario {scenario_id}: {allowed}.")
