"""Months made ahead of their use, by several processes, each a year at a time.

Months that are missing are otherwise made one by one where they are first asked for. Of the library of training years,
what is missing is made beside the training that plays what is there (:func:`make_library_beside`).
"""

from __future__ import annotations

import atexit
import functools
import os
import pickle
import queue
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from rl2grid import compile_notices
from rl2grid.errors import UsageError
from rl2grid.grids import Grid, System, find_system
from rl2grid.grids.systems import add_system
from rl2grid.processes import kill, take_standard_streams
from rl2grid.scenarios.cache import data_folder, free_bytes
from rl2grid.scenarios.generated import is_stored, make_months
from rl2grid.scenarios.month_names import MONTHS
from rl2grid.scenarios.splits import TRAINING_SEEDS

MAKERS = "RL2GRID_MAKERS"
"""Environment variable: how many processes make the library of training years beside a training; 0 for none, by default
one per core but one, and at least one."""
FEW_YEARS = 6
"""So many are made sooner by one process than others have started."""
PACKED = 4
"""A pack takes less than one of so many parts of its integers; a sixth was measured."""

_MAKER = "from rl2grid.scenarios.making import main; main()"
"""Not :mod:`multiprocessing`, which would import the caller's script again."""
_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


_IDLE_MAKER = f"import os; hasattr(os, 'nice') and os.nice(19); {_MAKER}"
"""Takes what time others leave."""


class Year(NamedTuple):
    """Months of the year of one seed, which are made together."""

    seed: int
    months: tuple[int, ...]
    """0 .. 11."""


class Years(Protocol):
    """What there is to make."""

    def get_nowait(self) -> Year:
        """The next year.

        Raises:
            queue.Empty: there is none left.
        """


def make_library_beside(grid: Grid) -> None:
    """Begin to make what is missing of the library of training years, once per process, in idle processes of their own.

    Where it does not fit, nothing is made ahead: some play a few years only. Who plays a year that is not there yet
    makes it, or waits for who does: nothing depends on how far they are. They end with this process.
    """
    _make_beside(grid, data_folder())


@functools.lru_cache(maxsize=64)
def _make_beside(grid: Grid, data: Path) -> None:
    from rl2grid.scenarios.training_years import has_library_room  # where it is needed, as the generator is

    missing = _MissingYears(grid)
    number = number_of_makers()
    if not number or not missing or not has_library_room(grid):
        return  # what is played is made when it is played
    ignored: queue.SimpleQueue[int | str] = queue.SimpleQueue()  # who plays the year will meet what is wrong
    system, quiet = find_system(grid.id), {compile_notices.VARIABLE: "1"}
    for _ in range(number):
        atexit.register(_Maker(system, missing, ignored, _IDLE_MAKER, quiet).stop)


def number_of_makers() -> int:
    """How many processes make the library beside a training.

    Raises:
        UsageError: what :data:`MAKERS` says is no number.
    """
    given = os.environ.get(MAKERS)
    if given is None:
        return max((os.cpu_count() or 1) - 1, 1)
    if not given.isdecimal():
        raise UsageError(f"{MAKERS}={given} is no number of processes: set it to 0 or more.")
    return int(given)


class _MissingYears:
    """Years of the library that are not there when somebody asks for the next to make."""

    def __init__(self, grid: Grid) -> None:
        self._grid = grid
        self._seeds = iter(TRAINING_SEEDS)
        self._lock = threading.Lock()

    def __bool__(self) -> bool:
        return not all(is_stored(self._grid, seed, 0) for seed in TRAINING_SEEDS)

    def get_nowait(self) -> Year:
        with self._lock:
            for seed in self._seeds:
                if not is_stored(self._grid, seed, 0):
                    return Year(seed, tuple(range(MONTHS)))
        raise queue.Empty


def make_packs(grid: Grid, months: Iterable[tuple[int, int]], workers: int | None = None) -> Iterator[int]:
    """Make the packs that are not there yet.

    Args:
        grid: the grid.
        months: (seed, month 0 .. 11) of each; those of one year are made together.
        workers: processes; with 1, this one makes them; None: this one if there are few, else one per core.

    Yields:
        How many months there are now, of those asked for.

    Raises:
        UsageError: the data folder cannot be written or has no room, or a process could not make its months.
    """
    asked = sorted(set(months))
    missing = [month for month in asked if not is_stored(grid, *month)]
    _check_room(grid, sum(seed not in TRAINING_SEEDS for seed, _ in missing))
    done = len(asked) - len(missing)
    yield done
    seeds = dict.fromkeys(seed for seed, _ in missing)
    years = [Year(seed, tuple(month for other, month in missing if other == seed)) for seed in seeds]
    if workers is None:
        workers = 1 if len(years) <= FEW_YEARS else os.cpu_count() or 1
    for made in _made_here(grid, years) if min(workers, len(years)) <= 1 else _made_elsewhere(grid, years, workers):
        done += made
        yield done


def _check_room(grid: Grid, missing: int) -> None:
    """Refuse months that do not fit, before any is made; years of the library are looked at where they are made."""
    if not missing:
        return
    from rl2grid.scenarios.generator.calendar import MONTH_ROWS  # where it is needed, as the generator is

    needed = missing * MONTH_ROWS * (2 * grid.n_load + grid.n_gen) * np.dtype(np.int16).itemsize // PACKED
    free = free_bytes()
    if needed > free:
        raise UsageError(
            f"{missing} months of {grid.id} are still to be made and take up to {needed / 1e6:,.0f} MB in "
            f"{data_folder()}, where {free / 1e6:,.0f} MB are free: free some, or set RL2GRID_DATA to a folder with "
            "more room."
        )


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
    makers = [_Maker(find_system(grid.id), waiting, made, _MAKER, {}) for _ in range(min(workers, len(years)))]
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

    def __init__(
        self,
        system: System,
        waiting: Years,
        made: queue.SimpleQueue[int | str],
        script: str,
        variables: Mapping[str, str],
    ) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", script],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **_ONE_THREAD, **variables},
        )
        self._thread = threading.Thread(target=self._ask, args=(system, waiting, made), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the process, whatever it is doing; what it was writing is not kept."""
        kill(self._process, self._thread)

    def _ask(self, system: System, waiting: Years, made: queue.SimpleQueue[int | str]) -> None:
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
        try:
            pickle.dump(answer, answers, pickle.HIGHEST_PROTOCOL)
            answers.flush()
        except BrokenPipeError:  # who asked was killed
            return
