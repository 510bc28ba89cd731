"""Scenarios by name: which ones a split holds, and their content.

An id is ``source/series`` or, for a window of the series, ``source/series[first:past the last]``.
The scenarios of a grid's system (:class:`rl2grid.grids.systems.Scenarios`) say which sources it has and what its splits
hold. Every grid has the source ``folder`` besides: what the user has imported.
"""

from __future__ import annotations

import functools
import hashlib
import re
import weakref
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rl2grid.errors import UsageError, one_of
from rl2grid.grids import Grid, System, find_system
from rl2grid.grids.systems import Series
from rl2grid.scenarios.bundled import interconnections
from rl2grid.scenarios.cache import data_folder
from rl2grid.scenarios.folder import read_folder
from rl2grid.scenarios.full import full_data_folder
from rl2grid.scenarios.generated import series_hash
from rl2grid.scenarios.imported import imported_names, load_imported, store_imported
from rl2grid.scenarios.making import make_packs
from rl2grid.scenarios.month_names import Months, parse_months
from rl2grid.scenarios.progress import Report, ignore
from rl2grid.scenarios.published import warn_of_deviation
from rl2grid.scenarios.scenario import Scenario
from rl2grid.scenarios.splits import HELD_OUT_SPLITS, SPLIT_VERSION, SPLITS, TRAIN, TRAINING_SEEDS

if TYPE_CHECKING:
    from rl2grid.scenarios.training_years import TrainingMonths

IMPORTED = "folder"
"""Source of imported series."""
_GENERATED = "generated/"

_ID = re.compile(r"(?P<source>\w+)/(?P<series>[^\[\]]+)(\[(?P<start>\d+):(?P<stop>\d+)\])?")


def list_scenarios(grid_id: str, split: str) -> tuple[str, ...]:
    """Ids of the scenarios of a split, in the order in which an evaluation plays them.

    Raises:
        UsageError: Unknown grid or split, the split is drawn from, or the full dataset is requested and has none.
    """
    system = find_system(grid_id)
    _check_split(split)
    return system.scenarios.listed(system.grid, split)


def check_in_split(grid_id: str, split: str, scenario_id: str) -> None:
    """Refuse a scenario that is not in a split, and is no window of one that is.

    Raises:
        UsageError: It is not, or unknown grid or split.
    """
    system = find_system(grid_id)
    _check_split(split)
    system.scenarios.check(system.grid, split, scenario_id.partition("[")[0])


def draw_scenario(grid_id: str, split: str, seed: int, number: int) -> str:
    """Id of what episode ``number`` of the stream of episodes of ``seed`` plays.

    Raises:
        UsageError: Unknown grid or split.
    """
    system = find_system(grid_id)
    _check_split(split)
    return system.scenarios.draw(system.grid, split, seed, number)


def load_scenario(grid_id: str, scenario_id: str) -> Scenario:
    """The scenario called ``scenario_id``; asking again returns the same object, for a while if it is a generated one.

    Raises:
        UsageError: Unknown grid or scenario, or a window outside its series.
    """
    system = find_system(grid_id)
    if scenario_id.startswith(_GENERATED):
        return _load_generated_scenario(system, scenario_id, data_folder())
    return _load_scenario(system, scenario_id, data_folder(), full_data_folder())


def open_series(grid_id: str, scenario_id: str) -> Scenario | TrainingMonths:
    """What an episode is played on: of the library of training years the months where they lie, else the scenario.

    Raises:
        UsageError: as :func:`load_scenario`.
    """
    months = _library_months(scenario_id)
    system = find_system(grid_id)
    if months is None or "generated" not in system.scenarios.sources(system.grid):
        return load_scenario(grid_id, scenario_id)
    # Imported where it is needed: compiling takes long, and playing recorded series compiles no generator.
    from rl2grid.scenarios.training_years import training_months

    return training_months(system.grid, months)


def check_training_room(grid_id: str, episodes: int) -> None:
    """Refuse so many episodes of training whose months do not fit on the disk, before the first is played.

    Raises:
        UsageError: less is free than the years that they may play, of which there are no more than the library has.
    """
    if generator_version(grid_id, TRAIN) is None:
        return
    from rl2grid.scenarios.training_years import check_library_room

    check_library_room(find_system(grid_id).grid, episodes)


def import_folder(grid: Grid, path: Path, report: Report = ignore) -> Scenario:
    """Any Grid2Op scenario folder as a scenario of ``grid``, checked and copied to the data folder.

    Its id is ``folder/<name of the folder>``; an earlier import of that name is replaced. ``report`` is told how many
    bytes of its files were read.

    Raises:
        UsageError: A file, a column or a value is missing or impossible; nothing is imported then.
    """
    # A folder may be given as `.` or through a link.
    path = path.resolve()
    # Which loads of another grid stand for a neighbour is not known.
    signed = interconnections(grid) if grid.bundled_names else None
    store_imported(grid, path.name, read_folder(grid, path, signed_loads=signed, report=report))
    # The name may have stood for another series before.
    _load_scenario.cache_clear()
    _load_series.cache_clear()
    return load_scenario(grid.id, f"folder/{path.name}")


def scenario_pack_hash(grid_id: str, split: str, scenarios: Sequence[str] | None = None) -> str:
    """Short hash of every value of scenarios of a split: of those given, else of all.

    Of generated months it begins with the version of the generator, as in ``1-0123456789abcdef``. Of training, without
    ``scenarios``, it covers the version of the library and the first months that seed 0 plays.

    Raises:
        UsageError: Unknown grid, split or scenario.
    """
    system = find_system(grid_id)
    _check_split(split)
    rule, listed = system.scenarios.sample(system.grid, split) if scenarios is None else ("", scenarios)
    digest = hashlib.sha256(rule.encode())
    for scenario_id in listed:
        digest.update(f"{scenario_id} {_content_hash(system, scenario_id)}\n".encode())
    version = generator_version(grid_id, split)
    return digest.hexdigest()[:16] if version is None else f"{version}-{digest.hexdigest()[:16]}"


def make_scenarios(grid_id: str, scenarios: Sequence[str], workers: int | None = None) -> tuple[Iterator[int], int]:
    """What makes the months of generated scenarios that are missing; all others are there.

    Args:
        grid_id: the grid.
        scenarios: ids.
        workers: see :func:`rl2grid.scenarios.making.make_packs`.

    Returns:
        An iterator that makes them and yields how many there are so far, and how many there will be.

    Raises:
        UsageError: a scenario that does not exist.
    """
    names = [_series_of(scenario_id) for scenario_id in scenarios if scenario_id.startswith(_GENERATED)]
    months = {(each.seed, month) for each in map(parse_months, names) for month in each.numbers}
    return make_packs(find_system(grid_id).grid, months, workers), len(months)


def split_version(grid_id: str, split: str) -> str | None:
    """Version of the list of a split; None: it is a list of recorded series, or is drawn from."""
    return SPLIT_VERSION if split in HELD_OUT_SPLITS and generator_version(grid_id, split) is not None else None


def generator_version(grid_id: str, split: str) -> str | None:
    """Version of what generated the scenarios of a split; None: they are recorded ones."""
    return find_system(grid_id).scenarios.generator_version(split)


def _content_hash(system: System, scenario_id: str) -> str:
    """Names the values of a scenario; of generated months without expanding them."""
    if scenario_id.startswith(_GENERATED):
        return series_hash(system.grid, _series_of(scenario_id))
    return load_scenario(system.id, scenario_id).content_hash


def _library_months(scenario_id: str) -> Months | None:
    """The months of the library that an id stands for; None: it stands for something else, or for a part of them."""
    if not scenario_id.startswith(_GENERATED) or "[" in scenario_id:
        return None
    months = parse_months(scenario_id.removeprefix(_GENERATED))
    return months if months.seed in TRAINING_SEEDS else None


def _series_of(scenario_id: str) -> str:
    """``17-03`` of ``generated/17-03[0:288]``."""
    return scenario_id.removeprefix(_GENERATED).partition("[")[0]


def _check_split(split: str) -> None:
    if split not in SPLITS:
        raise one_of("Split", split, SPLITS)


# The sizes bound the number of open memory maps, each of which keeps a file open.
@functools.lru_cache(maxsize=128)
def _load_scenario(system: System, scenario_id: str, data: Path, full_data: Path) -> Scenario:
    return _find_scenario(system, scenario_id, data, full_data)


class _OpenMonths:
    """Generated scenarios that somebody plays, and the latest that were opened.

    There is no end of them, and the space of a copy that was removed is free again only when nothing maps it: what
    nobody plays is let go soon. A hundred environments that play forty months open each of them once.
    """

    _LATEST = 4

    def __init__(self) -> None:
        self.cache_clear()

    def __call__(self, system: System, scenario_id: str, data: Path) -> Scenario:
        key = system, scenario_id, data
        found = self._open.get(key)
        if found is None:
            found = self._open[key] = _find_scenario(system, scenario_id, data, data)
            self._latest.append(found)
        return found

    def cache_clear(self) -> None:
        """Open every scenario anew."""
        self._open: weakref.WeakValueDictionary[tuple[System, str, Path], Scenario] = weakref.WeakValueDictionary()
        self._latest: deque[Scenario] = deque(maxlen=self._LATEST)


_load_generated_scenario = _OpenMonths()


def _find_scenario(system: System, scenario_id: str, data: Path, full_data: Path) -> Scenario:
    match, sources = _ID.fullmatch(scenario_id), system.scenarios.sources(system.grid)
    if match is None or match["source"] not in (*sources, IMPORTED):
        examples = [*sources.values(), f"{IMPORTED}/<name>"]
        raise UsageError(
            f"Scenario {scenario_id!r} is no id: it must look like {', '.join(examples)}, or a window of one such as "
            f"{examples[0]}[0:144]."
        )
    if match["source"] == "generated":
        whole = _load_from(system, "generated", match["series"])
        warn_of_deviation(whole)
    else:
        whole = _load_series(system, match["source"], match["series"], data, full_data)
    if match["start"] is None:
        return whole
    start, stop = int(match["start"]), int(match["stop"])
    if not 0 <= start <= stop - 2 <= whole.n_rows - 2:
        raise UsageError(
            f"Scenario {scenario_id!r} is outside its series: choose at least 2 of the rows 0 to {whole.n_rows}."
        )
    return whole.window(start, stop)


@functools.lru_cache(maxsize=128)
def _load_series(system: System, source: str, name: str, data: Path, full_data: Path) -> Scenario:
    return _load_from(system, source, name)


def _load_from(system: System, source: str, name: str) -> Scenario:
    grid = system.grid
    if source != IMPORTED:
        return _scenario(grid, source, name, system.scenarios.load(grid, source, name))
    if name not in imported_names(grid):
        raise UsageError(
            f"Scenario folder/{name} of {grid.id} was not imported: `rl2grid data import {grid.id} FOLDER` does it."
        )
    return _scenario(grid, source, name, load_imported(grid, name))


def _scenario(grid: Grid, source: str, name: str, series: Series) -> Scenario:
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
