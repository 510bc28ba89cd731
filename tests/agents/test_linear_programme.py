"""Limits of the solver, and its silence."""

import ctypes

import numpy as np
import pytest
import scipy.optimize

from rl2grid.agents.linear_programme import Affine, Programme


@pytest.mark.parametrize("limit", [None, 7])
def test_the_node_limit_reaches_the_solver(limit, monkeypatch):
    given = {}
    solve = scipy.optimize.milp

    def spy(*arguments, **keywords):
        given.update(keywords["options"])
        return solve(*arguments, **keywords)

    monkeypatch.setattr(scipy.optimize, "milp", spy)
    programme = Programme()
    cost = programme.column(0.0, 10.0, cost=1.0)
    chosen = programme.binary()
    programme.at_most([(chosen, 3.0)], Affine(0.0, {cost: 1.0}))
    programme.row(1.0, [(chosen, 1.0)], 1.0)
    np.testing.assert_allclose(programme.solve(10.0, limit), [3.0, 1.0], atol=1e-6)
    assert given.get("node_limit") == limit


def test_what_compiled_code_prints_is_dropped_while_solving_only(monkeypatch, capfd):
    library = ctypes.CDLL(None)
    solve = scipy.optimize.milp

    def chatty(*arguments, **keywords):
        library.puts(b"stray line")
        return solve(*arguments, **keywords)

    monkeypatch.setattr(scipy.optimize, "milp", chatty)
    programme = Programme()
    programme.column(1.0, 2.0, cost=1.0)
    library.puts(b"before")
    np.testing.assert_allclose(programme.solve(10.0), [1.0])
    library.puts(b"after")
    library.fflush(None)
    assert capfd.readouterr().out.split() == ["before", "after"]
