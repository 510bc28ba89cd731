"""Numbers read where they lie: compiled code knows the address of a series, whoever has mapped it into memory."""

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
