"""An hour of random play: memory, file descriptors, threads and disk must stay what they are.

``python benchmarks/endurance.py [--minutes 60] [--num-envs 256]`` plays the tasks in turn, each for its
share of the time with one vector environment, on a data folder of its own, and writes
``benchmarks/results/endurance.json``: a sample every half a minute, and by how much the last quarter of a task's
samples lies above its second one (the first quarter warms up). ``docs/worlds.md`` and training keep environments for
days: what grows here would end them.
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from rl2grid.records.files import write_json

RESULTS = Path(__file__).resolve().parent / "results" / "endurance.json"
TASKS = (("bus14-T0", None), ("bus14-R", "idle"), ("bus36-MO-v0-T1", "careful"))
SAMPLE_SECONDS = 30.0
MEMORY_GROWTH = 0.03
"""Share by which the resident memory may be larger at the end: what the allocator keeps varies so much."""


def anonymous_bytes(process: Path) -> int:
    """Memory of a process, given as its folder in ``/proc``, that is in no file."""
    lines = (process / "smaps_rollup").read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith("Anonymous")) * 2**10


def sample(data: Path) -> dict[str, int]:
    """What this process holds, and what its data folder takes."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    files = [path for folder in ("packs", "series") for path in (data / folder).rglob("*") if path.is_file()]
    return {
        "resident_mb": pages * os.sysconf("SC_PAGE_SIZE") // 2**20,
        "anonymous_mb": anonymous_bytes(Path("/proc/self")) // 2**20,
        "descriptors": len(os.listdir("/proc/self/fd")),
        "threads": threading.active_count(),
        "disk_mb": sum(path.stat().st_size for path in files) // 2**20,
    }


def play(task: str, heuristic: str | None, num_envs: int, seconds: float, data: Path) -> dict[str, Any]:
    """Play a task at random for a while."""
    envs: Any = gymnasium.make_vec(f"rl2grid/{task}-v0", num_envs=num_envs, heuristic=heuristic)
    envs.reset(seed=0)
    envs.action_space.seed(0)
    began = sampled = time.monotonic()
    samples, decisions, episodes = [sample(data)], 0, 0
    while time.monotonic() - began < seconds:
        _, _, terminated, truncated, _ = envs.step(envs.action_space.sample())
        decisions += num_envs
        episodes += int((terminated | truncated).sum())
        if time.monotonic() - sampled > SAMPLE_SECONDS:
            samples.append(sample(data))
            sampled = time.monotonic()
    envs.close()
    return {
        "heuristic": heuristic,
        "minutes": round((time.monotonic() - began) / 60, 1),
        "decisions": decisions,
        "episodes": episodes,
        "growth": growth(samples),
        "samples": samples,
        "after_closing": sample(data),
    }


def growth(samples: list[dict[str, int]]) -> dict[str, float]:
    """Median of the last quarter less that of the second one."""
    quarter = max(len(samples) // 4, 1)
    early, late = samples[quarter : 2 * quarter] or samples, samples[-quarter:]
    return {
        name: float(np.median([each[name] for each in late]) - np.median([each[name] for each in early]))
        for name in samples[0]
    }


def failures_of(task: str, result: dict[str, Any]) -> list[str]:
    """What grew."""
    before = result["samples"][len(result["samples"]) // 2]
    allowed = {"anonymous_mb": MEMORY_GROWTH * before["anonymous_mb"], "descriptors": 0, "threads": 0}
    return [f"{task}: {name} grew by {result['growth'][name]:g}" for name in allowed
            if result["growth"][name] > allowed[name]]  # fmt: skip


def main() -> int:
    """Play, write the result, and say whether anything grew."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--num-envs", type=int, default=256)
    options = parser.parse_args()
    tasks: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as scratch:
        data = Path(scratch)
        os.environ["RL2GRID_DATA"] = str(data)
        for task, heuristic in TASKS:
            tasks[task] = play(task, heuristic, options.num_envs, 60 * options.minutes / len(TASKS), data)
            print(task, {name: value for name, value in tasks[task].items() if name != "samples"}, flush=True)
    failures = [words for task, result in tasks.items() for words in failures_of(task, result)]
    command = shlex.join(["python", "benchmarks/endurance.py", *sys.argv[1:]])
    write_json(RESULTS, {"command": command, "failures": failures, "tasks": tasks}, indent=1)
    print(*failures, sep="\n")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
