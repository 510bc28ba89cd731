"""Functions that compiled functions call are optimised with these, and are whole when Python calls them."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from rl2grid.compiled_files import keep_code_of
from rl2grid.compiled_parts import Part, Pipeline, Whole, part_for_compiled_callers

pytestmark = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")


def compiled(function: Any, folder: Path) -> Any:
    """As :func:`rl2grid.compile.jit` does, with files in a folder."""
    made = numba.njit(pipeline_class=Pipeline)(function)
    keep_code_of(made, folder)
    part_for_compiled_callers(made)
    return made


root: Any = None
norm: Any = None
distance: Any = None
below: Any = None


def _root(x):
    if x < 0.0:
        raise ValueError("below zero", x)
    return math.sqrt(x)


def _norm(vector):
    total = 0.0
    for x in vector:
        total += x * x
    return root(total)


def _distance(one, other):
    return norm(one - other) + root(0.0)


def _below(x):
    return root(-x)


@pytest.fixture
def begin(tmp_path: Path) -> Callable[[], None]:
    """Makes the functions as a process that begins has them; files stay."""

    def made() -> None:
        global root, norm, distance, below
        root, norm = compiled(_root, tmp_path), compiled(_norm, tmp_path)
        distance, below = compiled(_distance, tmp_path), compiled(_below, tmp_path)

    made()
    return made


def kinds(function: Any) -> list[type]:
    return [type(result.library) for result in function.overloads.values()]


def test_what_python_calls_is_whole_and_what_it_calls_a_part(begin: Callable[[], None], tmp_path: Path):
    one, other = np.array([4.0, 1.0]), np.array([1.0, 5.0])
    assert distance(one, other) == 5.0
    assert (kinds(root), kinds(norm), kinds(distance)) == ([Part], [Part], [Whole])
    assert {path.suffix for path in tmp_path.rglob("*distance*")} >= {".nbi", ".nbc"}
    assert not list(tmp_path.rglob("*norm*.nbc")), "parts are not kept"
    assert norm(one - other) == 5.0, "called from Python, it gets machine code of its own"
    assert (kinds(root), kinds(norm)) == ([Part], [Whole])
    assert list(tmp_path.rglob("*norm*.nbc"))
    assert distance(one, other) == 5.0, "callers are none the wiser"


def test_a_whole_serves_callers_as_well(begin: Callable[[], None]):
    assert root(9.0) == 3.0
    assert distance(np.array([4.0, 1.0]), np.array([1.0, 5.0])) == 5.0
    assert (kinds(root), kinds(norm)) == ([Whole], [Part])


def test_another_process_finds_the_whole_with_its_parts(begin: Callable[[], None]):
    one = np.array([3.0, 4.0])
    assert norm(one) == 5.0
    begin()
    assert norm(one) == 5.0
    assert sum(norm.stats.cache_hits.values()) == 1
    assert kinds(root) == [], "nothing of it is compiled"


def test_what_a_part_raises_reaches_python(begin: Callable[[], None]):
    for expected in ([Part], []):  # compiled, and from the file
        begin()
        with pytest.raises(ValueError, match=r"below zero.*-2.0"):
            below(2.0)
        assert kinds(root) == expected


def test_functions_compiled_by_numba_alone_may_call_parts(begin: Callable[[], None]):
    @numba.njit
    def twice(vector):
        return 2.0 * norm(vector)

    assert twice(np.array([3.0, 4.0])) == 10.0
    assert kinds(norm) == [Part]
