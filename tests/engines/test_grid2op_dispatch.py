"""Grid2Op's redispatch as a function gives Grid2Op's own answers, bit for bit."""

import subprocess
import sys
from functools import partial

import numpy as np
import pytest
import scipy.optimize
from grid2op.Environment.dispatch import DefaultRedispatchSolver
from grids_of_tests import SHORTER
from test_dispatch import benchmark, grid2op_problem, random_problem

from rl2grid.engines.dispatch import find_dispatch
from rl2grid.engines.grid2op_dispatch import find_dispatch_grid2op
from rl2grid.grids import GRID_IDS


def ours(problem):
    """The new dispatch as bytes, or None if there is none."""
    out = np.full_like(problem.actual, np.nan)
    found = find_dispatch_grid2op(*problem.arguments, out)
    if not found:
        assert np.isnan(out).all(), "the dispatch is left alone where there is none"
    return out.tobytes() if found else None


def theirs(problem):
    """Grid2Op's answer to a problem that was not recorded."""
    result = DefaultRedispatchSolver().solve(*grid2op_problem(problem))
    return result.actual_dispatch.tobytes() if result.success else None


def check_recorded(grid_id, steps, seed):
    problems = benchmark.record(grid_id, steps, seed)
    assert len(problems) > 0.9 * steps
    for number, problem in enumerate(problems):
        expected = None if problem.answer is None else problem.answer.tobytes()
        assert ours(problem) == expected, f"problem {number} of {grid_id}"
    return problems


@pytest.mark.parametrize("grid_id", SHORTER)
def test_answers_of_play_are_grid2ops(grid_id):
    problems = check_recorded(grid_id, steps=40, seed=3)
    # The exact dispatch differs in most, so the comparison can fail.
    exact = [problem.exact() for problem in problems if problem.answer is not None]
    answers = [problem.answer for problem in problems if problem.answer is not None]
    assert np.mean([not np.array_equal(a, b) for a, b in zip(exact, answers, strict=True)]) > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_answers_of_long_play_are_grid2ops(grid_id):
    check_recorded(grid_id, steps=1500, seed=4)


def random_problems(count, seed):
    random = np.random.default_rng(seed)
    return [random_problem(random) for _ in range(count)]


def test_answers_of_rough_problems_are_grid2ops():
    """Idle generators, overshot limits, large imbalances: infeasible problems and failures of the solver."""
    failed = 0
    for problem in random_problems(300, seed=8):
        answer = theirs(problem)
        assert ours(problem) == answer
        failed += answer is None
    assert 15 < failed < 285


def overshot_problem(excess):
    """One generator cannot come down to its limit by ``excess`` MW; the other can make up for it."""
    single = partial(np.array, dtype=np.float32)
    pmax, ramp = single([100, 100]), single([5, 10])
    setpoint, actual = single([105 + excess, 50]), single([0, 0])
    target = single([-5 - excess / 2, 5 + excess / 2])
    limits = single([0, 0]), pmax, ramp, ramp
    every = np.ones(2, np.bool_)
    return benchmark.Problem(setpoint, setpoint, target, actual, every, *limits, every, 0.0, every, None, 0.0)


def solver_outcomes(monkeypatch):
    """A list that grows by whether SciPy succeeded, call by call."""
    outcomes = []
    minimize = scipy.optimize.minimize

    def recording(*arguments, **keywords):
        found = minimize(*arguments, **keywords)
        outcomes.append(bool(found.success))
        return found

    monkeypatch.setattr(scipy.optimize, "minimize", recording)
    return outcomes


@pytest.mark.parametrize(("excess", "accepted"), [(0.005, True), (0.5, False)])
def test_failures_of_the_solver_are_accepted_within_the_tolerance(monkeypatch, excess, accepted):
    problem = overshot_problem(excess)
    answer = theirs(problem)
    assert (answer is not None) == accepted
    outcomes = solver_outcomes(monkeypatch)
    assert ours(problem) == answer
    assert outcomes == [False]


def test_rough_problems_that_pass_the_first_test_fail_in_the_solver(monkeypatch):
    outcomes = solver_outcomes(monkeypatch)
    answers = [ours(problem) for problem in random_problems(200, seed=9)]
    failures = outcomes.count(False)
    assert failures > 0
    assert answers.count(None) > failures, "others are infeasible at first sight"


def test_decisions_agree_with_the_exact_dispatch_where_limits_are_sound():
    for problem in random_problems(100, seed=10):
        if (problem.setpoint > problem.pmax).any():
            continue
        out = np.empty_like(problem.actual)
        if not find_dispatch(*problem.arguments, out):
            assert ours(problem) is None


def test_arguments_are_left_alone_and_out_may_be_the_present_dispatch():
    for problem in random_problems(100, seed=11):
        before = [np.copy(argument) for argument in problem.arguments]
        expected = ours(problem)
        for argument, copy in zip(problem.arguments, before, strict=True):
            np.testing.assert_array_equal(argument, copy)
        arguments = list(problem.arguments)
        present = arguments[3] = problem.actual.copy()
        if find_dispatch_grid2op(*arguments, present):
            assert present.tobytes() == expected


def test_type_of_the_power_does_not_matter():
    for problem in random_problems(20, seed=12):
        expected = ours(problem)
        for kind in (np.float32, np.float64):
            arguments = [*problem.arguments[:-1], kind(problem.power)]
            out = np.empty_like(problem.actual)
            assert (out.tobytes() if find_dispatch_grid2op(*arguments, out) else None) == expected


def test_import_loads_neither_scipy_optimize_nor_grid2op():
    code = "import sys, rl2grid.engines.grid2op_dispatch; print({'scipy.optimize', 'grid2op'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
