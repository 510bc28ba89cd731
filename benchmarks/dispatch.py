"""Exact dispatch beside Grid2Op's, on the same problems and in the same episodes.

``python benchmarks/dispatch.py --steps 1000`` plays random redispatch, curtailment and storage on
every grid and prints the tables of ``docs/dispatch.md``.
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when NumPy is imported

import grid2op
import numba
import numpy as np
from grid2op.Action import PlayableAction
from grid2op.Environment.dispatch import (
    BaseRedispatchSolver,
    DefaultRedispatchSolver,
    RedispatchConstraints,
    RedispatchResult,
    RedispatchState,
)
from lightsim2grid import LightSimBackend
from numpy.typing import NDArray

from rl2grid.arrays import F64
from rl2grid.engines.dispatch import EPSILON, find_dispatch
from rl2grid.engines.reference.dispatch import ExactRedispatchSolver
from rl2grid.grids import GRID_IDS, Grid, load_grid


@dataclass(frozen=True)
class Problem:
    """One redispatch that Grid2Op had to find, and what it found."""

    new_p: NDArray[np.float32]
    setpoint: NDArray[np.float32]
    target: NDArray[np.float32]
    actual: NDArray[np.float32]
    modified: NDArray[np.bool_]
    pmin: NDArray[np.float32]
    pmax: NDArray[np.float32]
    ramp_up: NDArray[np.float32]
    ramp_down: NDArray[np.float32]
    redispatchable: NDArray[np.bool_]
    power: float
    participating: NDArray[np.bool_]
    """Grid2Op's choice of generators, before it looked whether they are enough."""
    answer: NDArray[np.float32] | None
    """Grid2Op's new dispatch; None ended the episode."""
    seconds: float
    """Time that Grid2Op took."""

    @property
    def arguments(self) -> tuple[Any, ...]:
        """The arguments of :func:`rl2grid.engines.dispatch.find_dispatch`, but for its last one."""
        return (
            self.new_p,
            self.setpoint,
            self.target,
            self.actual,
            self.modified,
            self.pmin,
            self.pmax,
            self.ramp_up,
            self.ramp_down,
            self.redispatchable,
            self.power,
        )

    def exact(self) -> NDArray[np.float32] | None:
        """The exact new dispatch."""
        out = np.empty_like(self.actual)
        return out if find_dispatch(*self.arguments, out) else None


@dataclass(frozen=True)
class Programme:
    """The quadratic programme of a problem over its participating generators, from Grid2Op's formulas."""

    goal: F64
    flexibility: F64
    lower: F64
    upper: F64
    costly: NDArray[np.bool_]
    """Generators in the objective."""
    power: float

    def objective(self, change: F64) -> float:
        """Squared distance to the goals, weighted by the inverse of the ramps, MW."""
        return float((((change - self.goal) ** 2 / self.flexibility)[self.costly]).sum())

    def violation(self, change: F64) -> float:
        """Largest violation of a bound or of the sum, MW."""
        bounds = max(float((self.lower - change).max()), float((change - self.upper).max()), 0.0)
        return max(bounds, abs(float(change.sum()) - self.power))


class RecordingSolver(DefaultRedispatchSolver):
    """Grid2Op's own solver, which keeps every problem."""

    def __init__(self) -> None:
        super().__init__()
        self.problems: list[Problem] = []

    def solve(self, constraints: RedispatchConstraints, state: RedispatchState) -> RedispatchResult:
        begin = time.perf_counter()
        result = super().solve(constraints, state)
        seconds = time.perf_counter() - begin
        self.problems.append(
            Problem(
                new_p=constraints.new_p.copy(),
                setpoint=state.gen_activeprod_t_redisp.copy(),
                target=state.target_dispatch.copy(),
                actual=state.actual_dispatch.copy(),
                modified=state.already_modified_gen.copy(),
                pmin=constraints.pmin.copy(),
                pmax=constraints.pmax.copy(),
                ramp_up=constraints.ramp_up.copy(),
                ramp_down=constraints.ramp_down.copy(),
                redispatchable=constraints.redispatchable_mask.copy(),
                power=float(constraints.power_to_compensate_mw),
                participating=constraints.gen_participating.copy(),
                answer=result.actual_dispatch.copy() if result.success else None,
                seconds=seconds,
            )
        )
        return result


def programme(problem: Problem, participating: NDArray[np.bool_]) -> Programme:
    """The quadratic programme, built as ``DefaultRedispatchSolver.solve`` builds it."""
    costly = problem.modified[participating]
    rise = problem.new_p - (problem.setpoint - problem.actual)
    planned = problem.new_p + problem.actual
    lower = np.maximum(problem.pmin - planned, -problem.ramp_down - rise)
    upper = np.minimum(problem.pmax - planned, problem.ramp_up - rise)
    slack = float(np.float32(0.5) * EPSILON)
    return Programme(
        goal=(problem.target - problem.actual)[participating].astype(float),
        flexibility=(problem.ramp_up + problem.ramp_down + EPSILON)[participating].astype(float),
        lower=lower[participating].astype(float) - slack,
        upper=upper[participating].astype(float) + slack,
        costly=costly if costly.any() else np.ones_like(costly),
        power=problem.power,
    )


def make_environment(grid: Grid, solver: BaseRedispatchSolver) -> Any:
    """The bundled Grid2Op environment of ``grid`` with every kind of continuous action."""
    folder = Path(grid2op.__file__).parent / "data" / grid.bundled_names[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return grid2op.make(
            str(folder), backend=LightSimBackend(), action_class=PlayableAction, redispatch_solver=solver
        )


def random_action(environment: Any, random: np.random.Generator) -> Any:
    """Redispatch of a few generators, sometimes curtailment, and storage where there is any."""
    grid = type(environment)
    action = environment.action_space()
    extent = random.choice([0.0, 0.2, 1.0]) * (random.random(grid.n_gen) < 0.4) * grid.gen_redispatchable
    action.redispatch = (random.uniform(-1, 1, grid.n_gen) * grid.gen_max_ramp_up * extent).astype(np.float32)
    if random.random() < 0.3:
        curtailed = grid.gen_renewable & (random.random(grid.n_gen) < 0.3)
        action.curtail = np.where(curtailed, random.uniform(0.3, 1, grid.n_gen), -1).astype(np.float32)
    if grid.n_storage:
        power = random.uniform(-0.5, 0.5, grid.n_storage) * grid.storage_max_p_absorb
        action.storage_p = power.astype(np.float32)
    return action


def record(grid_id: str, steps: int, seed: int) -> list[Problem]:
    """The problems of ``steps`` random steps on a grid, under Grid2Op's own dispatch."""
    environment = make_environment(load_grid(grid_id), RecordingSolver())
    random = np.random.default_rng(seed)
    environment.seed(seed)
    done = True
    for _ in range(steps):
        if done:
            environment.reset()
        _, _, done, _ = environment.step(random_action(environment, random))
    problems: list[Problem] = environment._redispatch_solver.problems
    environment.close()
    return problems


def compare_problems(problems: list[Problem]) -> dict[str, float]:
    """How the exact answers differ from Grid2Op's on the same problems."""
    distances, excesses, violations, disagreements = [], [], [], 0
    for problem in problems:
        exact = problem.exact()
        disagreements += (exact is None) != (problem.answer is None)
        if exact is None or problem.answer is None:
            continue
        # Generators that Grid2Op adds when the participating ones are not enough did move as well.
        participating = problem.participating | (problem.answer != problem.actual) | (exact != problem.actual)
        quadratic = programme(problem, participating)
        ours = (exact.astype(float) - problem.actual)[participating]
        theirs = (problem.answer.astype(float) - problem.actual)[participating]
        distances.append(np.abs(ours - theirs).max())
        excesses.append(np.sqrt(quadratic.objective(theirs)) - np.sqrt(quadratic.objective(ours)))
        violations.append(max(quadratic.violation(ours), quadratic.violation(theirs)))
    return {
        "problems": len(problems),
        "other decisions": disagreements,
        "median difference MW": float(np.median(distances)),
        "90% MW": float(np.quantile(distances, 0.9)),
        "max MW": float(np.max(distances)),
        "least excess √MW": float(np.min(excesses)),
        "max excess √MW": float(np.max(excesses)),
        "max violation MW": float(np.max(violations)),
        "Grid2Op µs": float(np.median([problem.seconds for problem in problems])) * 1e6,
        "exact µs": _exact_microseconds(problems),
    }


@numba.njit
def _solve_all(  # type: ignore[no-untyped-def]
    new_p, setpoint, target, actual, modified, pmin, pmax, ramp_up, ramp_down, redispatchable, power, out
):
    for k in range(power.size):
        find_dispatch(
            new_p[k], setpoint[k], target[k], actual[k], modified[k],
            pmin, pmax, ramp_up, ramp_down, redispatchable, power[k], out,
        )  # fmt: skip


def _exact_microseconds(problems: list[Problem]) -> float:
    """Mean time of an exact solve inside compiled code, best of five rounds."""
    first = problems[0]
    varying = [np.stack([problem.arguments[k] for problem in problems]) for k in range(5)]
    power = np.array([problem.power for problem in problems])
    arguments = (*varying, *first.arguments[5:10], power, np.empty_like(first.actual))
    _solve_all(*arguments)
    rounds = []
    for _ in range(5):
        begin = time.perf_counter()
        _solve_all(*arguments)
        rounds.append(time.perf_counter() - begin)
    return min(rounds) / len(problems) * 1e6


def compare_episodes(grid_id: str, steps: int, seed: int) -> dict[str, float]:
    """How far apart the dispatch of both modes drifts under the same actions."""
    grid = load_grid(grid_id)
    pair = [make_environment(grid, ExactRedispatchSolver()), make_environment(grid, DefaultRedispatchSolver())]
    random = np.random.default_rng(seed)
    distances, endings, other_endings = [], 0, 0
    for environment in pair:
        environment.seed(seed)
        environment.reset()
    for _ in range(steps):
        action = random_action(pair[0], random)
        played = [environment.step(environment.action_space.from_vect(action.to_vect())) for environment in pair]
        over = [done for _, _, done, _ in played]
        if any(over):
            endings += 1
            other_endings += not all(over)
            for environment in pair:
                environment.reset()
            continue
        distances.append(np.abs(played[0][0].actual_dispatch - played[1][0].actual_dispatch).max())
    for environment in pair:
        environment.close()
    return {
        "steps": steps,
        "median difference MW": float(np.median(distances)),
        "90% MW": float(np.quantile(distances, 0.9)),
        "max MW": float(np.max(distances)),
        "episode ends": endings,
        "of these not at the same step": other_endings,
    }


def table(rows: dict[str, dict[str, float]]) -> str:
    """A Markdown table, one grid a line."""
    columns = next(iter(rows.values()))
    lines = [f"| grid | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]
    for name, row in rows.items():
        lines.append(f"| {name} | {' | '.join(map(_cell, row.values()))} |")
    return "\n".join(lines)


def _cell(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.2g}" if abs(value) < 10 else f"{value:.0f}"


def main() -> None:
    """Play, compare and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1000, help="random steps per grid")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        problems = {each: compare_problems(record(each, arguments.steps, arguments.seed)) for each in GRID_IDS}
        print(table(problems), end="\n\n")
        print(table({each: compare_episodes(each, arguments.steps, arguments.seed) for each in GRID_IDS}))


if __name__ == "__main__":
    main()
