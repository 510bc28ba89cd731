"""Rankings of the topology actions: which actions the difficulty levels hold, and how often each was tried.

A ranking file ``data/<grid>.ranking.npz`` holds the catalogue ids in order, best first, what came of every
action's trials and, as JSON, how it was made. It is written by ``rl2grid rank <grid>``; see
:mod:`rl2grid.evaluation.ranking`.

The order is read with :func:`ranking`, by every task; the trials with :func:`trials`, by people.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import UsageError, one_of
from rl2grid.grids.grid import GRID_IDS, load_grid


@dataclass(frozen=True, eq=False)
class Ranking:
    """The ranked actions of one grid, best first."""

    ids: NDArray[np.int32]
    """Catalogue ids, without do nothing; read-only."""
    metadata: dict[str, Any]
    """How the ranking was made: version, command, seed, number of states, method."""
    hash: str
    """Short hash of the grid and of the ids in order."""


@dataclass(frozen=True, eq=False)
class Trials:
    """What came of trying the actions of one grid, by catalogue id; read-only."""

    trials: NDArray[np.uint32]
    """[action] how often the action was tried."""
    survived: NDArray[np.uint32]
    """[action] trials without a collapse of the grid, or a line above the hard limit of its protection."""
    margin: NDArray[np.float32]
    """[action] mean over the trials that survived of 1 - the worst loading that resulted, in [-1, 1]."""

    @property
    def survival(self) -> NDArray[np.float64]:
        """[action] share of the trials that survived; NaN for an action that was never tried."""
        tried = self.trials > 0
        return np.where(tried, self.survived / np.maximum(self.trials, 1), np.nan)


def ranking(grid_id: str) -> Ranking:
    """The ranking in use for ``grid_id``.

    Raises:
        UsageError: there is no such grid, or the installation lacks its ranking.
    """
    _check(grid_id)
    return _load(grid_id)


def ranking_hash(grid_id: str) -> str:
    """Short hash of the ranking in use for ``grid_id``."""
    return ranking(grid_id).hash


def trials(grid_id: str) -> Trials:
    """What came of the trials behind the ranking in use for ``grid_id``.

    Raises:
        UsageError: there is no such grid, the installation lacks its ranking, or the ranking tells nothing of
            trials or of other actions than the grid has.
    """
    _check(grid_id)
    return _load_trials(grid_id)


@functools.cache
def _load(grid_id: str) -> Ranking:
    with _opened(grid_id) as arrays:
        ids = arrays["ids"].astype(np.int32)
        metadata = json.loads(str(arrays["metadata"]))
    ids.setflags(write=False)
    digest = hashlib.sha256(grid_id.encode() + ids.astype("<i4").tobytes()).hexdigest()[:16]
    return Ranking(ids, metadata, digest)


@functools.cache
def _load_trials(grid_id: str) -> Trials:
    n_actions = load_grid(grid_id).level_sizes[-1]
    with _opened(grid_id) as arrays:
        if not {"trials", "survived", "margin"} <= set(arrays):
            raise UsageError(
                f"The ranking of {grid_id} does not tell how often its actions were tried: "
                f"make it anew with `rl2grid rank {grid_id}`."
            )
        loaded = Trials(
            arrays["trials"].astype(np.uint32),
            arrays["survived"].astype(np.uint32),
            arrays["margin"].astype(np.float32),
        )
    for array in (loaded.trials, loaded.survived, loaded.margin):
        if array.shape != (n_actions,):
            raise UsageError(
                f"The ranking of {grid_id} tells of {len(array):,} actions where the grid has {n_actions:,}: "
                f"make it anew with `rl2grid rank {grid_id}`."
            )
        array.setflags(write=False)
    return loaded


def _check(grid_id: str) -> None:
    if grid_id not in GRID_IDS:
        raise one_of("Grid", grid_id, GRID_IDS)


@contextmanager
def _opened(grid_id: str) -> Iterator[Any]:
    file = resources.files("rl2grid.grids") / "data" / f"{grid_id}.ranking.npz"
    if not file.is_file():
        raise UsageError(f"The ranking of {grid_id} is missing: make it with `rl2grid rank {grid_id}`.")
    with file.open("rb") as stream, np.load(stream) as arrays:
        yield arrays
