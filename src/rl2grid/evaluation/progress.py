"""What is shown of the course of many episodes."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

import rich.progress
from rich.console import Console
from rich.markup import escape

from rl2grid.evaluation.crew import Job, Progress
from rl2grid.records.files import printable


class Display:
    """Tells of the course of many episodes; this one keeps silent."""

    def skip(self, jobs: Iterable[Job]) -> None:
        """These were played in an earlier call."""

    def advance(self, progress: Progress) -> None:
        """An episode is under way."""

    def finish(self, job: Job, grid_steps: int) -> None:
        """An episode ended after so many steps."""


class ProgressBar(Display):
    """Episodes done, grid steps per second, remaining time."""

    def __init__(self, bar: rich.progress.Progress, words: str, n_jobs: int) -> None:
        self._bar = bar
        self._began = time.monotonic()
        self._shares: dict[Job, float] = {}
        self._steps: dict[Job, int] = {}
        self._finished = 0
        self._n_jobs = n_jobs
        self._id = bar.add_task(escape(printable(words)), total=n_jobs, rate="", count=f"0/{n_jobs}")

    def skip(self, jobs: Iterable[Job]) -> None:
        self._shares |= dict.fromkeys(jobs, 1.0)
        self._finished = len(self._shares)
        self._show()

    def advance(self, progress: Progress) -> None:
        self._shares[progress.job] = progress.grid_steps / progress.episode_length
        self._steps[progress.job] = progress.grid_steps
        self._show()

    def finish(self, job: Job, grid_steps: int) -> None:
        self._shares[job], self._steps[job] = 1.0, grid_steps
        self._finished += 1
        self._show()

    def _show(self) -> None:
        rate = sum(self._steps.values()) / max(time.monotonic() - self._began, 1e-3)
        self._bar.update(
            self._id,
            completed=sum(self._shares.values()),
            rate=f"{rate:,.0f} grid steps/s",
            count=f"{self._finished}/{self._n_jobs} episodes",
        )


@contextmanager
def show_progress(words: str, jobs: Sequence[Job], progress: bool) -> Iterator[Display]:
    """What to tell of the course of many episodes, with a bar or without.

    Args:
        words: what is done, as "Evaluating greedy".
        jobs: the episodes.
        progress: whether to show a bar.
    """
    if not progress:
        yield Display()
        return
    columns = (
        rich.progress.TextColumn("{task.description}"),
        rich.progress.BarColumn(),
        rich.progress.TextColumn("{task.fields[count]}"),
        rich.progress.TextColumn("{task.fields[rate]}"),
        rich.progress.TimeRemainingColumn(),
    )
    with rich.progress.Progress(*columns, console=Console(stderr=True)) as bar:
        yield ProgressBar(bar, words, len(jobs))


def watch_making(grid_id: str, made: Iterator[int], total: int, progress: bool) -> None:
    """Make months, with a bar if some are missing and somebody watches.

    Args:
        grid_id: of which grid.
        made: yields how many there are.
        total: how many there will be.
        progress: whether to show a bar.
    """
    there = next(made)
    if not progress or there == total:
        for _ in made:
            pass
        return
    columns = rich.progress.Progress.get_default_columns()
    with rich.progress.Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(f"Making months of {grid_id}", total=total, completed=there)
        for there in made:
            bar.update(task, completed=there)
