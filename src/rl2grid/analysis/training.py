"""What training runs say of themselves: their ``metrics.csv``."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import UsageError

Floats = NDArray[np.float64]

SURVIVAL, VALIDATION = "charts/survival", "validation/survival"
"""Names of the metrics: mean over the episodes that ended in an iteration, and on the validation scenarios."""
_COLUMNS = ("step", "grid_steps", "name", "value")


@dataclass(frozen=True, eq=False)
class TrainingCurve:
    """Survival of one run against its budget, float64 [point] each."""

    label: str
    decisions: Floats
    grid_steps: Floats
    survival: Floats
    validation_decisions: Floats
    validation_grid_steps: Floats
    validation_survival: Floats


def read_training_curve(path: Path, label: str) -> TrainingCurve:
    """The curve of a run.

    Args:
        path: ``metrics.csv``, or the run folder that holds it.
        label: what figures call the run; runs with one label are drawn as one line.

    Raises:
        UsageError: the file is missing, no metrics file, or no episode ended yet.
    """
    path = path / "metrics.csv" if path.is_dir() else path
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = [[row[column] for column in _COLUMNS] for row in csv.DictReader(file)]
        points = [(name, float(step), float(grid_steps), float(value)) for step, grid_steps, name, value in rows]
    except (OSError, KeyError, TypeError, ValueError):
        raise UsageError(
            f"{path} is no metrics file of a training run: give a run folder or its metrics.csv."
        ) from None
    training, validation = _points(points, SURVIVAL), _points(points, VALIDATION)
    if not len(training):
        raise UsageError(f"{path} has no survival yet: no episode has ended in training.")
    return TrainingCurve(label, *training.T, *validation.T)


def _points(points: list[tuple[str, float, float, float]], metric: str) -> Floats:
    """Decisions, grid steps and finite values of a metric, float64 [point, 3]."""
    chosen = [values for name, *values in points if name == metric and np.isfinite(values[-1])]
    return np.array(chosen, np.float64).reshape(len(chosen), 3)
