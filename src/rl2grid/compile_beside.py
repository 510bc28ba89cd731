"""A process beside this one that compiles what this one will need later.

It compiles while this process compiles something else (:mod:`rl2grid.compile_locks` keeps them from doing the same),
says nothing, and ends with this process. What comes out is the same with and without it.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from rl2grid import compile_notices

if TYPE_CHECKING:
    from filelock import FileLock

VARIABLE = "RL2GRID_COMPILERS"
"""Environment variable: how many processes beside this one compile, 1 or 0; by default 1 where there are two cores."""

_STARTED: list[subprocess.Popen[bytes]] = []
"""Kept, with the pipes that tell them that this process is over."""


def compile_beside(module: str, folder: Path) -> None:
    """Start ``python -m module``, unless another process has, there is one core only, or it is not wanted.

    Args:
        module: calls :func:`end_with_the_parent`, then compiles.
        folder: of the machine code.
    """
    wanted = os.environ.get(VARIABLE, "1" if _cores() > 1 else "0") != "0"
    turn = take_turn(folder) if wanted else None
    if turn is None:
        return
    turn.release()  # the new process takes it
    quiet = os.environ | {compile_notices.VARIABLE: "1", VARIABLE: "0"}
    command, silent = [sys.executable, "-P", "-m", module], subprocess.DEVNULL
    with contextlib.suppress(OSError):  # no more processes are allowed: it goes without
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=silent, stderr=silent, env=quiet)
        threading.Thread(target=process.wait, daemon=True).start()
        _STARTED.append(process)


def take_turn(folder: Path) -> FileLock | None:
    """The lock of the one process that compiles beside others, as long as it is kept; None: another one has it."""
    from filelock import FileLock, Timeout

    lock = FileLock(folder / "beside.lock")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
    except (Timeout, OSError, NotImplementedError):  # taken, or code cannot be shared here
        return None
    return lock


def end_with_the_parent() -> None:
    """Have this process end when the one that started it does, however that ends."""
    threading.Thread(target=_wait_for_the_end, daemon=True).start()


def _wait_for_the_end() -> None:
    sys.stdin.buffer.read()
    os._exit(0)


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
