"""A scenario: what the outside world does to a grid, step by step."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, fields, replace
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import F32, Flags

STEP = timedelta(minutes=5)
"""Time between two rows."""


@dataclass(frozen=True, eq=False)
class Scenario:
    """Time series of one grid, 5 minutes a row; row 0 is what a reset at ``start=0`` shows.

    Columns follow the grid's element order. Arrays are read-only and memory-mapped: processes that
    load the same scenario share its pages. Attribute names are those of Grid2Op's
    ``GridStateFromFileWithForecasts``.
    """

    id: str
    """For example ``bundled/0000`` (a whole series) or ``bundled/0000[0:432]`` (rows 0 to 431 of it)."""
    grid_id: str
    source: str
    """Where the series comes from: ``bundled``, ``full`` or ``folder``."""
    start_datetime: datetime
    """Time stamp of row 0. Grid2Op shows row 0 with a clock one step later, and so do observations."""
    content_hash: str
    """Hash of every value of the scenario; the same on every machine."""
    first_row: int
    """Where this window begins in its series (0 for a whole series)."""
    series_rows: int
    """Rows of the series that this is a window of."""

    load_p: F32 = field(repr=False)
    """Demand, MW, float32 [rows, load]."""
    load_q: F32 = field(repr=False)
    """Reactive demand, MVAr, float32 [rows, load]."""
    prod_p: F32 = field(repr=False)
    """Scheduled generation, MW, float32 [rows, gen]."""
    prod_v: F32 | None = field(default=None, repr=False)
    """Voltage set-points, kV, float32 [rows, gen]; None: the grid file's set-points hold."""
    load_p_forecast: F32 | None = field(default=None, repr=False)
    """Forecast made at each row for the steps after it, MW, float32 [rows, horizon, load]."""
    load_q_forecast: F32 | None = field(default=None, repr=False)
    """MVAr, float32 [rows, horizon, load]."""
    prod_p_forecast: F32 | None = field(default=None, repr=False)
    """MW, float32 [rows, horizon, gen]."""
    prod_v_forecast: F32 | None = field(default=None, repr=False)
    """kV, float32 [rows, horizon, gen]."""
    maintenance: Flags | None = field(default=None, repr=False)
    """Recorded planned outages, bool [rows, line]; None: nothing is recorded."""

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return len(self.load_p)

    @property
    def n_steps(self) -> int:
        """Steps that can be played from row 0: one fewer than rows, since a reset shows row 0."""
        return self.n_rows - 1

    @property
    def series_start_datetime(self) -> datetime:
        """Time stamp of row 0 of the whole series."""
        return self.start_datetime - self.first_row * STEP

    def window(self, start: int, stop: int) -> Scenario:
        """Rows ``start`` to ``stop - 1`` of a whole series as a scenario of their own; nothing is copied."""
        suffix = f"[{start}:{stop}]"
        sliced: dict[str, Any] = {name: array[start:stop] for name, array in self.arrays().items()}
        return replace(
            self,
            id=self.id + suffix,
            start_datetime=self.start_datetime + start * STEP,
            content_hash=hashlib.sha256((self.content_hash + suffix).encode()).hexdigest(),
            first_row=self.first_row + start,
            **sliced,
        )

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays that this scenario has, by name."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
