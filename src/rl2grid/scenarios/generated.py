"""Generated months: how they are named, made when first asked for, and kept.

``17-03`` is month 3 (0 .. 11) of the year of seed 17; ``17-03+04`` is that month and the next one, joined, so that an
episode that starts late in a month goes on in the next. A month that was made is kept as a small file, its pack, in
the data folder, and expanded into the memory-mapped copies that all series have. Everything kept can be made again
from its name: packs are filed under a fingerprint of the generator, so that those of another generator are never
read; a damaged one is made again. Months of the library that training plays are kept with their whole years
(:mod:`rl2grid.scenarios.training_years`).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import filelock
import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.scenarios.cache import (
    FORMAT_VERSION,
    LEFT_FREE_BYTES,
    CachedSeries,
    Copy,
    cached_series,
    copies_by_age,
    data_folder,
    free_bytes,
    remove_oldest,
)
from rl2grid.scenarios.fingerprint import generator_fingerprint
from rl2grid.scenarios.folder import FolderContent
from rl2grid.scenarios.month_names import Months, month_name, parse_months
from rl2grid.scenarios.scenario import Scenario
from rl2grid.scenarios.splits import TRAINING_SEEDS

if TYPE_CHECKING:
    from rl2grid.scenarios.generator.month import RawMonth

EXPANDED_BYTES = 8 * 2**30
"""Expanded generated months beyond this are removed, oldest first, and those without which less than
:data:`LEFT_FREE_BYTES` would be free; they are expanded again when needed."""
MONTHS_BETWEEN_CLEANUPS = 50
"""A process looks for months to remove after the first one that it expands, then each time after so many more, and
where less than :data:`LEFT_FREE_BYTES` is free: to look at thousands of files takes longer than to play an episode."""
_LOCKS = 64
_EXPANDED_MONTHS = itertools.count()
"""How many this process has expanded so far."""


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
    if expanded and (next(_EXPANDED_MONTHS) % MONTHS_BETWEEN_CLEANUPS == 0 or free_bytes() < LEFT_FREE_BYTES):
        _keep_latest(EXPANDED_BYTES)
    return series


def expanded_copies() -> list[Copy]:
    """The expanded months of all grids, the oldest first: they may be removed, and are expanded again when needed."""
    return copies_by_age((data_folder() / "series" / f"v{FORMAT_VERSION}").glob("*/generated.*.npy"))


def pack_folder(grid: Grid) -> Path:
    """Where the packs of this generator are kept."""
    return data_folder() / "packs" / grid.id / generator_fingerprint(grid)


def pack_path(grid: Grid, seed: int, month: int) -> Path:
    """The file that keeps a month, whether it is there or not."""
    return pack_folder(grid) / f"{month_name(seed, month)}.pack"


def is_stored(grid: Grid, seed: int, month: int) -> bool:
    """Whether a month was made; its values are not looked at."""
    if seed not in TRAINING_SEEDS:
        return pack_path(grid, seed, month).is_file()
    from rl2grid.scenarios.training_years import is_year_there

    return is_year_there(grid, seed)


def make_months(grid: Grid, seed: int, months: Sequence[int]) -> None:
    """Make the packs of months of one year, those that are not there; of the library, the year.

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

    if seed in TRAINING_SEEDS:
        return packs.hash_of_month(_read_or_make(grid, seed, [month])[0])
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
    """Months of one year, from their packs or the library; those without a sound one are made."""
    if seed in TRAINING_SEEDS:
        # Imported where it is needed, as the generator is.
        from rl2grid.scenarios.training_years import training_raw_month

        return [training_raw_month(grid, seed, month) for month in months]
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
    return made


def _make_missing(grid: Grid, seed: int, months: Sequence[int]) -> None:
    for month in months:
        if _read(grid, seed, month) is None:
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


def _keep_latest(limit: int) -> None:
    """Remove expanded months, the latest excepted, until the rest takes at most ``limit`` bytes and some are free."""
    copies = expanded_copies()
    taken = sum(copy.size for copy in copies)
    remove_oldest(copies[:-1], max(taken - limit, LEFT_FREE_BYTES - free_bytes()))
