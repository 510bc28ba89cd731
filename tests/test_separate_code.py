"""Compiled functions that are called by address: the same results, whoever compiled them, in whichever process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

PROGRAM = """
from typing import Annotated, NamedTuple

import numpy as np

from rl2grid.arrays import F64
from rl2grid.compile import jit
from rl2grid.handles import Handle, opener
from rl2grid.separate_code import Separate, separate_jit
from rl2grid.structures import allocate, row


class Rows(NamedTuple):
    values: Annotated[F64, row("entry")]


SEPARATE: list[Separate] = []
separate = separate_jit(Rows, SEPARATE)
open_rows = opener(Rows)


@separate
def total(rows, i):
    found = 0
    for k in range(rows.values.shape[1]):
        found += int(rows.values[i, k])
    return found


@separate
def total_beyond(rows, i):
    return total(rows, i) + (total(rows, i + 1) if i + 1 < rows.values.shape[0] else 0)


@jit
def ask(address, n):
    rows, found = open_rows(address), 0
    for i in range(n):
        found += total_beyond(rows, i)
    return found


rows = allocate(Rows, {"entry": 5}, 3)
rows.values[:] = np.arange(15).reshape(3, 5)
handle = Handle(rows)
if __name__ == "__main__":
    import sys

    if "ready" in sys.argv:
        for function in SEPARATE:
            function.ready()
            function.ready()
    print(ask(handle.address, 3), ask(handle.address, 3), len(ask.stats.cache_hits))
"""
EXPECTED = "200 200"
"""10 + 35 + 60 and, beyond the first row, 35 + 60."""


def run(program: Path, cache: Path, *arguments: str) -> list[str]:
    environment = os.environ | {"XDG_CACHE_HOME": str(cache), "RL2GRID_QUIET": "1"}
    done = subprocess.run(
        [sys.executable, str(program), *arguments], env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.rsplit(maxsplit=1)


def test_separate_functions_are_found_by_callers_of_this_process_and_of_others(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    cache = tmp_path / "cache"
    assert run(program, cache) == [EXPECTED, "0"], "compiled here, when it was first called"
    assert run(program, cache) == [EXPECTED, "1"], "the caller's code of another process finds this one's function"
    assert run(program, cache, "ready") == [EXPECTED, "1"], "made ready before it is called"


def test_without_compilation_functions_stay_what_they_are(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    code = "import program; print(program.total_beyond(program.rows, 1), program.SEPARATE)"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(tmp_path)},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.split(maxsplit=1) == ["95", "[]\n"]
