"""Which random numbers a generated year is made of."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.compile import jit
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
    """The numbers of one channel, or of one part of it where a year is not drawn at once."""

    seed: int
    attempt: int
    """How many years of this seed were discarded before."""
    channel: Channel
    part: int = 0

    def uniform(self, size: int) -> NDArray[np.float64]:
        """``size`` numbers in [0, 1)."""
        key = channel_key(self.attempt, int(self.channel), self.part)
        return Stream(self.seed, key, Purpose.SERIES).uniform(size)


@jit
def channel_key(attempt: int, channel: int, part: int) -> int:
    """The "episode" of a channel's stream (:class:`rl2grid.streams.Stream`)."""
    return (attempt << 24) | (channel << 16) | part


class Portion(NamedTuple):
    """Rows ``first`` to ``stop - 1`` of one possible year, drawn at once."""

    seed: int
    attempt: int
    first: int
    stop: int
    part: int = 0
    """Tells portions of the same year apart, whose numbers are independent."""

    def draws(self, channel: Channel) -> Draws:
        """The numbers of a channel."""
        return Draws(self.seed, self.attempt, channel, self.part)
