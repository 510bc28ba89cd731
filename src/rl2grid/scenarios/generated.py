"""Generated months: how they are named, made when first asked for, and kept.

``17-03`` is month 3 (0 .. 11) of the year of seed 17; ``17-03+04`` is that month and the next one, joined, so that an
episode that starts late in a month goes on in the next. A month that was made is kept as a small file, its pack, in
the data folder, and expanded into the memory-mapped copies that all series have. Everything kept can be made again
from its name: packs are filed under a fingerprint of the generator, so that those of another generator are never
read; a damaged one is made again; of what training has drawn only the latest is kept.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import json
import re
from collections.abc import Sequence
from dataclasses import fields
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import filelock
import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import UsageError
from rl2grid.grids import Grid, System, find_system
from rl2grid.scenarios.cache import FORMAT_VERSION, CachedSeries, cached_series, data_folder
from rl2grid.scenarios.folder import FolderContent
from rl2grid.scenarios.scenario import Scenario
from rl2grid.scenarios.splits import FIRST_TRAINING_SEED, TRAINING_SEEDS
from rl2grid.streams import Purpose, Stream

if TYPE_CHECKING:
    from rl2grid.scenarios.generator.month import RawMonth

VERSION = "2"
"""Version of the generator, named by every result on generated months: it changes with any value that is generated.
The hashes of the months of validation and test are published with it (:mod:`rl2grid.scenarios.published`)."""

MONTHS = 12
SEEDS_PER_YEAR, EPISODES_PER_YEAR = 16, 12
"""How many seeds in a row, and how many training episodes of each in a row, play the same year (from rows of their
own): making one month takes as long as making its year, and environments of a vector have seeds in a row."""

EXPANDED_BYTES = 8 * 2**30
"""Expanded generated months beyond this are removed, oldest first; they are expanded again when needed."""
MONTHS_BETWEEN_CLEANUPS = 50
"""A process looks for months to remove after the first one that it expands, then each time after so many more: to look
at thousands of files takes longer than to play an episode."""
TRAINING_PACK_BYTES = 2 * 2**30
"""Packs of a grid's training years beyond this are removed, oldest first."""

_POWER_FLOW = ("ac", "bits", "factors", "flow_state", "model", "newton", "ordering", "topology")
"""Modules of :mod:`rl2grid.powerflow` that decide what is generated."""

_NAME = re.compile(r"(?P<seed>0|[1-9]\d{0,18})-(?P<month>\d\d)(\+(?P<next>\d\d))?")
_LOCKS = 64
_EXPANDED_MONTHS = itertools.count()
"""How many this process has expanded so far."""


class Months(NamedTuple):
    """One month, or two in a row, of the year of a seed."""

    seed: int
    first: int
    n_months: int

    @property
    def numbers(self) -> range:
        """The months, 0 .. 11."""
        return range(self.first, self.first + self.n_months)


def parse_months(name: str) -> Months:
    """The months that ``name`` stands for.

    Raises:
        UsageError: It stands for none.
    """
    match = _NAME.fullmatch(name)
    if match is not None:
        first = int(match["month"])
        last = first if match["next"] is None else int(match["next"])
        if last < MONTHS and (match["next"] is None or last == first + 1):
            return Months(int(match["seed"]), first, last - first + 1)
    raise UsageError(
        f"Generated scenario {name!r} does not exist: it must look like 17-03 (seed, and month 00 to 11), or 17-03+04 "
        "for two months in a row."
    )


def month_name(seed: int, month: int) -> str:
    """For example ``17-03``."""
    return f"{seed}-{month:02d}"


def draw_training_months(seed: int, number: int) -> str:
    """Name of the two months in a row in which training episode ``number`` of ``seed`` is played."""
    year = Stream(seed // SEEDS_PER_YEAR, number // EPISODES_PER_YEAR, Purpose.SCENARIO).integer(TRAINING_SEEDS)
    # The second number of the stream: the first may be the one that draws a year.
    month = int(Stream(seed, number, Purpose.SCENARIO).uniform(2)[1] * (MONTHS - 1))
    return f"{month_name(FIRST_TRAINING_SEED + year, month)}+{month + 1:02d}"


def is_training_seed(seed: int) -> bool:
    """Whether training may play the year of ``seed``."""
    return FIRST_TRAINING_SEED <= seed < FIRST_TRAINING_SEED + TRAINING_SEEDS


def load_generated(grid: Grid, name: str) -> CachedSeries:
    """The months called ``name``, from the local copy, their packs or the generator.

    Raises:
        UsageError: There are no such months, or the data folder cannot be written.
    """
    months = parse_months(name)
    expanded = False

    def expand() -> FolderContent:
        nonlocal expanded
        expanded = True
        return _content(grid, months)

    series = cached_series(grid.id, f"generated.{name}", generator_fingerprint(grid), expand)
    if expanded and next(_EXPANDED_MONTHS) % MONTHS_BETWEEN_CLEANUPS == 0:
        _remove_oldest([*(data_folder() / "series" / f"v{FORMAT_VERSION}").glob("*/generated.*.npy")], EXPANDED_BYTES)
    return series


def generator_fingerprint(grid: Grid) -> str:
    """Short hash of everything that decides what the generator makes for ``grid``."""
    return _fingerprint(find_system(grid.id))


@functools.lru_cache(maxsize=64)
def _fingerprint(system: System) -> str:
    package = resources.files("rl2grid")
    sources = [
        *(package / "powerflow" / f"{module}.py" for module in _POWER_FLOW),
        *_python_files(package / "scenarios" / "generator"),
        package / "scenarios" / "packs.py",
        package / "grids" / "network.py",
        package / "streams.py",
    ]
    constants = json.dumps(system.required_constants(), sort_keys=True)
    digest = hashlib.sha256(f"{system.hash} {constants}".encode())
    for source in sources:
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def pack_folder(grid: Grid) -> Path:
    """Where the packs of this generator are kept."""
    return data_folder() / "packs" / grid.id / generator_fingerprint(grid)


def pack_path(grid: Grid, seed: int, month: int) -> Path:
    """The file that keeps a month, whether it is there or not."""
    return pack_folder(grid) / f"{month_name(seed, month)}.pack"


def make_months(grid: Grid, seed: int, months: Sequence[int]) -> None:
    """Make the packs of months of one year, those that are not there.

    Raises:
        UsageError: the data folder cannot be written.
    """
    _read_or_make(grid, seed, months)


def series_hash(grid: Grid, name: str) -> str:
    """Hash of the values of the months called ``name``, read from the heads of their packs, which are made if need be.

    It covers demand and generation as they are stored; forecasts and voltages follow from these, the grid and the name.

    Raises:
        UsageError: there are no such months, or the data folder cannot be written.
    """
    months = parse_months(name)
    hashes = [_stored_hash(grid, months.seed, month) for month in months.numbers]
    if None in hashes:
        make_months(grid, months.seed, months.numbers)
        hashes = [_stored_hash(grid, months.seed, month) for month in months.numbers]
    return "+".join(str(each) for each in hashes)


def _stored_hash(grid: Grid, seed: int, month: int) -> str | None:
    """The hash in the head of a pack; None where there is no sound pack of that month."""
    from rl2grid.scenarios import packs

    try:
        head = packs.read_head(pack_path(grid, seed, month))
    except UsageError:
        return None
    return str(head["series"]) if (head["grid"], head["seed"], head["month"]) == (grid.id, seed, month) else None


def _content(grid: Grid, months: Months) -> FolderContent:
    from rl2grid.scenarios.generator import month as generator

    raw = _read_or_make(grid, months.seed, months.numbers)
    parts = [generator.arrays_of(grid, each) for each in raw]
    if len(parts) == 1:
        return FolderContent(generator.start_of(raw[0]), _in_order(parts[0]))
    # The last row of a month is the first of the next one, which knows the forecasts made in it.
    joined = {name: np.concatenate([*(part[name][:-1] for part in parts[:-1]), parts[-1][name]]) for name in parts[0]}
    return FolderContent(generator.start_of(raw[0]), _in_order(joined))


def _in_order(arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """``arrays`` in the order of an imported folder, so that hashes agree."""
    return {field.name: arrays[field.name] for field in fields(Scenario) if field.name in arrays}


def _read_or_make(grid: Grid, seed: int, months: Sequence[int]) -> list[RawMonth]:
    """Months of one year, from their packs; those without a sound one are made."""
    found = [_read(grid, seed, month) for month in months]
    if None not in found:
        return [raw for raw in found if raw is not None]
    folder = pack_folder(grid)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with filelock.FileLock(pack_lock(folder, seed)):
            _remove_leftovers(folder, seed)
            try:
                _make_missing(grid, seed, months)
            except OSError:
                _remove_leftovers(folder, seed)
                raise
            made = [_read_back(grid, seed, month) for month in months]
    except OSError as error:
        raise UsageError(
            f"The data folder {data_folder()} cannot be written ({error}): set RL2GRID_DATA to one that can."
        ) from error
    if is_training_seed(seed):
        packs = [path for path in folder.glob("*.pack") if is_training_seed(_seed_of(path))]
        _remove_oldest(packs, TRAINING_PACK_BYTES)
    return made


def _make_missing(grid: Grid, seed: int, months: Sequence[int]) -> None:
    for month in months:
        if _read(grid, seed, month) is None:
            _make(grid, seed, month)
    if not is_training_seed(seed):
        return
    # The year is at hand, and its other months are likely to be drawn next.
    for month in range(MONTHS):
        if not pack_path(grid, seed, month).is_file():
            _make(grid, seed, month)


def _make(grid: Grid, seed: int, month: int) -> None:
    # Imported where it is needed: compiling takes long, and reading recorded series compiles nothing.
    from rl2grid.scenarios import packs
    from rl2grid.scenarios.generator import month as generator

    packs.write_pack(pack_path(grid, seed, month), generator.raw_month(grid, seed, month))


def _read(grid: Grid, seed: int, month: int) -> RawMonth | None:
    """The month in its pack; None where there is no sound one, or that of another month in its place."""
    from rl2grid.scenarios import packs

    try:
        raw = packs.read_raw(pack_path(grid, seed, month))
    except UsageError:
        return None
    return raw if (raw.grid_id, raw.seed, raw.month) == (grid.id, seed, month) else None


def _read_back(grid: Grid, seed: int, month: int) -> RawMonth:
    raw = _read(grid, seed, month)
    if raw is None:
        raise OSError(f"{pack_path(grid, seed, month)} does not read back as it was written")
    return raw


def pack_lock(folder: Path, seed: int) -> Path:
    """The lock that whoever makes packs of the year of ``seed`` holds."""
    return folder / f"{seed % _LOCKS:02d}.lock"


def _remove_leftovers(folder: Path, seed: int) -> None:
    """Remove what processes that were killed, or met a full disk, left of packs; the lock is held."""
    for path in folder.glob(f".{seed}-*.pack.*"):
        path.unlink(missing_ok=True)


def _seed_of(path: Path) -> int:
    return parse_months(path.stem).seed


def _remove_oldest(paths: list[Path], limit: int) -> None:
    """Remove files, the latest excepted, until the rest takes at most ``limit`` bytes."""
    status = []
    for path in paths:
        try:
            status.append((path.stat().st_mtime_ns, path.stat().st_size, path))
        except FileNotFoundError:
            continue  # Another process was faster.
    excess = sum(size for _, size, _ in status) - limit
    for _, size, path in sorted(status)[:-1]:
        if excess <= 0:
            return
        # What other processes have mapped stays readable for them.
        for companion in (path, *(path.with_suffix(suffix) for suffix in (".json", ".lock"))):
            companion.unlink(missing_ok=True)
        excess -= size


def _python_files(package: Traversable) -> list[Traversable]:
    return sorted((file for file in package.iterdir() if file.name.endswith(".py")), key=lambda file: file.name)
