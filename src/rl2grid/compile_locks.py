"""One process at a time compiles a function; others that need it wait, and load what was made.

A lock is a file beside the machine code of a function, which the system lets go when the process that holds it ends,
however it ends. A process that compiles a function takes those of the functions that it calls one after the other,
while it holds its own. Functions do not call each other in a circle, and the threads of a process compile one at a time
(Numba's own lock), so that no process can wait for one that waits for it.
"""

from __future__ import annotations

import errno
import functools
import time
from pathlib import Path
from typing import TYPE_CHECKING

from rl2grid import compile_notices

if TYPE_CHECKING:
    from filelock import FileLock

_WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""What some network file systems answer."""
_TELL_SECONDS = 1.0
_PATIENCE_SECONDS = 900.0
"""Who waits for longer compiles for himself: the other process has been stopped, or hangs."""


class CompileLock:
    """Of one function of one cache of machine code.

    Args:
        path: of the file; it and its folder are made.
        module: where the function is defined, for notices.
    """

    def __init__(self, path: Path, module: str) -> None:
        self._path, self._module = path, module

    def take(self) -> bool:
        """Wait until no other process compiles the function; False: that cannot be known, or took too long."""
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            return self._wait()
        except NotImplementedError:
            _say_that_there_are_none(self._path.parent.parent)
        except OSError as error:  # else the folder cannot be written, which whoever writes machine code there says
            if error.errno in _WITHOUT_LOCKS:
                _say_that_there_are_none(self._path.parent.parent)
        return False

    def _wait(self) -> bool:
        from filelock import Timeout

        patience = time.monotonic() + _PATIENCE_SECONDS
        while time.monotonic() < patience:
            try:
                self._lock.acquire(timeout=_TELL_SECONDS)
            except Timeout:
                compile_notices.NOTICES.wait(self._module)
            else:
                return True
        return False

    def release(self) -> None:
        """As often as it was taken."""
        self._lock.release()

    @functools.cached_property
    def _lock(self) -> FileLock:
        """Made when it is needed: hundreds of them take as long as to load all machine code."""
        from filelock import FileLock

        return FileLock(self._path)


@functools.cache
def _say_that_there_are_none(folder: Path) -> None:
    compile_notices.say(f"the file system of {folder} has no locks: processes that start at once all compile.")
