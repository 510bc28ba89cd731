"""Compiles the transition of environments in a process beside the one that will play them.

A process that makes its first environment compiles what makes months, then what begins episodes, and at last what plays
them, which is half of all. This module, run as a program, begins with the last.
"""

from __future__ import annotations

from numba import types

from rl2grid.compile import cache_directory
from rl2grid.compile_beside import compile_beside, end_with_the_parent, take_turn
from rl2grid.compiled_files import is_kept
from rl2grid.engines.native.advance import advance
from rl2grid.engines.native.environments import SEPARATE

_MODULE = "rl2grid.engines.native.compile_ahead"
_NUMBERS = types.Array(types.int64, 1, "C")
SIGNATURE = (
    types.int64,  # address
    types.int64,  # simulated
    types.int64,  # security
    _NUMBERS,  # rows
    _NUMBERS,  # order
    _NUMBERS,  # counter
    types.int64,  # abreast
    types.boolean,  # begins
    _NUMBERS,  # first
    _NUMBERS,  # end
    _NUMBERS,  # kinds
    _NUMBERS,  # targets
    types.Array(types.uint64, 2, "C"),  # masks
    types.Array(types.boolean, 1, "C"),  # injects
    types.Array(types.float32, 2, "C"),  # values
    types.int64,  # heuristic
    types.int64,  # reward
    types.UniTuple(types.float64, 3),  # weights
    types.float64,  # gamma
)
"""With which :func:`~rl2grid.engines.native.advance.advance` is called."""


def compile_ahead() -> None:
    """Have the transition compiled beside this process, if it has not been compiled."""
    if not is_kept(advance, SIGNATURE):
        compile_beside(_MODULE, cache_directory())


def _compile() -> None:
    end_with_the_parent()
    turn = take_turn(cache_directory())
    if turn is not None:
        advance.compile(SIGNATURE)  # type: ignore[attr-defined]
        for function in reversed(SEPARATE):  # the parent comes from the other end
            function.ready()
        turn.release()


if __name__ == "__main__":
    _compile()
