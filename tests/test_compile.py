"""Tests of :mod:`rl2grid.compile`."""

import ast
import functools
from pathlib import Path
from typing import Annotated, NamedTuple

import numba
import numpy as np
import pytest

from rl2grid import compile as compile_module
from rl2grid.arrays import F64, I32, I64
from rl2grid.compile import INTERPRETED_LAYERS, INTERPRETED_MODULES, jit
from rl2grid.handles import Handle, opener
from rl2grid.structures import allocate, constant, row

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


class _Limits(NamedTuple):
    limit: Annotated[F64, constant("line")]


class _Lines(NamedTuple):
    load: Annotated[I32, row("line")]
    limits: _Limits


class _Undeclared(NamedTuple):
    limit: F64


_open_lines = opener(_Lines)


@jit
def _overloads(lines: _Lines, i: int) -> int:
    return int((lines.load[i] > lines.limits.limit).sum())


@jit
def _overloads_at(address: int, i: int) -> int:
    return _overloads(_open_lines(address), i)


@jit
def _raised(limits: _Undeclared, by: float) -> float:
    return float(limits.limit.max()) + by


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")
def test_structures_from_python_and_of_callers_compile_a_function_once() -> None:
    limits = allocate(_Limits, {"line": 3}, limit=np.array([1.0, 2.0, 3.0]))
    lines = allocate(_Lines, {"line": 3}, 2, limits=limits, load=np.array([[1, 3, 5], [9, 9, 3]], np.int32))
    assert [_overloads(lines, i) for i in (0, 1)] == [_overloads.py_func(lines, i) for i in (0, 1)] == [2, 2]  # type: ignore[attr-defined]
    handle = Handle(lines)
    assert _overloads_at(handle.address, 0) == _overloads(handle, 1) == 2  # type: ignore[arg-type]
    assert len(_overloads.signatures) == 1  # type: ignore[attr-defined]
    lines.load[1] = 0
    assert _overloads(lines, 1) == 0


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")
def test_a_structure_from_python_is_what_it_was_declared_as() -> None:
    limits = allocate(_Limits, {"line": 3})
    turned = np.zeros((3, 2), np.int32).T
    with pytest.raises(TypeError, match=r"_Lines.load has to be a contiguous int32 array with 2 axes"):
        _overloads(_Lines(turned, limits), 0)


def test_a_tuple_that_is_no_structure_is_compiled_as_one_array_after_the_other() -> None:
    assert _raised(_Undeclared(np.array([0.5, 2.0])), 1) == 3


def _compiles(source: Path) -> bool:
    """Whether a module has compiled functions: what it would need for them is imported."""
    nodes = list(ast.walk(ast.parse(source.read_text(encoding="utf-8"))))
    whole = {name.name for node in nodes if isinstance(node, ast.Import) for name in node.names}
    parts = {(node.module, name.name) for node in nodes if isinstance(node, ast.ImportFrom) for name in node.names}
    ours = {("rl2grid.compile", name) for name in ("jit", "borrowing_jit", "owning_jit")}
    return bool(parts & ours) or "numba" in {
        name.partition(".")[0] for name in whole | {str(each) for each, _ in parts}
    }


@pytest.mark.parametrize("layer", INTERPRETED_LAYERS)
def test_layers_left_out_of_the_cache_key_compile_nothing(layer: str) -> None:
    sources = sorted((PACKAGE / layer).rglob("*.py"))
    assert sources
    assert not [source for source in sources if _compiles(source)]


def _is_compiled(node: ast.AST) -> bool:
    return isinstance(node, ast.FunctionDef) and any("jit" in ast.unparse(each) for each in node.decorator_list)


@functools.cache
def _names_in_compiled_functions() -> dict[Path, tuple[dict[str, tuple[str, str]], set[str]]]:
    """By source: what each imported name may be, a module or something in one, and the names in compiled functions."""
    found = {}
    for source in PACKAGE.rglob("*.py"):
        nodes = list(ast.walk(ast.parse(source.read_text(encoding="utf-8"))))
        imports = [node for node in nodes if isinstance(node, ast.ImportFrom) and node.module]
        imported = {
            name.asname or name.name: (str(node.module), f"{node.module}.{name.name}")
            for node in imports
            for name in node.names
        }
        compiled = [inner for node in nodes if _is_compiled(node) for inner in ast.walk(node)]
        found[source] = imported, {node.id for node in compiled if isinstance(node, ast.Name)}
    return found


@pytest.mark.parametrize("module", INTERPRETED_MODULES)
def test_modules_left_out_of_the_cache_key_are_not_used_by_compiled_functions(module: str) -> None:
    assert (PACKAGE / module).is_file()
    dotted = ".".join(["rl2grid", *Path(module).with_suffix("").parts]).removesuffix(".__init__")
    for source, (imported, used) in _names_in_compiled_functions().items():
        assert not used or source != PACKAGE / module
        known = {name for name, origins in imported.items() if dotted in origins}
        assert not known & used, source


def _key(package: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(compile_module, "__file__", str(package / "compile.py"))
    return str(compile_module.cache_directory.__wrapped__().name)


def test_the_cache_key_is_of_what_compiled_functions_use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    uncounted = [*INTERPRETED_MODULES, *(f"{layer}/module.py" for layer in INTERPRETED_LAYERS)]
    counted = ["compile.py", "compiled_files.py", "handles.py", "memory.py", "engines/native/advance.py"]
    for name in (*counted, *uncounted):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    keys = [_key(tmp_path, monkeypatch)]
    for name in uncounted:
        (tmp_path / name).write_text("edited")
    assert _key(tmp_path, monkeypatch) == keys[0]
    for name in counted:
        (tmp_path / name).write_text("edited")
        keys.append(_key(tmp_path, monkeypatch))
    assert len(set(keys)) == 1 + len(counted)
