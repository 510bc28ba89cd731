"""Grid2Op's full datasets, where the user has downloaded them.

Some are cut into weeks: ``2050-01-03_31`` is the week from that day of a year that was made with seed 31,
``Scenario_august_21_wk1`` the second of a month. Four weeks of one year that follow each other, counted from its first
day, are joined and named ``2050-01-03_31-4weeks`` after the first; where one of them is missing, the others stay weeks.

Each scenario belongs to a split by a hash of its folder's name (weeks: of the four that belong together), so that
the split does not depend on how much of the dataset is there, and the mixes of one month (same demand) stay together.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import os
import re
from collections.abc import Mapping, Sequence
from datetime import date, timedelta
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.scenarios.bundled import interconnections
from rl2grid.scenarios.cache import CachedSeries, cached_series
from rl2grid.scenarios.folder import FolderContent, read_folder, read_start, source_key

VARIABLE = "RL2GRID_FULL_DATA"
"""Environment variable naming the folder that holds the datasets."""

_TENTHS = ("test", "test", "validation", *["train"] * 7)
"""Which split each tenth of the hashes belongs to."""

WEEKS = 4
"""Weeks of a month."""
WEEK_STEPS = 7 * 288
_JOINED = f"-{WEEKS}weeks"
_DATED = re.compile(r"(\d{4}-\d\d-\d\d)_(\d+)")
_NUMBERED = re.compile(r"(.+)_wk(\d+)")


class _Week(NamedTuple):
    year: str
    """What the week is one of."""
    number: int
    """Weeks before it."""

    @property
    def month(self) -> str:
        return f"{self.year} {self.number // WEEKS}"


def is_full_requested() -> bool:
    """Whether training, validation and test shall come from the full dataset."""
    return bool(os.environ.get(VARIABLE))


def full_data_folder() -> Path:
    """The folder that holds the datasets: ``$RL2GRID_FULL_DATA``, else where Grid2Op downloads to."""
    return Path(os.environ.get(VARIABLE) or "~/data_grid2op").expanduser()


def full_folders(grid: Grid) -> Mapping[str, tuple[Path, ...]]:
    """Name of every scenario of the grid's full dataset (mixes as ``mix/name``) and its folder, or those of its weeks.

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
            f"add scenarios, or unset {VARIABLE} to play generated ones."
        )
    return names


def load_full(grid: Grid, name: str) -> CachedSeries:
    """The scenario called ``name``, one of :func:`full_folders`, from the local copy or its folders.

    Raises:
        UsageError: A folder is no scenario of the grid, or no week that joins the next one.
    """
    paths = full_folders(grid)[name]
    return cached_series(grid.id, f"full.{name}", source_key(grid, *paths), lambda: _content(grid, paths))


def _content(grid: Grid, paths: Sequence[Path]) -> FolderContent:
    signed = interconnections(grid)
    weeks = [read_folder(grid, path, signed_loads=signed) for path in paths]
    return FolderContent(weeks[0].start_datetime, _join(paths, [week.arrays for week in weeks]))


def _join(paths: Sequence[Path], weeks: Sequence[dict[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """The series of weeks that follow each other. The last row of one may be the first of the next."""
    for path, week in zip(paths[:-1], weeks[:-1], strict=True):
        rows = len(week["load_p"])
        if rows not in (WEEK_STEPS, WEEK_STEPS + 1):
            raise UsageError(
                f"Scenario folder {path} has {rows:,} rows: {WEEK_STEPS:,}, or one more, are needed to join its week "
                "with the next one."
            )
    for path, week in zip(paths, weeks, strict=True):
        if _columns(week) != _columns(weeks[0]):
            raise UsageError(f"Scenario folder {path} holds other tables than {paths[0]}: weeks with the same join.")
    return {
        name: np.concatenate([*(week[name][:WEEK_STEPS] for week in weeks[:-1]), weeks[-1][name]]) for name in weeks[0]
    }


def _columns(arrays: dict[str, NDArray[Any]]) -> dict[str, tuple[int, ...]]:
    return {name: array.shape[1:] for name, array in arrays.items()}


def _split_of(name: str) -> str:
    folder = name.rpartition("/")[2].removesuffix(_JOINED)
    week = _week_of(folder)
    digest = hashlib.sha256((folder if week is None else week.month).encode()).digest()
    return _TENTHS[int.from_bytes(digest[:8], "big") % len(_TENTHS)]


@functools.lru_cache(maxsize=16)
def _folders(dataset: Path) -> Mapping[str, tuple[Path, ...]]:
    folders = {path.name: path for path in sorted(dataset.glob("chronics/*/"))}
    folders |= {f"{path.parts[-3]}/{path.name}": path for path in sorted(dataset.glob("*/chronics/*/"))}
    if not folders:
        raise UsageError(
            f"There is no folder {dataset / 'chronics'} with scenarios: {VARIABLE} must name the folder that holds "
            f"{dataset.name} (default ~/data_grid2op), or be unset to play generated scenarios."
        )
    return _months(folders)


def _months(folders: Mapping[str, Path]) -> dict[str, tuple[Path, ...]]:
    """Four weeks under one name where they follow each other, all else as it is."""
    months: dict[str, dict[int, str]] = {}
    for name in folders:
        mix, slash, folder = name.rpartition("/")
        week = _week_of(folder)
        if week is not None:
            months.setdefault(mix + slash + week.month, {})[week.number % WEEKS] = name
    joined: dict[str, tuple[str, ...]] = {}
    for weeks in months.values():
        names = tuple(name for _, name in sorted(weeks.items()))
        if _follow_each_other([folders[name] for name in names]):
            joined |= dict.fromkeys(names, names)
    return {
        (names[0] + _JOINED if len(names) > 1 else name): tuple(folders[each] for each in names)
        for name, names in ((name, joined.get(name, (name,))) for name in folders)
    }


def _follow_each_other(paths: Sequence[Path]) -> bool:
    if len(paths) < WEEKS:
        return False
    try:
        starts = [read_start(path) for path in paths]
    except UsageError:
        return False
    return all(later - earlier == timedelta(weeks=1) for earlier, later in itertools.pairwise(starts))


def _week_of(folder: str) -> _Week | None:
    """Which week a folder holds; None: its name is not that of a week."""
    dated, numbered = _DATED.fullmatch(folder), _NUMBERED.fullmatch(folder)
    if numbered is not None:
        return _Week(numbered[1], int(numbered[2]))
    if dated is None:
        return None
    try:
        day = date.fromisoformat(dated[1])
    except ValueError:
        return None
    return _Week(f"{day.year}_{dated[2]}", (day.timetuple().tm_yday - 1) // 7)
