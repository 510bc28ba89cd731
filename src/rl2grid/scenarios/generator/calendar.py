"""How rows are counted and what day they are."""

from __future__ import annotations

from datetime import datetime, timedelta

import numpy as np

from rl2grid.arrays import F64, I64
from rl2grid.compile import jit

ROWS_PER_HOUR = 12
ROWS_PER_DAY = 288
MONTHS = 12
MONTH_STEPS = 28 * ROWS_PER_DAY
"""Steps of a month. Its last row is the first of the next month."""
MONTH_ROWS = MONTH_STEPS + 1
YEAR_ROWS = MONTHS * MONTH_STEPS + 1
"""A year is 12 blocks of 28 days from January 1st."""


def month_start(year: int, month: int) -> datetime:
    """Time stamp of the first row of a month (0 .. 11)."""
    return datetime(year, 1, 1) + timedelta(days=28 * month)


def day_kinds(year: int, days: int) -> I64:
    """0 for working days, 1 for Saturdays, 2 for Sundays, from January 1st: int64 [days]."""
    weekday = (datetime(year, 1, 1).weekday() + np.arange(days)) % 7
    return np.maximum(weekday - 4, 0).astype(np.int64)


@jit
def month_and_row(row: int, n_months: int) -> tuple[int, int]:
    """Which of ``n_months`` months in a row a row belongs to, and which row of that month it is.

    The last row of a month is the first of the next one, where there is a next one.
    """
    month = min(row // MONTH_STEPS, n_months - 1)
    return month, row - month * MONTH_STEPS


@jit
def seasonal(knots: F64, row: int) -> float:
    """Value at ``row`` of what is known in the middle of each of the 12 calendar months."""
    position = row * (12.0 / (365.0 * 288.0)) + 11.5
    whole = int(np.floor(position))
    part = position - whole
    return float(knots[whole % 12] * (1.0 - part) + knots[(whole + 1) % 12] * part)
