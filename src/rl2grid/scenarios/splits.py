"""How the series are split for learning and testing: the bundled ones, and those that the generator makes.

Generated months. A month is named by the seed of its year and its number, ``17-03``. Validation and test are lists of
20 months, each of another year, in every season; training draws the seeds of its years from a range in which those
lists have none. Seeds below :data:`FIRST_TRAINING_SEED` that are in no list are free for calibration.

Bundled series. The wheel holds days to months; some grids have a single series. Rows are [first:past the last], 288
to a day. No row of a test window is in a window of another split, and series with the same demand
(the two mixes of bus118-M) are cut at the same rows.

============= ============================ ======================= ======================== ==================
grid          series                       train                   validation               test
============= ============================ ======================= ======================== ==================
bus14         4 months, 3 of 2 days        a month, 3 weeks of     4th week of that month,  2 months
                                           another, 2 of 2 days    1 of 2 days
bus36-M       10 days of April             first 5 days            next 40 hours            last third
bus36-MO-v0   3 days of August, 3 of       first 3/4 of August     last 1/4 of August       February
              February
bus36-MO-v1   a day of August, a day of    first 3/4 of August     last 1/4 of August       April
              April
bus118-M      2 days of April, 2 of        first day of both       second day of April      second day of
              August, both in 2 mixes                                                       August
bus118-MOB-v0 a day of February            first 12 hours          next 4 hours             last third
bus118-MOB-v1 2 days of August, 2 of       first day of August     second day of August     January
              January
============= ============================ ======================= ======================== ==================

A grid with one series learns from its first two thirds (the last quarter of them validates). Where
there is a choice, the month with planned outages trains, since an agent can hardly be blamed for what
it never saw; the days of bus118-M are split so that doing nothing fails in training and in test.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

BUNDLED_SPLITS: Mapping[str, Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "bus14": {
            "train": ("0000", "0001", "rte_case14_realistic/000", "rte_case14_redisp/0[0:6048]"),
            "validation": ("0002", "rte_case14_redisp/0[6048:8065]"),
            "test": ("rte_case14_realistic/001", "rte_case14_redisp/1"),
        },
        "bus36-M": {
            "train": ("Scenario_april_000[0:1440]",),
            "validation": ("Scenario_april_000[1440:1920]",),
            "test": ("Scenario_april_000[1920:2879]",),
        },
        "bus36-MO-v0": {
            "train": ("Scenario_august_dummy[0:648]",),
            "validation": ("Scenario_august_dummy[648:865]",),
            "test": ("Scenario_february_dummy",),
        },
        "bus36-MO-v1": {
            "train": ("Scenario_august_21_wk1[0:216]",),
            "validation": ("Scenario_august_21_wk1[216:288]",),
            "test": ("Scenario_april_17_wk1",),
        },
        "bus118-M": {
            "train": ("x2.5/001[0:288]", "x2.5/002[0:288]", "x1/001[0:288]", "x1/002[0:288]"),
            "validation": ("x2.5/001[288:576]", "x1/001[288:576]"),
            "test": ("x2.5/002[288:576]", "x1/002[288:576]"),
        },
        "bus118-MOB-v0": {
            "train": ("2050-02-14_0[0:144]",),
            "validation": ("2050-02-14_0[144:192]",),
            "test": ("2050-02-14_0[192:289]",),
        },
        "bus118-MOB-v1": {
            "train": ("2035-08-20_0[0:288]",),
            "validation": ("2035-08-20_0[288:576]",),
            "test": ("2035-01-15_0",),
        },
    }
)
"""Windows of the bundled series per grid and split; an id is ``bundled/`` and one of these."""

FIRST_TRAINING_SEED = 1_000_000
"""Training plays years of this seed and above; validation and test those of seeds below it."""

TRAINING_SEEDS = 2**40
"""How many seeds training draws from."""

GENERATED_SPLITS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "generated-validation": (
            *("500000-00", "500001-07", "500002-02", "500003-09", "500004-04"),
            *("500005-11", "500006-06", "500007-01", "500008-08", "500009-03"),
            *("500010-10", "500011-05", "500012-00", "500013-07", "500014-02"),
            *("500015-09", "500016-04", "500017-11", "500018-06", "500019-01"),
        ),
        "generated-test": (
            *("600000-00", "600001-07", "600002-02", "600003-09", "600004-04"),
            *("600005-11", "600006-06", "600007-01", "600008-08", "600009-03"),
            *("600010-10", "600011-05", "600012-00", "600013-07", "600014-02"),
            *("600015-09", "600016-04", "600017-11", "600018-06", "600019-01"),
        ),
    }
)
"""Months per split, for every grid; an id is ``generated/`` and one of these."""

GENERATED_TRAINING = "generated-train"
"""The split of generated months that has no end: its months are drawn."""

TRAINING_SPLITS = ("train", GENERATED_TRAINING)
"""Splits that may be learned from; their episodes start in a random row."""

VALIDATION_OF: Mapping[str, str] = MappingProxyType({"train": "validation", GENERATED_TRAINING: "generated-validation"})
"""For each split that may be learned from, the one that picks models."""
TEST_OF: Mapping[str, str] = MappingProxyType({"train": "test", GENERATED_TRAINING: "generated-test"})
"""For each split that may be learned from, the one that has the final word."""
