"""Outages sampled in compiled code are those that the scenarios sample."""

from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
import pytest

from rl2grid.grids import MaintenanceConfig, load_grid
from rl2grid.philox import stream_key
from rl2grid.scenarios.maintenance import clipped_outages, sample_outages
from rl2grid.scenarios.outage_draws import draw_outages, most_outages, outage_model
from rl2grid.streams import Purpose, Stream

ROWS = 2 * 8064 + 1
STARTS = [datetime(2050, 1, 1) + timedelta(days=28 * month) for month in range(11)]
FREQUENT = MaintenanceConfig((9, 2, 5, 4), (0.5,) * 12, (2, 1) * 6, 0, 24)
CONFIGS = {
    "bus14": load_grid("bus14").maintenance,
    "bus36-M": load_grid("bus36-M").maintenance,
    "bus118-MOB-v0": load_grid("bus118-MOB-v0").maintenance,
    "none": replace(FREQUENT, lines=()),
    "around the clock": FREQUENT,
    "as many as there are": replace(FREQUENT, monthly_max_per_day=(9,) * 12, start_hour=22, end_hour=23),
}


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
@pytest.mark.parametrize("start", [0, 1, 4000, 8063])
def test_outages_are_those_of_the_sample(config: MaintenanceConfig, start: int) -> None:
    model = outage_model(config, STARTS, ROWS)
    room = most_outages(model)
    assert room == 0 or config.lines
    for number in range(40):
        series = number % len(STARTS)
        sampled = sample_outages(config, STARTS[series], ROWS, Stream(3, number, Purpose.MAINTENANCE))
        expected = sampled - np.array([0, start, start])
        expected = expected[expected[:, 2] > 0]
        drawn = np.full((3, room), -7, np.int32)
        count = draw_outages(model, series, 3, stream_key(number, int(Purpose.MAINTENANCE)), start, *drawn)
        np.testing.assert_array_equal(drawn[:, :count].T, expected)
        np.testing.assert_array_equal(clipped_outages(sampled, start, ROWS - start)[:, 0], expected[:, 0])
