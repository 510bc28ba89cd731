"""Packs: one small file per generated month.

A pack is a line of JSON, which names the values by their hash, and a compressed body. The body holds what the month is
made of, integers of 0.1 MW and 0.1 MVAr, column by column as differences from row to row; reactive demand as what
differs from 0.7 of active demand, which is nothing for ordinary loads. Forecasts and voltages follow from the grid, the
seed and the month, and are made when a pack is expanded.
"""

from __future__ import annotations

import hashlib
import json
import os
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from rl2grid.arrays import I16, U8
from rl2grid.compile import jit
from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.scenarios.generator.calendar import MONTH_ROWS
from rl2grid.scenarios.generator.constants import load_constants
from rl2grid.scenarios.generator.month import RawMonth
from rl2grid.scenarios.series_hash import hash_of_series

FORMAT = "rl2grid-pack-2"
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
        "series": hash_of_month(raw),
        "sha256": hashlib.sha256(body).hexdigest(),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_bytes(json.dumps(header).encode() + b"\n" + body)
    os.replace(temporary, path)


def hash_of_month(raw: RawMonth) -> str:
    """Hash of the rows of a month, without those behind its end that only forecasts show."""
    return hash_of_series(*(matrix[:MONTH_ROWS] for matrix in (raw.load_p, raw.load_q, raw.prod_p)))


def read_series_hash(path: Path) -> str | None:
    """:func:`hash_of_month` of the month in a pack, as the pack was written with it; None where there is no pack."""
    try:
        with path.open("rb") as stream:
            header: dict[str, Any] = json.loads(stream.readline())
        return str(header["series"]) if header["format"] == FORMAT else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


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
    flat = np.frombuffer(zlib.decompress(body), np.uint8)
    if flat.size != 2 * rows * sum(widths):
        raise UsageError(f"Pack {path} does not hold a month of {grid.id}: make it again.")
    load_p, load_q, prod_p = (np.empty((rows, width), np.int16) for width in widths)
    ends = 2 * rows * np.cumsum(widths)
    _decode(flat[: ends[0]], load_p)
    _decode(flat[ends[0] : ends[1]], load_q)
    _decode(flat[ends[1] :], prod_p)
    _add_usual_reactive(load_p, load_q)
    return RawMonth(grid.id, header["seed"], header["month"], load_p, load_q, prod_p)


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
    difference = raw.load_q.copy()
    _add_usual_reactive(raw.load_p, difference, -1)
    return raw.load_p, difference, raw.prod_p


@jit
def _add_usual_reactive(active: I16, reactive: I16, sign: int = 1) -> None:
    """Add 0.7 of ``active``, halves upwards."""
    for row in range(active.shape[0]):
        for load in range(active.shape[1]):
            reactive[row, load] += sign * ((7 * np.int32(active[row, load]) + 5) // 10)


def _columns(matrix: I16) -> bytes:
    """Differences down the columns; low bytes of all, then high bytes: those of small numbers are alike."""
    steps = np.diff(matrix.T, axis=1, prepend=np.int16(0))  # Modulo 2**16, as is their sum.
    zigzag = ((steps << 1) ^ (steps >> 15)).astype(np.uint16)
    return (zigzag & 0xFF).astype(np.uint8).tobytes() + (zigzag >> 8).astype(np.uint8).tobytes()


@jit
def _decode(data: U8, matrix: I16) -> None:
    """The inverse of :func:`_columns`."""
    rows, width = matrix.shape
    high = rows * width
    for column in range(width):
        value = np.int32(0)
        for row in range(rows):
            place = column * rows + row
            zigzag = np.int32(data[place]) | (np.int32(data[high + place]) << 8)
            value += (zigzag >> 1) ^ -(zigzag & 1)
            matrix[row, column] = value
