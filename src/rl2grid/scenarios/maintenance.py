"""Planned outages of lines: sampling them, and how far away they are."""

from __future__ import annotations

from datetime import date, datetime

import numpy as np
from numpy.typing import NDArray

from rl2grid.grids import STEPS_PER_HOUR, MaintenanceConfig
from rl2grid.scenarios.scenario import STEP
from rl2grid.streams import Stream

_ROWS_PER_DAY = 24 * STEPS_PER_HOUR
_SATURDAY = 5


def sample_maintenance(
    config: MaintenanceConfig, start_datetime: datetime, n_rows: int, n_line: int, stream: Stream
) -> NDArray[np.bool_]:
    """Planned outages of a whole series, as ``GridStateFromFileWithForecastsWithMaintenance`` samples them.

    Every calendar date that the series touches except the last stands for 288 rows, counted from
    row 0. On working days each line of ``config`` is drawn with the month's probability; of more than
    the month's daily maximum only so many stay, chosen uniformly; they are out from ``start_hour`` to
    ``end_hour`` of their rows. (Series begin at 00:00, or at 23:55 of the day before: there Grid2Op's
    weekday is that of the day before, which is replicated.)

    Returns:
        bool [rows, line], True where a line is out.
    """
    dates = _dates(start_datetime, n_rows)
    lines = np.array(config.lines, dtype=np.int64)
    draws = stream.uniform(len(dates) * 2 * len(lines)).reshape(len(dates), 2, len(lines))
    matrix = np.zeros((n_rows, n_line), np.bool_)
    for day, (this, (chance, priority)) in enumerate(zip(dates, draws, strict=True)):
        if this.weekday() >= _SATURDAY:
            continue
        out = chance < config.monthly_daily_probability[this.month - 1]
        ranked = np.argsort(np.where(out, priority, 2.0), kind="stable")
        kept = ranked[: min(int(out.sum()), config.monthly_max_per_day[this.month - 1])]
        first = day * _ROWS_PER_DAY
        rows = slice(first + config.start_hour * STEPS_PER_HOUR, first + config.end_hour * STEPS_PER_HOUR)
        matrix[rows, lines[kept]] = True
    return matrix


def maintenance_times(matrix: NDArray[np.bool_]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """When the next outage of each line begins and how long it lasts, at every row.

    Grid2Op's ``get_maintenance_time_1d`` and ``get_maintenance_duration_1d``, column by column, with one
    difference: Grid2Op misses an outage that is under way in row 0 (it looks for a change from 0 to 1)
    and then mixes up the later ones. Here it is like any outage under way: time 0, and what remains
    of it. So the values of an episode that begins inside a series are rows of the values of the series.

    Args:
        matrix: bool [rows, line], True where a line is out.

    Returns:
        Steps to the next outage, int32 [rows, line] (0 during one, -1 if there is none any more), and its
        length in steps, int32 [rows, line] (what remains during one, 0 if there is none any more).
    """
    time = np.full(matrix.shape, -1, np.int32)
    duration = np.zeros(matrix.shape, np.int32)
    lines = np.flatnonzero(matrix.any(axis=0))
    if not len(lines):
        return time, duration
    out = matrix[:, lines]
    n_rows = len(out)
    row = np.arange(n_rows)[:, None]
    begins = _next_row(out)
    ends = np.vstack((_next_row(~out), np.full(len(lines), n_rows)))
    planned = begins < n_rows
    time[:, lines] = np.where(planned, begins - row, -1)
    # During an outage ``begins`` is the row itself, so this is what remains of it.
    duration[:, lines] = np.where(planned, np.take_along_axis(ends, begins, axis=0) - begins, 0)
    return time, duration


def _next_row(flags: NDArray[np.bool_]) -> NDArray[np.int64]:
    """For every row the first row at or after it whose flag is set, or the number of rows."""
    n_rows = len(flags)
    own = np.where(flags, np.arange(n_rows)[:, None], n_rows)
    result: NDArray[np.int64] = np.minimum.accumulate(own[::-1], axis=0)[::-1]
    return result


def _dates(start_datetime: datetime, n_rows: int) -> list[date]:
    """The calendar dates that a series touches, except the last."""
    first, last = start_datetime.date(), (start_datetime + (n_rows - 1) * STEP).date()
    return [date.fromordinal(ordinal) for ordinal in range(first.toordinal(), last.toordinal())]
