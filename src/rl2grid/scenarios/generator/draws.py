"""Which random numbers a generated year is made of."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rl2grid.streams import Purpose, Stream


class Channel(enum.IntEnum):
    """What the numbers are for; channels are independent."""

    DEMAND_SLOW = 0
    DEMAND_NOISE = 1
    INTERCHANGE_SLOW = 2
    INTERCHANGE_FAST = 3
    WIND_WEEK = 4
    WIND_HOURS = 5
    WIND_GUSTS = 6
    SOLAR_DAY = 7
    SOLAR_HOURS = 8
    PRICE = 9
    MIX = 10
    LOAD_FORECAST = 11
    RENEWABLE_FORECAST = 12


@dataclass(frozen=True)
class Draws:
    """The numbers of one channel of one month (0 where a whole year is drawn at once)."""

    seed: int
    attempt: int
    """How many years of this seed were discarded before."""
    channel: Channel
    month: int = 0

    def uniform(self, size: int) -> NDArray[np.float64]:
        """``size`` numbers in [0, 1)."""
        key = (self.attempt << 16) | (int(self.channel) << 8) | self.month
        return Stream(self.seed, key, Purpose.SERIES).uniform(size)
