"""Time series handed to Grid2Op from memory, so that a reset reads no file."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from grid2op.Chronics import GridValue
from numpy.typing import NDArray

from rl2grid.scenarios.maintenance import maintenance_times
from rl2grid.scenarios.scenario import Scenario

_STEP = timedelta(minutes=5)


@dataclass(frozen=True)
class _Shared:
    """A scenario that copies of an environment share: it is read-only, and copying months takes memory.

    (A ``__deepcopy__`` of the chronics would be taken for that of Grid2Op's ``ChronicsHandler``, which
    forwards unknown attributes to them.)
    """

    scenario: Scenario

    def __deepcopy__(self, memo: dict[int, Any]) -> _Shared:
        return self


class ScenarioChronics(GridValue):
    """Plays a window of a :class:`~rl2grid.scenarios.scenario.Scenario` (``grid2op.Chronics.GridValue``).

    Row ``start`` is the state after a reset, row ``start + t`` that of step ``t``.
    """

    MULTI_CHRONICS = False

    def __init__(
        self,
        time_interval: timedelta = _STEP,
        max_iter: int = -1,
        start_datetime: datetime = datetime(2019, 1, 1),
        chunk_size: int | None = None,
        *,
        scenario: Scenario,
        n_line: int,
        **_from_files: Any,  # Grid2Op adds what its file readers need, such as the folder of the series
    ) -> None:
        super().__init__(time_interval, max_iter, start_datetime, chunk_size)
        self._no_hazard = np.zeros(n_line, np.int32)
        self.play(scenario, 0, scenario.n_steps, np.zeros((scenario.n_rows, n_line), np.bool_))

    def play(self, scenario: Scenario, start: int, n_steps: int, maintenance: NDArray[np.bool_]) -> None:
        """Choose the episode of the next reset.

        Args:
            scenario: the series.
            start: row of the first state.
            n_steps: steps of a completed episode.
            maintenance: bool [rows of the series, line].
        """
        self._shared = _Shared(scenario)
        self._start = start
        self._n_steps = n_steps
        self._maintenance = maintenance[start:]
        time_next, duration_next = maintenance_times(maintenance)
        self._time_next, self._duration_next = time_next[start:], duration_next[start:]

    def initialize(self, *orders: Any, names_chronics_to_backend: Any = None) -> None:
        """Called by Grid2Op at each reset; the series already are in the grid's order."""
        self.next_chronics()

    @property
    def _scenario(self) -> Scenario:
        return self._shared.scenario

    def next_chronics(self) -> None:
        """Back to the row before the first."""
        self.current_index = self._start - 1
        self.curr_iter = 0
        # As with Grid2Op's file readers, the first row is shown five minutes after the start of the series.
        self.start_datetime = self._scenario.start_datetime + self._start * _STEP
        self.current_datetime = self.start_datetime

    def load_next(self) -> tuple[Any, ...]:
        """The next row (``GridValue.load_next``)."""
        self.current_index += 1
        row = self.current_index
        if row > self._start + self._n_steps:
            raise StopIteration
        self.curr_iter += 1
        self.current_datetime += self.time_interval
        scenario, k = self._scenario, row - self._start
        values = {
            "injection": {
                "load_p": np.array(scenario.load_p[row]),
                "load_q": np.array(scenario.load_q[row]),
                "prod_p": np.array(scenario.prod_p[row]),
            },
            "maintenance": self._maintenance[k],
        }
        return (
            self.current_datetime,
            values,
            self._time_next[k].copy(),
            self._duration_next[k].copy(),
            self._no_hazard,
            None if scenario.prod_v is None else np.array(scenario.prod_v[row]),
        )

    def forecasts(self) -> list[tuple[datetime, dict[str, Any]]]:
        """One entry per horizon recorded with the series; the last rows have what was recorded for them."""
        scenario, row = self._scenario, self.current_index
        if scenario.load_p_forecast is None:
            return []
        # Grid2Op asks at every step, and reads the values only in simulate: hand out views.
        columns = [
            (name, values[row])
            for name, values in (
                ("load_p", scenario.load_p_forecast),
                ("load_q", scenario.load_q_forecast),
                ("prod_p", scenario.prod_p_forecast),
                ("prod_v", scenario.prod_v_forecast),
            )
            if values is not None
        ]
        return [
            (
                self.current_datetime + (horizon + 1) * _STEP,
                {"injection": {name: values[horizon] for name, values in columns}},
            )
            for horizon in range(scenario.load_p_forecast.shape[1])
        ]

    def done(self) -> bool:
        """All steps of the episode were played."""
        return self.curr_iter > self._n_steps

    def max_timestep(self) -> int:
        """Steps of a completed episode."""
        return self._n_steps

    def check_validity(self, backend: Any) -> None:
        """Nothing to check: a Scenario is checked when it is made."""

    def get_id(self) -> str:
        """The scenario's id (a constant string: Grid2Op asks at every step)."""
        return self._scenario.id
