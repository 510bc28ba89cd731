"""What the command line shows of a study: how far its cells are, and what came out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from rl2grid.studies.cells import Study
from rl2grid.studies.states import CellState, State


def study_table(study: Study, states: Sequence[CellState], remaining: float | None) -> RenderableType:
    """The course of a study as a table."""
    counts = {name: sum(state.state == name for state in states) for name in (State.DONE, State.RUNNING, State.FAILED)}
    head = f"{study.name}{f' ({study.scale})' if study.scale else ''}: {len(states)} cells, " + ", ".join(
        f"{count} {name}" for name, count in counts.items()
    )
    if remaining is not None:
        head += f", about {_duration(remaining)} left"
    table = Table(box=None, pad_edge=False)
    for column in ("cell", "state", "progress", "best survival", ""):
        table.add_column(column, no_wrap=column == "cell")
    for state in states:
        if state.state in (State.RUNNING, State.STOPPED):
            best = "-" if state.tail.best is None else f"{state.tail.best:.3f}"
            stage = f"{state.tail.decisions:,} of {state.decisions:,}" if state.decisions else "evaluation"
            table.add_row(state.cell.name, state.state, ProgressBar(1.0, state.share, width=20), best, stage)
    failures = [Text(f"{state.cell.name} failed: {state.error}") for state in states if state.state == State.FAILED]
    return Group(head, *([table] if table.row_count else []), *failures)


def results_table(states: Sequence[CellState]) -> Table:
    """Survival of the finished cells."""
    table = Table(box=None, pad_edge=False)
    table.add_column("cell", no_wrap=True)
    for column in ("survival", "episodes", "minutes"):
        table.add_column(column, justify="right")
    for state in states:
        if state.result is not None:
            result = state.result
            table.add_row(state.cell.name, f"{result.survival:.3f}", f"{result.episodes}", f"{result.minutes:.1f}")
    return table


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60.0)
    if minutes < 60:
        return f"{max(minutes, 1)} min"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours < 48 else f"{hours / 24:.0f} days"


@contextmanager
def live_display(console: Console | None) -> Iterator[Callable[[Callable[[], RenderableType]], None]]:
    """What to call with what is to be shown."""
    if console is None or not console.is_terminal:
        yield lambda make: None
        return
    with Live(console=console, auto_refresh=False, transient=False) as live:
        yield lambda make: live.update(make(), refresh=True)
