"""What a study is made of: cells, each an agent on a task, trained if it learns, and evaluated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rl2grid.algorithms.registry import Hyperparameters
from rl2grid.envs.tasks import Task, find_task
from rl2grid.errors import UsageError
from rl2grid.evaluation.protocol import first_months
from rl2grid.records.studies import CELLS_FOLDER, LABELS_FOLDER, RUN_FOLDER
from rl2grid.records.trainings import IMITATION
from rl2grid.studies.toml_file import with_tuples
from rl2grid.training import request

GOES_ON = {"ppo": "ppo", "lagrangian-ppo": "ppo", "sac": "sac"}
"""Algorithms that can go on from a pupil, and which policy it must have."""
_INHERITED = (
    "gamma",
    "reward_scale",
    "mask_actions",
    "normalize_observations",
    "network",
    "shortlist",
    "joint_actions",
    "actor_layers",
    "critic_layers",
    "torch_threads",
    "device",
)
"""Hyperparameters that a pupil shares with the algorithm that goes on from it."""


@dataclass(frozen=True)
class Lessons:
    """Who labels what pupils learn from, with rounds on the states that the pupil before meets (DAgger)."""

    teacher: str
    rounds: tuple[int, ...]
    """Training months of each round: the teacher plays the first, the pupil of the round before the others."""
    pupil_budget: int | None
    """Labels that each pupil learns from where another algorithm goes on from the last one; None: the run is itself the
    last pupil, and all have its hyperparameters."""


@dataclass(frozen=True)
class Round:
    """Training months that a teacher labels."""

    teacher: str
    months: int
    pupil: Path | None
    """Who plays them; None: the teacher."""
    folder: Path
    """Of the labels."""


@dataclass(frozen=True)
class Step:
    """One of the trainings of a cell."""

    folder: Path
    algorithm: str
    preset: str
    hyperparameters: Hyperparameters
    evaluate_every: int
    """Decisions between two evaluations on the validation scenarios."""
    round: Round | None
    """What is labelled before it; None: nothing."""


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
    """What is labelled and imitated before it learns, for this cell alone; None: nothing."""

    @property
    def rounds(self) -> tuple[int, ...]:
        """Months of each round of labels; empty where nothing is labelled."""
        return self.lessons.rounds if self.lessons else ()

    @property
    def goes_on(self) -> bool:
        """Whether it goes on from the last pupil instead of being it."""
        return self.lessons is not None and self.lessons.pupil_budget is not None

    def folders(self, cell: Path) -> list[Path]:
        """The run folders in that of a cell, in order.

        First pupils, one for each round of labels, then the run; it is itself the last pupil, or goes on from that.
        """
        pupils = len(self.rounds) if self.goes_on else len(self.rounds) - 1
        return [*(cell / f"pupil-{number}" for number in range(1, pupils + 1)), cell / RUN_FOLDER]

    def resolved(self, task: Task) -> Hyperparameters:
        """All hyperparameters of the run, but for folders that the cell makes.

        Raises:
            UsageError: they cannot work, or not for this task.
        """
        return request.hyperparameters(self.algorithm, task, self.preset, seed=self.seed, **self.hyperparameters)

    def steps(self, task: Task, cell: Path) -> list[Step]:
        """What is labelled and trained, in order, in the folder of a cell.

        Raises:
            UsageError: as :meth:`resolved`.
        """
        run = self.resolved(task)
        pupil, preset = (self._pupil(task, run), "default") if self.goes_on else (run, self.preset)
        *pupils, last = self.folders(cell)
        trainings = [
            *((folder, IMITATION, preset, pupil) for folder in pupils),
            (last, self.algorithm, self.preset, run),
        ]
        steps: list[Step] = []
        for number, (folder, algorithm, origin, chosen) in enumerate(trainings):
            before = steps[-1].folder if steps else None
            labelled = self._round(number, before, cell)
            places: dict[str, Any] = {"start_from": str(before)} if before else {}
            if labelled:
                places = {"labels": (str(labelled.folder),)}
            every = max(chosen.total_timesteps // self.validations, 1)
            steps.append(Step(folder, algorithm, origin, replace(chosen, **places), every, labelled))
        return steps

    def _round(self, number: int, pupil: Path | None, cell: Path) -> Round | None:
        """What is labelled before training ``number``; nothing before one that goes on from the last pupil."""
        if self.lessons is None or number >= len(self.lessons.rounds):
            return None
        return Round(self.lessons.teacher, self.lessons.rounds[number], pupil, cell / LABELS_FOLDER)

    def _pupil(self, task: Task, run: Hyperparameters) -> Hyperparameters:
        """The hyperparameters of pupils from whose last the run can go on."""
        assert self.lessons is not None
        shared = {name: getattr(run, name) for name in _INHERITED if hasattr(run, name)}
        given = {name: value for name, value in shared.items() if name != "joint_actions" or value is not None}
        policy, budget = GOES_ON[self.algorithm], self.lessons.pupil_budget
        return request.hyperparameters(IMITATION, task, seed=self.seed, policy=policy, total_timesteps=budget, **given)


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
