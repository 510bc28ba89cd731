"""What more cores are worth to trainings.

``python benchmarks/cores.py [--cores 1 2 4 8 16] [--seconds 3]`` measures decisions of PPO per second of wall clock
(256 environments, ``idle``): of one training whose environments have so many threads, and of so many trainings side by
side, each in a process of its own with one thread. Months are those of the library, made before anything is measured;
resets are included. It writes ``benchmarks/results/cores.json``, with the ratio of each number to that of one core, and
is for a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from loop_speed import measure

from rl2grid.envs.tasks import find_task
from rl2grid.records.files import write_json
from rl2grid.records.versions import library_versions, processor

RESULTS = Path(__file__).resolve().parent / "results" / "cores.json"
TASKS = ("bus14-T0",)
NUM_ENVS = 256


def trains(task: str, threads: int, seconds: float) -> float:
    """Decisions per second of one training."""
    rates = measure("ppo", task, "idle", NUM_ENVS, num_threads=threads, seconds=seconds, clock=time.perf_counter)
    return rates["decisions_per_s"]


def side_by_side(task: str, trainings: int, seconds: float) -> float:
    """Decisions per second of all trainings together."""
    command = [sys.executable, __file__, "--train", task, "--seconds", str(seconds)]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE) for _ in range(trainings)]
    return sum(float(json.loads(each.communicate()[0])) for each in running)


def main() -> int:
    """Measure, and write what came out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    cores = os.cpu_count() or 1
    powers = [2**power for power in range(8) if 2**power <= cores]
    parser.add_argument("--cores", type=int, nargs="*", default=powers)
    parser.add_argument("--tasks", nargs="*", default=TASKS)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--train", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.train:
        print(trains(options.train, 1, options.seconds))
        return 0
    result: dict[str, Any] = {"processor": processor(), "cores": cores, "versions": library_versions(), "tasks": {}}
    for task in options.tasks:
        make = [sys.executable, "-m", "rl2grid", "data", "make", find_task(task).grid_id, "--split", "train"]
        subprocess.run(make, check=True, stdout=subprocess.DEVNULL)
        measures = {
            "one training of ppo": lambda n, task=task: trains(task, n, options.seconds),
            "trainings of ppo side by side": lambda n, task=task: side_by_side(task, n, options.seconds),
        }
        rows = result["tasks"][task] = {}
        for name, of_cores in measures.items():
            rates = {n: of_cores(n) for n in options.cores}
            one = rates[options.cores[0]]
            rows[name] = {
                str(n): {"per_second": round(rate), "ratio": round(rate / one, 2)} for n, rate in rates.items()
            }
            print(task, name, rows[name], flush=True)
            write_json(options.results, result, indent=1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
