"""What the first call compiles: processor time, wall time alone and with a process beside, and what is compiled twice.

``python benchmarks/compilation.py [--rounds 1]`` makes a vector of environments, resets and steps it on an empty folder
of compiled code, in a process of its own, and writes ``benchmarks/results/compilation.json``: seconds until the first
step, of processor time (of the process itself) and of wall time, where it compiles alone and where another process
compiles beside it (:mod:`rl2grid.compile_beside`), in turn, so many times, with the load of the machine before each; of
the first time alone the functions that take longest themselves, and those that Numba compiles for several types of
arguments (a literal is a type of its own: :func:`rl2grid.compile.int64`). Years of training are made by the process
itself in both.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from rl2grid.compile_beside import VARIABLE
from rl2grid.records.files import write_json
from rl2grid.records.versions import processor

RESULTS = Path(__file__).resolve().parent / "results" / "compilation.json"
LONGEST = 12


def measure() -> dict[str, Any]:
    """Compile in this process, whose folder of compiled code is empty."""
    from numba.core import event

    spent: Counter[str] = Counter()
    running: list[list[Any]] = []

    class Clock(event.Listener):  # type: ignore[misc]
        """Adds up the time of every function without that of those that it calls."""

        def on_start(self, what: Any) -> None:
            function = what.data["dispatcher"].py_func
            running.append([f"{function.__module__}.{function.__name__}", time.process_time(), 0.0])

        def on_end(self, what: Any) -> None:
            name, began, inside = running.pop()
            seconds = time.process_time() - began
            spent[name] += seconds - inside
            if running:
                running[-1][2] += seconds

    event.register("numba:compile", Clock())
    import gymnasium

    import rl2grid  # noqa: F401 - registers the tasks

    began, wall = time.process_time(), time.perf_counter()
    envs = gymnasium.make_vec("rl2grid/bus14-T0-v0", num_envs=4, heuristic="idle", num_threads=1)
    envs.reset(seed=0)
    envs.step([0] * 4)
    seconds, wall = time.process_time() - began, time.perf_counter() - wall
    envs.close()
    longest = {name: round(value, 1) for name, value in spent.most_common(LONGEST)}
    measured = {"processor_seconds": round(seconds, 1), "wall_seconds": round(wall, 1)}
    return {**measured, "functions": len(spent), "longest": longest}


def measure_elsewhere(compilers: int) -> dict[str, Any]:
    """:func:`measure` in a new process with as many beside it, and what it compiled for several types."""
    load = round(os.getloadavg()[0], 1)
    with tempfile.TemporaryDirectory() as folder:
        settings = {"XDG_CACHE_HOME": folder, "RL2GRID_QUIET": "1", "RL2GRID_MAKERS": "0", VARIABLE: str(compilers)}
        command = [sys.executable, __file__, "--here"]
        done = subprocess.run(command, env=os.environ | settings, stdout=subprocess.PIPE, text=True, check=True)
        return {"load": load, **json.loads(done.stdout), "compiled_again": compiled_again(Path(folder))}


def compiled_again(folder: Path) -> dict[str, int]:
    """Functions that were compiled for several types, and for how many, from the indexes of Numba's files."""
    several = {}
    for path in sorted(folder.rglob("*.nbi")):
        with path.open("rb") as file:
            pickle.load(file)  # the version of Numba
            _, overloads = pickle.loads(file.read())
        if len(overloads) > 1:
            several[path.name.partition(".py3")[0]] = len(overloads)
    return several


def main() -> None:
    """Measure in new processes, and write what came out."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--here", action="store_true", help="measure in this process")
    options = parser.parse_args()
    if options.here:
        print(json.dumps(measure()))
        return
    rounds = [[measure_elsewhere(compilers) for compilers in (0, 1)] for _ in range(options.rounds)]
    alone = rounds[0][0]
    result = {
        "command": f"python benchmarks/compilation.py --rounds {options.rounds}",
        "processor": processor(),
        **{name: alone[name] for name in ("processor_seconds", "functions", "longest", "compiled_again")},
        "alone": [_times(one) for one, _ in rounds],
        "with_another_process": [_times(other) for _, other in rounds],
    }
    write_json(RESULTS, result)
    print(json.dumps(result, indent=1))


def _times(measured: dict[str, Any]) -> dict[str, Any]:
    return {name: measured[name] for name in ("load", "processor_seconds", "wall_seconds", "functions")}


if __name__ == "__main__":
    main()
