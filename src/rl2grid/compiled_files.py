"""Files of compiled code that are verified before they are run.

Numba takes whatever its cache holds for machine code: a flipped bit ends in a traceback, or in a crash. Here every file
ends with the SHA-256 of its name and of what is before; one that does not is left out with a notice, and compiled
again in its place.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numba.core.caching import IndexDataCacheFile

from rl2grid.errors import DamageWarning

_DIGEST = hashlib.sha256().digest_size
"""Bytes at the end of a file."""


class VerifiedCacheFile(IndexDataCacheFile):  # type: ignore[misc]
    """Numba's files of one function, with checksums, before which unpickling ends: Numba reads such files as well."""

    def _load_index(self) -> Any:
        if Path(self._index_path).exists() and not _is_sound(Path(self._index_path)):
            return {}
        return super()._load_index()

    def _load_data(self, name: str) -> Any:
        path = Path(self._data_path(name))
        if not _is_sound(path):
            raise OSError(f"{path} is damaged")  # for Numba a file that is not there
        return super()._load_data(name)

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[io.BytesIO]:
        content = io.BytesIO()
        yield content
        with super()._open_for_write(filepath) as file:
            file.write(content.getvalue() + _digest(Path(filepath).name, content.getvalue()))


def verify_files_of(compiled: Any) -> None:
    """Verify the files of a function of ``numba.njit(cache=True)`` from now on."""
    file = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    if isinstance(file, IndexDataCacheFile):  # there is none where Numba is told not to compile
        file.__class__ = VerifiedCacheFile


def _digest(name: str, content: bytes) -> bytes:
    """The hash of a file and its name: that of another function in its place is another file."""
    return hashlib.sha256(name.encode() + content).digest()


def _is_sound(path: Path) -> bool:
    content = path.read_bytes()
    if _digest(path.name, content[:-_DIGEST]) == content[-_DIGEST:]:
        return True
    warnings.warn(f"{path} was damaged: what it held is compiled again.", DamageWarning, stacklevel=2)
    return False
