"""Packs: one small file per generated month.

A pack is a line of JSON and a compressed body. The body holds what the month is made of, integers of 0.1 MW and
0.1 MVAr, column by column as differences from row to row; reactive demand as what differs from 0.7 of active demand,
which is nothing for ordinary loads. Forecasts and voltages follow from the grid, the seed and the month, and are made
when a pack is read. What was read once is kept in the data folder as arrays that processes map into memory and share.
"""

from __future__ import annotations

import hashlib
import json
import os
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import UsageError
from rl2grid.grids import Grid, load_grid
from rl2grid.scenarios.cache import cached_series
from rl2grid.scenarios.folder import FolderContent
from rl2grid.scenarios.generator.calendar import MONTH_ROWS
from rl2grid.scenarios.generator.constants import load_constants
from rl2grid.scenarios.generator.month import RawMonth, arrays_of, scenario_id, start_of
from rl2grid.scenarios.scenario import Scenario

I16 = NDArray[np.int16]
I32 = NDArray[np.int32]

FORMAT = "rl2grid-pack-1"
SUFFIX = ".pack"
_LEVEL = 9
"""Compression: the smallest files; they are written once."""


def write_pack(path: Path, raw: RawMonth) -> None:
    """Write a month (:func:`rl2grid.scenarios.generator.month.raw_month`) to ``path``, whole or not at all."""
    body = zlib.compress(b"".join(_columns(matrix) for matrix in _matrices(raw)), _LEVEL)
    header = {
        "format": FORMAT,
        "grid": raw.grid_id,
        "seed": raw.seed,
        "month": raw.month,
        "rows": len(raw.load_p),
        "sha256": hashlib.sha256(body).hexdigest(),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_bytes(json.dumps(header).encode() + b"\n" + body)
    os.replace(temporary, path)


def read_raw(path: Path) -> RawMonth:
    """The month in a pack.

    Raises:
        UsageError: there is no such file, or it is no undamaged pack of a grid of this version.
    """
    header, body = _open(path)
    grid = load_grid(header["grid"])
    rows = header["rows"]
    widths = (grid.n_load, grid.n_load, grid.n_gen)
    if rows != MONTH_ROWS + int(load_constants(grid.id).forecast.horizon[0]):
        raise UsageError(f"Pack {path} has {rows} rows, which no month of {grid.id} has: make it again.")
    flat = np.frombuffer(zlib.decompress(body), np.uint8).astype(np.uint16)
    if flat.size != 2 * rows * sum(widths):
        raise UsageError(f"Pack {path} does not hold a month of {grid.id}: make it again.")
    matrices, first = [], 0
    for width in widths:
        matrices.append(_rows(flat[first : first + 2 * rows * width], rows, width))
        first += 2 * rows * width
    load_p, difference, prod_p = matrices
    load_q = (difference + _usual_reactive(load_p.astype(np.int32))).astype(np.int16)
    return RawMonth(grid.id, header["seed"], header["month"], load_p, load_q, prod_p)


def read_pack(path: Path) -> Scenario:
    """The scenario in a pack, as read-only arrays in memory that processes share.

    The arrays are made on the first call and kept in the data folder (:mod:`rl2grid.scenarios.cache`); a copy that is
    damaged or missing is made again.

    Raises:
        UsageError: as :func:`read_raw`, or the data folder cannot be written.
    """
    header, _ = _open(path)
    grid = load_grid(header["grid"])
    raw_name = f"generated.{header['seed']}-{header['month']:02d}"
    series = cached_series(grid.id, raw_name, _key(grid, header), lambda: _content(grid, read_raw(path)))
    return Scenario(
        id=scenario_id(header["seed"], header["month"]),
        grid_id=grid.id,
        source="generated",
        start_datetime=series.start_datetime,
        content_hash=series.content_hash,
        first_row=0,
        series_rows=len(series.arrays["load_p"]),
        **series.arrays,
    )


def _content(grid: Grid, raw: RawMonth) -> FolderContent:
    return FolderContent(start_of(raw), arrays_of(grid, raw))


def _key(grid: Grid, header: dict[str, Any]) -> str:
    """Everything that the arrays of a pack depend on."""
    return hashlib.sha256(
        f"{FORMAT} {grid.hash} {load_constants(grid.id).hash} {header['sha256']}".encode()
    ).hexdigest()


def _open(path: Path) -> tuple[dict[str, Any], bytes]:
    """Header and body of a pack, whose checksum agrees."""
    try:
        line, _, body = path.read_bytes().partition(b"\n")
        header: dict[str, Any] = json.loads(line)
        sound = header["format"] == FORMAT and header["sha256"] == hashlib.sha256(body).hexdigest()
    except OSError as error:
        raise UsageError(f"Pack {path} cannot be read: {error.strerror}.") from error
    except (ValueError, KeyError, TypeError) as error:
        raise UsageError(f"File {path} is no pack: packs end in {SUFFIX} and are made by this version.") from error
    if not sound:
        raise UsageError(f"Pack {path} is damaged or of another version: make it again.")
    return header, body


def _matrices(raw: RawMonth) -> tuple[I16, I16, I16]:
    difference = raw.load_q - _usual_reactive(raw.load_p.astype(np.int32))
    return raw.load_p, difference.astype(np.int16), raw.prod_p


def _usual_reactive(active: I32) -> I32:
    """0.7 of ``active``, halves upwards."""
    return (7 * active + 5) // 10


def _columns(matrix: I16) -> bytes:
    """Differences down the columns; low bytes of all, then high bytes: those of small numbers are alike."""
    columns = matrix.T.astype(np.int32)
    steps = np.diff(columns, axis=1, prepend=0)
    zigzag = ((steps << 1) ^ (steps >> 31)).astype(np.uint16)
    return (zigzag & 0xFF).astype(np.uint8).tobytes() + (zigzag >> 8).astype(np.uint8).tobytes()


def _rows(data: NDArray[np.uint16], rows: int, width: int) -> I16:
    half = rows * width
    zigzag = (data[:half] | (data[half:] << 8)).astype(np.int32)
    steps = (zigzag >> 1) ^ -(zigzag & 1)
    matrix: I16 = np.ascontiguousarray(steps.reshape(width, rows).cumsum(axis=1).T.astype(np.int16))
    return matrix
