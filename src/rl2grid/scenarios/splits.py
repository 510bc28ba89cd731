"""How the generated months are split for learning and testing.

A month is named by the seed of its year and its number, ``17-03``. Validation and test are lists of 20 months, each
of another year, in every season; training draws the seeds of its years from a range in which those lists have none,
and has no end. Seeds from 10,000 to 19,999 were used to calibrate the generator; other seeds below
:data:`FIRST_TRAINING_SEED` that are in no list are free. The lists were drawn after the generator was frozen.
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

HELD_OUT_SPLITS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        VALIDATION: (
            *("700000-00", "700001-07", "700002-02", "700003-09", "700004-04"),
            *("700005-11", "700006-06", "700007-01", "700008-08", "700009-03"),
            *("700010-10", "700011-05", "700012-00", "700013-07", "700014-02"),
            *("700015-09", "700016-04", "700017-11", "700018-06", "700019-01"),
        ),
        TEST: (
            *("800000-00", "800001-07", "800002-02", "800003-09", "800004-04"),
            *("800005-11", "800006-06", "800007-01", "800008-08", "800009-03"),
            *("800010-10", "800011-05", "800012-00", "800013-07", "800014-02"),
            *("800015-09", "800016-04", "800017-11", "800018-06", "800019-01"),
        ),
    }
)
"""Months per split, for every grid; an id is ``generated/`` and one of these."""

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
