"""What training runs say of themselves: ``config.json``, ``energy.json``, and curves of their ``metrics.csv``."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rl2grid.arrays import F64
from rl2grid.errors import UsageError
from rl2grid.records.files import make_folder, write_json
from rl2grid.records.metrics import EPISODES, METRICS_FILE, SURVIVAL, VALIDATION, read_rows

RUN_FILE, ENERGY_FILE, TRACKING_FILE = "config.json", "energy.json", "wandb.json"
_COLUMNS = ("step", "grid_steps", "name", "value")


@dataclass(frozen=True, eq=False)
class Metric:
    """One figure of a run against its budget, float64 [point] each."""

    decisions: F64
    grid_steps: F64
    values: F64
    episodes: F64
    """Episodes that ended since the point before: what the value is the mean of, where it is of episodes."""


@dataclass(frozen=True, eq=False)
class TrainingCurve:
    """What one run logged."""

    label: str
    """What figures call the run; runs with one label are drawn as one line."""
    metrics: Mapping[str, Metric]
    """By name, such as :data:`SURVIVAL`, which is always there."""

    @property
    def survival(self) -> Metric:
        """Of the episodes that ended in training."""
        return self.metrics[SURVIVAL]

    @property
    def validation(self) -> Metric | None:
        """Survival on the validation scenarios; None before the first validation."""
        return self.metrics.get(VALIDATION)


@dataclass(frozen=True, eq=False)
class TrainingRun:
    """A run folder."""

    folder: Path
    task: str
    """Id of the task."""
    settings: Mapping[str, Any]
    """Everything that the runs of one method have in common: all but the seed."""
    seed: int
    curve: TrainingCurve


def is_run(folder: Path) -> bool:
    """Whether a folder is that of a training run."""
    return (folder / RUN_FILE).is_file()


def create_run_folder(folder: Path, configuration: Mapping[str, Any]) -> None:
    """Make the folder of a run with its configuration: it appears complete or not at all.

    Raises:
        UsageError: it cannot be made.
    """
    make_folder(folder.parent)
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    try:
        temporary.mkdir()
        write_json(temporary / RUN_FILE, configuration)
        os.rename(temporary, folder)
    except OSError as error:
        shutil.rmtree(temporary, ignore_errors=True)
        raise UsageError(f"Folder {str(folder)!r} cannot be made: {error.strerror}.") from error


def read_configuration(folder: Path) -> dict[str, Any]:
    """What :func:`create_run_folder` was given: ``request``, ``identity`` and ``seeds``.

    Raises:
        OSError: there is no such file.
        ValueError: it is no JSON.
    """
    configuration: dict[str, Any] = json.loads((folder / RUN_FILE).read_text(encoding="utf-8"))
    return configuration


def read_energy(folder: Path) -> dict[str, Any] | None:
    """The energy account of a run; None where there is none."""
    path = folder / ENERGY_FILE
    if not path.is_file():
        return None
    account: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return account


def write_energy(folder: Path, account: Mapping[str, Any]) -> None:
    """Write the energy account of a run."""
    write_json(folder / ENERGY_FILE, account)


def read_tracking(folder: Path) -> str | None:
    """The id under which a run is tracked; None where it is not."""
    path = folder / TRACKING_FILE
    return str(json.loads(path.read_text(encoding="utf-8"))["id"]) if path.exists() else None


def write_tracking(folder: Path, run_id: str) -> str:
    """Write the id under which a run is tracked, and return it."""
    write_json(folder / TRACKING_FILE, {"id": run_id}, indent=None)
    return run_id


def read_training_curve(path: Path, label: str) -> TrainingCurve:
    """The curve of a run.

    Args:
        path: ``metrics.csv``, or the run folder that holds it.
        label: what figures call the run; runs with one label are drawn as one line.

    A last line without its end, as a killed run leaves it, is ignored.

    Raises:
        UsageError: the file is missing, no metrics file, or no episode ended yet.
    """
    path = path / METRICS_FILE if path.is_dir() else path
    try:
        rows = [[row[column] for column in _COLUMNS] for row in read_rows(path)]
        points = [(name, float(step), float(grid_steps), float(value)) for step, grid_steps, name, value in rows]
    except (OSError, KeyError, TypeError, ValueError):
        raise UsageError(
            f"{path} is no metrics file of a training run: give a run folder or its metrics.csv."
        ) from None
    metrics = _metrics(points)
    if SURVIVAL not in metrics:
        raise UsageError(f"{path} has no survival yet: no episode has ended in training.")
    return TrainingCurve(label, metrics)


def read_training_run(folder: Path, label: str | None = None) -> TrainingRun:
    """A run, finished or still going on.

    Args:
        folder: the run folder.
        label: what figures call it; None: its algorithm and heuristic.

    Raises:
        UsageError: the folder is no run, or one of its files is missing or not what it should be.
    """
    if not is_run(folder):
        raise UsageError(f"{folder} holds no run: give a folder that 'rl2grid train' wrote.")
    try:
        config = read_configuration(folder)
        request, identity = config["request"], config["identity"]
        hyperparameters = dict(request["hyperparameters"])
        seed = int(hyperparameters.pop("seed"))
        task, algorithm, keywords = request["task"], request["algorithm"], request["env_keywords"]
        settings = {
            **{key: value for key, value in identity.items() if key != "seed"},
            **keywords,
            **hyperparameters,
            "algorithm": algorithm,
        }
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{folder / RUN_FILE} is no description of a run: {error!r}.") from None
    heuristic = keywords.get("heuristic")
    name = label or (f"{algorithm} + {heuristic}" if heuristic else algorithm)
    return TrainingRun(folder, task, settings, seed, read_training_curve(folder, name))


def group_curves(runs: Sequence[TrainingRun]) -> dict[str, dict[str, tuple[TrainingCurve, ...]]]:
    """Curves by task, then label, both in order of appearance.

    Raises:
        UsageError: runs that one label stands for differ in more than their seed, or not even in that.
    """
    groups: dict[str, dict[str, list[TrainingRun]]] = {}
    for run in runs:
        groups.setdefault(run.task, {}).setdefault(run.curve.label, []).append(run)
    for by_label in groups.values():
        for label, group in by_label.items():
            _check_one_method(label, group)
    return {
        task: {label: tuple(run.curve for run in group) for label, group in by_label.items()}
        for task, by_label in groups.items()
    }


def _check_one_method(label: str, runs: Sequence[TrainingRun]) -> None:
    first = runs[0]
    for place, run in enumerate(runs[1:], start=1):
        for key in sorted({*first.settings, *run.settings}):
            mine, other = first.settings.get(key), run.settings.get(key)
            if mine != other:
                raise UsageError(
                    f"Runs of different {key} do not belong into one curve: {first.folder} has {mine!r}, {run.folder} "
                    f"has {other!r}; tell them apart as LABEL={run.folder}."
                )
        if run.seed in {earlier.seed for earlier in runs[:place]}:
            raise UsageError(f"Two runs of {label} on {run.task} have seed {run.seed}: leave out {run.folder}.")


def _metrics(points: list[tuple[str, float, float, float]]) -> dict[str, Metric]:
    """Finite values of every metric."""
    ended = {step: value for name, step, _, value in points if name == EPISODES}
    rows: dict[str, list[tuple[float, float, float, float]]] = {}
    for name, step, grid_steps, value in points:
        if np.isfinite(value):
            rows.setdefault(name, []).append((step, grid_steps, value, max(ended.get(step, 1.0), 1.0)))
    return {name: Metric(*np.array(values, np.float64).T) for name, values in rows.items()}
