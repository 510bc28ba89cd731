"""What the first call compiles: processor time, and what is compiled more than once.

``python benchmarks/compilation.py`` makes a vector of environments, resets and steps it on an empty folder of compiled
code, in a process of its own, and writes ``benchmarks/results/compilation.json``: seconds of processor time until the
first step, the functions that take longest themselves, and those that Numba compiles for several types of arguments
(a literal is a type of its own: :func:`rl2grid.compile.int64`).
"""

from __future__ import annotations

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

    began = time.process_time()
    envs = gymnasium.make_vec("rl2grid/bus14-T0-v0", num_envs=4, heuristic="idle", num_threads=1)
    envs.reset(seed=0)
    envs.step([0] * 4)
    seconds = time.process_time() - began
    envs.close()
    longest = {name: round(value, 1) for name, value in spent.most_common(LONGEST)}
    return {"processor_seconds": round(seconds, 1), "functions": len(spent), "longest": longest}


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
    """Measure in a new process, and write what came out."""
    if "--here" in sys.argv:
        print(json.dumps(measure()))
        return
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"XDG_CACHE_HOME": folder, "RL2GRID_QUIET": "1"}
        command = [sys.executable, __file__, "--here"]
        done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
        several = compiled_again(Path(folder))
    result = {"command": "python benchmarks/compilation.py", "processor": processor(), **json.loads(done.stdout)}
    write_json(RESULTS, {**result, "compiled_again": several})
    print(json.dumps({**result, "compiled_again": several}, indent=1))


if __name__ == "__main__":
    main()
