"""What ``VectorEnv.step`` of 256 environments costs beside the engine's own time, in one run, on one thread.

::

    python benchmarks/vector_step.py [--rounds 5] [--steps 60] [--tasks NAME ...]

Processor time of whole steps, of which are apart:

- the engine: its two compiled calls, ``advance`` (transitions) and ``write_observations`` (those of endings included);
- beginnings: new episodes where some have ended, with the months that are made or opened for them;
- the vector: all else, which is checking actions and handing them over, infos of all environments and of endings,
  effects, buffers.

Played are random actions, of which many end episodes, and nothing, the cheapest step of the engine. It writes
``benchmarks/results/vector_step.json``: microseconds per step of all 256 environments, and the vector's share of the
engine's time, medians of the rounds (each the median of its steps). Masks of actions, for which one asks, are measured
beside. Processor time counts caches that other processes have emptied, the vector's more than the engine's: the load of
the machine is noted.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.engines.native import transitions
from rl2grid.records.files import write_json

RESULTS = Path(__file__).parent / "results" / "vector_step.json"
TASKS = ("bus14-T0", "bus36-MO-v0-T0", "bus118-M-T0")
PLAYS = ("random", "nothing")
NUM_ENVS = 256
ENGINE, BEGINNINGS = "engine", "beginnings"
COMPILED = transitions.advance, transitions.write_observations


class Clock:
    """Processor time of this thread that named parts of a step take."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._inside = 0

    def time(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """``function``, whose time is noted unless another part's is running, to which it belongs then."""

        def timed(*arguments: Any, **keywords: Any) -> Any:
            if self._inside:
                return function(*arguments, **keywords)
            self._inside, began = 1, time.thread_time()
            try:
                return function(*arguments, **keywords)
            finally:
                self.seconds[part] = self.seconds.get(part, 0.0) + time.thread_time() - began
                self._inside = 0

        return timed


class Steps:
    """A vector environment whose steps are taken apart."""

    def __init__(self, task: str, play: str) -> None:
        self.envs: Any = gymnasium.make_vec(f"rl2grid/{task}-v0", num_envs=NUM_ENVS, num_threads=1)
        self.play, self.random, self.clock = play, np.random.default_rng(0), Clock()
        transitions.advance = self.clock.time(ENGINE, COMPILED[0])
        transitions.write_observations = self.clock.time(ENGINE, COMPILED[1])
        rows = self.envs.unwrapped._rows
        rows._begin = self.clock.time(BEGINNINGS, rows._begin)
        self.envs.reset(seed=0)

    def step(self) -> dict[str, float]:
        """Microseconds of a step and of its parts, and how many episodes ended."""
        actions = np.zeros(NUM_ENVS, np.int64)
        if self.play == "random":
            actions = self.random.integers(self.envs.single_action_space.n, size=NUM_ENVS)
        self.clock.seconds = dict.fromkeys((ENGINE, BEGINNINGS), 0.0)
        began = time.thread_time()
        _, _, terminated, truncated, _ = self.envs.step(actions)
        parts = self.clock.seconds | {"step": time.thread_time() - began}
        parts["vector"] = parts["step"] - sum(self.clock.seconds.values())
        return {part: 1e6 * seconds for part, seconds in parts.items()} | {
            "vector_over_engine": parts["vector"] / parts[ENGINE],
            "endings": float((terminated | truncated).sum()),
        }

    def masks(self) -> float:
        """Microseconds of the masks of all environments."""
        began = time.thread_time()
        self.envs.unwrapped.action_masks()
        return 1e6 * (time.thread_time() - began)


def measure(task: str, play: str, rounds: int, steps: int) -> dict[str, Any]:
    """Medians of the rounds, and their range."""
    played = Steps(task, play)
    for _ in range(steps):  # begins many episodes, whose months are there from now on
        played.step()
    samples: dict[str, list[float]] = {}
    for _ in range(rounds):
        taken = [played.step() | {"masks": played.masks()} for _ in range(steps)]
        for name in taken[0]:
            samples.setdefault(name, []).append(statistics.median(step[name] for step in taken))
    played.envs.close()
    return {name: _summary(values, 3 if name == "vector_over_engine" else 1) for name, values in samples.items()}


def _summary(values: list[float], digits: int) -> dict[str, float]:
    shown = {"median": statistics.median(values), "min": min(values), "max": max(values)}
    return {name: round(value, digits) for name, value in shown.items()}


def main() -> None:
    """Measure and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--tasks", nargs="+", default=TASKS)
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    results: dict[str, Any] = {
        "environments": NUM_ENVS,
        "threads": 1,
        "unit": "microseconds of a step of all of them",
        "processors": os.cpu_count(),
        "load_before": round(os.getloadavg()[0], 1),
    }
    for task in options.tasks:
        for play in PLAYS:
            results[f"{task} {play}"] = measured = measure(task, play, options.rounds, options.steps)
            print(f"{task} {play}", {name: value["median"] for name, value in measured.items()}, flush=True)
    write_json(options.output, results, indent=1)


if __name__ == "__main__":
    main()
