"""The tests that the documentation names exist."""

import ast
import re
from pathlib import Path

TESTS = Path(__file__).parent
PAGE = TESTS.parent / "docs" / "pitfalls.md"


def named_tests() -> set[tuple[str, str]]:
    """Files and functions that the page names."""
    return set(re.findall(r"`([\w/]+\.py)::(\w+)`", PAGE.read_text(encoding="utf-8")))


def functions_of(file: str) -> set[str]:
    body = ast.parse((TESTS / file).read_text(encoding="utf-8")).body
    return {node.name for node in body if isinstance(node, ast.FunctionDef)}


def test_every_test_that_is_named_exists() -> None:
    named = named_tests()
    assert len(named) > 30
    missing = [f"{file}::{name}" for file, name in sorted(named) if name not in functions_of(file)]
    assert not missing


def test_every_pitfall_names_a_test() -> None:
    text = PAGE.read_text(encoding="utf-8").split("## Formulas")[0]
    rows = [line for line in text.splitlines() if line.startswith("| ") and not line.startswith("| Pitfall")]
    assert len(rows) == 29
    for row in rows:
        pitfall, consequence, test = (cell.strip() for cell in row.strip("|").split("|"))
        assert pitfall
        assert consequence.endswith(".")
        assert "::test_" in test
