"""Planned outages sampled in compiled code, where episodes begin by the thousand.

What is sampled is what :func:`rl2grid.scenarios.maintenance.sample_outages` samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Annotated, NamedTuple

import numpy as np

from rl2grid.arrays import F64, I32, I64, Flags
from rl2grid.compile import jit
from rl2grid.grids import STEPS_PER_HOUR, MaintenanceConfig
from rl2grid.philox import fill_uniforms
from rl2grid.scenarios.maintenance import ROWS_PER_DAY, SATURDAY, calendar_of
from rl2grid.structures import constant


class OutageModel(NamedTuple):
    """How outages of series of one length are sampled in compiled code; ``series`` counts their first time stamps."""

    line: Annotated[I32, constant("maintained", "in ascending order")]
    draw: Annotated[I64, constant("maintained", "place of its draws among those of a day")]
    probability: Annotated[F64, constant("12", "that a line is drawn on a working day of a calendar month")]
    most: Annotated[I64, constant("12", "lines out on one day")]
    begin: Annotated[I64, constant("1", "row of the day in which an outage begins")]
    end: Annotated[I64, constant("1", "first row of the day after it")]
    rows: Annotated[I64, constant("1", "of a series")]
    weekday: Annotated[I64, constant("series day", "0 is Monday")]
    month: Annotated[I64, constant("series day", "calendar month, 0 .. 11")]


def outage_model(config: MaintenanceConfig, starts: Sequence[datetime], n_rows: int) -> OutageModel:
    """The model of ``n_rows`` rows from each of ``starts``, all at the same time of day."""
    order = np.argsort(np.array(config.lines, np.int64), kind="stable")
    calendars = [calendar_of(start, n_rows) for start in starts]
    return OutageModel(
        np.array(config.lines, np.int32)[order],
        order,
        np.array(config.monthly_daily_probability, np.float64),
        np.array(config.monthly_max_per_day, np.int64),
        np.array([config.start_hour * STEPS_PER_HOUR], np.int64),
        np.array([config.end_hour * STEPS_PER_HOUR], np.int64),
        np.array([n_rows], np.int64),
        np.stack([weekday for weekday, _ in calendars]).astype(np.int64),
        np.stack([month for _, month in calendars]).astype(np.int64),
    )


def most_outages(model: OutageModel) -> int:
    """No sample has more."""
    each_day = np.minimum(model.most, len(model.line))[model.month]
    return int(each_day.sum(axis=1).max(initial=0))


@jit
def draw_outages(
    model: OutageModel, series: int, seed: int, key: int, start: int, line: I32, begin: I32, end: I32
) -> int:
    """Sample a series' outages, those excepted that are over before row ``start``; rows are counted from there.

    Args:
        model: of the grid.
        series: whose calendar holds.
        seed: of the stream.
        key: of the stream, see :func:`rl2grid.philox.fill_uniforms`.
        start: row.
        line: output, int32 [outage], with room for :func:`most_outages`; as the next two.
        begin: output, first row, negative if it began before.
        end: output, row after the last.

    Returns:
        How many there are; they are ordered by line and row.
    """
    n_days, n_lines = model.month.shape[1], model.line.size
    kept = np.zeros((n_days, n_lines), np.bool_)
    draws = np.empty(2 * n_lines)
    for day in range(n_days):
        if model.weekday[series, day] < SATURDAY and n_lines:
            fill_uniforms(seed, key, day * draws.size, draws)
            _keep_some(model, model.month[series, day], draws, kept[day])
    count, n_rows = 0, int(model.rows[0])
    for k in range(n_lines):
        first, last = 0, -1  # of an outage that may go on
        for day in range(n_days):
            if not kept[day, model.draw[k]]:
                continue
            opens = min(day * ROWS_PER_DAY + int(model.begin[0]), n_rows)
            closes = min(day * ROWS_PER_DAY + int(model.end[0]), n_rows)
            if opens >= closes:
                continue
            if opens > last:
                count = _note_outage(model.line[k], first - start, last - start, count, line, begin, end)
                first = opens
            last = closes
        count = _note_outage(model.line[k], first - start, last - start, count, line, begin, end)
    return count


@jit
def _keep_some(model: OutageModel, month: int, draws: F64, kept: Flags) -> None:
    """Of the lines drawn for a day, those of lowest priority number, as many as may be out in ``month``."""
    n_lines = kept.size
    left = model.most[month]
    while left > 0:
        best = -1
        for k in range(n_lines):
            drawn = not kept[k] and draws[k] < model.probability[month]
            if drawn and (best < 0 or draws[n_lines + k] < draws[n_lines + best]):
                best = k
        if best < 0:
            return
        kept[best] = True
        left -= 1


@jit
def _note_outage(number: int, first: int, last: int, count: int, line: I32, begin: I32, end: I32) -> int:
    """Enter an outage that is not over in row 0; returns how many are entered now."""
    if last <= 0:
        return count
    line[count], begin[count], end[count] = number, first, last
    return count + 1
