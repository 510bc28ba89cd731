"""Rankings of the topology actions: which actions the difficulty levels hold, and how often each was tried.

A ranking file ``data/<grid>.ranking.npz`` holds the catalogue ids in order, best first, what came of every
action's trials and, as JSON, how it was made. It is written by ``rl2grid rank <grid>``; see
:mod:`rl2grid.evaluation.ranking`.

The order is read with :func:`ranking`, by every task below the highest level; the trials with :func:`trials`, by
people.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np

from rl2grid.errors import UsageError
from rl2grid.grids.ranking import Ranking, Trials
from rl2grid.grids.systems import find_system, load_grid


def ranking(grid_id: str) -> Ranking:
    """The ranking in use for ``grid_id``.

    Raises:
        UsageError: there is no such grid, or it has no ranking.
    """
    found = find_system(grid_id).ranking
    if found is None:
        raise UsageError(f"The ranking of {grid_id} is missing: make it with `rl2grid rank {grid_id}`.")
    return found


def ranking_hash(grid_id: str) -> str:
    """Short hash of the ranking in use for ``grid_id``."""
    return ranking(grid_id).hash


def trials(grid_id: str) -> Trials:
    """What came of the trials behind the ranking in use for ``grid_id``.

    Raises:
        UsageError: there is no such grid, it has no ranking, or the ranking tells nothing of trials or of other actions
            than the grid has.
    """
    found, n_actions = ranking(grid_id).trials, load_grid(grid_id).level_sizes[-1]
    if found is None:
        raise UsageError(
            f"The ranking of {grid_id} does not tell how often its actions were tried: "
            f"make it anew with `rl2grid rank {grid_id}`."
        )
    for array in (found.trials, found.survived, found.margin):
        if array.shape != (n_actions,):
            raise UsageError(
                f"The ranking of {grid_id} tells of {len(array):,} actions where the grid has {n_actions:,}: "
                f"make it anew with `rl2grid rank {grid_id}`."
            )
    return found


def read_ranking(grid_id: str, file: str | Path | Traversable) -> Ranking:
    """The ranking in a file that ``rl2grid rank`` has written.

    Raises:
        UsageError: the file cannot be read.
    """
    source = Path(file) if isinstance(file, str) else file
    try:
        with source.open("rb") as stream, np.load(stream) as arrays:
            ids = arrays["ids"].astype(np.int32)
            metadata = json.loads(str(arrays["metadata"]))
            tried = _trials(arrays)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise UsageError(
            f"The ranking of {grid_id} in {source} cannot be read ({error}): make it with `rl2grid rank {grid_id}`."
        ) from error
    ids.setflags(write=False)
    digest = hashlib.sha256(grid_id.encode() + ids.astype("<i4").tobytes()).hexdigest()[:16]
    return Ranking(ids, metadata, digest, tried)


def read_shipped_ranking(grid_id: str) -> Ranking | None:
    """The ranking of a grid whose files are shipped; None where the installation lacks it."""
    file = resources.files("rl2grid.grids") / "data" / f"{grid_id}.ranking.npz"
    return read_ranking(grid_id, file) if file.is_file() else None


def _trials(arrays: Any) -> Trials | None:
    if not {"trials", "survived", "margin"} <= set(arrays):
        return None
    loaded = Trials(
        arrays["trials"].astype(np.uint32),
        arrays["survived"].astype(np.uint32),
        arrays["margin"].astype(np.float32),
    )
    for array in (loaded.trials, loaded.survived, loaded.margin):
        array.setflags(write=False)
    return loaded
