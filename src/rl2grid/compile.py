"""Compilation of the small numerical functions, cached on disk between runs.

Numba's on-disk cache notices an edit of the file that defines a function, but not of the functions
that it calls. The cache directory is therefore keyed by a hash of the sources and by Numba's version:
an edit begins a fresh cache, and nothing stale is ever run. What compiled functions do not use does not count.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import platformdirs
from numba.core.types.misc import unliteral

from rl2grid import compile_notices
from rl2grid.compiled_files import keep_code_of
from rl2grid.compiled_parts import Pipeline, part_for_compiled_callers
from rl2grid.handles import opened
from rl2grid.structures import is_structure

compile_notices.install()

Function = TypeVar("Function", bound=Callable[..., Any])

_RUNTIME = "_nrt"
"""Numba's option for its runtime, which counts references and frees arrays."""

INTERPRETED_LAYERS = (
    "agents", "algorithms", "analysis", "cli", "drawing", "envs", "evaluation", "ledger", "records", "studies",
    "training",
)  # fmt: skip
"""Subpackages without compiled functions: an edit of them leaves the compiled ones what they are."""

INTERPRETED_MODULES = (
    "__init__.py", "__main__.py", "benchmark.py", "compile_beside.py", "compile_locks.py", "compile_notices.py",
    "errors.py", "processes.py", "engines/native/compile_ahead.py",
)  # fmt: skip
"""Modules beside compiled functions nothing of which they use: what takes part in an import, says something, or starts
processes."""


@functools.cache
def cache_directory() -> Path:
    """Where compiled code of exactly the present sources is kept."""
    package = Path(__file__).resolve().parent
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sorted(package.rglob("*.py")):
        name = path.relative_to(package)
        if name.parts[0] in INTERPRETED_LAYERS or name.as_posix() in INTERPRETED_MODULES:
            continue
        digest.update(name.as_posix().encode())
        digest.update(path.read_bytes())
    return Path(platformdirs.user_cache_dir("rl2grid")) / "numba" / digest.hexdigest()[:16]


def jit(function: Function) -> Function:
    """Compile ``function`` on first use and keep the machine code between runs.

    Division by zero follows NumPy, and floating point stays strict: results do not depend on how
    a loop is vectorised.
    """
    compiled: Function = numba.njit(error_model="numpy", nogil=True, pipeline_class=Pipeline)(function)
    keep_code_of(compiled, cache_directory())
    part_for_compiled_callers(compiled)
    _take_literals_as_numbers(compiled)
    _take_structures_as_opened(compiled)
    return compiled


def borrowing_jit(function: Function) -> Function:
    """:func:`jit` for a function that borrows the arrays it is given: it makes none and returns none.

    Numba otherwise counts a reference to every array of every argument at each call, two atomic additions that cost
    more than a small power flow and that threads contend for. Callers, compiled or not, need not know.
    """
    compiled: Any = jit(function)
    compiled.targetoptions[_RUNTIME] = False
    return cast(Function, compiled)


def owning_jit(function: Function) -> Function:
    """:func:`jit` for a function that makes arrays, although borrowing functions call it (callees inherit that)."""
    compiled: Any = jit(function)
    compiled.targetoptions[_RUNTIME] = True
    return cast(Function, compiled)


def _take_literals_as_numbers(compiled: Any) -> None:
    """Compile a function once for ``f(0)``, ``f(1)`` and ``f(i)``.

    For Numba every literal that a compiled caller gives is a type of its own, for which the function and all that it
    calls are compiled again: most of the engine, twice.
    """
    if not hasattr(compiled, "get_call_template"):  # Numba is told not to compile
        return
    typed = compiled.get_call_template

    def get_call_template(args: tuple[Any, ...], kws: dict[str, Any]) -> Any:
        return typed(tuple(map(unliteral, args)), {name: unliteral(kind) for name, kind in kws.items()})

    compiled.get_call_template = get_call_template


def _take_structures_as_opened(compiled: Any) -> None:
    """Compile a function once for a structure, whether compiled code or Python hands it over.

    For Numba the NamedTuple is a type of its own, and all of its arrays are arguments: the function and all that it
    calls would be compiled again, for several times as long.
    """
    if not hasattr(compiled, "_compile_for_args"):  # Numba is told not to compile
        return
    compile_for = compiled._compile_for_args

    def call_opened(*arguments: Any) -> Any:
        return compiled(*map(opened, arguments))

    def compile_for_args(*arguments: Any) -> Any:
        """What Numba calls, with the same arguments."""
        return call_opened if any(map(is_structure, map(type, arguments))) else compile_for(*arguments)

    compiled._compile_for_args = compile_for_args
