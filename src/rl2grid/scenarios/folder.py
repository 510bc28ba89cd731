"""Reading a Grid2Op scenario folder: one CSV file per quantity, one row per 5 minutes.

Columns are matched by name, as Grid2Op does. Values are parsed as float64 and rounded to float32,
which gives exactly the numbers that Grid2Op plays. Everything that could make an episode wrong
without a word is refused with the file, the column and the row (row 0 is the first below the header).
"""

from __future__ import annotations

import bz2
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.scenarios.progress import Report, ignore

_REQUIRED = ("load_p", "load_q", "prod_p")
_OPTIONAL = ("prod_v", "load_p_forecasted", "load_q_forecasted", "prod_p_forecasted", "prod_v_forecasted")
_OUTAGES = ("maintenance", "hazards")
_OF_ONE_GRID = ("prod_v", "prod_v_forecasted", *_OUTAGES)
_SUFFIXES = (".csv", ".csv.bz2")
MAX_TABLE_BYTES = 2**29
"""Of a table that was unpacked: more than ten times the largest of a month of 118 substations."""
_INFOS = ("start_datetime.info", "time_interval.info")

DISPATCHABLE_TOLERANCE = 0.01
"""Share of pmax by which a dispatchable generator may exceed it: rounding and losses."""
RENEWABLE_TOLERANCE = 1.0
"""Share of pmax by which wind and sun may exceed it: Grid2Op's own series do so by up to 43 percent
(l2rpn_icaps_2021), so only values that no plant could mean are refused."""
_ZERO = 1e-7
"""What Grid2Op takes for zero in an outage file."""

_CHUNK = 2048
"""Rows that are parsed at once."""

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class FolderContent:
    """What a scenario folder holds, in the order of the grid."""

    start_datetime: datetime
    arrays: dict[str, NDArray[Any]]
    """Named as the attributes of :class:`rl2grid.scenarios.scenario.Scenario`."""


def source_key(grid: Grid, *paths: Path) -> str:
    """SHA-256 over everything that decides what :func:`read_folder` returns for these folders.

    Raises:
        UsageError: There is no such folder.
    """
    digest = hashlib.sha256(repr((grid.name_load, grid.name_gen, grid.name_line)).encode())
    for path in paths:
        for file in _files(path):
            content = file.read_bytes()
            digest.update(f"{file.name} {len(content)}\n".encode())
            digest.update(content)
    return digest.hexdigest()


def read_folder(
    grid: Grid,
    path: Path,
    *,
    by_substation: bool = False,
    signed_loads: Sequence[int] | None = None,
    columns: Mapping[str, str] = MappingProxyType({}),
    dispatchable_tolerance: float = DISPATCHABLE_TOLERANCE,
    report: Report = ignore,
) -> FolderContent:
    """The series in the folder ``path``.

    Args:
        grid: The grid to which the columns belong.
        path: A folder with ``load_p.csv`` (or ``.csv.bz2``) and its companions.
        by_substation: The series was made for a grid of the same substations with other names: an
            element is found by the substation in its name (``load_13_2`` sits on substation 13),
            generators that the series lacks stay at 0 MW, and what belongs to the other grid alone
            (voltages, outages) is left out.
        signed_loads: Loads that may be negative (interconnections); None: all of them.
        columns: What columns of the files are called in the grid, where the names differ.
        dispatchable_tolerance: Share of pmax by which a dispatchable generator may exceed it.
        report: told how many bytes of the files were read.

    Raises:
        UsageError: A file, a column or a value is missing or impossible.
    """
    if not path.is_dir():
        raise UsageError(f"There is no scenario folder {path}.")
    reader = _Reader(grid, path, by_substation, columns, report)
    arrays: dict[str, NDArray[Any]] = {}
    for name in _REQUIRED + _OPTIONAL + _OUTAGES:
        if by_substation and name in _OF_ONE_GRID:
            continue
        matrix = reader.read(name)
        if matrix is None:
            continue
        if name in _OUTAGES:
            arrays[name] = np.abs(matrix) >= _ZERO
        elif name.endswith("_forecasted"):
            arrays[name.removesuffix("ed")] = reader.forecast(matrix)
        else:
            arrays[name] = matrix.astype(np.float32)
    reader.refuse_hazards(arrays.pop("hazards", None))
    reader.check_loads(arrays["load_p"], signed_loads)
    reader.check_generation(arrays["prod_p"], dispatchable_tolerance)
    return FolderContent(read_start(path), arrays)


class _Reader:
    """Reads the files of one folder and remembers how many rows they must have."""

    def __init__(self, grid: Grid, path: Path, by_substation: bool, columns: Mapping[str, str], report: Report) -> None:
        self._grid = grid
        self._path = path
        self._by_substation = by_substation
        self._columns = columns
        self._report = report
        self._rows = 0
        self._bytes_read, self._bytes = 0, sum(file.stat().st_size for file in _files(path))

    def read(self, name: str) -> Matrix | None:
        """The file called ``name`` in grid order, or None where an optional file is absent."""
        file = _find(self._path, name)
        if file is None:
            if name in _REQUIRED:
                raise UsageError(f"File {self._path / name}.csv (or .csv.bz2) is missing from the scenario folder.")
            return None
        header, matrix = _parse(file, self._report_part(file))
        self._check_length(name, file, len(matrix))
        order = self._order(name, file, header)
        result = np.zeros((len(matrix), len(self._names(name))))
        result[:, order] = matrix
        return result

    def _report_part(self, file: Path) -> Report:
        """Of a file; what is told on are bytes of the folder."""
        before, size = self._bytes_read, file.stat().st_size
        self._bytes_read += size

        def report_rows(done: int, total: int) -> None:
            self._report(before + size * done // total, self._bytes)

        return report_rows

    def forecast(self, matrix: Matrix) -> NDArray[np.float32]:
        """[rows * horizon, n] to [rows, horizon, n]: the horizons of one row follow each other."""
        return matrix.astype(np.float32).reshape(self._rows, -1, matrix.shape[1])

    def refuse_hazards(self, hazards: NDArray[Any] | None) -> None:
        if hazards is not None and hazards.any():
            row, column = np.argwhere(hazards)[0]
            raise UsageError(
                f"File {self._file('hazards')}, column {self._grid.name_line[column]}, row {row}: a hazard is "
                "recorded, and only scenarios without hazards can be played."
            )

    def check_loads(self, load_p: NDArray[Any], signed: Sequence[int] | None) -> None:
        if signed is None:
            return
        bad = load_p < 0
        bad[:, list(signed)] = False
        if bad.any():
            row, column = np.argwhere(bad)[0]
            raise UsageError(
                f"File {self._file('load_p')}, column {self._grid.name_load[column]}, row {row}: the load is "
                f"{load_p[row, column]} MW, and only interconnections may be negative."
            )

    def check_generation(self, prod_p: NDArray[Any], dispatchable_tolerance: float) -> None:
        pmax = self._grid.gen_pmax
        tolerance = np.where(self._grid.gen_renewable, RENEWABLE_TOLERANCE, dispatchable_tolerance) * pmax
        bad = (prod_p > pmax + tolerance) | (prod_p < -DISPATCHABLE_TOLERANCE * pmax)
        if bad.any():
            row, column = np.argwhere(bad)[0]
            raise UsageError(
                f"File {self._file('prod_p')}, column {self._grid.name_gen[column]}, row {row}: the generation is "
                f"{prod_p[row, column]} MW, and the generator can give 0 to {pmax[column]} MW."
            )

    def _file(self, name: str) -> Path | None:
        return _find(self._path, name)

    def _names(self, name: str) -> tuple[str, ...]:
        if name.startswith("load"):
            return self._grid.name_load
        return self._grid.name_gen if name.startswith("prod") else self._grid.name_line

    def _check_length(self, name: str, file: Path, rows: int) -> None:
        if name == _REQUIRED[0]:
            if rows < 2:
                raise UsageError(f"File {file} has {rows} rows: a scenario needs at least 2.")
            self._rows = rows
        elif name.endswith("_forecasted"):
            if rows == 0 or rows % self._rows:
                raise UsageError(f"File {file} has {rows} rows: a multiple of the {self._rows} of load_p is needed.")
        elif rows != self._rows:
            raise UsageError(f"File {file} has {rows} rows: the {self._rows} of load_p are needed.")

    def _order(self, name: str, file: Path, header: list[str]) -> list[int]:
        """Where each column of the file goes."""
        names = self._names(name)
        order = []
        for column in header:
            element = self._element(name, names, self._columns.get(column, column))
            if element is None:
                raise UsageError(f"File {file}, column {column}: grid {self._grid.id} has {_listed(names)}.")
            if element in order:
                raise UsageError(f"File {file}, column {column} occurs twice: one column per element is needed.")
            order.append(element)
        missing = [names[element] for element in range(len(names)) if element not in order]
        if missing and not (self._by_substation and name.startswith("prod")):
            raise UsageError(f"File {file} lacks the columns {', '.join(missing)} of grid {self._grid.id}.")
        return order

    def _element(self, name: str, names: tuple[str, ...], column: str) -> int | None:
        if column in names:
            return names.index(column)
        if not self._by_substation:
            return None
        substations = self._grid.load_to_subid if name.startswith("load") else self._grid.gen_to_subid
        found = np.flatnonzero(substations == int(column.split("_")[1]))
        return int(found[0]) if len(found) else None


def _parse(file: Path, report: Report) -> tuple[list[str], Matrix]:
    """Header and values of a semicolon-separated file; ``report`` is told of its rows."""
    try:
        raw = _decompressed(file.read_bytes()) if file.suffix == ".bz2" else file.read_bytes()
        header_line, _, body = raw.decode().partition("\n")
    except (OSError, ValueError, EOFError) as error:
        raise UsageError(f"File {file} cannot be read ({error}): a complete CSV file is needed.") from error
    header = [column.strip() for column in header_line.split(";")]
    lines = [line for line in body.splitlines() if line and not line.isspace()]
    matrix = np.zeros((len(lines), len(header)))
    for first in range(0, len(lines), _CHUNK):
        part = slice(first, min(first + _CHUNK, len(lines)))
        try:
            values = np.loadtxt(lines[part], delimiter=";", ndmin=2, comments=None)
        except ValueError:
            values = None
        if values is None or values.shape[1] != len(header) or not np.isfinite(values).all():
            raise _bad_cell(file, header, body)
        matrix[part] = values
        report(part.stop, len(lines))
    return header, matrix


def _decompressed(content: bytes) -> bytes:
    """What a bzip2 file holds, which may be several streams in a row.

    Raises:
        ValueError: more than :data:`MAX_TABLE_BYTES`.
        EOFError: its end is missing.
    """
    parts: list[bytes] = []
    left = MAX_TABLE_BYTES
    while content:
        unpacking = bz2.BZ2Decompressor()
        parts.append(unpacking.decompress(content, left))
        left -= len(parts[-1])
        if not unpacking.eof:
            if not unpacking.needs_input or left <= 0:
                raise ValueError(f"it expands to more than {MAX_TABLE_BYTES // 2**20} MiB")
            raise EOFError("its end is missing")
        content = unpacking.unused_data
    return b"".join(parts)


def _bad_cell(file: Path, header: list[str], body: str) -> UsageError:
    """The error for the first cell that is no number, found without NumPy's help."""
    for row, line in enumerate(body.splitlines()):
        cells = line.split(";")
        if len(cells) != len(header):
            return UsageError(
                f"File {file}, row {row} has {len(cells)} values: the {len(header)} of the header are needed."
            )
        for column, cell in zip(header, cells, strict=True):
            if not _is_number(cell):
                return UsageError(f"File {file}, column {column}, row {row}: {cell.strip()!r} is no finite number.")
    return UsageError(f"File {file} is no table of numbers separated by semicolons.")


def _is_number(cell: str) -> bool:
    try:
        return bool(np.isfinite(float(cell)))
    except ValueError:
        return False


def read_start(path: Path) -> datetime:
    """The first time stamp of a scenario folder, once its rows are known to be 5 minutes apart.

    Raises:
        UsageError: They are not, or there is no time stamp.
    """
    start, interval = ((path / name) for name in _INFOS)
    if not start.is_file():
        raise UsageError(f"File {start} is missing from the scenario folder.")
    if interval.is_file() and interval.read_text().strip() not in ("00:05", "5", "05"):
        raise UsageError(f"File {interval} says {interval.read_text().strip()!r}: rows must be 00:05 apart.")
    text = start.read_text().strip()
    for form in ("%Y-%m-%d %H:%M", "%Y-%m-%d"):
        try:
            return datetime.strptime(text, form)
        except ValueError:
            continue
    raise UsageError(f"File {start} says {text!r}: a time such as 2019-01-05 23:55 is needed.")


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        raise UsageError(f"There is no scenario folder {path}.")
    tables = [_find(path, name) for name in _REQUIRED + _OPTIONAL + _OUTAGES]
    infos = [path / name for name in _INFOS]
    return [file for file in tables if file is not None] + [file for file in infos if file.is_file()]


def _find(path: Path, name: str) -> Path | None:
    return next((path / (name + suffix) for suffix in _SUFFIXES if (path / (name + suffix)).is_file()), None)


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(names) if len(names) <= 12 else f"{', '.join(names[:12])} and {len(names) - 12} more"
