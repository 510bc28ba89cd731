"""Speed and memory of the reference engine beside plain Grid2Op, interleaved in one run.

``python benchmarks/reference.py`` plays do-nothing steps of a topology task (observation, reward, costs
and info included) and, in turn with it, ``env.step(do nothing)`` of an unmodified Grid2Op environment
with the same backend; then resets of both. It writes ``benchmarks/results/reference.json``.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import gymnasium

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.engines.reference.extract import make_environment
from rl2grid.grids import load_grid

GRIDS = ("bus14", "bus36-MO-v0", "bus118-M", "bus118-MOB-v1")


def steps_per_second(step: Callable[[], bool], reset: Callable[[], Any], steps: int) -> float:
    """Rate of ``step`` with the resets, which happen when an episode ends, left out."""
    seconds = 0.0
    for _ in range(steps):
        begin = time.perf_counter()
        over = step()
        seconds += time.perf_counter() - begin
        if over:
            reset()
    return steps / seconds


def milliseconds(reset: Callable[[], Any], times: int) -> float:
    """Duration of one ``reset``."""
    begin = time.perf_counter()
    for _ in range(times):
        reset()
    return 1000 * (time.perf_counter() - begin) / times


def measure(grid_id: str, rounds: int, steps: int) -> dict[str, Any]:
    """Both engines in turn, ``rounds`` times."""
    ours = gymnasium.make(f"rl2grid/{grid_id}-T0-v0", engine="reference", split="bundled", disable_env_checker=True)
    plain = make_environment(load_grid(grid_id).bundled_names[0])
    ours.reset(seed=0)
    plain.reset()

    def step_ours() -> bool:
        _, _, terminated, truncated, _ = ours.step(0)
        return terminated or truncated

    nothing = plain.action_space()

    def step_plain() -> bool:
        return bool(plain.step(nothing)[2])

    steps_per_second(step_ours, ours.reset, 50)  # compiles
    steps_per_second(step_plain, plain.reset, 50)
    samples: dict[str, list[float]] = {"ours": [], "grid2op": [], "reset_ours_ms": [], "reset_grid2op_ms": []}
    for _ in range(rounds):
        samples["ours"].append(steps_per_second(step_ours, ours.reset, steps))
        samples["grid2op"].append(steps_per_second(step_plain, plain.reset, steps))
        samples["reset_ours_ms"].append(milliseconds(ours.reset, 5))
        samples["reset_grid2op_ms"].append(milliseconds(plain.reset, 5))
    ratios = [a / b for a, b in zip(samples["ours"], samples["grid2op"], strict=True)]
    result: dict[str, Any] = {name: _summary(values) for name, values in samples.items()}
    result["ratio"] = _summary(ratios)
    result["worker_mib"] = worker_memory(grid_id)
    return result


def _summary(values: list[float]) -> dict[str, float]:
    return {"median": round(statistics.median(values), 3), "min": round(min(values), 3), "max": round(max(values), 3)}


def worker_memory(grid_id: str) -> dict[str, float]:
    """Private memory of a process that plays 1 and 8 environments, MiB."""
    code = (
        "import sys, gymnasium, rl2grid\n"
        "n = int(sys.argv[2])\n"
        "env = gymnasium.make_vec(f'rl2grid/{sys.argv[1]}-T0-v0', num_envs=n, engine='reference', num_workers=0)\n"
        "env.reset(seed=0)\n"
        "env.step([0] * n)\n"
        "rows = open('/proc/self/smaps_rollup').read().splitlines()\n"
        "private = sum(int(row.split()[1]) for row in rows if row.startswith('Private_'))\n"
        "print(private / 1024)\n"
    )
    measured = {}
    for n in (1, 8):
        command = [sys.executable, "-c", code, grid_id, str(n)]
        output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        measured[str(n)] = round(float(output.split()[-1]), 1)
    return measured


def main() -> None:
    """Measure the grids and write the result."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "reference.json")
    arguments = parser.parse_args()
    results: dict[str, Any] = {
        "command": "python benchmarks/reference.py",
        "python": platform.python_version(),
        "processor": platform.machine(),
    }
    for grid_id in GRIDS:
        results[grid_id] = row = measure(grid_id, arguments.rounds, arguments.steps)
        print(
            f"{grid_id:14} ours {row['ours']['median']:6.0f} steps/s, Grid2Op {row['grid2op']['median']:6.0f} steps/s, "
            f"ratio {row['ratio']['median']:.2f} ({row['ratio']['min']:.2f} to {row['ratio']['max']:.2f}); "
            f"reset {row['reset_ours_ms']['median']:.0f} ms against {row['reset_grid2op_ms']['median']:.0f} ms; "
            f"process with 1 / 8 environments {row['worker_mib']['1']:.0f} / {row['worker_mib']['8']:.0f} MiB"
        )
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
