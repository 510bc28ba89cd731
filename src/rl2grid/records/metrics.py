"""``metrics.csv``: the metrics of a run, one row per value.

::

    step,grid_steps,wall_time,name,value

which ``pandas.read_csv(path).pivot(index="step", columns="name", values="value")`` turns into one column per metric.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from pathlib import Path

METRICS_FILE = "metrics.csv"
METRIC_COLUMNS = ("step", "grid_steps", "wall_time", "name", "value")
"""``step``: decisions of the agent; ``grid_steps``: grid steps behind them; ``wall_time``: seconds of training."""
SURVIVAL, VALIDATION = "charts/survival", "validation/survival"
"""Names of the metrics: mean over the episodes that ended in an iteration, and on the validation scenarios."""
EPISODES = "charts/episodes"


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
        self._csv = csv.writer(self._file, lineterminator="\n")

    def write(self, step: int, grid_steps: int, wall_time: float, values: Mapping[str, float]) -> None:
        """Append the values of one step, complete on disk when this returns."""
        for name, value in values.items():
            self._csv.writerow((step, grid_steps, f"{wall_time:.3f}", name, repr(float(value))))
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
            match line.decode("utf-8").rstrip("\n").split(","):
                case ["step", *_]:
                    continue
                case [step, _, _, name, value]:
                    self.decisions = int(step)
                    if name == VALIDATION:
                        self.best = max(float(value), self.best or 0.0)


def read_rows(path: Path) -> Iterator[dict[str, str]]:
    """The rows of a metrics file. A last line without its end, as a killed writer leaves it, is ignored."""
    text = path.read_text(encoding="utf-8")
    return csv.DictReader(io.StringIO(text[: text.rfind("\n") + 1]))


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
    last = path.read_text(encoding="utf-8").strip().splitlines()[-1].split(",")
    return float(last[2]) if last[2] != "wall_time" else 0.0


def _keep_rows_until(path: Path, step: int) -> None:
    """Cut the file behind its last complete row of a step up to ``step``; make it, with its header, if need be."""
    header = ",".join(METRIC_COLUMNS) + "\n"
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
