"""Running a study: cells are submitted, watched, tried again after failures, and collected.

Everything that is known of a study is in its folder, so that several processes may run the same study, and any of them
may be killed: a cell belongs to the process that holds its lock, and is finished when its result is written.

    cells/<cell>/   see :mod:`rl2grid.studies.cell`
    episodes.csv    all evaluated episodes of the finished cells
    study.json      cells, states, commands, identity hashes, minutes
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from rl2grid.records.collection import EVALUATION_FOLDER, RUN_FOLDER, STUDY_FILE
from rl2grid.records.episodes import COLUMN_NAMES, EPISODES_FILE, format_row, read_episodes
from rl2grid.records.files import make_folder, write_json
from rl2grid.records.trainings import METRICS_FILE, VALIDATION
from rl2grid.records.versions import library_versions
from rl2grid.studies.backends import Backend, Job
from rl2grid.studies.cell import (
    BUSY,
    FINISHED,
    REFUSED,
    STOPPED,
    CellResult,
    commands,
    is_busy,
    last_error,
    played_episodes,
    prepare,
    read_result,
)
from rl2grid.studies.study import Cell, Study
from rl2grid.training.interrupts import stop_requests

_POLL_SECONDS = 0.5
_BUSY_SECONDS = 5.0
_AGENT_WORK = 5_000
"""What the evaluation of an agent without training counts, in decisions, when remaining time is estimated."""


class State(StrEnum):
    """How a cell is."""

    WAITING = "waiting"
    RUNNING = "running"
    STOPPED = "stopped"
    FAILED = "failed"
    DONE = "done"


@dataclass
class CellState:
    """What is known of a cell."""

    cell: Cell
    folder: Path
    decisions: int
    """To train for."""
    state: State = State.WAITING
    attempts: int = 0
    error: str = ""
    """Last line of the last failure."""
    result: CellResult | None = None
    not_before: float = 0.0
    """Monotonic time before which it is not submitted."""
    tail: MetricsTail = field(init=False)

    def __post_init__(self) -> None:
        self.tail = MetricsTail(self.folder / RUN_FOLDER / METRICS_FILE)

    @property
    def work(self) -> float:
        """Size of the cell, in decisions."""
        return float(self.decisions or _AGENT_WORK)

    @property
    def share(self) -> float:
        """Share of the work that is done, 0 to 1; the evaluation after a training counts nothing."""
        if self.result is not None:
            return 1.0
        if self.decisions:
            return min(self.tail.decisions / self.decisions, 1.0)
        return min(played_episodes(self.folder) / self.episodes, 1.0)

    @property
    def episodes(self) -> int:
        """Episodes to evaluate."""
        return len(self.cell.scenarios) * self.cell.evaluation_seeds


class MetricsTail:
    """Follows a file of metrics that grows."""

    def __init__(self, path: Path) -> None:
        self.decisions = 0
        self.best: float | None = None
        """Highest survival on the validation scenarios."""
        self._path, self._offset = path, 0
        self._last = b""
        """The last line that was read, which ends at the offset."""

    def read(self) -> None:
        """Take in what was appended."""
        if not self._path.exists():
            return
        with self._path.open("rb") as file:
            file.seek(self._offset - len(self._last))
            if file.read(len(self._last)) != self._last:  # a resumed run cut it back, and perhaps wrote on since
                self.decisions, self.best, self._offset, self._last = 0, None, 0, b""
                file.seek(0)
            text = file.read()
        lines = text[: text.rfind(b"\n") + 1].splitlines(keepends=True)
        if not lines:
            return
        self._offset, self._last = self._offset + sum(map(len, lines)), lines[-1]
        for line in lines:
            match line.decode("utf-8").rstrip("\n").split(","):
                case ["step", *_]:
                    continue
                case [step, _, _, name, value]:
                    self.decisions = int(step)
                    if name == VALIDATION:
                        self.best = max(float(value), self.best or 0.0)


def read_states(study: Study) -> list[CellState]:
    """What the study's folder says of every cell."""
    failures = _recorded_failures(study.output / STUDY_FILE)
    states = []
    for cell in study.cells:
        state = CellState(cell, study.folder(cell), cell.decisions)
        _look(state)
        if state.state in (State.WAITING, State.STOPPED) and cell.name in failures:
            state.state, state.error = State.FAILED, failures[cell.name]
        states.append(state)
    return states


def run_study(study: Study, backend: Backend, console: Console | None = None) -> list[CellState]:
    """Work on all cells that are not finished, until none is left or an interrupt asks to stop.

    Args:
        study: what to do.
        backend: where to do it.
        console: where progress is shown; None: nowhere.

    Raises:
        UsageError: the study's folder holds cells of another definition; nothing was begun.
        KeyboardInterrupt: the user asked to stop; all cells have written their checkpoints.
    """
    make_folder(study.output)
    for cell in study.cells:
        if (study.folder(cell)).exists():
            prepare(study.folder(cell), cell)
    for cell in study.cells:
        prepare(study.folder(cell), cell)
    runner = _Runner(study, backend)
    with stop_requests() as stop, _display(console) as show:
        while not stop.is_set() and runner.step():
            show(lambda: study_table(study, runner.states, runner.remaining_seconds()))
            stop.wait(_POLL_SECONDS)
        if stop.is_set():
            runner.stop(lambda: show(lambda: "Stopping: the cells write their checkpoints."))
        show(lambda: study_table(study, runner.states, None))
    runner.record()
    if stop.is_set():
        raise KeyboardInterrupt
    return runner.states


class _Runner:
    """The cells of a study on their way."""

    def __init__(self, study: Study, backend: Backend) -> None:
        self.study, self.backend = study, backend
        self.states = read_states(study)
        self._jobs: dict[int, Job] = {}
        self._began = time.monotonic()
        self._done_before = sum(state.work * state.share for state in self.states)
        for state in self.states:
            if state.state != State.DONE:
                state.state, state.error = State.WAITING, ""
        self.record()

    def step(self) -> bool:
        """Collect what ended, submit what fits; returns whether anything is left to do."""
        for number, job in list(self._jobs.items()):
            status = job.poll()
            if status is None:
                self.states[number].tail.read()
                continue
            del self._jobs[number]
            self._ended(self.states[number], status)
            self.record()
        for number, state in enumerate(self.states):
            if len(self._jobs) >= self.backend.slots:
                break
            if state.state == State.WAITING and time.monotonic() >= state.not_before:
                self._submit(number, state)
        return any(state.state in (State.WAITING, State.RUNNING) for state in self.states)

    def stop(self, show: Callable[[], None]) -> None:
        """Let all cells write their checkpoints and end."""
        for job in self._jobs.values():
            job.stop()
        while self._jobs:
            show()
            for number, job in list(self._jobs.items()):
                status = job.poll()
                if status is not None and not is_busy(self.states[number].folder):
                    del self._jobs[number]
                    _look(self.states[number])
            time.sleep(_POLL_SECONDS / 5)

    def record(self) -> None:
        """Write what is known."""
        write_study(self.study, self.states)

    def remaining_seconds(self) -> float | None:
        """Estimate by the work done since the beginning; None while there is none."""
        done = sum(state.work * state.share for state in self.states)
        rate = (done - self._done_before) / (time.monotonic() - self._began)
        left = sum(state.work * (1.0 - state.share) for state in self.states if state.state != State.FAILED)
        return left / rate if rate > 0.0 else None

    def _submit(self, number: int, state: CellState) -> None:
        _look(state)
        if state.state == State.DONE:
            self.record()
            return
        if state.state == State.RUNNING:  # by another process
            state.state, state.not_before = State.WAITING, time.monotonic() + _BUSY_SECONDS
            return
        self._jobs[number] = self.backend.submit(state.folder)
        state.state = State.RUNNING

    def _ended(self, state: CellState, status: int) -> None:
        state.tail.read()
        state.result = read_result(state.folder)
        if status == FINISHED and state.result is not None:
            state.state = State.DONE
            return
        state.state = State.WAITING
        if status in (BUSY, STOPPED):
            state.not_before = time.monotonic() + _BUSY_SECONDS
            return
        state.attempts += 1
        state.error = last_error(state.folder)
        if status == REFUSED or state.attempts > self.study.retries:
            state.state = State.FAILED


def write_study(study: Study, states: Sequence[CellState]) -> None:
    """Write ``study.json`` and ``episodes.csv``, each whole or not at all."""
    study.output.mkdir(parents=True, exist_ok=True)
    _write_episodes(study.output / EPISODES_FILE, states)
    cells = []
    for state in states:
        entry: dict[str, Any] = {"cell": state.cell.name, "state": state.state, "attempts": state.attempts}
        if state.error:
            entry["error"] = state.error
        if state.result is not None:
            entry |= vars(state.result)
        cells.append({**entry, "commands": commands(state.folder, state.cell)})
    write_json(
        study.output / STUDY_FILE,
        {"name": study.name, "scale": study.scale, "versions": library_versions(), "cells": cells},
    )


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


def _look(state: CellState) -> None:
    """Find out from the folder how a cell is."""
    state.result = read_result(state.folder)
    state.tail.read()
    if state.result is not None:
        state.state = State.DONE
    elif is_busy(state.folder):
        state.state = State.RUNNING
    elif (state.folder / RUN_FOLDER).exists() or (state.folder / EVALUATION_FOLDER).exists():
        state.state = State.STOPPED
    else:
        state.state = State.WAITING


def _recorded_failures(path: Path) -> dict[str, str]:
    """Error messages of the cells that the last process of the study gave up."""
    if not path.exists():
        return {}
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return {entry["cell"]: entry["error"] for entry in cells if entry["state"] == State.FAILED}


def _write_episodes(path: Path, states: Sequence[CellState]) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with temporary.open("w", encoding="utf-8", newline="") as file:
        file.write(",".join(("cell", "training_seed", *COLUMN_NAMES)) + "\n")
        for state in states:
            if state.result is None:
                continue
            seed = state.cell.training.seed if state.cell.training else ""
            for episode in read_episodes(state.folder / EVALUATION_FOLDER / EPISODES_FILE):
                file.write(f"{state.cell.name},{seed},{format_row(episode)}")
    os.replace(temporary, path)


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60.0)
    if minutes < 60:
        return f"{max(minutes, 1)} min"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours < 48 else f"{hours / 24:.0f} days"


@contextmanager
def _display(console: Console | None) -> Iterator[Callable[[Callable[[], RenderableType]], None]]:
    """What to call with what is to be shown."""
    if console is None or not console.is_terminal:
        yield lambda make: None
        return
    with Live(console=console, auto_refresh=False, transient=False) as live:
        yield lambda make: live.update(make(), refresh=True)
