"""Two things that have nothing to do with each other, done at once."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

First = TypeVar("First")
Second = TypeVar("Second")


class Pair:
    """Runs two functions, and returns what both return.

    Args:
        at_once: Whether in two threads; else one after the other. PyTorch and compiled code let other threads run.
    """

    def __init__(self, at_once: bool) -> None:
        self._other = ThreadPoolExecutor(1, "rl2grid-learner") if at_once else None

    def run(self, first: Callable[[], First], second: Callable[[], Second]) -> tuple[First, Second]:
        """Run both; what either raises, when both have ended."""
        if self._other is None:
            return first(), second()
        beside = self._other.submit(second)
        try:
            done = first()
        finally:
            beside.exception()
        return done, beside.result()
