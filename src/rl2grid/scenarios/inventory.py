"""What series there are on this machine, how much space they take, and freeing the part that can be made again."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import NamedTuple

from rl2grid.grids import Grid, find_system
from rl2grid.scenarios.bundled import bundled_folders
from rl2grid.scenarios.cache import data_folder
from rl2grid.scenarios.full import full_data_folder
from rl2grid.scenarios.generated import pack_folder, pack_path, parse_months
from rl2grid.scenarios.imported import imported_folder, imported_names
from rl2grid.scenarios.recorded import RecordedScenarios
from rl2grid.scenarios.splits import HELD_OUT_SPLITS

CACHES = ("series", "packs")
"""Folders below the data folder whose content is made again when needed."""


class StoredSeries(NamedTuple):
    """Series of one kind."""

    grid_id: str
    kind: str
    """``bundled``, ``recorded``, ``generated``, ``imported`` or ``full``."""
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


def remove_caches() -> None:
    """Remove expanded copies and generated packs; what was imported or downloaded stays."""
    for name in CACHES:
        shutil.rmtree(data_folder() / name, ignore_errors=True)


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
