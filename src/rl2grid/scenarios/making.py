"""Months made ahead of their use, by several processes, each a year at a time.

Months that are missing are otherwise made one by one where they are first asked for.
"""

from __future__ import annotations

import os
import pickle
import queue
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from rl2grid.errors import UsageError
from rl2grid.grids import Grid, System, find_system
from rl2grid.grids.systems import add_system
from rl2grid.processes import kill, take_standard_streams
from rl2grid.scenarios.generated import make_months, pack_path

FEW_YEARS = 6
"""So many are made sooner by one process than others have started."""

_MAKER = "from rl2grid.scenarios.making import main; main()"
"""Not :mod:`multiprocessing`, which would import the caller's script again."""
_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


class Year(NamedTuple):
    """Months of the year of one seed, which are made together."""

    seed: int
    months: tuple[int, ...]
    """0 .. 11."""


def make_packs(grid: Grid, months: Iterable[tuple[int, int]], workers: int | None = None) -> Iterator[int]:
    """Make the packs that are not there yet.

    Args:
        grid: the grid.
        months: (seed, month 0 .. 11) of each; those of one year are made together.
        workers: processes; with 1, this one makes them; None: this one if there are few, else one per core.

    Yields:
        How many months there are now, of those asked for.

    Raises:
        UsageError: the data folder cannot be written, or a process could not make its months.
    """
    asked = sorted(set(months))
    missing = [month for month in asked if not pack_path(grid, *month).is_file()]
    done = len(asked) - len(missing)
    yield done
    seeds = dict.fromkeys(seed for seed, _ in missing)
    years = [Year(seed, tuple(month for other, month in missing if other == seed)) for seed in seeds]
    if workers is None:
        workers = 1 if len(years) <= FEW_YEARS else os.cpu_count() or 1
    for made in _made_here(grid, years) if min(workers, len(years)) <= 1 else _made_elsewhere(grid, years, workers):
        done += made
        yield done


def _made_here(grid: Grid, years: list[Year]) -> Iterator[int]:
    for year in years:
        for month in year.months:
            make_months(grid, year.seed, [month])
            yield 1


def _made_elsewhere(grid: Grid, years: list[Year], workers: int) -> Iterator[int]:
    """Each process takes the next year when it has made its last."""
    waiting: queue.SimpleQueue[Year] = queue.SimpleQueue()
    for year in years:
        waiting.put(year)
    made: queue.SimpleQueue[int | str] = queue.SimpleQueue()
    makers = [_Maker(find_system(grid.id), waiting, made) for _ in range(min(workers, len(years)))]
    left = sum(len(year.months) for year in years)
    try:
        while left:
            number = made.get()
            if isinstance(number, str):
                raise UsageError(number)
            left -= number
            yield number
    finally:
        for maker in makers:
            maker.stop()


class _Maker:
    """A process that makes years, and the thread that asks it for them."""

    def __init__(self, system: System, waiting: queue.SimpleQueue[Year], made: queue.SimpleQueue[int | str]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", _MAKER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | _ONE_THREAD,
        )
        self._thread = threading.Thread(target=self._ask, args=(system, waiting, made), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the process, whatever it is doing; what it was writing is not kept."""
        kill(self._process, self._thread)

    def _ask(self, system: System, waiting: queue.SimpleQueue[Year], made: queue.SimpleQueue[int | str]) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            pickle.dump(system, self._process.stdin, pickle.HIGHEST_PROTOCOL)
            while True:
                year = waiting.get_nowait()
                pickle.dump(year, self._process.stdin, pickle.HIGHEST_PROTOCOL)
                self._process.stdin.flush()
                answer = pickle.load(self._process.stdout)
                made.put(answer)
        except queue.Empty:
            return
        except (OSError, EOFError, pickle.UnpicklingError, ValueError):
            made.put(f"A process that made months of {system.id} died with exit status {self._process.wait()}.")


def main() -> None:
    """Make the years that are asked for on the standard input."""
    requests, answers = take_standard_streams()
    system: System = pickle.load(requests)
    add_system(system)
    while True:
        try:
            year = pickle.load(requests)
        except EOFError:
            return
        answer: int | str = len(year.months)
        try:
            make_months(system.grid, year.seed, year.months)
        except UsageError as error:
            answer = str(error)
        pickle.dump(answer, answers, pickle.HIGHEST_PROTOCOL)
        answers.flush()
