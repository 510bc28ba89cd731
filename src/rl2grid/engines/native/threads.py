"""Threads that are there in the process that asks for them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

Result = TypeVar("Result")


class Threads:
    """A pool of threads. A process that was forked has none of its parent's, and would wait for them for ever."""

    def __init__(self, number: int, name: str) -> None:
        self._number, self._name = number, name
        self._pool, self._process = ThreadPoolExecutor(number, name), os.getpid()

    def map(self, function: Callable[..., Result], *arguments: Iterable[Any]) -> Iterator[Result]:
        """See :meth:`concurrent.futures.Executor.map`."""
        if self._process != os.getpid():
            self._pool, self._process = ThreadPoolExecutor(self._number, self._name), os.getpid()
        return self._pool.map(function, *arguments)
