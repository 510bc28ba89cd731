"""Threads that are there in the process that asks for them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any, TypeVar

Result = TypeVar("Result")


class Threads:
    """A pool of threads. A process that was forked has none of its parent's, and would wait for them for ever.

    Args:
        number: how many work at the same time, the one that asks included.
        name: of the others.
    """

    def __init__(self, number: int, name: str) -> None:
        self._number, self._name = max(number - 1, 1), name
        self._pool, self._process = ThreadPoolExecutor(self._number, name), os.getpid()

    def map(self, function: Callable[..., Result], *arguments: Iterable[Any]) -> list[Result]:
        """The results of ``function`` for each of the arguments; the first is worked on by the thread that asks.

        To hand work to another thread and to be told that it is done take as long as dozens of grid steps.
        """
        if self._process != os.getpid():
            self._pool, self._process = ThreadPoolExecutor(self._number, self._name), os.getpid()
        own, *others = zip(*arguments, strict=True)
        futures = [self._pool.submit(function, *each) for each in others]
        try:
            first = function(*own)
        finally:
            wait(futures)
        return [first, *(future.result() for future in futures)]
