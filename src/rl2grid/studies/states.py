"""How the cells of a study are, as their folders say."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

from rl2grid.records.locks import is_locked
from rl2grid.records.metrics import METRICS_FILE, MetricsTail
from rl2grid.records.studies import (
    EVALUATION_FOLDER,
    LABELS_FOLDER,
    RUN_FOLDER,
    CellResult,
    played_episodes,
    read_result,
    read_study,
)
from rl2grid.studies.cells import Cell, Study

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
        return float(len(self._trainings) * self.decisions or _AGENT_WORK)

    @property
    def rounds(self) -> int:
        """Rounds of labels that it learns from."""
        return len(self.cell.training.rounds) if self.cell.training else 0

    @property
    def _trainings(self) -> list[Path]:
        return self.cell.training.folders(self.folder) if self.cell.training else []

    @property
    def pupils(self) -> int:
        """Pupils that were begun, each after its round of labels."""
        return sum(pupil.exists() for pupil in self._trainings[:-1])

    @property
    def share(self) -> float:
        """Share of the work that is done, 0 to 1; the evaluation after a training counts nothing."""
        if self.result is not None:
            return 1.0
        if self.decisions:
            return (self.pupils + min(self.tail.decisions / self.decisions, 1.0)) / len(self._trainings)
        return min(played_episodes(self.folder) / self.episodes, 1.0)

    @property
    def episodes(self) -> int:
        """Episodes to evaluate."""
        return len(self.cell.scenarios) * self.cell.evaluation_seeds


def read_states(study: Study) -> list[CellState]:
    """What the study's folder says of every cell."""
    failures = _recorded_failures(study.output)
    states = []
    for cell in study.cells:
        state = CellState(cell, study.folder(cell), cell.decisions)
        look(state)
        if state.state in (State.WAITING, State.STOPPED) and cell.name in failures:
            state.state, state.error = State.FAILED, failures[cell.name]
        states.append(state)
    return states


def look(state: CellState) -> None:
    """Find out from the folder how a cell is."""
    state.result = read_result(state.folder)
    state.tail.read()
    if state.result is not None:
        state.state = State.DONE
    elif is_locked(state.folder):
        state.state = State.RUNNING
    elif any((state.folder / begun).exists() for begun in (RUN_FOLDER, EVALUATION_FOLDER, LABELS_FOLDER)):
        state.state = State.STOPPED
    else:
        state.state = State.WAITING


def _recorded_failures(folder: Path) -> dict[str, str]:
    """Error messages of the cells that the last process of the study gave up."""
    stored = read_study(folder) or {"cells": []}
    return {entry["cell"]: str(entry.get("error")) for entry in stored["cells"] if entry.get("state") == State.FAILED}
