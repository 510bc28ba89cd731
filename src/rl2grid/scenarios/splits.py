"""How the generated months are split for learning and testing.

A month is named by the seed of its year and its number, ``17-03``. Validation is a list of 200 months and test one of
500, each month of another year, and the first N of a list are balanced over the seasons; training draws from the
months of a library of years, whose seeds are in neither list. Seeds from 10,000 to 19,999 were used to calibrate the
generator; other seeds below :data:`FIRST_TRAINING_SEED` that are in no list are free. The lists were drawn after the
generator was frozen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.scenarios.month_names import MONTHS, Months
from rl2grid.streams import Purpose, Stream

TRAIN, VALIDATION, TEST, BUNDLED = "train", "validation", "test", "bundled"

SPLITS = (TRAIN, VALIDATION, TEST, BUNDLED)
"""``train`` teaches, ``validation`` picks models, ``test`` has the final word; ``bundled`` is every series inside the
Grid2Op wheel, days to months of each grid."""

FIRST_TRAINING_SEED = 1_000_000
"""Training plays years of this seed and above; validation and test those of seeds below it."""

TRAINING_YEARS = 96
"""Years of the library. Two months in a row begin in 11 of the months of each: 1,056 scenarios."""

TRAINING_SEEDS = range(FIRST_TRAINING_SEED, FIRST_TRAINING_SEED + TRAINING_YEARS)
"""Of the years of the library."""

LIBRARY_VERSION = "1"
"""Version of the library and of how training draws from it."""

YEARS_FOR_FIRST = (4, 24)
"""From so many years the first and the second episode of a seed are drawn, later ones from all: a training on an empty
data folder begins while the other years are made."""

SPLIT_VERSION = "2"
"""Version of the lists of validation and test, named by every result on them. The first version, 20 months each, was
looked at too often."""


def _months_of_own_years(first_seed: int, number: int) -> tuple[str, ...]:
    """Names of months of as many years. Seven months on each time: the first N are spread over the seasons."""
    return tuple(f"{first_seed + k}-{7 * k % 12:02d}" for k in range(number))


HELD_OUT_SPLITS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {VALIDATION: _months_of_own_years(710_000, 200), TEST: _months_of_own_years(810_000, 500)}
)
"""Months per split, for every grid, in the order in which a part of them is played; an id is ``generated/`` and one of
these."""

VALIDATION_MONTHS = 20
"""Of the list, in each validation of a training, of which there are many."""

_SHOWN = 20


def years_for(number: int) -> int:
    """From how many years of the library episode ``number`` of a seed is drawn: the first so many."""
    return YEARS_FOR_FIRST[number] if number < len(YEARS_FOR_FIRST) else TRAINING_YEARS


def draw_training_months(seed: int, number: int) -> Months:
    """The two months in a row in which training episode ``number`` of ``seed`` is played."""
    year, month = Stream(seed, number, Purpose.SCENARIO).uniform(2)
    return Months(FIRST_TRAINING_SEED + int(year * years_for(number)), int(month * (MONTHS - 1)), 2)


def draw_listed(ids: Sequence[str], split: str, seed: int, number: int) -> str:
    """What episode ``number`` of the stream of ``seed`` plays of a list: any in training, else one after the other."""
    if split == TRAIN:
        return ids[Stream(seed, number, Purpose.SCENARIO).integer(len(ids))]
    return ids[(seed + number) % len(ids)]


def require_listed(grid: Grid, split: str, ids: Sequence[str], scenario_id: str) -> None:
    """Refuse a series that is not in the list of a split.

    Raises:
        UsageError: it is not.
    """
    if scenario_id in ids:
        return
    listed = ", ".join(ids[:_SHOWN]) + (f" or {len(ids) - _SHOWN} more" if len(ids) > _SHOWN else "")
    raise UsageError(f"Scenario {scenario_id!r} is not in the split {split} of {grid.id}: choose one of {listed}.")


def shortened(values: Sequence[str]) -> tuple[str, ...]:
    """The first of the values, saying how many more there are."""
    if len(values) <= _SHOWN:
        return tuple(values)
    return (*values[:_SHOWN], f"{len(values) - _SHOWN} more")
