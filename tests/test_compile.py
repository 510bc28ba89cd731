"""Tests of :mod:`rl2grid.compile`."""

import ast
from pathlib import Path

import numba
import numpy as np
import pytest

from rl2grid import compile as compile_module
from rl2grid.arrays import I64
from rl2grid.compile import INTERPRETED_LAYERS, jit

PACKAGE = Path(compile_module.__file__).parent


@jit
def _chosen(values: I64, place: int, doubled: bool) -> int:
    return 2 * int(values[place]) if doubled else int(values[place])


@jit
def _chosen_by_literals(values: I64, place: int) -> int:
    return _chosen(values, 0, True) + _chosen(values, 1, False) + _chosen(values, place, place > 1)


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")
def test_literals_of_callers_compile_a_function_once() -> None:
    assert _chosen_by_literals.py_func(np.arange(5, 8), 2) == _chosen_by_literals(np.arange(5, 8), 2) == 10 + 6 + 14
    types = {signature[1:] for signature in _chosen.signatures}  # type: ignore[attr-defined]
    assert types == {(numba.int64, numba.boolean)}


@pytest.mark.parametrize("layer", INTERPRETED_LAYERS)
def test_layers_left_out_of_the_cache_key_compile_nothing(layer: str) -> None:
    sources = sorted((PACKAGE / layer).rglob("*.py"))
    assert sources
    for source in sources:
        for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module == "rl2grid.compile":
                assert "jit" not in {name.name for name in node.names}, source
            if isinstance(node, ast.Import):
                assert "numba" not in {name.name.split(".")[0] for name in node.names}, source
            if isinstance(node, ast.ImportFrom) and node.module:
                assert node.module.split(".")[0] != "numba", source
