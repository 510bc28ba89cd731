"""Grid2Op's full datasets, where the user has downloaded them.

Each scenario belongs to a split by a hash of its folder's name, so that the split does not depend
on how much of the dataset is there, and the mixes of one month (same demand) stay together.
"""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Mapping
from pathlib import Path

from rl2grid.errors import UsageError
from rl2grid.grids import Grid

VARIABLE = "RL2GRID_FULL_DATA"
"""Environment variable naming the folder that holds the datasets."""

_TENTHS = ("test", "test", "validation", *["train"] * 7)
"""Which split each tenth of the hashes belongs to."""


def is_full_requested() -> bool:
    """Whether training, validation and test shall come from the full dataset."""
    return bool(os.environ.get(VARIABLE))


def full_data_folder() -> Path:
    """The folder that holds the datasets: ``$RL2GRID_FULL_DATA``, else where Grid2Op downloads to."""
    return Path(os.environ.get(VARIABLE) or "~/data_grid2op").expanduser()


def full_folders(grid: Grid) -> Mapping[str, Path]:
    """Name of every scenario of the grid's full dataset (mixes as ``mix/name``) and its folder.

    Raises:
        UsageError: The dataset is not there.
    """
    return _folders(full_data_folder() / grid.grid2op_name)


def full_split(grid: Grid, split: str) -> tuple[str, ...]:
    """Names of the scenarios of the grid's full dataset that belong to ``split``.

    Raises:
        UsageError: There is none.
    """
    names = tuple(name for name in full_folders(grid) if _split_of(name) == split)
    if not names:
        raise UsageError(
            f"The dataset in {full_data_folder() / grid.grid2op_name} has no scenario for the split {split}: "
            f"add scenarios, or unset {VARIABLE} to play the bundled ones."
        )
    return names


def _split_of(name: str) -> str:
    digest = hashlib.sha256(name.rpartition("/")[2].encode()).digest()
    return _TENTHS[int.from_bytes(digest[:8], "big") % len(_TENTHS)]


@functools.lru_cache(maxsize=16)
def _folders(dataset: Path) -> Mapping[str, Path]:
    folders = {path.name: path for path in sorted(dataset.glob("chronics/*/"))}
    folders |= {f"{path.parts[-3]}/{path.name}": path for path in sorted(dataset.glob("*/chronics/*/"))}
    if not folders:
        raise UsageError(
            f"There is no folder {dataset / 'chronics'} with scenarios: {VARIABLE} must name the folder that holds "
            f"{dataset.name} (default ~/data_grid2op), or be unset to play the bundled scenarios."
        )
    return folders
