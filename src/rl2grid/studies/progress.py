"""What the command line shows of a study: how far its cells are, and what came out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from rl2grid.analysis.table import Cell, Column, ResultTable
from rl2grid.records.logs import LOG_FILE
from rl2grid.studies.cells import Study
from rl2grid.studies.states import CellState, State

_LINE_SECONDS = 60.0
"""Without a terminal it is said how far a study is when nothing was said for this long."""


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
    if not state.decisions:
        return "evaluation"
    if state.tail.decisions == 0 and state.rounds:
        return f"labels and pupils, round {min(state.pupils + 1, state.rounds)} of {state.rounds}"
    return f"{state.tail.decisions:,} of {state.decisions:,}"


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60.0)
    if minutes < 60:
        return f"{max(minutes, 1)} min"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours < 48 else f"{hours / 24:.0f} days"


Show = Callable[[Sequence[CellState], float | None], None]
"""To be called with the states of all cells and the seconds that are left, if that is known."""


@contextmanager
def study_display(study: Study, console: Console | None) -> Iterator[Show]:
    """What to call whenever something may have changed: a table in a terminal, elsewhere a line for each change."""
    if console is None:
        yield lambda states, remaining: None
    elif console.is_terminal:
        with Live(console=console, auto_refresh=False, transient=False) as live:
            yield lambda states, remaining: live.update(study_table(study, states, remaining), refresh=True)
    else:
        yield _Lines(study, console).show


class _Lines:
    """The course of a study as lines: what is begun, how far it is every minute, what has ended."""

    def __init__(self, study: Study, console: Console) -> None:
        self._study, self._console = study, console
        self._known: dict[str, str] = {}
        self._told = time.monotonic()

    def show(self, states: Sequence[CellState], remaining: float | None) -> None:
        """Say what has changed."""
        changed = [state for state in states if self._known.get(state.cell.name) != state.state]
        first = not self._known
        self._known |= {state.cell.name: str(state.state) for state in states}
        if first:
            self._say(headline(self._study, states, remaining))
        for state in changed:
            if state.state != State.WAITING and not (first and state.state == State.DONE):
                self._say(f"{state.cell.name}: {_news(state)}")
        if time.monotonic() - self._told >= _LINE_SECONDS:
            self._say(headline(self._study, states, remaining))

    def _say(self, words: str) -> None:
        self._told = time.monotonic()
        self._console.print(words, soft_wrap=True, highlight=False, markup=False)


def _news(state: CellState) -> str:
    if state.state == State.RUNNING:
        return f"begun; {state.folder / LOG_FILE} says more, such as what is compiled"
    if state.state == State.FAILED:
        return f"failed: {state.error}"
    return str(state.state) if state.result is None else f"{state.state}, survival {state.result.survival:.3f}"
