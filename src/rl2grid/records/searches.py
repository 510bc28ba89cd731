"""A search for hyperparameters as it is stored: what is searched, the best configuration, and who may write.

::

    tuning.json     what is searched
    journal.log     Optuna's journal: every trial, shared by all processes of the search
    trials/<hash>/  one run folder per seed of a configuration
    best.json       the best configuration
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from rl2grid.records.files import read_json, write_record
from rl2grid.records.locks import locked

SEARCH_FILE, BEST_FILE = "tuning.json", "best.json"
JOURNAL_FILE, TRIALS_FOLDER = "journal.log", "trials"
_SEARCH_LOCK, _BEGINNING_LOCK, _TRIAL_LOCKS = ".search.lock", ".begin.lock", ".locks"


def read_search(folder: Path) -> dict[str, Any] | None:
    """What is searched; None in a folder without a search."""
    path = folder / SEARCH_FILE
    if not path.exists():
        return None
    remedy = "restore it, or begin another search in another folder"
    search: dict[str, Any] = read_json(path, "a description of a search", remedy, {"seeds": list, "task": str})
    return search


def write_search(folder: Path, search: Mapping[str, Any]) -> None:
    """Write what is searched."""
    write_record(folder / SEARCH_FILE, dict(search))


def write_best(folder: Path, best: Mapping[str, Any]) -> None:
    """Write the best configuration and the command that trains with it."""
    write_record(folder / BEST_FILE, dict(best))


def search_lock(folder: Path) -> AbstractContextManager[None]:
    """Held by the one process that leads a search.

    Raises:
        LockedError: on entering, when another process leads it.
    """
    return locked(folder, _SEARCH_LOCK)


def beginning_lock(folder: Path) -> AbstractContextManager[None]:
    """Held by the one process that begins a trial; others wait."""
    return locked(folder, _BEGINNING_LOCK, wait=True)


def trial_lock(folder: Path, name: str) -> AbstractContextManager[None]:
    """Held by the one process that trains in the trial folder of that name; others wait."""
    locks = folder / _TRIAL_LOCKS
    locks.mkdir(exist_ok=True)
    return locked(locks, name, wait=True)
