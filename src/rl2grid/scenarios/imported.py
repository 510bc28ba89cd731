"""Series that the user has imported, each kept as one compressed file until it is imported again or deleted.

Unlike the expanded copies they cannot be made again: clearing the caches leaves them alone.
"""

from __future__ import annotations

import hashlib
import os
import re
import zipfile
import zlib
from datetime import datetime
from pathlib import Path

import numpy as np

from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.scenarios.cache import CachedSeries, cached_series, data_folder
from rl2grid.scenarios.folder import FolderContent

_START = "start_datetime"
MAX_BYTES = 2**32
"""Of an imported series that was unpacked: years on the largest grids."""
_NAME = re.compile(r"[^\[\]/\\]+")


def imported_folder(grid: Grid) -> Path:
    """Where imported series of a grid are kept."""
    return data_folder() / "imported" / grid.id


def imported_names(grid: Grid) -> tuple[str, ...]:
    """Names of the imported series of a grid."""
    return tuple(sorted(path.stem for path in imported_folder(grid).glob("[!.]*.npz")))


def store_imported(grid: Grid, name: str, content: FolderContent) -> Path:
    """Keep a series, whole or not at all, in the place of an earlier one of that name.

    Raises:
        UsageError: The name cannot be part of a scenario id, or the data folder cannot be written.
    """
    if _NAME.fullmatch(name) is None or name.startswith("."):
        raise UsageError(f"Folder name {name!r} cannot name a scenario: rename it without brackets and a leading dot.")
    path = imported_folder(grid) / f"{name}.npz"
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as stream:
            start = np.array(content.start_datetime.isoformat())
            np.savez_compressed(stream, allow_pickle=False, **{_START: start}, **content.arrays)
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise UsageError(
            f"The data folder {data_folder()} cannot be written ({error}): set RL2GRID_DATA to one that can."
        ) from error
    return path


def load_imported(grid: Grid, name: str) -> CachedSeries:
    """The series called ``name``, one of :func:`imported_names`.

    Raises:
        UsageError: Its file is damaged.
    """
    path = imported_folder(grid) / f"{name}.npz"
    try:
        key = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise UsageError(f"Imported scenario {path} cannot be read: {error.strerror}.") from None
    return cached_series(grid.id, f"folder.{name}", key, lambda: _read(path))


def _read(path: Path) -> FolderContent:
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(part.file_size for part in archive.infolist()) > MAX_BYTES:
                raise ValueError(f"it expands to more than {MAX_BYTES // 2**20} MiB")
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        start = datetime.fromisoformat(str(arrays.pop(_START)))
    except (OSError, ValueError, KeyError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        raise UsageError(f"Imported scenario {path} is damaged ({error}): import its folder again.") from error
    return FolderContent(start, arrays)
