"""Several numbers side by side: the SIMD value type with which many similar power flows are solved at once.

A value of :class:`LanesType` holds :data:`WIDTH` float64, one per lane, and lives in registers. Arrays of lanes
are float64 with :data:`WIDTH` entries along their last axis; :func:`load` and :func:`store` address them by row,
counted over all other axes, and without checks. Products that are added are rounded once (``fma``), on every
processor; lanes never mix.
"""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, overload, register_model
from numpy.typing import NDArray

Lanes = NDArray[np.float64]
"""An array of lanes, float64 [..., WIDTH]."""
WIDTH = 8
"""Lanes of a value: one register of AVX-512, two of AVX2."""

_DOUBLE = ir.DoubleType()
_VECTOR = ir.VectorType(_DOUBLE, WIDTH)


class LanesType(types.Type):  # type: ignore[misc]
    """Type of a value with :data:`WIDTH` lanes."""

    def __init__(self) -> None:
        super().__init__(name=f"Lanes({WIDTH})")


_LANES = LanesType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, lanes: LanesType) -> None:
        super().__init__(manager, lanes, _VECTOR)


def _address(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    array = context.make_array(signature.args[0])(context, builder, arguments[0])
    row = context.cast(builder, arguments[1], signature.args[1], types.intp)
    first = cgutils.gep_inbounds(builder, array.data, builder.mul(row, ir.Constant(row.type, WIDTH)))
    return builder.bitcast(first, _VECTOR.as_pointer())


@intrinsic  # type: ignore[untyped-decorator]
def load(typing_context: Any, array: Any, row: Any) -> Any:
    """Row ``row`` of an array of lanes."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_address(context, builder, signature, arguments), align=8)

    return _LANES(array, row), generate


@intrinsic  # type: ignore[untyped-decorator]
def store(typing_context: Any, array: Any, row: Any, value: Any) -> Any:
    """Write row ``row`` of an array of lanes."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.store(arguments[2], _address(context, builder, signature, arguments), align=8)
        return context.get_dummy_value()

    return types.void(array, row, _LANES), generate


@intrinsic  # type: ignore[untyped-decorator]
def splat(typing_context: Any, number: Any) -> Any:
    """The same float64 in every lane."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        undefined = ir.Constant(_VECTOR, ir.Undefined)
        first = builder.insert_element(undefined, arguments[0], ir.Constant(ir.IntType(32), 0))
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
        return builder.shuffle_vector(first, undefined, zeros)

    return _LANES(types.float64), generate


@intrinsic  # type: ignore[untyped-decorator]
def at(typing_context: Any, array: Any, index: Any) -> Any:
    """Entry ``index`` of a float64 array, counted over all axes and without check, in every lane."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        place = context.cast(builder, arguments[1], signature.args[1], types.intp)
        number = builder.load(cgutils.gep_inbounds(builder, data, place))
        undefined = ir.Constant(_VECTOR, ir.Undefined)
        first = builder.insert_element(undefined, number, ir.Constant(ir.IntType(32), 0))
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
        return builder.shuffle_vector(first, undefined, zeros)

    return _LANES(array, index), generate


def _call(name: str, n_arguments: int) -> Any:
    """An intrinsic of LLVM, lane by lane."""

    def typed(typing_context: Any, *values: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            kind = ir.FunctionType(_VECTOR, [_VECTOR] * n_arguments)
            function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{WIDTH}f64")
            return builder.call(function, arguments)

        return _LANES(*[_LANES] * n_arguments), generate

    if n_arguments == 1:
        return intrinsic(lambda typing_context, a: typed(typing_context, a))
    if n_arguments == 2:
        return intrinsic(lambda typing_context, a, b: typed(typing_context, a, b))
    return intrinsic(lambda typing_context, a, b, c: typed(typing_context, a, b, c))


fma = _call("fma", 3)
"""``fma(a, b, c)`` is a * b + c."""
larger = _call("maxnum", 2)
magnitude = _call("fabs", 1)
root = _call("sqrt", 1)


def lanes_at(axes: int) -> Any:
    """What reads entry or row ``k`` of an array into every lane, whether all lanes share it or each has its own.

    Args:
        axes: of an array that lanes share (:func:`at`); of lanes it has one more (:func:`load`).
    """

    def read(array: Any, k: Any) -> Any:
        """Entry or row ``k``."""

    def choose(array, k):  # type: ignore[no-untyped-def]  # Numba compares signatures, annotations included
        if array.ndim == axes:
            return lambda array, k: at(array, k)
        return lambda array, k: load(array, k)

    overload(read)(choose)
    return read


def _define(symbol: Any, name: str, n_arguments: int) -> None:
    """Let an operator of Python be an instruction of LLVM."""

    @infer_global(symbol)  # type: ignore[untyped-decorator]
    class _Typing(ConcreteTemplate):  # type: ignore[misc]
        cases = [signature(_LANES, *[_LANES] * n_arguments)]  # noqa: RUF012

    @lower_builtin(symbol, *[LanesType] * n_arguments)  # type: ignore[untyped-decorator]
    def _generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return getattr(builder, name)(*arguments)


for _symbol, _name, _n_arguments in (
    (operator.add, "fadd", 2),
    (operator.sub, "fsub", 2),
    (operator.mul, "fmul", 2),
    (operator.truediv, "fdiv", 2),
    (operator.neg, "fneg", 1),
):
    _define(_symbol, _name, _n_arguments)
