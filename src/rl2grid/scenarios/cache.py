"""The local copy of the series, as arrays that processes map into memory and share.

A series is two files: ``<name>-<key>.npy``, all its arrays one after the other as bytes, and
``<name>-<key>.json``, the manifest with their places and a SHA-256. The key is made of everything
that the arrays depend on, so a changed source makes a new copy instead of a stale one. Files are
written to a temporary name and renamed; one process makes a copy while the others wait; a copy that
is missing or does not match its manifest is made again.

Hashing a copy of 100 MB takes longer than opening it may take. The manifest therefore remembers the size,
times and number of the file that was hashed last, and the values are hashed again only where these differ;
:func:`remove_damaged` always hashes them. What changes a file without changing its times, such as a failing
disk, is found by the latter alone.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import glob
import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import platformdirs
from numpy.typing import NDArray

from rl2grid.errors import UsageError
from rl2grid.scenarios.folder import FolderContent

FORMAT_VERSION = 1
"""Raised whenever the files below a version's folder would be read differently."""
LEFT_FREE_BYTES = 2**30
"""What is made ahead of its use, or kept after it, gives way where less is free."""
_ALIGNMENT = 64
_SETTLED = 2_000_000_000
"""Nanoseconds after which another change of a file is sure to change its times, on any file system."""
_SEEN, _SUM = "seen", "manifest_sha256"
"""Entries of the manifest about the copy on this disk; all others are about its content."""


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
    return _folder_of(os.environ.get("RL2GRID_DATA"))


@functools.cache
def _folder_of(given: str | None) -> Path:
    return Path(given or platformdirs.user_cache_dir("rl2grid")).expanduser()


def free_bytes() -> int:
    """What is free where the data folder is, or will be."""
    folder = data_folder().absolute()
    while not folder.exists():
        folder = folder.parent
    return shutil.disk_usage(folder).free


class Copy(NamedTuple):
    """A copy on the disk; the least is the oldest."""

    changed: int
    """Nanoseconds since the epoch."""
    size: int
    """Bytes."""
    path: Path


def copies_by_age(paths: Iterable[Path]) -> list[Copy]:
    """The copies that are still there, the oldest first."""
    copies = []
    for path in paths:
        with contextlib.suppress(FileNotFoundError):  # another process was faster
            status = path.stat()
            copies.append(Copy(status.st_mtime_ns, status.st_size, path))
    return sorted(copies)


def remove_oldest(copies: list[Copy], excess: int) -> None:
    """Remove the first copies until ``excess`` bytes are gone; what processes have mapped stays readable for them."""
    for copy in copies:
        if excess <= 0:
            return
        for companion in (copy.path, *(copy.path.with_suffix(suffix) for suffix in (".json", ".lock"))):
            companion.unlink(missing_ok=True)
        excess -= copy.size


def copies_of_other_keys(grid_id: str, pattern: str, key: str) -> list[Copy]:
    """Copies whose names match ``pattern`` and whose key is not ``key``, the oldest first."""
    current = _key_suffix(key)
    paths = series_folder(grid_id).glob(f"{pattern}.npy")
    return copies_by_age(path for path in paths if not path.stem.endswith(current))


def series_folder(grid_id: str) -> Path:
    """Where the copies of a grid's series are."""
    return data_folder() / "series" / f"v{FORMAT_VERSION}" / grid_id


def cached_series(grid_id: str, name: str, key: str, build: Callable[[], FolderContent]) -> CachedSeries:
    """The series ``name`` of a grid, made by ``build`` where no sound copy of it exists.

    Raises:
        UsageError: The data folder cannot be written; or what ``build`` raises.
    """
    _allow_many_files()
    data = _data_path(grid_id, name, key)
    manifest = data.with_suffix(".json")
    series = _read(data, manifest)
    if series is not None:
        return series
    try:
        data.parent.mkdir(parents=True, exist_ok=True)
        import filelock  # here: importing rl2grid shall not take long

        with filelock.FileLock(data.with_suffix(".lock")):
            series = _read(data, manifest) or _make(data, manifest, build())
    except OSError as error:
        if error.errno == errno.EMFILE:
            raise UsageError(
                "This process has as many open files as it may, and every month that is played is one: allow more "
                "(ulimit -n), or make fewer environments."
            ) from error
        raise UsageError(
            f"The data folder {data_folder()} cannot be written ({error}): set RL2GRID_DATA to one that can."
        ) from error
    return series


def is_cached(grid_id: str, name: str, key: str) -> bool:
    """Whether there is a copy of a series; it is not looked at."""
    return _data_path(grid_id, name, key).with_suffix(".json").is_file()


def _data_path(grid_id: str, name: str, key: str) -> Path:
    stem = f"{name.replace('/', '.')}{_key_suffix(key)}"
    return series_folder(grid_id) / f"{stem}.npy"


def _key_suffix(key: str) -> str:
    return f"-{key[:16]}"


@functools.cache
def _allow_many_files() -> None:
    """Let this process have as many open files as the system allows it, not the few that it begins with.

    Every mapped month counts as one for as long as an environment plays it: the usual 1,024 end a vector of as many.
    """
    try:
        import resource
    except ImportError:  # not a system with such limits
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def remove_damaged(grid_id: str) -> list[Path]:
    """Hash every copy of a grid, remove those that do not match their manifest, and return their files.

    Raises:
        UsageError: A damaged copy cannot be removed.
    """
    copies = sorted(series_folder(grid_id).glob("[!.]*.npy"))
    try:
        return [data for data in copies if not _matches(data) and _remove(data)]
    except OSError as error:
        raise UsageError(
            f"The data folder {data_folder()} has damaged files that cannot be removed ({error})."
        ) from error


def _matches(data: Path) -> bool:
    record = _read_manifest(data.with_suffix(".json"))
    return record is not None and _is_sound(data, record)


def _remove(data: Path) -> bool:
    """Whether the copy was removed; one that was being made is sound by now."""
    import filelock

    with filelock.FileLock(data.with_suffix(".lock")):
        if not data.is_file() or _matches(data):
            return False
        data.unlink()
        data.with_suffix(".json").unlink(missing_ok=True)
        return True


def _make(data: Path, manifest: Path, content: FolderContent) -> CachedSeries:
    table: dict[str, dict[str, Any]] = {}
    size = 0
    for name, array in content.arrays.items():
        size += -size % _ALIGNMENT
        portable = array.dtype.newbyteorder("<").str
        table[name] = {"dtype": portable, "shape": array.shape, "offset": size}
        size += array.nbytes
    digest = hashlib.sha256()
    for leftover in data.parent.glob(f".{glob.escape(data.stem)}.*"):  # of processes that were killed; the lock is held
        leftover.unlink(missing_ok=True)
    temporary = data.with_name(f".{data.name}.{os.getpid()}")
    try:
        with temporary.open("wb") as stream:
            header = {"descr": "|u1", "fortran_order": False, "shape": (size,)}
            np.lib.format.write_array_header_1_0(stream, header)
            for part in _parts(content.arrays):
                digest.update(part)
                stream.write(part)
        os.replace(temporary, data)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
    record = {"start_datetime": content.start_datetime.isoformat(), "arrays": table, "sha256": digest.hexdigest()}
    _write_manifest(manifest, record)
    series = _map(data, record)
    if series is None:
        raise OSError(f"{data} does not read back as it was written")
    return series


def _parts(arrays: Mapping[str, NDArray[Any]]) -> Iterator[memoryview]:
    """The bytes of all arrays, each beginning at a multiple of the alignment."""
    size = 0
    for array in arrays.values():
        yield memoryview(bytes(-size % _ALIGNMENT))
        portable = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        yield portable.reshape(-1).view(np.uint8).data
        size += -size % _ALIGNMENT + portable.nbytes


def _read(data: Path, manifest: Path) -> CachedSeries | None:
    """The series, or None where a file is missing or damaged."""
    record = _read_manifest(manifest)
    if record is None:
        return None
    try:
        status = _status(data)
        if record.get(_SEEN) != status:
            if not _is_sound(data, record):
                return None
            _remember(manifest, record, status)
        return _map(data, record)
    except (OSError, ValueError, KeyError, TypeError, EOFError):
        return None


def _map(data: Path, record: dict[str, Any]) -> CachedSeries | None:
    """The arrays that a manifest describes, whose values are not looked at; None where they are not there."""
    buffer = np.asarray(np.load(data, mmap_mode="r"))
    arrays = {name: _view(buffer, **place) for name, place in record["arrays"].items()}
    start = datetime.fromisoformat(record["start_datetime"])
    # The values are named through their checksum: hashing the small manifest hashes everything.
    content = {name: value for name, value in record.items() if name not in (_SEEN, _SUM)}
    content_hash = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    return CachedSeries(start, arrays, content_hash)


def _is_sound(data: Path, record: dict[str, Any]) -> bool:
    """Whether the values are those that the manifest was written for."""
    try:
        buffer = np.asarray(np.load(data, mmap_mode="r"))
    except (OSError, ValueError, EOFError):
        return False
    return buffer.dtype == np.uint8 and bool(hashlib.sha256(buffer.data).hexdigest() == record["sha256"])


def _read_manifest(manifest: Path) -> dict[str, Any] | None:
    """The manifest, or None where it is missing or damaged."""
    try:
        record: dict[str, Any] = json.loads(manifest.read_bytes())
        return record if record.pop(_SUM) == _sum(record) else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _write_manifest(manifest: Path, record: dict[str, Any]) -> None:
    temporary = manifest.with_name(f".{manifest.name}.{os.getpid()}")
    temporary.write_text(json.dumps(record | {_SUM: _sum(record)}, indent=1, sort_keys=True))
    os.replace(temporary, manifest)


def _sum(record: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def _status(data: Path) -> list[int]:
    """What changes when a file does: size, times of its content and of its record, and its number."""
    status = data.stat()
    return [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]


def _remember(manifest: Path, record: dict[str, Any], status: list[int]) -> None:
    """Note that the file of this status was hashed, so that the next process need not do it again."""
    if time.time_ns() - max(status[1:3]) < _SETTLED:
        return
    with contextlib.suppress(OSError):  # A folder that is only read is hashed every time.
        _write_manifest(manifest, record | {_SEEN: status})


def _view(buffer: NDArray[np.uint8], dtype: str, shape: list[int], offset: int) -> NDArray[Any]:
    kind = np.dtype(dtype)
    size = int(np.prod(shape)) * kind.itemsize
    return buffer[offset : offset + size].view(kind).reshape(shape)
