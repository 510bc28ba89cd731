"""Speed of the native engine beside Grid2Op and LightSim2Grid's ``LightEnv``, interleaved in one run, one thread.

``python benchmarks/engine.py`` measures, round by round and in turn:

- our step: one compiled call for ``ROWS`` environments that plays a whole grid step with opponent, maintenance,
  protections, reward, costs and scores, and writes the normalised observations; resets are not counted;
- ``VectorEnv.step`` of the same environments: the same with Gymnasium's infos and automatic resets;
- Grid2Op: ``env.step`` with LightSim2Grid, its series in memory, resets not counted;
- ``LightEnv.step``: power flow and protections in C++, without rules, opponents and rewards.

What is played: nothing, a random topology action of the full catalogue at every step, a random continuous action at
every step. Grid2Op plays the same kind of actions, made before the clock starts. It writes
``benchmarks/results/engine.json``: median and range of the rounds, and of their ratios.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import gymnasium
import numpy as np

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.transitions import Commands, NativeTransitions, commands_of
from rl2grid.engines.reference.extract import make_environment
from rl2grid.grids import Grid, load_grid
from rl2grid.mdp.actions import (
    DO_NOTHING,
    ActionKind,
    continuous_layout,
    decode_continuous,
    full_catalogue,
    inject,
    moved_elements,
)
from rl2grid.mdp.features import observation_size, physical_scale
from rl2grid.mdp.rewards import PRESETS
from rl2grid.scenarios.episodes import plan_episode

GRIDS = ("bus14", "bus36-MO-v0", "bus118-M", "bus118-MOB-v1")
PLAYS = ("nothing", "topology", "continuous")
ROWS = 64


class Ours:
    """``ROWS`` native environments; only steps are on the clock."""

    def __init__(self, grid: Grid, play: str, rows: int = ROWS, threads: int = 1) -> None:
        self.grid, self.play, self.threads = grid, play, threads
        kind = "R" if play == "continuous" else "T"
        self.transitions = NativeTransitions(NativeEngine(grid, rows), None, kind, PRESETS["default"], 1.0)
        self.rows = np.arange(rows)
        self.scale = physical_scale(grid, kind)
        self.observations = np.zeros((rows, observation_size(grid, kind)), np.float32)
        self.episodes = [0] * rows
        self.generator = np.random.default_rng(0)
        self.reset_seconds, self.resets = 0.0, 0
        self.begin(self.rows)

    def begin(self, rows: Any) -> None:
        """Reset environments, off the clock of the steps."""
        for i in rows.tolist():
            plan = plan_episode(self.grid, "train", i, self.episodes[i])
            self.episodes[i] += 1
            begin = time.perf_counter()
            self.transitions.reset(i, plan)
            self.reset_seconds += time.perf_counter() - begin
        self.resets += len(rows)

    def actions(self) -> Commands:
        """One action per environment."""
        n = len(self.rows)
        if self.play == "nothing":
            return commands_of(self.grid, [DO_NOTHING] * n)
        if self.play == "topology":
            catalogue = full_catalogue(self.grid)
            chosen = self.generator.integers(len(catalogue), size=n)
            return commands_of(self.grid, [catalogue[k] for k in chosen.tolist()])
        size = continuous_layout(self.grid).size
        values = self.generator.uniform(-1, 1, (n, size)).astype(np.float32)
        return commands_of(self.grid, [inject(row) for row in values])

    def microseconds(self, steps: int) -> float:
        """Mean duration of a step of one environment."""
        state, seconds = self.transitions.engine.state, 0.0
        for _ in range(steps):
            commands = self.actions()
            begin = time.perf_counter()
            self.transitions.play_rows(self.rows, commands, self.threads)
            self.transitions.write_observations(self.rows, *self.scale, self.observations)
            seconds += time.perf_counter() - begin
            ended = np.flatnonzero(state.terminated | state.truncated)
            if len(ended):
                self.begin(ended)
        return 1e6 * seconds / (steps * len(self.rows))


class OurVector:
    """The same through Gymnasium, resets included."""

    def __init__(self, grid: Grid, play: str) -> None:
        task = (
            f"rl2grid/{grid.id}-R-v0" if play == "continuous" else f"rl2grid/{grid.id}-T{len(grid.level_sizes) - 1}-v0"
        )
        self.play = play
        self.envs: Any = gymnasium.make_vec(task, num_envs=ROWS, num_threads=1)
        self.envs.reset(seed=0)
        self.envs.action_space.seed(0)

    def microseconds(self, steps: int) -> float:
        """Mean duration of a step of one environment."""
        seconds = 0.0
        for _ in range(steps):
            actions = np.zeros(ROWS, np.int64) if self.play == "nothing" else self.envs.action_space.sample()
            begin = time.perf_counter()
            self.envs.step(actions)
            seconds += time.perf_counter() - begin
        return 1e6 * seconds / (steps * ROWS)


class Grid2Op:
    """A plain Grid2Op environment; only ``env.step`` is on the clock of the steps."""

    def __init__(self, grid: Grid, play: str) -> None:
        self.grid, self.play = grid, play
        self.environment = _curtailable(grid) if play == "continuous" else make_environment(grid.bundled_names[0])
        self.generator = np.random.default_rng(0)
        self.reset_seconds, self.resets = 0.0, 0
        self.environment.reset()

    def action(self) -> Any:
        """A fresh action."""
        space = self.environment.action_space
        if self.play == "nothing":
            return space()
        if self.play == "topology":
            catalogue = full_catalogue(self.grid)
            chosen = catalogue[int(self.generator.integers(len(catalogue)))]
            action = space()
            for kind, target, mask in chosen.changes:
                if kind == ActionKind.MOVE:
                    moved = np.zeros(self.grid.dim_topo, np.bool_)
                    moved[moved_elements(self.grid, target, mask)] = True
                    action.change_bus = moved
                elif kind == ActionKind.SWITCH:
                    action.line_change_status = [target]
            return action
        size = continuous_layout(self.grid).size
        asked = decode_continuous(self.grid, self.generator.uniform(-1, 1, size).astype(np.float32))
        action = space()
        action.redispatch = asked.redispatch
        if self.grid.n_storage:
            action.storage_p = asked.storage
        action.curtail = asked.curtailment_limit
        return action

    def microseconds(self, steps: int) -> float:
        """Mean duration of a step."""
        seconds = 0.0
        for _ in range(steps):
            action = self.action()
            begin = time.perf_counter()
            _, _, over, _ = self.environment.step(action)
            seconds += time.perf_counter() - begin
            if over:
                begin = time.perf_counter()
                self.environment.reset()
                self.reset_seconds += time.perf_counter() - begin
                self.resets += 1
        return 1e6 * seconds / steps


class LightEnvironment:
    """LightSim2Grid's own step environment, doing nothing, with limits that nothing exceeds."""

    def __init__(self, grid: Grid) -> None:
        from lightsim2grid import LightEnv

        environment = make_environment(grid.bundled_names[0])
        environment.reset()
        model, data = environment.backend._grid.copy(), environment.chronics_handler.real_data.data
        self.light = LightEnv(model)
        protections = self.light.protections
        limits = 100.0 * np.asarray(grid.thermal_limit, np.float64)
        protections.set_thermal_limit_or(limits)
        protections.set_thermal_limit_ex(limits)
        protections.set_max_line_time_step_overflow(np.full(grid.n_line, 10_000, np.int32))
        rows = min(500, len(data.load_p) - 1)

        def unused(width: int) -> Any:
            return np.full((rows, width), np.nan)

        shunts = len(model.get_shunts())
        voltages = np.tile([each.target_vm_pu for each in model.get_generators()], (rows, 1))
        series = [np.ascontiguousarray(part[:rows], np.float64) for part in (data.load_p, data.load_q, data.prod_p)]
        storages, none = unused(len(model.get_storages())), unused(0)
        self.light.assign_time_series(
            *series, np.ascontiguousarray(voltages), storages, unused(shunts), unused(shunts), none, none
        )
        self.left = self.rows = rows - 10
        self.light.reset()

    def microseconds(self, steps: int) -> float:
        """Mean duration of a step."""
        seconds = 0.0
        for _ in range(steps):
            if self.left == 0:
                self.light.reset()
                self.left = self.rows
            self.left -= 1
            begin = time.perf_counter()
            self.light.step(0)
            seconds += time.perf_counter() - begin
        return 1e6 * seconds / steps


def _curtailable(grid: Grid) -> Any:
    """The grid's environment with an action class that allows curtailment."""
    import grid2op
    from grid2op.Action import PlayableAction
    from lightsim2grid import LightSimBackend

    folder = Path(grid2op.__file__).parent / "data" / grid.bundled_names[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return grid2op.make(str(folder), backend=LightSimBackend(), action_class=PlayableAction)


def measure(grid_id: str, play: str, rounds: int, steps: int) -> dict[str, Any]:
    """All sides in turn, ``rounds`` times."""
    grid = load_grid(grid_id)
    sides: dict[str, Any] = {
        "step": Ours(grid, play),
        "vector_step": OurVector(grid, play),
        "grid2op": Grid2Op(grid, play),
    }
    if play == "nothing":
        sides["light_env"] = LightEnvironment(grid)
    # Ours are cheap: enough of them that a round of each takes about as long.
    shares: dict[str, int] = {"step": max(steps // 4, 20), "vector_step": max(steps // 8, 10), "light_env": steps}
    for side in sides.values():
        side.microseconds(5)
    samples: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(rounds):
        for name, side in sides.items():
            samples[name].append(side.microseconds(shares.get(name, steps)))
    result: dict[str, Any] = {f"{name}_us": _summary(values) for name, values in samples.items()}
    for peer in ("grid2op", "light_env"):
        for name in ("step", "vector_step"):
            if peer in samples:
                result[f"{peer}_over_{name}"] = _summary(_ratios(samples[peer], samples[name]))
    ours, theirs = sides["step"], sides["grid2op"]
    result["reset_us"] = round(1e6 * ours.reset_seconds / ours.resets, 1)
    if theirs.resets:
        result["grid2op_reset_us"] = round(1e6 * theirs.reset_seconds / theirs.resets, 1)
    return result


def thread_scaling(grid_id: str, rounds: int, steps: int) -> dict[str, Any]:
    """Our step with one and with two threads."""
    grid = load_grid(grid_id)
    one, two = Ours(grid, "nothing", 256, 1), Ours(grid, "nothing", 256, 2)
    samples: list[tuple[float, float]] = []
    for _ in range(rounds + 1):
        samples.append((one.microseconds(steps), two.microseconds(steps)))
    return _summary([first / second for first, second in samples[1:]])


def memory_and_construction(grid_id: str) -> dict[str, float]:
    """Kilobytes per environment, and seconds to build a thousand after compilation."""
    grid = load_grid(grid_id)
    begin = time.perf_counter()
    engine = NativeEngine(grid, 1000)
    seconds = time.perf_counter() - begin
    plan = plan_episode(grid, "train", 0, 0)
    engine.prepare(0, plan)
    environments = engine.environments
    parts = (environments.state, environments.hidden, environments.flow, environments.opponent)
    size = sum(array.nbytes for part in parts for array in part if array.ndim and len(array) == 1000)
    return {"kilobytes": round(size / 1000 / 1000, 1), "seconds_for_1000": round(seconds, 3)}


def start_up() -> dict[str, float]:
    """Seconds of a fresh process to its first step, with an empty cache and with a filled one."""
    code = (
        "import gymnasium, rl2grid\n"
        "env = gymnasium.make_vec('rl2grid/bus14-T0-v0', num_envs=4)\n"
        "env.reset(seed=0)\n"
        "env.step([0] * 4)\n"
    )
    seconds: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"XDG_CACHE_HOME": cache}
        for name in ("cold", "warm"):
            begin = time.perf_counter()
            subprocess.run([sys.executable, "-c", code], env=environment, check=True)
            seconds[name] = round(time.perf_counter() - begin, 1)
    return seconds


def _ratios(peer: list[float], ours: list[float]) -> list[float]:
    return [a / b for a, b in zip(peer, ours, strict=True)]


def _summary(values: list[float]) -> dict[str, float]:
    return {"median": round(statistics.median(values), 3), "min": round(min(values), 3), "max": round(max(values), 3)}


def main() -> None:
    """Measure and write the result."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--grids", nargs="+", default=list(GRIDS), choices=GRIDS)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "engine.json")
    arguments = parser.parse_args()
    results: dict[str, Any] = {
        "command": "python benchmarks/engine.py",
        "python": platform.python_version(),
        "processor": platform.machine(),
        "environments": ROWS,
        "start_up_seconds": start_up(),
    }
    for grid_id in arguments.grids:
        grid_result: dict[str, Any] = {}
        results[grid_id] = grid_result
        for play in PLAYS:
            grid_result[play] = measure(grid_id, play, arguments.rounds, arguments.steps)
            print(f"{grid_id} {play}: {json.dumps(grid_result[play])}", flush=True)
        grid_result["two_threads_over_one"] = thread_scaling(grid_id, arguments.rounds, 100)
        grid_result["environment"] = memory_and_construction(grid_id)
        print(f"{grid_id}: {grid_result['two_threads_over_one']} {grid_result['environment']}", flush=True)
    temporary = arguments.output.with_suffix(".tmp")
    temporary.write_text(json.dumps(results, indent=1) + "\n")
    temporary.replace(arguments.output)


if __name__ == "__main__":
    main()
