"""Packs: one small file per generated month.

A pack is a line of JSON, its head, which names the values by their hash and ends with a checksum of its own, and a
compressed body. The body holds what the month is
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

FORMAT = "rl2grid-pack-3"
SUFFIX = ".pack"
MAX_BYTES = 2**26
"""A larger file is no pack."""
_HEAD: dict[str, type] = {
    "format": str, "grid": str, "seed": int, "month": int, "rows": int, "series": str, "sha256": str,
}  # fmt: skip
"""What a head says, besides its checksum."""
_HEAD_BYTES = 2**12
"""More than a head has."""
_LEVEL = 9
"""Compression: the smallest files; they are written once."""


def write_pack(path: Path, raw: RawMonth) -> None:
    """Write a month (:func:`rl2grid.scenarios.generator.month.raw_month`) to ``path``, whole or not at all."""
    body = zlib.compress(b"".join(_columns(matrix) for matrix in _matrices(raw)), _LEVEL)
    head = {
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
    temporary.write_bytes(json.dumps(head | {"checksum": _checksum(head)}).encode() + b"\n" + body)
    os.replace(temporary, path)


def hash_of_month(raw: RawMonth) -> str:
    """Hash of the rows of a month, without those behind its end that only forecasts show."""
    return hash_of_series(*(matrix[:MONTH_ROWS] for matrix in (raw.load_p, raw.load_q, raw.prod_p)))


def read_head(path: Path) -> dict[str, Any]:
    """What the head of a pack says: format, grid, seed, month, rows, and the hashes of the series and of the body.

    ``series`` is :func:`hash_of_month` of the month, as the pack was written with it.

    Raises:
        UsageError: there is no such file, or it is no pack with an undamaged head.
    """
    try:
        with path.open("rb") as stream:
            return _checked_head(path, stream.readline(_HEAD_BYTES))
    except OSError as error:
        raise UsageError(f"Pack {path} cannot be read: {error.strerror}.") from error


def read_raw(path: Path) -> RawMonth:
    """The month in a pack.

    Raises:
        UsageError: there is no such file, or it is no undamaged pack of a grid of this version.
    """
    head, body = _open(path)
    grid = load_grid(head["grid"])
    rows = head["rows"]
    widths = (grid.n_load, grid.n_load, grid.n_gen)
    if rows != MONTH_ROWS + int(load_constants(grid.id).forecast.horizon[0]):
        raise UsageError(f"Pack {path} has {rows} rows, which no month of {grid.id} has: make it again.")
    flat = _expanded(body, 2 * rows * sum(widths))
    if flat is None:
        raise UsageError(f"Pack {path} does not hold a month of {grid.id}: make it again.")
    load_p, load_q, prod_p = (np.empty((rows, width), np.int16) for width in widths)
    ends = 2 * rows * np.cumsum(widths)
    _decode(flat[: ends[0]], load_p)
    _decode(flat[ends[0] : ends[1]], load_q)
    _decode(flat[ends[1] :], prod_p)
    _add_usual_reactive(load_p, load_q)
    return RawMonth(grid.id, head["seed"], head["month"], load_p, load_q, prod_p)


def _open(path: Path) -> tuple[dict[str, Any], bytes]:
    """Head and body of a pack, whose checksums agree."""
    try:
        with path.open("rb") as stream:
            line, _, body = stream.read(MAX_BYTES + 1).partition(b"\n")
    except OSError as error:
        raise UsageError(f"Pack {path} cannot be read: {error.strerror}.") from error
    head = _checked_head(path, line)
    if len(line) + len(body) > MAX_BYTES or head["sha256"] != hashlib.sha256(body).hexdigest():
        raise _damaged(path)
    return head, body


def _checked_head(path: Path, line: bytes) -> dict[str, Any]:
    try:
        head: dict[str, Any] = json.loads(line)
        stated = head.pop("checksum", None)
        sound = head["format"] == FORMAT and stated == _checksum(head)
        complete = all(type(head[name]) is kind for name, kind in _HEAD.items())
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UsageError(f"File {path} is no pack: packs end in {SUFFIX} and are made by this version.") from error
    if not (sound and complete):
        raise _damaged(path)
    return head


def _damaged(path: Path) -> UsageError:
    return UsageError(f"Pack {path} is damaged or of another version: make it again.")


def _checksum(head: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(head, sort_keys=True).encode()).hexdigest()


def _expanded(body: bytes, size: int) -> U8 | None:
    """What a body holds, which is never expanded to more than ``size`` bytes; None: it has another size, or is none."""
    unpacking = zlib.decompressobj()
    try:
        flat = np.frombuffer(unpacking.decompress(body, size + 1), np.uint8)
    except zlib.error:
        return None
    return flat if unpacking.eof and flat.size == size else None


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
