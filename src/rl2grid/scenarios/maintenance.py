"""Planned outages of lines: sampling them, and how far away they are."""

from __future__ import annotations

from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from rl2grid.grids import STEPS_PER_HOUR, MaintenanceConfig
from rl2grid.scenarios.scenario import STEP
from rl2grid.streams import Stream

ROWS_PER_DAY = 24 * STEPS_PER_HOUR
SATURDAY = 5
"""Of the weekdays, of which 0 is Monday."""


def sample_outages(
    config: MaintenanceConfig, start_datetime: datetime, n_rows: int, stream: Stream
) -> NDArray[np.int32]:
    """Planned outages of a whole series, as ``GridStateFromFileWithForecastsWithMaintenance`` samples them.

    Every calendar date that the series touches except the last stands for 288 rows, counted from
    row 0. On working days each line of ``config`` is drawn with the month's probability; of more than
    the month's daily maximum only so many stay, chosen uniformly; they are out from ``start_hour`` to
    ``end_hour`` of their rows. (Series begin at 00:00, or at 23:55 of the day before: there Grid2Op's
    weekday is that of the day before, which is replicated.)

    Returns:
        int32 [outage, 3]: line, first row, row after the last; by line and row.
    """
    weekday, month = calendar_of(start_datetime, n_rows)
    lines = np.array(config.lines, np.int64)
    draws = stream.uniform(len(month) * 2 * len(lines)).reshape(len(month), 2, len(lines))
    chance, priority = draws[:, 0], draws[:, 1]
    drawn = (chance < np.array(config.monthly_daily_probability)[month, None]) & (weekday < SATURDAY)[:, None]
    ranked = np.argsort(np.where(drawn, priority, 2.0), axis=1, kind="stable")
    most = np.minimum(drawn.sum(axis=1), np.array(config.monthly_max_per_day, np.int64)[month])
    kept = np.zeros_like(drawn)
    np.put_along_axis(kept, ranked, np.arange(len(lines)) < most[:, None], axis=1)
    day, which = np.nonzero(kept)
    first = day * ROWS_PER_DAY
    begin, end = first + config.start_hour * STEPS_PER_HOUR, first + config.end_hour * STEPS_PER_HOUR
    return clipped_outages(np.stack([lines[which], begin, end], axis=1), 0, n_rows)


def outages_of(matrix: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Outages of a matrix [row, line], int32 [outage, 3]: line, first row, row after the last; by line and row."""
    lines = np.flatnonzero(matrix.any(axis=0))
    padded = np.zeros((len(lines), len(matrix) + 2), np.int8)
    padded[:, 1:-1] = matrix[:, lines].T
    change = np.diff(padded, axis=1)
    which, begin = np.nonzero(change == 1)
    _, end = np.nonzero(change == -1)
    return np.stack([lines[which], begin, end], axis=1).astype(np.int32)


def matrix_of(outages: NDArray[np.int32], n_rows: int, n_line: int) -> NDArray[np.bool_]:
    """The inverse of :func:`outages_of`."""
    matrix = np.zeros((n_rows, n_line), np.bool_)
    for line, begin, end in outages.tolist():
        matrix[begin:end, line] = True
    return matrix


def clipped_outages(outages: NDArray[np.integer], first: int, n_rows: int) -> NDArray[np.int32]:
    """The part of outages [outage, 3] that is in ``n_rows`` rows from ``first`` on, counted from there.

    Returns:
        As :func:`outages_of`: outages of a line of which one begins where the other ends are one.
    """
    line, begin = outages[:, 0], np.maximum(outages[:, 1] - first, 0)
    end = np.minimum(outages[:, 2] - first, n_rows)
    order = np.lexsort((begin, line))
    order = order[begin[order] < end[order]]
    line, begin, end = line[order], begin[order], end[order]
    apart = np.ones(len(order), np.bool_)
    apart[1:] = (line[1:] != line[:-1]) | (begin[1:] > end[:-1])
    return np.stack([line[apart], begin[apart], end[np.append(apart[1:], True)[: len(order)]]], axis=1).astype(np.int32)


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


def calendar_of(start_datetime: datetime, n_rows: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Weekday (0 is Monday) and month (0 .. 11) of the calendar dates that a series touches, except the last."""
    first, last = start_datetime.date(), (start_datetime + (n_rows - 1) * STEP).date()
    dates = np.datetime64(first) + np.arange((last - first).days)
    return (first.weekday() + np.arange(len(dates))) % 7, dates.astype("datetime64[M]").astype(np.int64) % 12
