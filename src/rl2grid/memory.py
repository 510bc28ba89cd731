"""Numbers in memory that compiled code shares: read where somebody has mapped them, or counted by several threads."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.extending import intrinsic


@intrinsic  # type: ignore[untyped-decorator]
def float32_at(typing_context: Any, address: Any, index: Any) -> Any:
    """The float32 number ``index`` places after ``address``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = builder.inttoptr(arguments[0], ir.FloatType().as_pointer())
        return builder.load(builder.gep(pointer, [arguments[1]]))

    return types.float32(types.int64, types.int64), generate


@intrinsic  # type: ignore[untyped-decorator]
def int16_at(typing_context: Any, address: Any, index: Any) -> Any:
    """The int16 number ``index`` places after ``address``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = builder.inttoptr(arguments[0], ir.IntType(16).as_pointer())
        return builder.load(builder.gep(pointer, [arguments[1]]))

    return types.int16(types.int64, types.int64), generate


@intrinsic  # type: ignore[untyped-decorator]
def take_next(typing_context: Any, counter: Any) -> Any:
    """The number at the address ``counter``, int64, which is one more afterwards: no two threads are given the same."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        word = ir.IntType(64)
        return builder.atomic_rmw("add", builder.inttoptr(arguments[0], word.as_pointer()), word(1), "monotonic")

    return types.int64(types.int64), generate
