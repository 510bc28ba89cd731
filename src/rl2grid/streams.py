"""Counter-based random streams: a draw is a pure function of (seed, episode, purpose, index).

Nothing that a benchmark draws may depend on batch size, threads or the version of a distribution
sampler. A stream is therefore the raw output of Philox4x64 (Salmon et al., 2011), whose key is made
of the seed, the episode number and the purpose; uniforms and integers are derived from it here.
"""

from __future__ import annotations

import enum

import numpy as np
from numpy.typing import NDArray


class Purpose(enum.IntEnum):
    """What a stream is for; streams of different purposes are independent."""

    SCENARIO = 0
    START = 1
    MAINTENANCE = 2
    OPPONENT = 3
    AGENT = 4
    SERIES = 5
    IMAGINATION = 6


class Stream:
    """A sequence of random numbers identified by (seed, episode, purpose)."""

    def __init__(self, seed: int, episode: int, purpose: Purpose) -> None:
        if seed < 0 or episode < 0:
            raise ValueError(f"seed and episode must not be negative, got {seed} and {episode}.")
        key = np.array([seed & 0xFFFFFFFFFFFFFFFF, (episode << 8) | int(purpose)], dtype=np.uint64)
        self._bits = np.random.Philox(key=key)

    def uniform(self, size: int) -> NDArray[np.float64]:
        """``size`` numbers in [0, 1), on the grid of multiples of 2^-53."""
        raw = self._bits.random_raw(size)
        return (raw >> np.uint64(11)).astype(np.float64) * 2.0**-53

    def integer(self, bound: int) -> int:
        """A number in 0 .. bound - 1 (the bias of at most bound * 2^-53 is immaterial here)."""
        return int(self.uniform(1)[0] * bound)
