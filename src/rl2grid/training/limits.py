"""How long a run may take."""

from __future__ import annotations

import math
import time

from rl2grid.errors import UsageError


class TimeLimit:
    """Wall-clock time of this process, counted from when the limit is made; of no influence on results."""

    def __init__(self, minutes: float | None) -> None:
        """``minutes``: None is no limit.

        Raises:
            UsageError: not a positive number.
        """
        if minutes is not None and not 0.0 < minutes < math.inf:
            raise UsageError(f"max_minutes={minutes} is not allowed: give a positive number of minutes, or None.")
        self._end = math.inf if minutes is None else time.monotonic() + 60.0 * minutes

    @property
    def reached(self) -> bool:
        """Whether the time is up."""
        return time.monotonic() >= self._end
