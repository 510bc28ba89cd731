"""``metrics.csv``: the metrics of a run, one row per value.

::

    step,grid_steps,wall_time,name,value,checksum

of which the last is that of the row (:func:`rl2grid.records.files.sealed_line`). It decorates: what is damaged is set
aside, and the run goes on.
``pandas.read_csv(path).pivot(index="step", columns="name", values="value")`` makes one column per metric.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path

from rl2grid.errors import DamageWarning, UsageError
from rl2grid.records.files import CHECKSUM, not_what, opened_line, read_text, sealed_line, set_aside, write_text

METRICS_FILE = "metrics.csv"
METRIC_COLUMNS = ("step", "grid_steps", "wall_time", "name", "value")
"""``step``: decisions of the agent; ``grid_steps``: grid steps behind them; ``wall_time``: seconds of training."""
SURVIVAL, VALIDATION = "charts/survival", "validation/survival"
"""Names of the metrics: mean over the episodes that ended in an iteration, and on the validation scenarios."""
EPISODES = "charts/episodes"
_WHAT, _REMEDY = "a metrics file", "resuming the run sets it aside, and keeps what is sound"


class MetricsFile:
    """Appends metrics to the file of a run folder."""

    def __init__(self, folder: Path, *, after_step: int = -1) -> None:
        """Open the file.

        Args:
            folder: the run folder.
            after_step: rows of later steps are dropped first: a resumed run writes them again.
        """
        path = folder / METRICS_FILE
        _keep_rows_until(path, after_step)
        self._file = path.open("a", encoding="utf-8", newline="")

    def write(self, step: int, grid_steps: int, wall_time: float, values: Mapping[str, float]) -> None:
        """Append the values of one step, complete on disk when this returns."""
        for name, value in values.items():
            row = f"{step},{grid_steps},{wall_time:.3f},{name},{float(value)!r}"
            self._file.write(sealed_line(row) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class MetricsTail:
    """Follows a file of metrics that grows."""

    def __init__(self, path: Path) -> None:
        self.decisions = 0
        self.best: float | None = None
        """Highest survival on the validation scenarios."""
        self._path, self._offset = path, 0
        self._last = b""
        """The last line that was read, which ends at the offset."""

    def read(self) -> None:
        """Take in what was appended."""
        if not self._path.exists():
            return
        with self._path.open("rb") as file:
            file.seek(self._offset - len(self._last))
            if file.read(len(self._last)) != self._last:  # a resumed run cut it back, and perhaps wrote on since
                self.decisions, self.best, self._offset, self._last = 0, None, 0, b""
                file.seek(0)
            text = file.read()
        lines = text[: text.rfind(b"\n") + 1].splitlines(keepends=True)
        if not lines:
            return
        self._offset, self._last = self._offset + sum(map(len, lines)), lines[-1]
        for line in lines:
            row = _row(line.decode("utf-8", errors="replace").rstrip("\n"))
            if row is None:  # the header, or damaged: what follows says how far the run is
                continue
            self.decisions = int(row["step"])
            if row["name"] == VALIDATION:
                self.best = max(float(row["value"]), self.best or 0.0)


def read_rows(path: Path) -> Iterator[dict[str, str]]:
    """The rows of a metrics file. A last line without its end, as a killed writer leaves it, is ignored.

    Raises:
        UsageError: it is no metrics file, or one of its rows was changed.
    """
    text = read_text(path, _WHAT, _REMEDY)
    head, *lines = text[: text.rfind("\n") + 1].splitlines() or [""]
    if tuple(head.split(",")[: len(METRIC_COLUMNS)]) != METRIC_COLUMNS:
        raise UsageError(f"{path} is no metrics file of a training run: give a run folder or its metrics.csv.")
    for number, line in enumerate(lines, start=2):
        row = _row(line)
        if row is None:
            raise not_what(path, _WHAT, f"line {number} was changed", _REMEDY)
        yield row


def _row(line: str) -> dict[str, str] | None:
    """The values of a line by column; None: it is the header, or was changed."""
    values = line.split(",")
    if len(values) > len(METRIC_COLUMNS):
        opened = opened_line(line)
        values = [] if opened is None else opened.split(",")
    if len(values) != len(METRIC_COLUMNS):
        return None
    row = dict(zip(METRIC_COLUMNS, values, strict=True))
    try:
        _ = int(row["step"]), float(row["grid_steps"]), float(row["wall_time"]), float(row["value"])
    except ValueError:
        return None
    return row


def read_validations(folder: Path) -> dict[int, dict[str, float]]:
    """What a run reached on the validation scenarios: means over episodes by decisions, then name.

    Args:
        folder: the run folder; without metrics there were no validations.
    """
    path, prefix = folder / METRICS_FILE, "validation/"
    if not path.exists():
        return {}
    validations: dict[int, dict[str, float]] = {}
    for row in read_rows(path):
        if row["name"].startswith(prefix):
            validations.setdefault(int(row["step"]), {})[row["name"].removeprefix(prefix)] = float(row["value"])
    return validations


def trained_seconds(run: Path) -> float:
    """Seconds that a run has taken so far, interruptions left out; 0 without metrics."""
    path = run / METRICS_FILE
    if not path.exists():
        return 0.0
    rows = map(_row, path.read_text(encoding="utf-8", errors="replace").splitlines())
    return max((float(row["wall_time"]) for row in rows if row is not None), default=0.0)


def _keep_rows_until(path: Path, step: int) -> None:
    """Cut the file behind its last complete row of a step up to ``step``; make it, with its header, if need be.

    A damaged file is set aside; what is sound of it is kept. That the file of a run that has begun is gone is said.
    """
    header = ",".join((*METRIC_COLUMNS, CHECKSUM)) + "\n"
    if not path.exists():
        if step >= 0:
            why = f"{path} is missing: what it said of the first {step} decisions is lost."
            warnings.warn(why, DamageWarning, stacklevel=2)
        write_text(path, header)
        return
    try:
        head, *lines = path.read_bytes().decode("utf-8", errors="replace").splitlines(keepends=True) or [""]
    except MemoryError:
        head, lines = "", []
    kept, damaged = [header], head != header
    for line in lines:
        row = _row(line.removesuffix("\n"))
        if row is not None and int(row["step"]) > step:
            break
        if row is None and not line.endswith("\n") and line is lines[-1]:
            break  # a kill cut it short
        damaged |= row is None or not line.endswith("\n")
        kept += [] if row is None else [line]
    if damaged:
        set_aside(path, f"{path} was damaged: {len(kept) - 1} of its rows are kept")
    write_text(path, "".join(kept))
