"""Draws of the bootstrap: how often each run and each month is drawn in each resample.

Random numbers come from a counter-based generator, so that an interval is a function of the results alone.
"""

from __future__ import annotations

import functools

import numpy as np

from rl2grid.arrays import F64

RESAMPLES = 2000
"""Bootstrap samples of an interval."""
MONTHS = 0
"""Stream of the months, which all methods share; runs of different methods are drawn from streams of their own."""


@functools.lru_cache(maxsize=32)
def drawn(n: int, resamples: int, stream: int) -> F64:
    """How often each of ``n`` is drawn when ``n`` are drawn with replacement.

    Args:
        n: of runs or months.
        resamples: number of bootstrap samples.
        stream: what is drawn with the same stream is drawn alike.

    Returns:
        float64 [resample, n], read-only.
    """
    if n == 1:
        counts = np.ones((resamples, 1))
    else:
        # Philox's raw output, as in rl2grid.streams.
        raw = np.random.Philox(key=stream).random_raw(resamples * n)
        chosen = ((raw >> np.uint64(11)).astype(np.float64) * 2.0**-53 * n).astype(np.int64)
        places = np.arange(resamples).repeat(n) * n + chosen
        counts = np.bincount(places, minlength=resamples * n).reshape(resamples, n).astype(np.float64)
    counts.setflags(write=False)
    return counts
