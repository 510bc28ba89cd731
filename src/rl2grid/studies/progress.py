"""What the command line shows of a study: how far its cells are, and what came out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from rl2grid.analysis.table import Cell, Column, ResultTable
from rl2grid.studies.cells import Study
from rl2grid.studies.states import CellState, State


def study_table(study: Study, states: Sequence[CellState], remaining: float | None) -> RenderableType:
    """The course of a study, to be seen while it runs."""
    table = Table(box=None, pad_edge=False)
    for column in ("cell", "state", "progress", "best survival", ""):
        table.add_column(column, no_wrap=column == "cell")
    for state in _under_way(states):
        bar = ProgressBar(1.0, state.share, width=20)
        table.add_row(state.cell.name, state.state, bar, _best(state), _stage(state))
    words = [Text(sentence) for sentence in failures(states)]
    return Group(headline(study, states, remaining), *([table] if table.row_count else []), *words)


def headline(study: Study, states: Sequence[CellState], remaining: float | None) -> str:
    """How many cells are how far, and how many seconds are left if that is known."""
    counts = {name: sum(state.state == name for state in states) for name in (State.DONE, State.RUNNING, State.FAILED)}
    head = f"{study.name}{f' ({study.scale})' if study.scale else ''}: {len(states)} cells, " + ", ".join(
        f"{count} {name}" for name, count in counts.items()
    )
    return head if remaining is None else f"{head}, about {_duration(remaining)} left"


def failures(states: Sequence[CellState]) -> list[str]:
    """Why cells were given up."""
    return [f"{state.cell.name} failed: {state.error}" for state in states if state.state == State.FAILED]


def cells_table(states: Sequence[CellState]) -> ResultTable:
    """The cells that were begun and have not ended."""
    columns = (
        Column("cell", words=True),
        Column("state", words=True),
        *map(Column, ("done", "best survival", "stage")),
    )
    rows = [
        tuple(map(Cell, (state.cell.name, state.state, f"{state.share:.0%}", _best(state), _stage(state))))
        for state in _under_way(states)
    ]
    return ResultTable("under way", "", columns, tuple(rows))


def results_table(states: Sequence[CellState]) -> ResultTable:
    """Survival of the finished cells."""
    columns = (Column("cell", words=True), *map(Column, ("survival", "episodes", "minutes")))
    finished = [(state.cell.name, state.result) for state in states if state.result is not None]
    rows = [
        tuple(map(Cell, (name, f"{result.survival:.3f}", f"{result.episodes}", f"{result.minutes:.1f}")))
        for name, result in finished
    ]
    return ResultTable("finished", "", columns, tuple(rows))


def _under_way(states: Sequence[CellState]) -> list[CellState]:
    return [state for state in states if state.state in (State.RUNNING, State.STOPPED)]


def _best(state: CellState) -> str:
    return "-" if state.tail.best is None else f"{state.tail.best:.3f}"


def _stage(state: CellState) -> str:
    return f"{state.tail.decisions:,} of {state.decisions:,}" if state.decisions else "evaluation"


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
