"""Numbers in memory that compiled code shares: read where somebody has mapped them, or counted by several threads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.extending import intrinsic

from rl2grid.arrays import Index


def _reader(number: types.Number) -> Callable[[Index, Index], Any]:
    """A function for compiled code: the number so many places after an address."""

    @intrinsic  # type: ignore[untyped-decorator]
    def number_at(typing_context: Any, address: Any, index: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            pointer = builder.inttoptr(arguments[0], context.get_data_type(number).as_pointer())
            return builder.load(builder.gep(pointer, [arguments[1]]))

        return number(types.int64, types.int64), generate

    result: Callable[[Index, Index], Any] = number_at
    return result


float32_at, int16_at = _reader(types.float32), _reader(types.int16)


@intrinsic  # type: ignore[untyped-decorator]
def take_next(typing_context: Any, counter: Any) -> Any:
    """The number at the address ``counter``, int64, which is one more afterwards: no two threads are given the same."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        word = ir.IntType(64)
        return builder.atomic_rmw("add", builder.inttoptr(arguments[0], word.as_pointer()), word(1), "monotonic")

    return types.int64(types.int64), generate
