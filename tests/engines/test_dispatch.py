"""The exact redispatch against Grid2Op, an independent solver and the optimality conditions."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when NumPy is imported

import daqp
import grid2op
import numpy as np
import pytest
from grid2op.Action import PlayableAction
from grid2op.Environment.dispatch import DefaultRedispatchSolver, RedispatchConstraints, RedispatchState
from grid2op.Exceptions import IllegalRedispatching, ImpossibleRedispatching
from grids_of_tests import SHORTER
from lightsim2grid import LightSimBackend
from numpy.typing import NDArray

from rl2grid.engines import dispatch
from rl2grid.engines.dispatch import (
    EPSILON,
    TOLERANCE,
    add_request,
    dispatch_is_needed,
    find_dispatch,
    redispatch_is_impossible,
    solve_programme,
)
from rl2grid.engines.reference.dispatch import ExactRedispatchSolver
from rl2grid.grids import GRID_IDS, load_grid

RECORDED_STEPS = 30
RANDOM_PROBLEMS = 3000
FLOAT32_ROUNDING = 5e-5  # MW, of a dispatch of some hundred MW


def _load_benchmark() -> ModuleType:
    path = Path(__file__).parents[2] / "benchmarks" / "dispatch.py"
    specification = importlib.util.spec_from_file_location("benchmarks_dispatch", path)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[specification.name] = module
    specification.loader.exec_module(module)
    return module


benchmark = _load_benchmark()
Problem, Programme = benchmark.Problem, benchmark.Programme


@pytest.fixture(scope="module")
def recorded() -> dict[str, list[Any]]:
    """Problems of random play under Grid2Op's own dispatch; a longer test below takes all grids."""
    return {grid_id: benchmark.record(grid_id, RECORDED_STEPS, seed=1) for grid_id in SHORTER}


def random_problem(random: np.random.Generator) -> Any:
    """A problem far rougher than those of play: idle generators, overshot limits, large imbalances."""
    n = int(random.integers(1, 40))
    rough = random.choice([0.1, 0.5, 1.0, 2.0])
    pmin = random.choice([0.0, 1.0]) * random.uniform(0, 20, n)
    pmax = pmin + random.uniform(5, 400, n)
    ramp_up = random.uniform(0.5, 30, n)
    ramp_down = ramp_up if random.random() < 0.5 else random.uniform(0.5, 30, n)
    redispatchable = random.random(n) < 0.7
    redispatchable[0] = True
    setpoint = pmin + random.random(n) * (pmax - pmin)
    actual = np.where(redispatchable & (random.random(n) < 0.7), random.normal(0, 5, n), 0)
    modified = redispatchable & (random.random(n) < random.choice([0, 0.3, 1]))
    target = np.where(modified, actual + random.normal(0, 5, n), 0)
    new_p = np.maximum(setpoint - actual + random.normal(0, rough, n) * ramp_up / 3, 0)
    idle = random.random(n) < random.choice([0, 0.7])
    for values in (new_p, actual, target, setpoint):
        values[idle] = 0
    beyond = random.random(n) < random.choice([0, 0.1], p=[0.8, 0.2])
    setpoint[beyond] = (pmax + ramp_up * random.uniform(0.9, 2, n))[beyond]
    power = float(np.float32(random.normal(0, 10 * rough)))
    single = [np.asarray(values, np.float32) for values in (new_p, setpoint, target, actual)]
    limits = [np.asarray(values, np.float32) for values in (pmin, pmax, ramp_up, ramp_down)]
    in_use = (single[0] > 0) | (np.abs(single[3]) >= 1e-7) | (single[2] != single[3])
    return Problem(
        *single, modified & ~idle, *limits, redispatchable, power, redispatchable & in_use, answer=None, seconds=0.0
    )


@pytest.fixture(scope="module")
def random_problems() -> list[Any]:
    random = np.random.default_rng(7)
    return [random_problem(random) for _ in range(RANDOM_PROBLEMS)]


def grid2op_participants(problem: Any) -> NDArray[np.bool_] | None:
    """The generators with which Grid2Op solves, or None where it finds the problem infeasible."""
    constraints, state = grid2op_problem(problem)
    participating, _, failure = DefaultRedispatchSolver()._prepare_solver_inputs(constraints, state)
    return participating if failure is None else None


def grid2op_problem(problem: Any) -> tuple[RedispatchConstraints, RedispatchState]:
    n = problem.new_p.size
    constraints = RedispatchConstraints(
        new_p=problem.new_p,
        gen_participating=problem.participating,
        gen_detached=np.zeros(n, np.bool_),
        power_to_compensate_mw=problem.power,
        contributions={},
        pmin=problem.pmin,
        pmax=problem.pmax,
        ramp_up=problem.ramp_up,
        ramp_down=problem.ramp_down,
        redispatchable_mask=problem.redispatchable,
        can_use_all_redispatchable=True,
        epsilon=EPSILON,
        tol=TOLERANCE,
    )
    state = RedispatchState.allocate(n, 0, 0)
    state.target_dispatch = problem.target
    state.actual_dispatch = problem.actual
    state.already_modified_gen = problem.modified
    state.gen_activeprod_t_redisp = problem.setpoint
    return constraints, state


def solved(problems: list[Any]) -> Iterator[tuple[Any, Any, NDArray[np.float64]]]:
    """Feasible problems with their programme and the float64 solution of it."""
    for problem in problems:
        participating = grid2op_participants(problem)
        if participating is None:
            continue
        programme = benchmark.programme(problem, participating)
        if (programme.lower > programme.upper).any():
            continue
        yield problem, programme, solution(programme)


def solution(programme: Any) -> NDArray[np.float64]:
    order = np.argsort(~programme.costly, kind="stable")
    costly = int(programme.costly.sum())
    goal = np.where(programme.costly, programme.goal, 0.0)[order]
    out = np.empty(order.size)
    bounds = programme.lower[order], programme.upper[order]
    solve_programme(goal, programme.flexibility[order], *bounds, costly, programme.power, out)
    change = np.empty(order.size)
    change[order] = out
    return change


def optimality_gap(gradient: NDArray[np.float64], x: NDArray[np.float64], programme: Any) -> float:
    """Distance to a multiplier of the sum with which the Karush-Kuhn-Tucker conditions hold.

    The gradient equals the multiplier between the bounds, is no less at the lower bound and no more
    at the upper one. The problem is convex, so a gap of zero proves optimality.
    """
    at_lower, at_upper = x <= programme.lower + 1e-9, x >= programme.upper - 1e-9
    least = np.max(gradient[~at_lower], initial=-np.inf)
    most = np.min(gradient[~at_upper], initial=np.inf)
    return max(float(least - most), 0.0)


def independent_solution(programme: Any) -> NDArray[np.float64]:
    """The same programme by a dual active-set solver: first the objective, then the least norm."""
    costly, weight = programme.costly, 1 / programme.flexibility
    slope = np.where(costly, -weight * programme.goal, 0.0)
    regular = np.where(costly, weight, 1e-7 * weight)
    change = _daqp(regular, slope, programme.lower, programme.upper, programme.power)
    if not costly.all():
        rest = programme.power - change[costly].sum()
        change[~costly] = _daqp(
            weight[~costly], np.zeros((~costly).sum()), programme.lower[~costly], programme.upper[~costly], rest
        )
    return change


def _daqp(
    weight: NDArray[np.float64],
    slope: NDArray[np.float64],
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    total: float,
) -> NDArray[np.float64]:
    equality = 5
    sense = np.zeros(weight.size + 1, np.int32)
    sense[-1] = equality
    bounds = np.append(upper, total), np.append(lower, total)
    sums = np.ones((1, weight.size))
    x, _, flag, _ = daqp.solve(np.diag(weight), slope, sums, *bounds, sense, primal_tol=1e-10, dual_tol=1e-10)
    assert flag == 1
    return np.asarray(x)


def all_problems(recorded: dict[str, list[Any]], random_problems: list[Any]) -> list[Any]:
    return [problem for problems in recorded.values() for problem in problems] + random_problems


def test_enough_problems_are_compared(recorded: dict[str, list[Any]], random_problems: list[Any]) -> None:
    assert min(len(problems) for problems in recorded.values()) > 0.9 * RECORDED_STEPS
    assert sum(1 for _ in solved(random_problems)) > 0.6 * RANDOM_PROBLEMS


def test_solution_is_feasible(recorded: dict[str, list[Any]], random_problems: list[Any]) -> None:
    for _, programme, change in solved(all_problems(recorded, random_problems)):
        assert programme.violation(change) < 1e-9


def test_solution_satisfies_the_optimality_conditions(
    recorded: dict[str, list[Any]], random_problems: list[Any]
) -> None:
    for _, programme, change in solved(all_problems(recorded, random_problems)):
        gradient = np.where(programme.costly, (change - programme.goal) / programme.flexibility, 0.0)
        assert optimality_gap(gradient, change, programme) < 1e-9


def test_solution_has_the_least_norm_of_all_optima(recorded: dict[str, list[Any]], random_problems: list[Any]) -> None:
    free_balance = 0
    for _, programme, change in solved(all_problems(recorded, random_problems)):
        free = ~programme.costly
        if not free.any():
            continue
        free_balance += 1
        # The costly ones are unique, so the free ones only share a fixed sum.
        rest = Programme(
            goal=programme.goal[free],
            flexibility=programme.flexibility[free],
            lower=programme.lower[free],
            upper=programme.upper[free],
            costly=programme.costly[free],
            power=programme.power,
        )
        assert optimality_gap(change[free] / rest.flexibility, change[free], rest) < 1e-9
    assert free_balance > 500


def test_solution_equals_that_of_an_independent_solver(
    recorded: dict[str, list[Any]], random_problems: list[Any]
) -> None:
    for _, programme, change in solved(all_problems(recorded, random_problems)):
        other = independent_solution(programme)
        assert programme.objective(change) <= programme.objective(other) + 1e-9
        np.testing.assert_allclose(change, other, atol=1e-9 if programme.costly.all() else 1e-4)


def test_dispatch_is_the_solution_in_float32(recorded: dict[str, list[Any]], random_problems: list[Any]) -> None:
    for problem, programme, change in solved(all_problems(recorded, random_problems)):
        exact = problem.exact()
        assert exact is not None
        assert exact.dtype == np.float32
        participating = grid2op_participants(problem)
        assert participating is not None
        expected = problem.actual.copy()
        expected[participating] += change
        np.testing.assert_allclose(exact, expected, atol=FLOAT32_ROUNDING)
        assert programme.violation((exact.astype(float) - problem.actual)[participating]) < 4 * FLOAT32_ROUNDING


def test_no_worse_than_grid2op_wherever_its_answer_is_feasible(recorded: dict[str, list[Any]]) -> None:
    compared = 0
    for problem, programme, change in solved(all_problems(recorded, [])):
        if problem.answer is None:
            continue
        participating = grid2op_participants(problem)
        theirs = (problem.answer.astype(float) - problem.actual)[participating]
        if programme.violation(theirs) > FLOAT32_ROUNDING:
            continue
        compared += 1
        assert np.sqrt(programme.objective(change)) <= np.sqrt(programme.objective(theirs)) + 1e-5
    assert compared > 0.9 * RECORDED_STEPS * len(SHORTER)


@pytest.mark.slow
def test_thousands_of_recorded_problems() -> None:
    compared = 0
    for grid_id in GRID_IDS:
        problems = benchmark.record(grid_id, 600, seed=11)
        for problem, programme, change in solved(problems):
            compared += 1
            assert programme.violation(change) < 1e-9
            gradient = np.where(programme.costly, (change - programme.goal) / programme.flexibility, 0.0)
            assert optimality_gap(gradient, change, programme) < 1e-9
            other = independent_solution(programme)
            assert programme.objective(change) <= programme.objective(other) + 1e-9
            np.testing.assert_allclose(change, other, atol=1e-9 if programme.costly.all() else 1e-4)
            theirs = (problem.answer.astype(float) - problem.actual)[grid2op_participants(problem)]
            if programme.violation(theirs) <= FLOAT32_ROUNDING:
                assert np.sqrt(programme.objective(change)) <= np.sqrt(programme.objective(theirs)) + 1e-5
    assert compared > 3500


def test_same_game_overs_as_grid2op(recorded: dict[str, list[Any]], random_problems: list[Any]) -> None:
    """Grid2Op's check of feasibility, its second try with all generators, and crossed bounds."""
    outcomes = {"feasible": 0, "second try": 0, "out of reach": 0, "crossed bounds": 0}
    for problem in all_problems(recorded, random_problems):
        participating, exact = grid2op_participants(problem), problem.exact()
        if participating is None:
            outcomes["out of reach"] += 1
            assert exact is None
            continue
        programme = benchmark.programme(problem, participating)
        crossed = bool((programme.lower > programme.upper).any())
        assert (exact is None) == crossed
        outcome = "second try" if (participating != problem.participating).any() else "feasible"
        outcomes["crossed bounds" if crossed else outcome] += 1
    assert min(outcomes.values()) >= 10, outcomes


def test_crossed_bounds_end_the_episode_in_grid2op_too(random_problems: list[Any]) -> None:
    """Its solver then fails too, but for gaps within its tolerance of one per cent of the scale."""
    checked = 0
    for problem in random_problems:
        participating = grid2op_participants(problem)
        if participating is None:
            continue
        programme = benchmark.programme(problem, participating)
        scale = max(np.abs(problem.actual).max(), 1.0)
        if (programme.lower - programme.upper).max() <= 2 * TOLERANCE * scale:
            continue
        checked += 1
        assert not DefaultRedispatchSolver().solve(*grid2op_problem(problem)).success
        if checked == 20:
            break
    assert checked == 20


def test_generators_without_cost_share_by_flexibility() -> None:
    """One generator goes to its target of 3 MW; the two untouched ones pay for it, 1 to 2 by their ramps."""
    n = 3
    plain = np.zeros(n, np.float32)
    ramp = np.array([5, 1, 2], np.float32)
    target, modified = np.array([3, 0, 0], np.float32), np.array([True, False, False])
    out = np.empty(n, np.float32)
    level = np.full(n, 50, np.float32)
    pmax = np.full(n, 100, np.float32)
    everyone = np.ones(n, np.bool_)
    assert find_dispatch(level, level, target, plain, modified, plain, pmax, ramp, ramp, everyone, 0.0, out)
    np.testing.assert_allclose(out, [3, -1, -2], atol=1e-3)
    # Asked for 5 MW, it gets what the others can give: their ramps.
    target[0] = 5
    assert find_dispatch(level, level, target, plain, modified, plain, pmax, ramp, ramp, everyone, 0.0, out)
    np.testing.assert_allclose(out, [3, -1, -2], atol=3e-4)
    # Beyond all ramps together nothing is found, and `out` is left alone.
    before = out.copy()
    assert not find_dispatch(level, level, target, plain, modified, plain, pmax, ramp, ramp, everyone, 8.1, out)
    np.testing.assert_array_equal(out, before)


def test_dispatch_may_be_written_over_the_old_one(random_problems: list[Any]) -> None:
    for problem in random_problems[:200]:
        exact, actual = problem.exact(), problem.actual.copy()
        arguments = list(problem.arguments)
        arguments[3] = actual
        if find_dispatch(*arguments, actual):
            np.testing.assert_array_equal(actual, exact)


def test_sum_rounds_as_numpy_does() -> None:
    random = np.random.default_rng(0)
    for size in range(129):
        for _ in range(20):
            values = random.normal(0, 50, size).astype(np.float32)
            assert dispatch.rounded_sum(values, size) == values.sum()


class CountingSolver(ExactRedispatchSolver):
    """Counts its calls."""

    def __init__(self) -> None:
        super().__init__()
        self.calls = 0

    def solve(self, constraints: RedispatchConstraints, state: RedispatchState) -> Any:
        self.calls += 1
        return super().solve(constraints, state)


@pytest.mark.parametrize("grid_id", ["bus14", "bus118-MOB-v0"])
def test_dispatch_is_needed_when_grid2op_calls_its_solver(grid_id: str) -> None:
    environment = benchmark.make_environment(load_grid(grid_id), CountingSolver())
    environment.seed(0)
    observation, random = environment.reset(), np.random.default_rng(0)
    solver, seen = environment._redispatch_solver, {True: 0, False: 0}
    for step in range(80):
        calls, actual = solver.calls, observation.actual_dispatch.copy()
        action = benchmark.random_action(environment, random) if 20 < step < 40 else environment.action_space()
        observation, _, done, _ = environment.step(action)
        if done:
            break
        state = environment._dispatch_state
        needed = dispatch_is_needed(actual, state.target_dispatch, state.amount_storage, state.sum_curtailment_mw)
        assert needed == (solver.calls > calls)
        seen[needed] += 1
    environment.close()
    assert min(seen.values()) > 5


def test_each_reason_alone_makes_dispatch_needed() -> None:
    zero, many = np.zeros(3, np.float32), np.full(3, 0.009, np.float32)
    assert not dispatch_is_needed(zero, zero, 0.0, 0.0)
    assert not dispatch_is_needed(zero, many, 0.009, -0.009)
    assert dispatch_is_needed(zero, zero, -0.01, 0.0)
    assert dispatch_is_needed(zero, zero, 0.0, -0.01)
    assert dispatch_is_needed(zero, np.array([0, 0.01, 0], np.float32), 0.0, 0.0)
    assert dispatch_is_needed(many, many, 0.0, 0.0)  # reached, but not balanced


@pytest.mark.parametrize("grid_id", ["bus14", "bus36-MO-v1", "bus118-MOB-v1"])
def test_targets_and_impossible_requests_are_those_of_grid2op(grid_id: str) -> None:
    """Requests pile up in one direction until Grid2Op refuses them."""
    environment = benchmark.make_environment(load_grid(grid_id), ExactRedispatchSolver())
    environment.seed(0)
    environment.reset()
    grid, random = type(environment), np.random.default_rng(1)
    target, modified = np.zeros(grid.n_gen, np.float32), np.zeros(grid.n_gen, np.bool_)
    refused = accepted = 0
    # Small machines reach their limits soonest.
    small = grid.gen_redispatchable & (grid.gen_pmax / np.maximum(grid.gen_max_ramp_up, 0.1) < 40)
    for _ in range(150):
        request = np.where(small & (random.random(grid.n_gen) < 0.7), grid.gen_max_ramp_up, 0).astype(np.float32)
        action = environment.action_space()
        action.redispatch = request
        actual = environment._actual_dispatch.copy()
        impossible = redispatch_is_impossible(request, target, actual, modified, grid.gen_pmin, grid.gen_pmax)
        observation, _, done, info = environment.step(action)
        if done:
            environment.reset()
            target[:], modified[:] = 0, False
            continue
        illegal = any(isinstance(error, IllegalRedispatching) for error in info["exception"])
        assert impossible == illegal
        if impossible:
            refused += 1
            # Grid2Op does not quite undo a refused request: take its state for the next one.
            target[:], modified[:] = environment._target_dispatch, environment._already_modified_gen
            continue
        accepted += 1
        add_request(request, target, actual, modified)
        np.testing.assert_array_equal(target, observation.target_dispatch)
        np.testing.assert_array_equal(modified, environment._already_modified_gen)
    environment.close()
    assert refused > 5
    assert accepted > 5


def test_a_refused_request_changes_nothing() -> None:
    n = 2
    request, target = np.array([6, 0], np.float32), np.array([95, 1], np.float32)
    actual, modified = np.zeros(n, np.float32), np.array([True, True])
    pmin, pmax = np.zeros(n, np.float32), np.full(n, 100, np.float32)
    assert redispatch_is_impossible(request, target, actual, modified, pmin, pmax)
    assert redispatch_is_impossible(-request, -target, actual, modified, pmin, pmax)
    assert not redispatch_is_impossible(request - np.float32(1), target, actual, modified, pmin, pmax)
    # A first request counts from where the generator is, whatever the target.
    assert not redispatch_is_impossible(request, target, actual, np.zeros(n, np.bool_), pmin, pmax)
    np.testing.assert_array_equal(target, [95, 1])


def test_every_environment_behind_an_environment_dispatches_exactly() -> None:
    """``obs.simulate``, copies, forecasts and the mixes of a multi-mix environment."""
    multimix = grid2op.make(
        "l2rpn_neurips_2020_track2",
        test=True,
        backend=LightSimBackend(),
        action_class=PlayableAction,
        redispatch_solver=ExactRedispatchSolver,
    )
    for mix in multimix.mix_envs.values():
        copy = mix.copy()
        for environment in (mix, mix.observation_space.obs_env, copy, copy.observation_space.obs_env):
            assert isinstance(environment._redispatch_solver, ExactRedispatchSolver)
    observation = multimix.reset()
    forecast = observation.get_forecast_env()
    assert isinstance(forecast._redispatch_solver, ExactRedispatchSolver)
    forecast.close()
    multimix.close()


def test_impossible_balance_ends_the_episode_at_the_same_step_in_both_modes() -> None:
    """All renewables shut at once: the rest cannot ramp up fast enough."""
    for solver in (ExactRedispatchSolver(), DefaultRedispatchSolver()):
        environment = benchmark.make_environment(load_grid("bus118-MOB-v0"), solver)
        environment.seed(0)
        environment.reset()
        action = environment.action_space()
        action.curtail = np.where(environment.gen_renewable, 0, -1).astype(np.float32)
        _, _, done, info = environment.step(action)
        environment.close()
        assert done
        assert any(isinstance(error, ImpossibleRedispatching) for error in info["exception"])
