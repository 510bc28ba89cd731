"""Planned outages are Grid2Op's."""

from datetime import datetime, timedelta
from typing import Any

import numpy as np
import pytest
from grid2op.Chronics import GridStateFromFileWithForecastsWithMaintenance, GridValue
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as numpy_strategies
from numpy.typing import NDArray

from rl2grid.grids import MaintenanceConfig
from rl2grid.scenarios.maintenance import clipped_outages, maintenance_times, matrix_of, outages_of, sample_outages
from rl2grid.streams import Purpose, Stream

NAMES = tuple(f"line_{i}" for i in range(8))
CONFIG = MaintenanceConfig((1, 2, 4, 5, 7), (0.0, 0.2, 0.5, *[0.3] * 9), (0, 2, 1, *[3] * 9), 9, 17)


def grid2op_times(column: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    return GridValue.get_maintenance_time_1d(column), GridValue.get_maintenance_duration_1d(column)


@settings(max_examples=200, deadline=None)
@given(numpy_strategies.arrays(np.bool_, st.tuples(st.integers(1, 40), st.integers(1, 3))))
def test_times_equal_grid2ops(matrix: NDArray[Any]) -> None:
    """Grid2Op is asked about a series that begins one quiet row earlier: see the next test."""
    time, duration = maintenance_times(matrix)
    assert time.dtype == duration.dtype == np.int32
    for line in range(matrix.shape[1]):
        expected = grid2op_times(np.concatenate(([0.0], matrix[:, line])))
        np.testing.assert_array_equal(time[:, line], expected[0][1:])
        np.testing.assert_array_equal(duration[:, line], expected[1][1:])
        if not matrix[0, line]:
            np.testing.assert_array_equal(time[:, line], grid2op_times(matrix[:, line].astype(float))[0])
            np.testing.assert_array_equal(duration[:, line], grid2op_times(matrix[:, line].astype(float))[1])


def test_an_outage_under_way_in_the_first_row_is_counted_down() -> None:
    matrix = np.array([1, 1, 0, 0, 1, 1, 1, 0], bool)[:, None]
    time, duration = maintenance_times(matrix)
    assert time[:, 0].tolist() == [0, 0, 2, 1, 0, 0, 0, -1]
    assert duration[:, 0].tolist() == [2, 1, 3, 3, 3, 2, 1, 0]
    theirs, _ = grid2op_times(matrix[:, 0].astype(float))
    assert theirs[4] == -1, "Grid2Op loses the second outage; if it no longer does, the docstring is out of date"


def test_an_episode_inside_a_series_sees_the_rows_of_the_series() -> None:
    rng = np.random.default_rng(0)
    matrix = np.repeat(rng.random((60, 5)) < 0.2, 7, axis=0)
    time, duration = maintenance_times(matrix)
    for start in (3, 100, 210, 419):
        window_time, window_duration = maintenance_times(matrix[start:])
        np.testing.assert_array_equal(window_time, time[start:])
        np.testing.assert_array_equal(window_duration, duration[start:])


class ReplayedDraws:
    """Stands in for Grid2Op's generator and hands it our draws, working day after working day."""

    def __init__(self, days: list[NDArray[Any]]) -> None:
        self._days = iter(days)

    def choice(
        self, options: Any, p: list[float] | None = None, size: int = 1, replace: bool = True
    ) -> NDArray[np.generic]:
        if p is not None:
            chance, self._priority = next(self._days)
            self._out = chance < p[1]
            return self._out.copy()
        assert not replace
        assert options == self._out.sum()
        return np.argsort(self._priority[self._out])[options - size :]


@pytest.mark.parametrize("start", [datetime(2019, 1, 5, 23, 55), datetime(2012, 2, 20), datetime(2035, 3, 30, 12, 30)])
@pytest.mark.parametrize("n_rows", [8065, 576, 300, 100])
def test_a_sample_equals_grid2ops_with_the_same_draws(start: datetime, n_rows: int) -> None:
    total = 0
    for seed in range(5):
        outages = sample_outages(CONFIG, start, n_rows, Stream(seed, 3, Purpose.MAINTENANCE))
        ours = matrix_of(outages, n_rows, len(NAMES))
        last = start + (n_rows - 1) * timedelta(minutes=5)
        n_dates = (last.date() - start.date()).days
        draws = Stream(seed, 3, Purpose.MAINTENANCE).uniform(n_dates * 10).reshape(n_dates, 2, 5)
        working = [draws[day] for day in range(n_dates) if (start.date() + timedelta(days=day)).weekday() < 5]
        theirs = GridStateFromFileWithForecastsWithMaintenance._generate_matenance_static(
            NAMES,
            n_rows,
            {NAMES[line] for line in CONFIG.lines},
            timedelta(minutes=5),
            start,
            CONFIG.start_hour,
            CONFIG.end_hour,
            CONFIG.monthly_daily_probability,
            CONFIG.monthly_max_per_day,
            ReplayedDraws(working),
        )
        np.testing.assert_array_equal(ours, theirs.astype(bool))
        total += int(ours.sum())
    assert total > 0 or n_rows < 8065


def test_frequency_maximum_and_hours() -> None:
    config, n_rows = MaintenanceConfig((0, 3), (0.25,) * 12, (1,) * 12, 9, 17), 288 * 28 + 1
    samples = np.stack(
        [
            matrix_of(sample_outages(config, datetime(2019, 1, 6), n_rows, stream), n_rows, 4)
            for stream in (Stream(seed, 0, Purpose.MAINTENANCE) for seed in range(200))
        ]
    )
    assert not samples[:, :, [1, 2]].any()
    days = samples[:, :-1].reshape(200, 28, 288, 4)
    assert not days[:, :, : 9 * 12].any()
    assert not days[:, :, 17 * 12 :].any()
    assert (days[:, :, 108] == days[:, :, 203]).all()
    assert days.any(axis=2).sum(axis=2).max() == 1
    working = days[:, [day for day in range(28) if day % 7 not in (0, 6)]]  # The series begins on a Sunday.
    assert days.sum() == working.sum()
    # Both drawn (1/16 of days): one of them stays, so each line is out on 1/4 - 1/32 of the days.
    assert working[:, :, 150, [0, 3]].mean(axis=(0, 1)) == pytest.approx([7 / 32] * 2, abs=0.02)


@settings(max_examples=200, deadline=None)
@given(numpy_strategies.arrays(np.bool_, st.tuples(st.integers(1, 40), st.integers(1, 3))), st.data())
def test_outages_are_those_of_the_matrix_and_of_each_of_its_windows(matrix: NDArray[Any], data: st.DataObject) -> None:
    n_rows, n_line = matrix.shape
    outages = outages_of(matrix)
    np.testing.assert_array_equal(matrix_of(outages, n_rows, n_line), matrix)
    first = data.draw(st.integers(0, n_rows - 1))
    length = data.draw(st.integers(1, n_rows - first))
    shuffled = outages[data.draw(st.permutations(range(len(outages))))]
    window = clipped_outages(shuffled, first, length)
    assert window.dtype == np.int32
    np.testing.assert_array_equal(window, outages_of(matrix[first : first + length]))


def test_outages_that_meet_are_one() -> None:
    outages = np.array([[3, 288, 576], [1, 5, 7], [3, 0, 288], [1, 7, 9], [1, 10, 12]])
    assert clipped_outages(outages, 0, 1000).tolist() == [[1, 5, 9], [1, 10, 12], [3, 0, 576]]
