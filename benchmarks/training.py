"""What somebody who trains sees of the engine: decisions a second through ``gymnasium.make_vec``, months and resets in.

::

    python benchmarks/training.py --before REVISION [--rounds 5] [--only NAME ...]

Each round runs every case in a process of its own, with the package as it is and as it was at ``REVISION``, in turns,
and Grid2Op doing nothing. Cases:

- ``random``: random actions of the task's smallest set, no heuristic, 256 environments, one thread, per second of
  processor time. The library is made before, in both revisions; a first round, which compiles, does not count.
- ``nothing``: doing nothing, 64 environments, one thread.
- ``careful``: random actions, 64 environments, one thread, and the heuristic ``careful`` between decisions.
- ``first_step``: from the start of a process to the end of the first step of 256 environments, on an empty data folder,
  with compiled code there.
- ``threads``: 256 environments, one thread and two in turns, wall clock.
- ``library``: ``rl2grid data make GRID --split train`` on an empty data folder, two processes.

It writes ``benchmarks/results/training.json``: medians of the rounds, the ratio to before, and to Grid2Op.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "training.json"
TASKS = ("bus14-T0", "bus36-MO-v0-T0", "bus118-M-T0")
SECONDS = 8.0
"""Of a measurement."""
GRID2OP_STEPS = 600

_PLAY = """
import json, sys, time
import gymnasium, numpy as np
import rl2grid
task, n, play, seconds = sys.argv[1], int(sys.argv[2]), sys.argv[3], float(sys.argv[4])
heuristic = sys.argv[5] if len(sys.argv) > 5 else None
envs = gymnasium.make_vec(f"rl2grid/{task}-v0", num_envs=n, num_threads=1, heuristic=heuristic)
numbers, generator = envs.single_action_space.n, np.random.default_rng(0)
def actions():
    return generator.integers(numbers, size=n) if play == "random" else np.zeros(n, np.int64)
envs.reset(seed=0)
for _ in range(20):
    envs.step(actions())
began, spent, steps, ended = time.perf_counter(), time.process_time(), 0, 0
while time.perf_counter() - began < seconds:
    _, _, terminated, truncated, _ = envs.step(actions())
    steps += n
    ended += int((terminated | truncated).sum())
print(json.dumps({"decisions_per_s": steps / (time.process_time() - spent), "episodes": ended}))
"""
_THREADS = """
import json, statistics, sys, time
import gymnasium, numpy as np
import rl2grid
task, play, rounds = sys.argv[1], sys.argv[2], int(sys.argv[3])
n = 256
both = [gymnasium.make_vec(f"rl2grid/{task}-v0", num_envs=n, num_threads=k, heuristic=None) for k in (1, 2)]
numbers = both[0].single_action_space.n
for envs in both:
    envs.reset(seed=0)
seconds = []
for number in range(rounds + 1):
    took = []
    for envs in both:
        generator = np.random.default_rng(number)
        began = time.perf_counter()
        for _ in range(40):
            envs.step(generator.integers(numbers, size=n) if play == "random" else np.zeros(n, np.int64))
        took.append(time.perf_counter() - began)
    seconds.append(took)
ratios = [one / two for one, two in seconds[1:]]
median, least, most = (round(pick(ratios), 2) for pick in (statistics.median, min, max))
print(json.dumps({"two_over_one": {"median": median, "min": least, "max": most}}))
"""
_FIRST_STEP = """
import sys
import gymnasium, numpy as np
import rl2grid
envs = gymnasium.make_vec(f"rl2grid/{sys.argv[1]}-v0", num_envs=256, heuristic=None)
envs.reset(seed=0)
envs.step(np.zeros(256, np.int64))
"""
_GRID2OP = """
import json, sys
sys.path.insert(0, "benchmarks")
from engine import Grid2Op
from rl2grid.grids import load_grid
side = Grid2Op(load_grid(sys.argv[1]), "nothing")
side.microseconds(20)
print(json.dumps({"decisions_per_s": 1e6 / side.microseconds(int(sys.argv[2]))}))
"""


def grid_of(task: str) -> str:
    """``bus14`` of ``bus14-T0``."""
    return task.rpartition("-")[0]


def cases() -> dict[str, tuple[str, ...]]:
    """What is measured in both revisions: script and arguments, by name."""
    found: dict[str, tuple[str, ...]] = {}
    for task in TASKS:
        found[f"random {task}"] = (_PLAY, task, "256", "random", str(SECONDS))
        found[f"nothing {task}"] = (_PLAY, task, "64", "nothing", str(SECONDS))
        found[f"careful {task}"] = (_PLAY, task, "64", "random", str(SECONDS), "careful")
    return found


def output_of(source: Path, script: str, *arguments: str, data: Path | None = None) -> bytes:
    """What a script prints, in a process with the package of ``source``."""
    variables = {"PYTHONPATH": str(source / "src"), "OPENBLAS_NUM_THREADS": "1", "RL2GRID_QUIET": "1"}
    if data is not None:
        variables["RL2GRID_DATA"] = str(data)
    command = [sys.executable, "-c", script, *arguments]
    return subprocess.run(command, cwd=source, env=os.environ | variables, stdout=subprocess.PIPE, check=True).stdout


def run(source: Path, script: str, *arguments: str) -> dict[str, Any]:
    """The record that a script prints last."""
    return dict(json.loads(output_of(source, script, *arguments).splitlines()[-1]))


@contextmanager
def revision(name: str) -> Iterator[Path]:
    """A checkout of a revision of this repository."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(["git", "worktree", "add", "--detach", folder, name], cwd=ROOT, check=True, capture_output=True)
        try:
            yield Path(folder)
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", folder], cwd=ROOT, check=True)


def seconds_on_empty_folder(source: Path, script: str, *arguments: str) -> float:
    """How long a script takes with an empty data folder."""
    with tempfile.TemporaryDirectory() as data:
        began = time.perf_counter()
        output_of(source, script, *arguments, data=Path(data))
        return time.perf_counter() - began


def making_library(grid_id: str) -> str:
    """What makes the months of the library of a grid that are missing, in two processes."""
    command = ["data", "make", grid_id, "--split", "train", "--workers", "2"]
    return f"import sys; from rl2grid.cli.main import main; sys.exit(main({command!r}))"


def summary(values: list[float]) -> dict[str, float]:
    """Median and range."""
    return {"median": round(statistics.median(values), 1), "min": round(min(values), 1), "max": round(max(values), 1)}


def main() -> None:
    """Measure and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--before", required=True, help="revision to compare with")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", nargs="+", default=None, help="cases, by the beginning of their names")
    options = parser.parse_args()

    def is_wanted(name: str) -> bool:
        return options.only is None or name.startswith(tuple(options.only))

    result: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    result["command"] = shlex.join(["python", "benchmarks/training.py", *sys.argv[1:]])  # the last one
    grids = [grid_of(task) for task in TASKS]
    with revision(options.before) as old:
        for name, (script, *arguments) in cases().items():
            if not is_wanted(name):
                continue
            for source in (old, ROOT):
                output_of(source, making_library(grid_of(arguments[0])))
            rates: dict[str, list[float]] = {"before": [], "now": []}
            for number in range(options.rounds + 1):  # the first compiles what is missing
                for side, source in (("before", old), ("now", ROOT)):
                    rate = run(source, script, *arguments)["decisions_per_s"]
                    if number:
                        rates[side].append(rate)
            ratio = [now / before for now, before in zip(rates["now"], rates["before"], strict=True)]
            entry: dict[str, Any] = {"revision_before": options.before}
            entry |= {side: summary(values) for side, values in rates.items()} | {"now_over_before": summary(ratio)}
            if name.startswith("nothing"):
                peer = [
                    run(ROOT, _GRID2OP, grid_of(arguments[0]), str(GRID2OP_STEPS))["decisions_per_s"]
                    for _ in range(options.rounds)
                ]
                entry["grid2op"] = summary(peer)
                entry["now_over_grid2op"] = summary([a / b for a, b in zip(rates["now"], peer, strict=True)])
            write(result, name, entry)
    for task in TASKS:
        for play in ("random", "nothing"):
            if is_wanted(f"threads {task} {play}"):
                write(result, f"threads {task} {play}", run(ROOT, _THREADS, task, play, str(2 * options.rounds)))
    for grid, task in zip(grids, TASKS, strict=True):
        if is_wanted(f"first_step {task}"):
            values = [seconds_on_empty_folder(ROOT, _FIRST_STEP, task) for _ in range(options.rounds)]
            write(result, f"first_step {task}", {"seconds": summary(values)})
        if is_wanted(f"library {grid}"):
            seconds = seconds_on_empty_folder(ROOT, making_library(grid))
            write(result, f"library {grid}", {"seconds": summary([seconds])})


def write(result: dict[str, Any], name: str, entry: dict[str, Any]) -> None:
    """Keep an entry, and show it."""
    result[name] = entry
    print(name, json.dumps(entry), flush=True)
    RESULTS.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
