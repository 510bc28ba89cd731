"""How the generated months are split for learning and testing.

A month is named by the seed of its year and its number, ``17-03``. Validation is a list of 200 months and test one of
500, each month of another year, and the first N of a list are balanced over the seasons; training draws the seeds of
its years from a range in which those lists have none, and has no end. Seeds from 10,000 to 19,999 were used to
calibrate the generator; other seeds below :data:`FIRST_TRAINING_SEED` that are in no list are free. The lists were
drawn after the generator was frozen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.streams import Purpose, Stream

TRAIN, VALIDATION, TEST, BUNDLED = "train", "validation", "test", "bundled"

SPLITS = (TRAIN, VALIDATION, TEST, BUNDLED)
"""``train`` teaches, ``validation`` picks models, ``test`` has the final word; ``bundled`` is every series inside the
Grid2Op wheel, days to months of each grid."""

FIRST_TRAINING_SEED = 1_000_000
"""Training plays years of this seed and above; validation and test those of seeds below it."""

TRAINING_SEEDS = 2**40
"""How many seeds training draws from."""

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
