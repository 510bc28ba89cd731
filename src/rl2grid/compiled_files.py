"""Files of compiled code, which one process makes for all, and which are verified before they are run.

Numba takes whatever its cache holds for machine code: a flipped bit ends in a traceback, or in a crash. Here every file
ends with the SHA-256 of its name and of what is before; one that does not is left out with a notice, and compiled
again in its place. Numba lets every process that starts without machine code compile all of it, one writing over the
other: here one process compiles a function (:mod:`rl2grid.compile_locks`). Where nothing can be written, what is there
is read nevertheless, and the rest compiled by every process.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    _CacheLocator,
    _SourceFileBackedLocatorMixin,
)
from numba.core.compiler_lock import global_compiler_lock

from rl2grid import compile_notices
from rl2grid.compile_locks import CompileLock
from rl2grid.errors import DamageWarning

_DIGEST = hashlib.sha256().digest_size
"""Bytes at the end of a file."""


class VerifiedCacheFile(IndexDataCacheFile):  # type: ignore[misc]
    """Numba's files of one function, with checksums, before which unpickling ends: Numba reads such files as well."""

    def _load_index(self) -> Any:
        try:
            return super()._load_index() if _is_sound(Path(self._index_path)) else {}
        except OSError:  # there is none, or none that this user may read
            return {}

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


class _Locator(_SourceFileBackedLocatorMixin, _CacheLocator):  # type: ignore[misc]
    """A folder of machine code, whether or not it can be written; one folder in it for each of sources."""

    def __init__(self, folder: Path, function: Any, source: str) -> None:
        self._py_file, self._lineno = source, function.__code__.co_firstlineno
        self._folder = str(folder / self.get_suitable_cache_subpath(source))

    def get_cache_path(self) -> str:
        return self._folder


class _LocatorIn:
    """Makes the locators of a folder, where Numba has classes of locators."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def from_function(self, function: Any, source: str) -> _Locator:
        """Never None: a folder that cannot be written can be read."""
        return _Locator(self._folder, function, source)


class _Implementation(CompileResultCacheImpl):  # type: ignore[misc]
    """Numba's, with one folder."""

    def __init__(self, folder: Path, function: Any) -> None:
        self._locator_classes = [_LocatorIn(folder)]
        super().__init__(function)


class CompiledFunction(FunctionCache):  # type: ignore[misc]
    """The machine code of one function in a folder.

    Args:
        function: the function, in Python.
        folder: of all machine code.
    """

    def __init__(self, function: Any, folder: Path) -> None:
        self._folder = folder
        self._impl_class = functools.partial(_Implementation, folder)
        super().__init__(function)
        base = self._impl.filename_base
        self._cache_file = VerifiedCacheFile(self._cache_path, base, self._impl.locator.get_source_stamp())
        self._lock = CompileLock(Path(self._cache_path) / f"{base}.lock", function.__module__)
        self._taken: list[int] = []
        """How often the lock was taken in each call of :meth:`in_one_process` that is not over."""

    @contextlib.contextmanager
    def in_one_process(self) -> Iterator[None]:
        """Let no other process compile the function, from the moment on at which it turns out not to be there."""
        self._taken.append(0)
        try:
            yield
        finally:
            for _ in range(self._taken.pop()):
                self._lock.release()

    def holds(self, signature: Any, target_context: Any) -> bool:
        """Whether there is machine code for these types of arguments."""
        data: str | None = self._cache_file._load_index().get(self._index_key(signature, target_context.codegen()))
        return data is not None and (Path(self._cache_path) / data).exists()

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """What the folder holds, or another process is about to put there; None: it is to be compiled."""
        kept = super().load_overload(sig, target_context)
        if kept is not None or not self._taken or not self._lock.take():
            return kept
        self._taken[-1] += 1
        return super().load_overload(sig, target_context)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Put it into the folder, if that can be done."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _say_that_it_is_not_kept(self._folder, error.strerror)


def keep_code_of(compiled: Any, folder: Path) -> None:
    """Have the machine code of a function of ``numba.njit`` kept in a folder, and compiled by one process for all."""
    if not hasattr(compiled, "enable_caching"):  # Numba is told not to compile
        return
    kept, compile_here = CompiledFunction(compiled.py_func, folder), compiled.compile

    def compile_once(signature: Any) -> Any:
        with global_compiler_lock, kept.in_one_process():
            return compile_here(signature)

    compiled._cache, compiled.compile = kept, compile_once


def is_kept(compiled: Any, signature: tuple[Any, ...]) -> bool:
    """Whether the machine code of a function for some types is there, or none is wanted."""
    kept = getattr(compiled, "_cache", None)
    return not isinstance(kept, CompiledFunction) or kept.holds(signature, compiled.targetctx)


@functools.cache
def _say_that_it_is_not_kept(folder: Path, reason: str | None) -> None:
    compile_notices.say(f"compiled code cannot be kept in {folder} ({reason}): every process compiles it again.")


def _digest(name: str, content: bytes) -> bytes:
    """The hash of a file and its name: that of another function in its place is another file."""
    return hashlib.sha256(name.encode() + content).digest()


def _is_sound(path: Path) -> bool:
    content = path.read_bytes()
    if _digest(path.name, content[:-_DIGEST]) == content[-_DIGEST:]:
        return True
    warnings.warn(f"{path} was damaged: what it held is compiled again.", DamageWarning, stacklevel=2)
    return False
