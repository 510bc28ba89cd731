"""Locks of folders that are written: one process at a time. A lock goes with its process, however that ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import BaseFileLock, FileLock, Timeout

LOCK_FILE = ".lock"


class LockedError(Exception):
    """Another process holds the lock."""


def take_lock(folder: Path, name: str = LOCK_FILE, *, wait: bool = False) -> BaseFileLock:
    """Take the lock of a folder, to be given back by its ``release``.

    Args:
        folder: one that exists.
        name: of the lock's file.
        wait: for a process that holds it, instead of refusing.

    Raises:
        LockedError: another process holds it.
    """
    lock = FileLock(folder / name)
    try:
        lock.acquire(timeout=-1 if wait else 0)
    except Timeout:
        raise LockedError(f"Another process holds the lock of {folder}.") from None
    return lock


@contextmanager
def locked(folder: Path, name: str = LOCK_FILE, *, wait: bool = False) -> Iterator[None]:
    """:func:`take_lock` for as long as the context lasts."""
    lock = take_lock(folder, name, wait=wait)
    try:
        yield
    finally:
        lock.release()


def is_locked(folder: Path) -> bool:
    """Whether a process holds the lock of a folder now."""
    if not (folder / LOCK_FILE).exists():
        return False
    try:
        with locked(folder):
            return False
    except LockedError:
        return True
