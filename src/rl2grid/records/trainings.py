"""What training runs say of themselves: ``config.json``, ``energy.json``, and curves of their ``metrics.csv``."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rl2grid.arrays import F64
from rl2grid.errors import UsageError
from rl2grid.records.files import make_folder, read_json, set_aside, write_record
from rl2grid.records.metrics import EPISODES, METRICS_FILE, SURVIVAL, VALIDATION, read_rows

IMITATION = "imitation"
"""The algorithm that learns from labels and plays nothing."""
RUN_FILE, ENERGY_FILE, TRACKING_FILE = "config.json", "energy.json", "wandb.json"
_COLUMNS = ("step", "grid_steps", "name", "value")
_CONFIGURATION = {
    "request": {"task": str, "algorithm": str, "hyperparameters": {"seed": int}, "env_keywords": dict},
    "identity": dict,
}
_FIGURES = {"energy_kwh": float, "co2_kg": float, "cpu_seconds": float, "wall_seconds": float, "method": str}
_ACCOUNT = {**_FIGURES, "parts": [_FIGURES]}


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
    """By name, such as :data:`SURVIVAL`, which whoever learns without playing has not."""

    @property
    def survival(self) -> Metric:
        """Of the episodes that ended in training."""
        return self.metrics[SURVIVAL]

    @property
    def is_of_play(self) -> bool:
        """Whether episodes ended in training."""
        return SURVIVAL in self.metrics

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


def create_run_folder(
    folder: Path, configuration: Mapping[str, Any], fill: Callable[[Path], None] = lambda folder: None
) -> None:
    """Make the folder of a run with its configuration: it appears complete or not at all.

    Args:
        folder: of the run.
        configuration: what :func:`read_configuration` returns.
        fill: writes what else belongs into the folder from the beginning.

    Raises:
        UsageError: it cannot be made.
    """
    make_folder(folder.parent)
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    try:
        temporary.mkdir()
        write_record(temporary / RUN_FILE, dict(configuration))
        fill(temporary)
        os.rename(temporary, folder)
    except OSError as error:
        shutil.rmtree(temporary, ignore_errors=True)
        raise UsageError(f"Folder {str(folder)!r} cannot be made: {error.strerror}.") from error


def read_configuration(folder: Path) -> dict[str, Any]:
    """What :func:`create_run_folder` was given: ``request``, ``identity`` and ``seeds``.

    Raises:
        UsageError: there is no such file, or it is none.
    """
    configuration: dict[str, Any] = read_json(
        folder / RUN_FILE, "a description of a run", "give a folder as 'rl2grid train' wrote it", _CONFIGURATION
    )
    return configuration


def read_energy(folder: Path) -> dict[str, Any] | None:
    """The energy account of a run; None where there is none, or one that was damaged and is now set aside."""
    account: dict[str, Any] | None = _read_decoration(folder / ENERGY_FILE, "an energy account", _ACCOUNT)
    return account


def write_energy(folder: Path, account: Mapping[str, Any]) -> None:
    """Write the energy account of a run."""
    write_record(folder / ENERGY_FILE, dict(account))


def read_tracking(folder: Path) -> str | None:
    """The id under which a run is tracked; None where it is not, or as :func:`read_energy`."""
    tracking = _read_decoration(folder / TRACKING_FILE, "an id of a tracked run", {"id": str})
    return None if tracking is None else str(tracking["id"])


def write_tracking(folder: Path, run_id: str) -> str:
    """Write the id under which a run is tracked, and return it."""
    write_record(folder / TRACKING_FILE, {"id": run_id}, indent=None)
    return run_id


def _read_decoration(path: Path, what: str, shape: Any) -> Any:
    """What a file holds without which a run is still the same; None where there is none, or no sound one."""
    if not path.exists():
        return None
    try:
        return read_json(path, what, "what it said is lost", shape)
    except UsageError as error:
        set_aside(path, str(error))
        return None


def read_training_curve(path: Path, label: str, *, of_play: bool = True) -> TrainingCurve:
    """The curve of a run.

    Args:
        path: ``metrics.csv``, or the run folder that holds it.
        label: what figures call the run; runs with one label are drawn as one line.
        of_play: whether episodes must have ended in training; else a validation is enough.

    A last line without its end, as a killed run leaves it, is ignored.

    Raises:
        UsageError: the file is missing, no metrics file, or no episode ended yet.
    """
    path = path / METRICS_FILE if path.is_dir() else path
    try:
        rows = [[row[column] for column in _COLUMNS] for row in read_rows(path)]
        points = [(name, float(step), float(grid_steps), float(value)) for step, grid_steps, name, value in rows]
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, UsageError) and path.is_file():
            raise
        raise UsageError(
            f"{path} is no metrics file of a training run: give a run folder or its metrics.csv."
        ) from None
    metrics = _metrics(points)
    if SURVIVAL not in metrics and (of_play or VALIDATION not in metrics):
        raise UsageError(f"{path} has no survival yet: no episode has ended in training.")
    return TrainingCurve(label, metrics)


def chosen_of_labels(identity: Mapping[str, Any]) -> dict[str, Any]:
    """What repeated trainings have in common of the labels that they learned from: all but the contents.

    Where it is not told how many months of each round there are, as of early trainings, contents tell labels apart.
    """
    return {name: value for name, value in identity.items() if name != "labels" or "months" not in identity}


def chosen_of_start(identity: Mapping[str, Any]) -> dict[str, Any]:
    """What repeated trainings have in common of the policy that they began with: the algorithm and its budget.

    Where the budget is not told, as of early trainings, how many decisions the policy is from tells starts apart.
    """
    left_out = {"policy_hash"} | ({"decisions"} if identity.get("budget") is not None else set())
    return {name: value for name, value in identity.items() if name not in left_out}


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
    config = read_configuration(folder)
    request, identity = config["request"], config["identity"]
    hyperparameters = dict(request["hyperparameters"])
    seed = int(hyperparameters.pop("seed"))
    task, algorithm, keywords = request["task"], request["algorithm"], request["env_keywords"]
    # Runs of one method may each begin with a policy of their own, and learn from labels of their own months.
    for place in ("start_from", "labels"):
        hyperparameters.pop(place, None)
    settings = {
        **{key: value for key, value in identity.items() if key not in ("seed", "start", "labels")},
        "labels": chosen_of_labels(identity.get("labels", {})),
        "started from": identity.get("start", {}).get("algorithm"),
        **keywords,
        **hyperparameters,
        "algorithm": algorithm,
    }
    heuristic = keywords.get("heuristic")
    name = label or (f"{algorithm} + {heuristic}" if heuristic else algorithm)
    return TrainingRun(folder, task, settings, seed, read_training_curve(folder, name, of_play=False))


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
