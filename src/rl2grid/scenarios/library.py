"""Scenarios by name: which ones a split holds, and their content.

An id is ``source/series`` or, for a window of the series, ``source/series[first:past the last]``.
The source ``bundled`` is inside the Grid2Op wheel. The source ``full`` is Grid2Op's downloadable
dataset where the user has it: ``$RL2GRID_FULL_DATA`` names the folder that holds it (the one with
``l2rpn_case14_sandbox`` and its like inside), and its being set is the request to split it instead
of the bundled series. The split ``bundled`` is every bundled series from beginning to end, in
either case.
"""

from __future__ import annotations

import functools
import hashlib
import re
from pathlib import Path

from rl2grid.errors import UsageError, one_of
from rl2grid.grids import Grid, load_grid
from rl2grid.scenarios.bundled import bundled_folders, interconnections, load_bundled
from rl2grid.scenarios.cache import CachedSeries, cached_series, data_folder
from rl2grid.scenarios.folder import read_folder, source_key
from rl2grid.scenarios.full import full_data_folder, full_folders, full_split, is_full_requested
from rl2grid.scenarios.scenario import Scenario
from rl2grid.scenarios.splits import BUNDLED_SPLITS

SPLITS = ("train", "validation", "test", "bundled")
"""``train`` teaches, ``validation`` picks models, ``test`` has the final word, ``bundled`` is every bundled series."""

SOURCES = ("bundled", "full")

GENERATOR_VERSION: str | None = None
"""Version of what generated the scenarios, named by every result; None: all scenarios are recorded ones."""
_ID = re.compile(r"(?P<source>\w+)/(?P<series>[^\[\]]+)(\[(?P<start>\d+):(?P<stop>\d+)\])?")


def list_scenarios(grid_id: str, split: str) -> tuple[str, ...]:
    """Ids of the scenarios of a split, in the order in which an evaluation plays them.

    Raises:
        UsageError: Unknown grid or split, or the full dataset is requested and has none.
    """
    grid = load_grid(grid_id)
    if split not in SPLITS:
        raise one_of("Split", split, SPLITS)
    if split == "bundled":
        return tuple(f"bundled/{name}" for name in bundled_folders(grid))
    if is_full_requested():
        return tuple(f"full/{name}" for name in full_split(grid, split))
    return tuple(f"bundled/{window}" for window in BUNDLED_SPLITS[grid_id][split])


def load_scenario(grid_id: str, scenario_id: str) -> Scenario:
    """The scenario called ``scenario_id``; asking again returns the same object.

    Raises:
        UsageError: Unknown grid or scenario, or a window outside its series.
    """
    return _load_scenario(load_grid(grid_id), scenario_id, data_folder(), full_data_folder())


def import_folder(grid: Grid, path: Path) -> Scenario:
    """Any Grid2Op scenario folder as a scenario of ``grid``, checked and copied to the data folder.

    Its id is ``folder/<name of the folder>``.

    Raises:
        UsageError: A file, a column or a value is missing or impossible; nothing is imported then.
    """
    return _scenario(grid, "folder", path.name, _load_folder(grid, "folder", path.name, path))


def scenario_pack_hash(grid_id: str, split: str) -> str:
    """Short hash of every value of every scenario of a split.

    Raises:
        UsageError: Unknown grid or split.
    """
    digest = hashlib.sha256()
    for scenario_id in list_scenarios(grid_id, split):
        digest.update(f"{scenario_id} {load_scenario(grid_id, scenario_id).content_hash}\n".encode())
    return digest.hexdigest()[:16]


# The sizes bound the number of open memory maps, each of which keeps a file open.
@functools.lru_cache(maxsize=128)
def _load_scenario(grid: Grid, scenario_id: str, data: Path, full_data: Path) -> Scenario:
    match = _ID.fullmatch(scenario_id)
    if match is None or match["source"] not in SOURCES:
        raise UsageError(
            f"Scenario {scenario_id!r} is no id: it must look like {list_scenarios(grid.id, 'bundled')[0]}, "
            f"full/<series>, or a window of one such as {list_scenarios(grid.id, 'bundled')[0]}[0:144]."
        )
    whole = _load_series(grid, match["source"], match["series"], data, full_data)
    if match["start"] is None:
        return whole
    start, stop = int(match["start"]), int(match["stop"])
    if not 0 <= start <= stop - 2 <= whole.n_rows - 2:
        raise UsageError(
            f"Scenario {scenario_id!r} is outside its series: choose at least 2 of the rows 0 to {whole.n_rows}."
        )
    return whole.window(start, stop)


@functools.lru_cache(maxsize=128)
def _load_series(grid: Grid, source: str, name: str, data: Path, full_data: Path) -> Scenario:
    folders = bundled_folders(grid) if source == "bundled" else full_folders(grid)
    if name not in folders:
        raise one_of(f"Scenario of {grid.id}", f"{source}/{name}", _shortened([f"{source}/{name}" for name in folders]))
    if source == "bundled":
        return _scenario(grid, source, name, load_bundled(grid, name))
    return _scenario(grid, source, name, _load_folder(grid, source, name, folders[name]))


def _load_folder(grid: Grid, source: str, name: str, path: Path) -> CachedSeries:
    return cached_series(
        grid.id,
        f"{source}.{name}",
        source_key(grid, path),
        lambda: read_folder(grid, path, signed_loads=interconnections(grid)),
    )


def _scenario(grid: Grid, source: str, name: str, series: CachedSeries) -> Scenario:
    arrays = dict(series.arrays)
    if grid.maintenance.lines:
        arrays.pop("maintenance", None)  # This grid samples its outages, as Grid2Op does.
    return Scenario(
        id=f"{source}/{name}",
        grid_id=grid.id,
        source=source,
        start_datetime=series.start_datetime,
        content_hash=series.content_hash,
        first_row=0,
        series_rows=len(arrays["load_p"]),
        **arrays,
    )


def _shortened(values: list[str], limit: int = 20) -> tuple[str, ...]:
    """At most ``limit`` of the values, saying how many more there are."""
    if len(values) <= limit:
        return tuple(values)
    return (*values[:limit], f"{len(values) - limit} more")
