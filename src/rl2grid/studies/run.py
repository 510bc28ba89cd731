"""Running a study: cells are submitted, watched, tried again after failures, and collected.

Everything that is known of a study is in its folder, so that several processes may run the same study, and any of them
may be killed: a cell belongs to the process that holds its lock, and is finished when its result is written.

    cells/<cell>/   see :mod:`rl2grid.studies.cell`
    episodes.csv    all evaluated episodes of the finished cells
    study.json      cells, states, commands, identity hashes, minutes
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from rich.console import Console

from rl2grid.errors import UsageError
from rl2grid.records.files import make_own_folder
from rl2grid.records.locks import is_locked
from rl2grid.records.studies import (
    CELLS_FOLDER,
    STUDY_FILE,
    read_result,
    read_study,
    write_study,
    write_study_episodes,
)
from rl2grid.records.versions import library_versions
from rl2grid.studies.backends import Backend, Job
from rl2grid.studies.cell import BUSY, FINISHED, REFUSED, STOPPED, commands, last_error, prepare
from rl2grid.studies.cells import Study
from rl2grid.studies.progress import study_display
from rl2grid.studies.states import CellState, State, look, read_states
from rl2grid.training.interrupts import stop_requests

_POLL_SECONDS = 0.5
_BUSY_SECONDS = 5.0


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
    _check_same_study(study)
    make_own_folder(study.output, (STUDY_FILE, CELLS_FOLDER, "jobs"), "study")
    for cell in study.cells:
        if (study.folder(cell)).exists():
            prepare(study.folder(cell), cell)
    for cell in study.cells:
        prepare(study.folder(cell), cell)
    runner = _Runner(study, backend)
    with stop_requests() as stop, study_display(study, console) as show:
        while not stop.is_set() and runner.step():
            show(runner.states, runner.remaining_seconds())
            stop.wait(_POLL_SECONDS)
        if stop.is_set():
            if console is not None:
                console.print("Stopping: the cells write their checkpoints.")
            runner.stop()
        show(runner.states, None)
    runner.record()
    if stop.is_set():
        raise KeyboardInterrupt
    return runner.states


def _check_same_study(study: Study) -> None:
    stored = read_study(study.output) or {}
    for key, value in (("name", study.name), ("scale", study.scale)):
        if stored.get(key, value) != value:
            raise UsageError(
                f"{study.output} holds a study with another {key} ({stored[key]!r}): choose another "
                "folder with --output."
            )


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

    def stop(self) -> None:
        """Let all cells write their checkpoints and end."""
        for job in self._jobs.values():
            job.stop()
        while self._jobs:
            for number, job in list(self._jobs.items()):
                status = job.poll()
                if status is not None and not is_locked(self.states[number].folder):
                    del self._jobs[number]
                    look(self.states[number])
            time.sleep(_POLL_SECONDS / 5)

    def record(self) -> None:
        """Write what is known."""
        record_study(self.study, self.states)

    def remaining_seconds(self) -> float | None:
        """Estimate by the work done since the beginning; None while there is none."""
        done = sum(state.work * state.share for state in self.states)
        rate = (done - self._done_before) / (time.monotonic() - self._began)
        left = sum(state.work * (1.0 - state.share) for state in self.states if state.state != State.FAILED)
        return left / rate if rate > 0.0 else None

    def _submit(self, number: int, state: CellState) -> None:
        look(state)
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


def record_study(study: Study, states: Sequence[CellState]) -> None:
    """Write ``study.json`` and ``episodes.csv``, each whole or not at all."""
    study.output.mkdir(parents=True, exist_ok=True)
    finished = [state.cell for state in states if state.result is not None]
    write_study_episodes(
        study.output, [(cell.name, cell.training.seed if cell.training else None) for cell in finished]
    )
    cells = []
    for state in states:
        entry: dict[str, Any] = {"cell": state.cell.name, "state": state.state, "attempts": state.attempts}
        if state.error:
            entry["error"] = state.error
        if state.result is not None:
            entry |= vars(state.result)
        cells.append({**entry, "commands": commands(state.folder, state.cell)})
    write_study(
        study.output,
        {"name": study.name, "scale": study.scale, "versions": library_versions(), "cells": cells},
    )
