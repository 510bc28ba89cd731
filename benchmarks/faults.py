"""Which faults, put into the code on purpose, the tests of ``make test`` notice.

``python benchmarks/faults.py [NAME|PART ...]`` puts the faults of ``benchmarks/faults.toml``, one at a time, into a
copy of the package, runs the tests of the changed part until one fails, and writes ``benchmarks/results/faults.json``:
the first test that fails for each, or null for a fault that none notices. Without a fault all of them must pass.
``--tests FOLDER`` takes the tests of another version, with whose results those of today are compared.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rl2grid.records.files import write_json
from rl2grid.scenarios.cache import data_folder

ROOT = Path(__file__).resolve().parents[1]
FAULTS = Path(__file__).resolve().parent / "faults.toml"
RESULTS = Path(__file__).resolve().parent / "results" / "faults.json"
TESTS = {
    "engine": (
        ("engines/test_native_parity.py", "engines/test_joint_actions.py"),
        ("mdp", "engines", "powerflow", "envs"),
    ),
    "algorithms": (("algorithms", "training"),),
    "records": (("records", "evaluation", "ledger", "studies", "analysis", "cli"),),
}
"""Tests that are run for a fault of each part of the code, one group after the other: first those that play most."""


@dataclass(frozen=True)
class Fault:
    """One change that makes the code wrong."""

    name: str
    part: str
    """A key of :data:`TESTS`."""
    file: str
    """Below ``src/rl2grid``."""
    find: str
    """Stands in the file once."""
    replace: str


def read_faults() -> list[Fault]:
    """All faults of the list."""
    return [Fault(**entry) for entry in tomllib.loads(FAULTS.read_text(encoding="utf-8"))["fault"]]


class Copy:
    """A copy of the package, made wrong and right again in one place: code that a fault leaves alone stays compiled."""

    def __init__(self, scratch: Path) -> None:
        self._scratch = scratch
        self._source = scratch / "src"
        shutil.copytree(ROOT / "src", self._source, ignore=shutil.ignore_patterns("__pycache__"))

    @contextlib.contextmanager
    def with_fault(self, fault: Fault) -> Iterator[None]:
        """Change the copy for a while.

        Raises:
            SystemExit: the text to change does not stand in the file exactly once.
        """
        path = self._source / "rl2grid" / fault.file
        text = path.read_text(encoding="utf-8")
        times = text.count(fault.find)
        if times != 1:
            raise SystemExit(f"{fault.name}: {fault.find!r} stands {times} times in {fault.file}, not once.")
        path.write_text(text.replace(fault.find, fault.replace), encoding="utf-8")
        try:
            yield
        finally:
            path.write_text(text, encoding="utf-8")

    def first_failure(self, part: str, tests: Path) -> str | None:
        """The first of the tests for a part of the code that fails, None if all pass."""
        # Compiled code of a faulty version is of no use to anyone; the months are those of all versions.
        environment = os.environ | {
            "PYTHONPATH": f"{self._source}:{tests}",
            "PYTHONDONTWRITEBYTECODE": "1",
            "XDG_CACHE_HOME": str(self._scratch),
            "RL2GRID_DATA": str(data_folder()),
            "OPENBLAS_NUM_THREADS": "1",
        }
        for group in TESTS[part]:
            paths = [str(tests / name) for name in group if (tests / name).exists()]
            command = [sys.executable, "-m", "pytest", "-m", "not slow", "-x", "-q", "-p", "no:cacheprovider", *paths]
            finished = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
            if finished.returncode != 0:
                return _first_failed(finished)
        return None


def _first_failed(finished: subprocess.CompletedProcess[str]) -> str:
    """The test that a run of pytest stopped at."""
    lines = [line for line in finished.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    failed = [line.split(" ", 1)[1].split(" - ")[0] for line in lines]
    return failed[0].removeprefix("tests/") if failed else f"exit status {finished.returncode}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="faults to put in, or parts of the code; all if left out")
    parser.add_argument("--tests", type=Path, default=ROOT / "tests", help="folder of the tests")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    results = json.loads(options.output.read_text(encoding="utf-8")) if options.output.is_file() else {}
    chosen = [fault for fault in read_faults() if not options.names or {fault.name, fault.part} & {*options.names}]
    with tempfile.TemporaryDirectory() as scratch:
        copy = Copy(Path(scratch))
        for fault in chosen:
            begun = time.monotonic()
            with copy.with_fault(fault):
                results[fault.name] = copy.first_failure(fault.part, options.tests)
            print(
                f"{fault.name}: {results[fault.name] or 'NOT NOTICED'} ({time.monotonic() - begun:.0f} s)", flush=True
            )
            write_json(options.output, results, indent=1)
    print(f"{sum(value is not None for value in results.values())} of {len(results)} noticed")


if __name__ == "__main__":
    main()
