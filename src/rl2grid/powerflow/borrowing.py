"""Compilation without reference counting, for small functions that are handed many arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from rl2grid.compile import jit

Function = TypeVar("Function", bound=Callable[..., Any])
_RUNTIME = "_nrt"
"""Numba's option for its runtime, which counts references and frees arrays."""


def borrowing_jit(function: Function) -> Function:
    """Compile a function that borrows the arrays it is given: it makes none and returns none.

    Numba otherwise counts a reference to every array of every argument at each call, two atomic additions that cost
    more than a small power flow and that threads contend for. Callers, compiled or not, need not know.
    """
    compiled: Any = jit(function)
    compiled.targetoptions[_RUNTIME] = False
    return cast(Function, compiled)


def owning_jit(function: Function) -> Function:
    """Compile a function that makes arrays, although borrowing functions call it (callees inherit the option)."""
    compiled: Any = jit(function)
    compiled.targetoptions[_RUNTIME] = True
    return cast(Function, compiled)
