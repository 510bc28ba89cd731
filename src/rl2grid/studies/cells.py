"""What a study is made of: cells, each an agent on a task, trained if it learns, and evaluated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rl2grid.algorithms.registry import Hyperparameters
from rl2grid.envs.tasks import Task, find_task
from rl2grid.errors import UsageError
from rl2grid.evaluation.protocol import first_months
from rl2grid.records.studies import CELLS_FOLDER, RUN_FOLDER
from rl2grid.studies.toml_file import with_tuples
from rl2grid.training import request


@dataclass(frozen=True)
class Lessons:
    """Who labels what imitation learns from, with rounds on the states that the pupil meets (DAgger)."""

    teacher: str
    rounds: tuple[int, ...]
    """Training months of each round: the teacher plays the first, the pupil of the round before the others."""


@dataclass(frozen=True)
class Training:
    """What a cell learns before it is evaluated."""

    algorithm: str
    seed: int
    preset: str
    hyperparameters: Mapping[str, Any]
    """Changes of the preset, the budget (``total_timesteps``) among them."""
    validations: int
    """Evaluations on the validation scenarios, spread evenly over the budget."""
    lessons: Lessons | None
    """What is labelled before it learns, for this cell alone; None: nothing."""

    @property
    def rounds(self) -> tuple[int, ...]:
        """Months of each round of labels; empty where nothing is labelled."""
        return self.lessons.rounds if self.lessons else ()

    def folders(self, cell: Path) -> list[Path]:
        """The run folders in that of a cell, in order: a pupil for each round of labels but the last, then the run."""
        return [*(cell / f"pupil-{number}" for number in range(1, len(self.rounds))), cell / RUN_FOLDER]

    def resolved(self, task: Task) -> Hyperparameters:
        """All hyperparameters, but for the folder of labels that the cell makes.

        Raises:
            UsageError: they cannot work, or not for this task.
        """
        return request.hyperparameters(self.algorithm, task, self.preset, seed=self.seed, **self.hyperparameters)


@dataclass(frozen=True)
class Cell:
    """One agent on one task: trained, if it learns, and evaluated."""

    name: str
    """Name of its folder, unique in the study."""
    agent: str
    """An agent without training, or the algorithm."""
    task: Task
    heuristic: str | None
    environment: Mapping[str, Any]
    """Further keywords of ``gymnasium.make``."""
    split: str
    months: int | None
    """How many months of a split are played; None: all."""
    evaluation_seeds: int
    """Episodes per month, with seeds 0, 1, ..."""
    training: Training | None

    @property
    def decisions(self) -> int:
        """Decisions to train for; 0 for agents that need no training."""
        return self.training.resolved(self.task).total_timesteps if self.training else 0

    @property
    def scenarios(self) -> tuple[str, ...]:
        """The months that are played."""
        return first_months(self.task, self.split, self.months)


@dataclass(frozen=True)
class Study:
    """All cells of a study at one scale."""

    name: str
    output: Path
    scale: str | None
    retries: int
    """How often a cell that failed is tried again."""
    cells: tuple[Cell, ...]
    slurm: Mapping[str, Any]
    """Parameters of the Slurm jobs (submitit's)."""

    def folder(self, cell: Cell) -> Path:
        """Where a cell is kept."""
        return self.output / CELLS_FOLDER / cell.name


def cell_to_dict(cell: Cell) -> dict[str, Any]:
    """A cell as it is stored in JSON."""
    return asdict(cell) | {"task": cell.task.id}


def cell_from_dict(stored: Mapping[str, Any]) -> Cell:
    """The inverse of :func:`cell_to_dict`.

    Raises:
        UsageError: there is no such task, or the entries are not those of a cell.
    """
    try:
        return _cell_from_dict(stored)
    except (TypeError, KeyError, AttributeError) as error:
        raise UsageError(f"Cell {stored.get('name')!r} is none of this version of rl2grid: {error}.") from None


def _cell_from_dict(stored: Mapping[str, Any]) -> Cell:
    cell = {**stored, "task": find_task(stored["task"]), "environment": with_tuples(stored["environment"])}
    if cell["training"] is not None:
        training = dict(cell["training"])
        if training["lessons"] is not None:
            training["lessons"] = Lessons(**with_tuples(training["lessons"]))
        cell["training"] = Training(**{**training, "hyperparameters": with_tuples(training["hyperparameters"])})
    return Cell(**cell)
