"""Weights & Biases, when asked for: the metrics of ``metrics.csv`` under the same names, at the same steps."""

from __future__ import annotations

import importlib
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rl2grid.errors import UsageError
from rl2grid.records.trainings import read_tracking, write_tracking

Track = Callable[[int, Mapping[str, float]], None]
"""Takes the decisions made so far and the metrics at that point."""


def check_tracking(project: str | None) -> None:
    """Refuse a project that cannot be tracked.

    Raises:
        UsageError: Weights & Biases is not installed.
    """
    if project is not None:
        _wandb()


@contextmanager
def tracked(folder: Path, project: str | None, config: Mapping[str, Any]) -> Iterator[Track]:
    """Send metrics to a project of Weights & Biases while the context lasts.

    A run that goes on in the same folder goes on under the same id. Steps that were sent before an interruption are
    sent again; Weights & Biases keeps the first of equal ones.

    Args:
        folder: The run folder; local files of Weights & Biases go there as well.
        project: Name of the project; None: nothing is sent.
        config: What the run is shown with.

    Raises:
        UsageError: Weights & Biases is not installed, or refuses the run.
    """
    if project is None:
        yield lambda step, values: None
        return
    wandb = _wandb()
    try:
        run = wandb.init(
            project=project, id=_run_id(folder), name=folder.name, resume="allow", dir=str(folder), config=dict(config)
        )
    except wandb.Error as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise UsageError(f"Weights & Biases refuses the run ({reason}): log in, or set WANDB_MODE=offline.") from error
    try:
        yield lambda step, values: run.log(dict(values), step=step)
    finally:
        run.finish()


def _wandb() -> Any:
    try:
        wandb: Any = importlib.import_module("wandb")
    except ImportError:
        wandb = None
    # A folder called wandb, as Weights & Biases leaves behind, can be imported as well.
    if not hasattr(wandb, "init"):
        raise UsageError("Tracking needs wandb: install it with `pip install rl2grid[tracking]`.")
    return wandb


def _run_id(folder: Path) -> str:
    """The id stored in the run folder; a new one, if there is none yet."""
    return read_tracking(folder) or write_tracking(folder, uuid.uuid4().hex[:12])
