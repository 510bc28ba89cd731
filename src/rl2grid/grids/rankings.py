"""Rankings of the topology actions: which actions the difficulty levels hold.

A ranking file ``data/<grid>.ranking.npz`` holds the best catalogue ids in order and, as JSON, how it
was made. It is written by ``rl2grid rank <grid>``; see :mod:`rl2grid.experiments.ranking`.
"""

from __future__ import annotations

import functools
import hashlib
import json
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import UsageError, one_of
from rl2grid.grids.grid import GRID_IDS


@dataclass(frozen=True, eq=False)
class Ranking:
    """The ranked actions of one grid, best first."""

    ids: NDArray[np.int32]
    """Catalogue ids, without do nothing; read-only."""
    metadata: dict[str, Any]
    """How the ranking was made: version, command, seed, number of states, method."""
    hash: str
    """Short hash of the grid and of the ids in order."""


def ranking(grid_id: str) -> Ranking:
    """The ranking in use for ``grid_id``.

    Raises:
        UsageError: there is no such grid, or the installation lacks its ranking.
    """
    if grid_id not in GRID_IDS:
        raise one_of("Grid", grid_id, GRID_IDS)
    return _load(grid_id)


def ranking_hash(grid_id: str) -> str:
    """Short hash of the ranking in use for ``grid_id``."""
    return ranking(grid_id).hash


@functools.cache
def _load(grid_id: str) -> Ranking:
    file = resources.files("rl2grid.grids") / "data" / f"{grid_id}.ranking.npz"
    if not file.is_file():
        raise UsageError(f"The ranking of {grid_id} is missing: make it with `rl2grid rank {grid_id}`.")
    with file.open("rb") as stream, np.load(stream) as arrays:
        ids = arrays["ids"].astype(np.int32)
        metadata = json.loads(str(arrays["metadata"]))
    ids.setflags(write=False)
    digest = hashlib.sha256(grid_id.encode() + ids.astype("<i4").tobytes()).hexdigest()[:16]
    return Ranking(ids, metadata, digest)
