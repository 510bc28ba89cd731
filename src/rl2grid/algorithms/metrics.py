"""The metrics of a run, in ``metrics.csv`` (see :mod:`rl2grid.records.metrics`) and in TensorBoard."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rl2grid.records.metrics import MetricsFile


class MetricsWriter:
    """Appends metrics to ``metrics.csv`` and to the folder ``tensorboard`` of a run."""

    def __init__(self, folder: Path, *, after_step: int = -1, tensorboard: bool = True) -> None:
        """Open the files of a run folder.

        Args:
            folder: The run folder.
            after_step: Rows of later steps are dropped first: a resumed run writes them again.
            tensorboard: Whether to write TensorBoard events as well.
        """
        self._file = MetricsFile(folder, after_step=after_step)
        self._events: Any = None
        if tensorboard:
            # Imported here: TensorBoard takes a second, and not every run wants it.
            from torch.utils.tensorboard import SummaryWriter

            self._events = SummaryWriter(str(folder / "tensorboard"), purge_step=after_step + 1)  # type: ignore[no-untyped-call]

    def write(self, step: int, grid_steps: int, wall_time: float, values: Mapping[str, float]) -> None:
        """Append the values of one step, complete on disk when this returns."""
        self._file.write(step, grid_steps, wall_time, values)
        if self._events is not None:
            for name, value in values.items():
                self._events.add_scalar(name, value, step)
            self._events.flush()

    def close(self) -> None:
        """Close both files."""
        self._file.close()
        if self._events is not None:
            self._events.close()
