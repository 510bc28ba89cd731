"""The local copy of the series, as arrays that processes map into memory and share.

A series is two files: ``<name>-<key>.npy``, all its arrays one after the other as bytes, and
``<name>-<key>.json``, the manifest with their places and a SHA-256. The key is made of everything
that the arrays depend on, so a changed source makes a new copy instead of a stale one. Files are
written to a temporary name and renamed; one process makes a copy while the others wait; a copy that
is missing or does not match its manifest is made again.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import filelock
import numpy as np
import platformdirs
from numpy.typing import NDArray

from rl2grid.errors import UsageError
from rl2grid.scenarios.folder import FolderContent

FORMAT_VERSION = 1
"""Raised whenever the files below a version's folder would be read differently."""
_ALIGNMENT = 64


@dataclass(frozen=True)
class CachedSeries:
    """A series mapped into memory."""

    start_datetime: datetime
    arrays: dict[str, NDArray[Any]]
    """Read-only views into one memory-mapped file."""
    content_hash: str
    """SHA-256 of the values, their names, types and shapes, and the first time stamp."""


def data_folder() -> Path:
    """Where series are kept: ``$RL2GRID_DATA``, else the user's cache folder of this system."""
    return Path(os.environ.get("RL2GRID_DATA") or platformdirs.user_cache_dir("rl2grid")).expanduser()


def cached_series(grid_id: str, name: str, key: str, build: Callable[[], FolderContent]) -> CachedSeries:
    """The series ``name`` of a grid, made by ``build`` where no sound copy of it exists.

    Raises:
        UsageError: The data folder cannot be written; or what ``build`` raises.
    """
    folder = data_folder() / "series" / f"v{FORMAT_VERSION}" / grid_id
    stem = folder / f"{name.replace('/', '.')}-{key[:16]}"
    data, manifest = stem.with_name(stem.name + ".npy"), stem.with_name(stem.name + ".json")
    series = _read(data, manifest)
    if series is not None:
        return series
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with filelock.FileLock(stem.with_name(stem.name + ".lock")):
            series = _read(data, manifest) or _make(data, manifest, build())
    except OSError as error:
        raise UsageError(
            f"The data folder {data_folder()} cannot be written ({error}): set RL2GRID_DATA to one that can."
        ) from error
    return series


def _make(data: Path, manifest: Path, content: FolderContent) -> CachedSeries:
    table: dict[str, dict[str, Any]] = {}
    buffer = bytearray()
    for name, array in content.arrays.items():
        buffer.extend(bytes(-len(buffer) % _ALIGNMENT))
        portable = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        table[name] = {"dtype": portable.dtype.str, "shape": portable.shape, "offset": len(buffer)}
        buffer.extend(portable.tobytes())
    record = {
        "start_datetime": content.start_datetime.isoformat(),
        "arrays": table,
        "sha256": hashlib.sha256(buffer).hexdigest(),
    }
    temporary = data.with_name(f".{data.name}.{os.getpid()}")
    with temporary.open("wb") as stream:
        np.save(stream, np.frombuffer(buffer, np.uint8))
    os.replace(temporary, data)
    temporary = manifest.with_name(f".{manifest.name}.{os.getpid()}")
    temporary.write_text(json.dumps(record, indent=1, sort_keys=True))
    os.replace(temporary, manifest)
    series = _read(data, manifest)
    if series is None:
        raise OSError(f"{data} does not read back as it was written")
    return series


def _read(data: Path, manifest: Path) -> CachedSeries | None:
    """The series, or None where a file is missing or damaged."""
    try:
        record = json.loads(manifest.read_text())
        buffer = np.asarray(np.load(data, mmap_mode="r"))
        if buffer.dtype != np.uint8 or hashlib.sha256(buffer.data).hexdigest() != record["sha256"]:
            return None
        arrays = {name: _view(buffer, **place) for name, place in record["arrays"].items()}
        start = datetime.fromisoformat(record["start_datetime"])
    except (OSError, ValueError, KeyError, TypeError, EOFError):
        return None
    # The values are named through their checksum: hashing the small manifest hashes everything.
    content_hash = hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
    return CachedSeries(start, arrays, content_hash)


def _view(buffer: NDArray[np.uint8], dtype: str, shape: list[int], offset: int) -> NDArray[Any]:
    kind = np.dtype(dtype)
    size = int(np.prod(shape)) * kind.itemsize
    return buffer[offset : offset + size].view(kind).reshape(shape)
