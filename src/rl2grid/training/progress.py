"""What a training shows of its course."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

Show = Callable[[int, float | None, float | None], None]
"""To be called after every iteration with the decisions so far, survival in training and that of the best policy."""


@contextmanager
def progress_bar(title: str, first: int, total: int, *, shown: bool) -> Iterator[Show]:
    """A bar with rate, ETA and survival; yields what to call after every iteration.

    Args:
        title: what is trained on what.
        first: decisions before this process began.
        total: decisions of the whole run.
        shown: whether there is anything to be seen.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("decisions, {task.fields[rate]}/s, survival {task.fields[survival]}, best {task.fields[best]}, ETA"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), disable=not shown) as progress:
        bar = progress.add_task(title, total=total, completed=first, rate="-", survival="-", best="-")
        began = time.perf_counter()

        def show(decisions: int, survival: float | None, best: float | None) -> None:
            progress.update(
                bar,
                completed=decisions,
                rate=f"{(decisions - first) / (time.perf_counter() - began):.0f}",
                survival="-" if survival is None else f"{survival:.2f}",
                best="-" if best is None else f"{best:.2f}",
            )

        yield show
