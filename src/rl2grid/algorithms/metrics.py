"""The metrics of a run, in a tidy CSV file and in TensorBoard.

``metrics.csv`` has one row per value::

    step,grid_steps,wall_time,name,value

which ``pandas.read_csv(path).pivot(index="step", columns="name", values="value")`` turns into one column per metric.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

COLUMNS = ("step", "grid_steps", "wall_time", "name", "value")
"""``step``: decisions of the agent; ``grid_steps``: grid steps behind them; ``wall_time``: seconds of training."""


class MetricsWriter:
    """Appends metrics to ``metrics.csv`` and to the folder ``tensorboard`` of a run."""

    def __init__(self, folder: Path, *, after_step: int = -1, tensorboard: bool = True) -> None:
        """Open the files of a run folder.

        Args:
            folder: The run folder.
            after_step: Rows of later steps are dropped first: a resumed run writes them again.
            tensorboard: Whether to write TensorBoard events as well.
        """
        path = folder / "metrics.csv"
        _keep_rows_until(path, after_step)
        self._file = path.open("a", encoding="utf-8", newline="")
        self._csv = csv.writer(self._file, lineterminator="\n")
        self._events: Any = None
        if tensorboard:
            # Imported here: TensorBoard takes a second, and not every run wants it.
            from torch.utils.tensorboard import SummaryWriter

            self._events = SummaryWriter(str(folder / "tensorboard"), purge_step=after_step + 1)  # type: ignore[no-untyped-call]

    def write(self, step: int, grid_steps: int, wall_time: float, values: Mapping[str, float]) -> None:
        """Append the values of one step, complete on disk when this returns."""
        for name, value in values.items():
            self._csv.writerow((step, grid_steps, f"{wall_time:.3f}", name, repr(float(value))))
            if self._events is not None:
                self._events.add_scalar(name, value, step)
        self.flush()

    def flush(self) -> None:
        """Hand everything to the operating system."""
        self._file.flush()
        if self._events is not None:
            self._events.flush()

    def close(self) -> None:
        """Close both files."""
        self._file.close()
        if self._events is not None:
            self._events.close()


def _keep_rows_until(path: Path, step: int) -> None:
    """Cut the file behind its last complete row of a step up to ``step``; make it, with its header, if need be."""
    header = ",".join(COLUMNS) + "\n"
    if not path.exists() or path.stat().st_size < len(header):
        path.write_text(header, encoding="utf-8", newline="\n")
        return
    with open(path, "rb+") as file:
        end = len(file.readline())
        for row in file:
            if not row.endswith(b"\n") or int(row.split(b",", 1)[0]) > step:
                break
            end += len(row)
        file.truncate(end)
