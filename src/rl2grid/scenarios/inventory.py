"""What series there are on this machine, how much space they take, and freeing the part that can be made again."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import filelock

from rl2grid.grids import Grid, find_system
from rl2grid.scenarios.bundled import bundled_folders
from rl2grid.scenarios.cache import data_folder, series_folder
from rl2grid.scenarios.full import full_data_folder
from rl2grid.scenarios.generated import is_stored, pack_folder, pack_lock, pack_path
from rl2grid.scenarios.imported import imported_folder, imported_names
from rl2grid.scenarios.month_names import parse_months
from rl2grid.scenarios.recorded import RecordedScenarios
from rl2grid.scenarios.splits import HELD_OUT_SPLITS, TRAINING_SEEDS

CACHES = ("series", "packs")
"""Folders below the data folder whose content is made again when needed."""


class StoredSeries(NamedTuple):
    """Series of one kind."""

    grid_id: str
    kind: str
    """``bundled``, ``recorded``, ``training``, ``generated``, ``imported`` or ``full``."""
    what: str
    """In words."""
    size: int
    """Bytes on disk."""
    place: Path


def inventory(grid: Grid) -> list[StoredSeries]:
    """Everything there is of a grid; kinds of which there is nothing are left out."""
    found = [*_recorded(grid), *_generated(grid)]
    names = imported_names(grid)
    if names:
        folder = imported_folder(grid)
        found.append(StoredSeries(grid.id, "imported", _some(names), size_of(folder), folder))
    dataset = full_data_folder() / grid.grid2op_name
    if dataset.is_dir():
        scenarios = sum(1 for pattern in ("chronics/*/", "*/chronics/*/") for _ in dataset.glob(pattern))
        found.append(StoredSeries(grid.id, "full", f"{scenarios:,} scenarios", size_of(dataset), dataset))
    return found


def size_of(path: Path) -> int:
    """Bytes of all files in a folder; 0 where there is none."""
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def caches_size() -> int:
    """Bytes that :func:`remove_caches` frees."""
    return sum(size_of(data_folder() / name) for name in CACHES)


class Removed(NamedTuple):
    """What :func:`remove_caches` did."""

    size: int
    """Bytes that were freed."""
    in_use: int
    """Files that were left, because a process is making them or what belongs to them."""
    refused: int
    """Files that this user may not remove."""


def remove_caches() -> Removed:
    """Remove expanded copies and generated packs; what was imported or downloaded stays.

    Processes at work are not disturbed: folders and locks stay, what is being made is left alone, and what others have
    mapped stays readable for them.
    """
    removed = Removed(0, 0, 0)
    for name in CACHES:
        for path in sorted((data_folder() / name).rglob("*")):
            if path.is_file() and path.suffix != ".lock":
                removed = Removed(*map(sum, zip(removed, _remove(path), strict=True)))
    return removed


def _remove(path: Path) -> Removed:
    try:
        size = path.stat().st_size
        with filelock.FileLock(_lock_of(path), timeout=0):
            path.unlink(missing_ok=True)
    except filelock.Timeout:
        return Removed(0, 1, 0)
    except FileNotFoundError:
        return Removed(0, 0, 0)  # another process was faster
    except OSError:
        return Removed(0, 0, 1)
    return Removed(size, 0, 0)


def _lock_of(path: Path) -> Path:
    """The lock that whoever makes a file of the caches holds."""
    name = path.name.removeprefix(".")
    if ".pack" in name:
        seed = name.partition("-")[0]
        return pack_lock(path.parent, int(seed)) if seed.isdigit() else path.with_suffix(".lock")
    stem = name.partition(".npy")[0].partition(".json")[0]
    return path.with_name(f"{stem}.lock")


def _recorded(grid: Grid) -> list[StoredSeries]:
    """What comes with the grid: series of the wheel, or folders that a system of one's own names."""
    scenarios, kind = find_system(grid.id).scenarios, "bundled"
    folders = list(bundled_folders(grid).values())
    if isinstance(scenarios, RecordedScenarios):
        kind = "recorded"
        folders = [series for series in scenarios.series.values() if isinstance(series, Path)]
    if not folders:
        return []
    return [StoredSeries(grid.id, kind, f"{len(folders)} series", sum(map(size_of, folders)), folders[0].parent)]


def _generated(grid: Grid) -> list[StoredSeries]:
    if find_system(grid.id).constants is None:
        return []
    return [*_library(grid), *_packs(grid)]


def _library(grid: Grid) -> list[StoredSeries]:
    """The years that training plays."""
    years = sum(is_stored(grid, seed, 0) for seed in TRAINING_SEEDS)
    if not years:
        return []
    files = list(series_folder(grid.id).glob("year.*.npy"))
    what = f"{years} of {len(TRAINING_SEEDS)} years of training"
    return [StoredSeries(grid.id, "training", what, sum(path.stat().st_size for path in files), series_folder(grid.id))]


def _packs(grid: Grid) -> list[StoredSeries]:
    folder = pack_folder(grid)
    packs = list(folder.glob("*.pack"))
    if not packs:
        return []
    seeds = {parse_months(path.stem).seed for path in packs}
    parts = [f"{len(packs):,} months, seeds {_some(tuple(map(str, sorted(seeds))))}"]
    for split, names in HELD_OUT_SPLITS.items():
        months = [parse_months(name) for name in names]
        made = sum(pack_path(grid, each.seed, each.first).is_file() for each in months)
        if made:
            parts.append(f"{split} {made}/{len(names)}")
    return [StoredSeries(grid.id, "generated", ", ".join(parts), size_of(folder), folder)]


def _some(names: tuple[str, ...], limit: int = 5) -> str:
    listed = ", ".join(names[:limit])
    return listed if len(names) <= limit else f"{listed} and {len(names) - limit} more"
