"""What the first seconds cost: commands that only say something, imports, and the first episode.

``python benchmarks/start_up.py [--rounds 15]`` starts every command of :data:`COMMANDS` in turn, each in a process of
its own, so many times after a first one that does not count, and writes ``benchmarks/results/start_up.json``: medians
of the seconds of processor time (user and system) and of wall time, from the start of the process to its end. A
process that reports how far it is before it ends, the last one, is measured until then too. ``python -c pass`` and
``import numpy`` say how fast the machine is at that moment.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from rl2grid.records.files import write_json
from rl2grid.records.versions import processor

RESULTS = Path(__file__).resolve().parent / "results" / "start_up.json"
MAKE_AND_RESET = (
    "import gymnasium, rl2grid; "
    "env = gymnasium.make('rl2grid/bus14-T0-v0', heuristic='idle', split='validation'); env.reset(seed=0); "
    "import time; print(time.process_time(), time.time())"
)
COMMANDS: dict[str, list[str]] = {
    "python -c pass": ["-c", "pass"],
    "import numpy": ["-c", "import numpy"],
    "import gymnasium": ["-c", "import gymnasium"],
    "import rl2grid": ["-c", "import rl2grid"],
    "import gymnasium, rl2grid": ["-c", "import gymnasium, rl2grid"],
    "rl2grid --help": ["-m", "rl2grid", "--help"],
    "rl2grid --version": ["-m", "rl2grid", "--version"],
    "rl2grid tasks": ["-m", "rl2grid", "tasks"],
    "make and reset": ["-c", MAKE_AND_RESET],
}
"""What is measured, and what Python is given; the last has its months and compiled code from the run before."""
REPORTING = {"make and reset": "make and reset, until the first observation"}
"""Commands that print their processor time and the time of day when their work is done, and what that is called."""


def seconds(arguments: list[str]) -> tuple[tuple[float, float], str]:
    """Processor and wall time of a process from its start to its end, and what it printed."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run([sys.executable, *arguments], stdout=subprocess.PIPE, text=True, check=True)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    return (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall), done.stdout


def measure(rounds: int) -> dict[str, dict[str, float]]:
    """Medians by command; commands take turns, so that a load of the machine is a load on all."""
    taken: dict[str, list[tuple[float, float]]] = {}
    for number in range(rounds + 1):
        for name, arguments in COMMANDS.items():
            began = time.time()
            spent, printed = seconds(arguments)
            if not number:
                continue
            taken.setdefault(name, []).append(spent)
            if name in REPORTING:
                used, at = map(float, printed.split())
                taken.setdefault(REPORTING[name], []).append((used, at - began))
    return {name: _medians(spent) for name, spent in taken.items()}


def _medians(spent: list[tuple[float, float]]) -> dict[str, float]:
    processor_seconds, wall_seconds = (round(statistics.median(column), 3) for column in zip(*spent, strict=True))
    return {"processor_seconds": processor_seconds, "wall_seconds": wall_seconds}


def main() -> None:
    """Measure and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=15)
    rounds = parser.parse_args().rounds
    result: dict[str, Any] = {"command": f"python benchmarks/start_up.py --rounds {rounds}", "processor": processor()}
    measured = measure(rounds)
    for name, spent in measured.items():
        print(f"{name:44} {spent['processor_seconds']:.3f} s of processor time, {spent['wall_seconds']:.3f} s")
    write_json(RESULTS, {**result, "medians": measured})


if __name__ == "__main__":
    main()
