"""Twenty first runs at once: programs that all find an empty data folder and no compiled code, and share both.

``python benchmarks/first_runs.py [--number 20]`` starts so many programs at the same moment on one new folder:
evaluations, trainings, a ranking and the making of months in turn. All must end well, those that do the same with the
same, and nothing half written may stay. Writes ``benchmarks/results/first_runs.json``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from kills import PROGRAM, SUBJECTS, Subject

from rl2grid.records.files import write_json

RESULTS = Path(__file__).resolve().parent / "results" / "first_runs.json"
NAMES = ("evaluate", "train ppo", "make months", "train sac", "rank")
"""Subjects of ``kills.py``."""


def start(subject: Subject, folder: Path, data: Path) -> subprocess.Popen[bytes]:
    """Start a program on the common data folder."""
    folder.mkdir()
    environment = os.environ | {"RL2GRID_DATA": str(data), "XDG_CACHE_HOME": str(data)}
    with folder.with_name(f"{folder.name}.log").open("wb") as log:
        return subprocess.Popen(
            [*PROGRAM, *subject.first(folder)], stdout=log, stderr=subprocess.STDOUT, env=environment
        )


def run(number: int, root: Path) -> dict[str, Any]:
    """Start them all, wait, and compare what they leave."""
    subjects = {one.name: one for one in SUBJECTS}
    data, began = root / "data", time.monotonic()
    names = [NAMES[i % len(NAMES)] for i in range(number)]
    folders = [root / f"{i}" for i in range(number)]
    processes = [start(subjects[name], folder, data) for name, folder in zip(names, folders, strict=True)]
    failures, left = [], dict[str, str]()
    for name, folder, process in zip(names, folders, processes, strict=True):
        code = process.wait()
        if code:
            lines = folder.with_name(f"{folder.name}.log").read_text(errors="replace").strip().splitlines()
            failures.append(f"{name}: exit status {code}: {' / '.join(lines[-2:])[-300:]}")
            continue
        result = json.dumps(subjects[name].left(data if subjects[name].own_data else folder), sort_keys=True)
        if left.setdefault(name, result) != result:
            failures.append(f"{name}: left something else than the first one")
    files = [path for path in data.rglob("*") if path.is_file()]
    temporary = [str(path.relative_to(data)) for path in files if path.name.startswith(".")]
    return {
        "programs": number,
        "seconds": round(time.monotonic() - began),
        "failures": failures + [f"left behind: {name}" for name in temporary],
        "files": len(files),
        "megabytes": round(sum(path.stat().st_size for path in files) / 1e6),
    }


def main() -> int:
    """Start them all, write the result, and say whether anything failed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--number", type=int, default=20)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        result = run(options.number, Path(scratch))
    command = f"python benchmarks/first_runs.py --number {options.number}"
    print(result)
    write_json(RESULTS, {"command": command, **result}, indent=1)
    return 1 if result["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
