"""What a ledger keeps of every month."""

from __future__ import annotations

import numpy as np
import pytest
from sample_results import episode

from rl2grid.records.month_values import common_months, pack_months, unpack_months

MONTHS = {"split": "test", "split_version": "2", "generator_version": "1", "number": 500, "seeds": 1}


def test_every_month_comes_back():
    played = [
        episode("a", survival=1.0),
        episode("b", survival=1.0),
        episode("c", survival=0.25, cost_tlo=60.0),
        episode("d", survival=0.0, cost_lsi=0.5),
    ]
    packed = pack_months(played)
    assert packed == {
        "length": "100*4",
        "survived": "100*2 25 0",
        "cost_lsi": "0*2 1 0.5",
        "cost_tlo": "10*2 60 10",
    }
    values = unpack_months(packed, seeds=2)
    np.testing.assert_array_equal(values["survival"], [[1, 1], [0.25, 0]])
    np.testing.assert_array_equal(values["completed"], [[1, 1], [0, 0]])
    np.testing.assert_array_equal(values["cost_tlo"], [[10, 10], [60, 10]])


def test_five_hundred_months_are_a_few_kilobytes():
    random = np.random.default_rng(0)
    months = [episode(f"{k}", survival=float(share)) for k, share in enumerate(random.uniform(size=500))]
    assert len("".join(pack_months(months).values())) < 5000


@pytest.mark.parametrize("text", ["1 2 3", "", "x"])
def test_columns_that_do_not_fit_are_refused(text):
    packed = {**pack_months([episode(), episode(seed=1)]), "survived": text}
    with pytest.raises(ValueError, match=r"Values of months need|could not convert|cannot reshape"):
        unpack_months(packed, seeds=1)


def test_months_in_common_are_the_first_of_the_same_list():
    assert common_months(MONTHS, {**MONTHS, "number": 200}) == 200
    assert common_months(MONTHS, MONTHS) == 500
    for key, other in (("split_version", "1"), ("seeds", 2), ("generator_version", "2"), ("split", "validation")):
        assert common_months(MONTHS, {**MONTHS, key: other}) == 0
