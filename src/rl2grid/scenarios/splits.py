"""How the generated months are split for learning and testing.

A month is named by the seed of its year and its number, ``17-03``. Validation and test are lists of 20 months, each
of another year, in every season; training draws the seeds of its years from a range in which those lists have none,
and has no end. Seeds from 10,000 to 19,999 were used to calibrate the generator; other seeds below
:data:`FIRST_TRAINING_SEED` that are in no list are free. The lists were drawn after the generator was frozen.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

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
