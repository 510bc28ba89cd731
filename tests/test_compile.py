"""Tests of :mod:`rl2grid.compile`."""

import ast
from pathlib import Path

import pytest

from rl2grid import compile as compile_module
from rl2grid.compile import INTERPRETED_LAYERS

PACKAGE = Path(compile_module.__file__).parent


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
