"""Scenarios by name: which ones a split holds, and their content.

An id is ``source/series`` or, for a window of the series, ``source/series[first:past the last]``.
The source ``generated`` is the generator: training, validation and test play its months
(:mod:`rl2grid.scenarios.splits`). The source ``bundled`` is inside the Grid2Op wheel; the split of that name is every
bundled series from beginning to end. The source ``full`` is Grid2Op's downloadable dataset where the user has it:
``$RL2GRID_FULL_DATA`` names the folder that holds it (the one with ``l2rpn_case14_sandbox`` and its like inside), and
its being set is the request to train, validate and test on it instead. The source ``folder`` is what the user has
imported.
"""

from __future__ import annotations

import functools
import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

from rl2grid.errors import UsageError, one_of
from rl2grid.grids import Grid, load_grid
from rl2grid.scenarios.bundled import bundled_folders, interconnections, load_bundled
from rl2grid.scenarios.cache import CachedSeries, data_folder
from rl2grid.scenarios.folder import read_folder
from rl2grid.scenarios.full import full_data_folder, full_folders, full_split, is_full_requested, load_full
from rl2grid.scenarios.generated import (
    EPISODES_PER_YEAR,
    SEEDS_PER_YEAR,
    VERSION,
    draw_training_months,
    is_training_seed,
    load_generated,
    parse_months,
)
from rl2grid.scenarios.imported import imported_names, load_imported, store_imported
from rl2grid.scenarios.progress import Report, ignore
from rl2grid.scenarios.published import warn_of_deviation
from rl2grid.scenarios.scenario import Scenario
from rl2grid.scenarios.splits import (
    BUNDLED,
    FIRST_TRAINING_SEED,
    HELD_OUT_SPLITS,
    SPLITS,
    TRAIN,
    TRAINING_SEEDS,
)

SOURCES = ("bundled", "full", "generated", "folder")

_LISTED = 20
_ID = re.compile(r"(?P<source>\w+)/(?P<series>[^\[\]]+)(\[(?P<start>\d+):(?P<stop>\d+)\])?")


def list_scenarios(grid_id: str, split: str) -> tuple[str, ...]:
    """Ids of the scenarios of a split, in the order in which an evaluation plays them.

    Raises:
        UsageError: Unknown grid or split, the split has no end, or the full dataset is requested and has none.
    """
    grid = load_grid(grid_id)
    _check_split(split)
    if split == BUNDLED:
        return tuple(f"bundled/{name}" for name in bundled_folders(grid))
    if is_full_requested():
        return tuple(f"full/{name}" for name in full_split(grid, split))
    if split == TRAIN:
        raise UsageError(
            f"The split {split} has no end, and its months cannot be listed: choose one of "
            f"{', '.join(other for other in SPLITS if other != split)}."
        )
    return tuple(f"generated/{name}" for name in HELD_OUT_SPLITS[split])


def check_in_split(grid_id: str, split: str, scenario_id: str) -> None:
    """Refuse a scenario that is not in a split, and is no window of one that is.

    Raises:
        UsageError: It is not, or unknown grid or split.
    """
    _check_split(split)
    series = scenario_id.partition("[")[0]
    if split == TRAIN and not is_full_requested():
        _check_training_months(load_grid(grid_id), series)
        return
    ids = list_scenarios(grid_id, split)
    if series not in ids:
        listed = ", ".join(ids[:_LISTED]) + (f" or {len(ids) - _LISTED} more" if len(ids) > _LISTED else "")
        raise UsageError(f"Scenario {scenario_id!r} is not in the split {split} of {grid_id}: choose one of {listed}.")


def load_scenario(grid_id: str, scenario_id: str) -> Scenario:
    """The scenario called ``scenario_id``; asking again returns the same object, for a while if it is a generated one.

    Raises:
        UsageError: Unknown grid or scenario, or a window outside its series.
    """
    grid = load_grid(grid_id)
    if scenario_id.startswith("generated/"):
        return _load_generated_scenario(grid, scenario_id, data_folder())
    return _load_scenario(grid, scenario_id, data_folder(), full_data_folder())


def import_folder(grid: Grid, path: Path, report: Report = ignore) -> Scenario:
    """Any Grid2Op scenario folder as a scenario of ``grid``, checked and copied to the data folder.

    Its id is ``folder/<name of the folder>``; an earlier import of that name is replaced. ``report`` is told how many
    bytes of its files were read.

    Raises:
        UsageError: A file, a column or a value is missing or impossible; nothing is imported then.
    """
    # A folder may be given as `.` or through a link.
    path = path.resolve()
    store_imported(grid, path.name, read_folder(grid, path, signed_loads=interconnections(grid), report=report))
    # The name may have stood for another series before.
    _load_scenario.cache_clear()
    _load_series.cache_clear()
    return load_scenario(grid.id, f"folder/{path.name}")


def scenario_pack_hash(grid_id: str, split: str, scenarios: Sequence[str] | None = None) -> str:
    """Short hash of every value of scenarios of a split: of those given, else of all.

    Of generated months it begins with the version of the generator, as in ``1-0123456789abcdef``. Training has no end:
    without ``scenarios``, its hash covers the rule by which months are drawn and the first month that training with
    seed 0 plays.

    Raises:
        UsageError: Unknown grid, split or scenario.
    """
    _check_split(split)
    digest = hashlib.sha256()
    if scenarios is None and split == TRAIN and not is_full_requested():
        digest.update(f"{FIRST_TRAINING_SEED} {TRAINING_SEEDS} {SEEDS_PER_YEAR} {EPISODES_PER_YEAR}\n".encode())
        scenarios = [f"generated/{draw_training_months(0, 0)}"]
    for scenario_id in list_scenarios(grid_id, split) if scenarios is None else scenarios:
        digest.update(f"{scenario_id} {load_scenario(grid_id, scenario_id).content_hash}\n".encode())
    version = generator_version(split)
    return digest.hexdigest()[:16] if version is None else f"{version}-{digest.hexdigest()[:16]}"


def generator_version(split: str) -> str | None:
    """Version of what generated the scenarios of a split; None: they are recorded ones."""
    return None if split == BUNDLED or is_full_requested() else VERSION


def _check_split(split: str) -> None:
    if split not in SPLITS:
        raise one_of("Split", split, SPLITS)


def _check_training_months(grid: Grid, scenario_id: str) -> None:
    source, _, name = scenario_id.partition("/")
    if source == "generated" and is_training_seed(parse_months(name).seed):
        return
    raise UsageError(
        f"Scenario {scenario_id!r} is not in the split {TRAIN} of {grid.id}: choose one such as "
        f"generated/{FIRST_TRAINING_SEED}-03, with a seed of at least {FIRST_TRAINING_SEED}."
    )


# The sizes bound the number of open memory maps, each of which keeps a file open.
@functools.lru_cache(maxsize=128)
def _load_scenario(grid: Grid, scenario_id: str, data: Path, full_data: Path) -> Scenario:
    return _find_scenario(grid, scenario_id, data, full_data)


# Fewer: there is no end of them, and the space of a removed copy is free again only when nothing maps it.
@functools.lru_cache(maxsize=16)
def _load_generated_scenario(grid: Grid, scenario_id: str, data: Path) -> Scenario:
    return _find_scenario(grid, scenario_id, data, data)


def _find_scenario(grid: Grid, scenario_id: str, data: Path, full_data: Path) -> Scenario:
    match = _ID.fullmatch(scenario_id)
    if match is None or match["source"] not in SOURCES:
        raise UsageError(
            f"Scenario {scenario_id!r} is no id: it must look like {list_scenarios(grid.id, 'bundled')[0]}, "
            f"full/<series>, generated/17-03, folder/<name>, or a window of one such as "
            f"{list_scenarios(grid.id, 'bundled')[0]}[0:144]."
        )
    if match["source"] == "generated":
        whole = _scenario(grid, "generated", match["series"], load_generated(grid, match["series"]))
        warn_of_deviation(whole)
    else:
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
    if source == "folder":
        if name not in imported_names(grid):
            raise UsageError(
                f"Scenario folder/{name} of {grid.id} was not imported: `rl2grid data import {grid.id} FOLDER` does it."
            )
        return _scenario(grid, source, name, load_imported(grid, name))
    names = tuple(bundled_folders(grid) if source == "bundled" else full_folders(grid))
    if name not in names:
        raise one_of(f"Scenario of {grid.id}", f"{source}/{name}", _shortened([f"{source}/{each}" for each in names]))
    if source == "bundled":
        return _scenario(grid, source, name, load_bundled(grid, name))
    return _scenario(grid, source, name, load_full(grid, name))


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
