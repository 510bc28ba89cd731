"""The programme of dispatch beside SciPy's solver on random programmes, and on three buses solved by hand."""

import numpy as np
import pytest
from scipy.optimize import linprog

from rl2grid.agents.dispatch import Control
from rl2grid.agents.dispatch_programme import DispatchProgramme

TRIANGLE = np.array([[2 / 3, 1 / 3], [1 / 3, 2 / 3], [1 / 3, -1 / 3]])
"""Change of the flows 1-3, 2-3, 1-2 per MW injected at buses 1, 2 and taken out at 3; three equal lines."""


def test_three_buses_redispatch_just_enough():
    # 90 MW from bus 1 to bus 3: 60 on 1-3. Moving x MW from bus 1 to bus 2 leaves 60 - x/3 on 1-3.
    control = Control(*(np.array(x, np.float64) for x in ([0, 0], [-50, 0], [0, 50], [0, 0], [1, 2])))
    programme = DispatchProgramme(control, control.price)
    overload = programme.add(np.zeros(3), np.full(3, 1000.0))
    programme.at_most(TRIANGLE, np.array([50.0, 100.0, 100.0]) - [60.0, 30.0, 30.0], (overload, -np.ones(3)))
    np.testing.assert_allclose(programme.solve(), [-30, 30], atol=1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_costs_as_little_as_with_another_solver(seed):
    """Objectives agree to 1e-6; the programmes are always feasible: overloads are priced, not forbidden."""
    rng = np.random.default_rng(seed)
    n, rows = 6, 8
    at_rest = rng.normal(size=n)
    now = at_rest + rng.normal(size=n)
    control = Control(now, now - rng.uniform(0, 5, n), now + rng.uniform(0, 5, n), at_rest, rng.uniform(0.1, 2, n))
    effect, bound, weight = rng.normal(size=(rows, n)), rng.normal(size=rows), rng.uniform(1, 9, rows)
    effect[rng.random((rows, n)) < 0.3] = 0.0
    programme = DispatchProgramme(control, control.price)
    overload = programme.add(np.zeros(rows), weight)
    programme.at_most(effect, bound, (overload, -np.ones(rows)))
    found = programme.solve()
    assert found is not None
    assert np.isclose(found.sum(), now.sum())
    assert (found >= control.least - 1e-7).all()
    assert (found <= control.most + 1e-7).all()
    # The same with a column for each injection, each distance from rest and each overload.
    eye, none = np.eye(n), np.zeros((n, rows))
    other = linprog(
        np.concatenate((np.zeros(n), control.price, weight)),
        A_ub=np.block([[eye, -eye, none], [-eye, -eye, none], [effect, np.zeros((rows, n)), -np.eye(rows)]]),
        b_ub=np.concatenate((at_rest, -at_rest, bound)),
        A_eq=np.concatenate((np.ones(n), np.zeros(n + rows)))[None],
        b_eq=[now.sum()],
        bounds=[*zip(control.least, control.most, strict=True), *[(0, None)] * (n + rows)],
    )
    cost = control.price @ np.abs(found - at_rest) + weight @ np.maximum(effect @ found - bound, 0.0)
    assert np.isclose(cost, other.fun, rtol=1e-6, atol=1e-6)
