"""Several numbers side by side: the SIMD value type with which many similar power flows are solved at once.

A value of :class:`LanesType` holds :data:`WIDTH` float64, one per lane, and lives in registers. Arrays of lanes
are float64 with :data:`WIDTH` entries along their last axis; :func:`load` and :func:`store` address them by row,
counted over all other axes, and without checks. Products that are added are rounded once (``fma``), on every
processor; lanes never mix.
"""

from __future__ import annotations

import functools
import itertools
import math
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


def _spread(builder: Any, number: Any) -> Any:
    """The same number in every lane."""
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    first = builder.insert_element(undefined, number, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
    return builder.shuffle_vector(first, undefined, zeros)


def _as_lanes(builder: Any, kind: types.Type, value: Any) -> Any:
    """Lanes as they are, and a float64 in every lane."""
    return value if kind is _LANES else _spread(builder, value)


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
        return _spread(builder, arguments[0])

    return _LANES(types.float64), generate


@intrinsic  # type: ignore[untyped-decorator]
def at(typing_context: Any, array: Any, index: Any) -> Any:
    """Entry ``index`` of a float64 array, counted over all axes and without check, in every lane."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _spread(builder, builder.load(_entry(context, builder, signature, arguments)))

    return _LANES(array, index), generate


def _entry(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Address of an entry of a float64 array, counted over all axes."""
    data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
    place = context.cast(builder, arguments[1], signature.args[1], types.intp)
    return cgutils.gep_inbounds(builder, data, place)


@intrinsic  # type: ignore[untyped-decorator]
def _number(typing_context: Any, array: Any, index: Any) -> Any:
    """Entry ``index`` of a float64 array, counted over all axes and without check."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_entry(context, builder, signature, arguments))

    return types.float64(array, index), generate


@intrinsic  # type: ignore[untyped-decorator]
def _set_number(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """Write entry ``index`` of a float64 array, counted over all axes and without check."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.store(arguments[2], _entry(context, builder, signature, arguments))
        return context.get_dummy_value()

    return types.void(array, index, types.float64), generate


def _transposed(builder: Any, vectors: list[Any]) -> list[Any]:
    """The columns of ``WIDTH`` vectors: blocks beside the diagonal change places, of one number, of two, of four."""
    size = 1
    while size < WIDTH:
        places = range(WIDTH)
        upper = [k if not k & size else WIDTH + k - size for k in places]
        lower = [k + size if not k & size else WIDTH + k for k in places]
        swapped = list(vectors)
        for k in places:
            if not k & size:
                pair = vectors[k], vectors[k + size]
                for which, order in ((k, upper), (k + size, lower)):
                    mask = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), order)
                    swapped[which] = builder.shuffle_vector(*pair, mask)
        vectors, size = swapped, 2 * size
    return vectors


def _row_addresses(context: Any, builder: Any, kinds: Any, rows: Any, chosen: Any, column: Any) -> list[Any]:
    """Where ``WIDTH`` numbers of each chosen row of a matrix, of two axes or more, begin."""
    matrix = context.make_array(kinds[0])(context, builder, rows)
    numbers = context.make_array(kinds[1])(context, builder, chosen).data
    _, width, *further = cgutils.unpack_tuple(builder, matrix.shape)
    for size in further:
        width = builder.mul(width, size)
    found = []
    for lane in range(WIDTH):
        row = builder.load(cgutils.gep_inbounds(builder, numbers, ir.Constant(ir.IntType(64), lane)))
        first = cgutils.gep_inbounds(builder, matrix.data, builder.add(builder.mul(row, width), column))
        found.append(builder.bitcast(first, _VECTOR.as_pointer()))
    return found


@intrinsic  # type: ignore[untyped-decorator]
def load_columns(typing_context: Any, matrix: Any, rows: Any, column: Any, array: Any) -> Any:
    """Copy ``WIDTH`` columns of a matrix, float64, to as many rows of an array of lanes; unchecked.

    Lane l is given row ``rows[l]``, int64; the first column, int64, is the first row of the array too. Columns are
    counted over all axes but the first.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        matrix, rows, column, array = arguments
        addresses = _row_addresses(context, builder, signature.args, matrix, rows, column)
        vectors = _transposed(builder, [builder.load(address, align=8) for address in addresses])
        for k, vector in enumerate(vectors):
            row = builder.add(column, ir.Constant(ir.IntType(64), k))
            kinds = types.void(signature.args[3], types.int64)
            builder.store(vector, _address(context, builder, kinds, (array, row)), align=8)
        return context.get_dummy_value()

    return types.void(matrix, rows, types.int64, array), generate


@intrinsic  # type: ignore[untyped-decorator]
def store_columns(typing_context: Any, matrix: Any, rows: Any, column: Any, array: Any) -> Any:
    """Copy ``WIDTH`` rows of an array of lanes to as many columns of a matrix: what :func:`load_columns` reads."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        matrix, rows, column, array = arguments
        vectors = []
        for k in range(WIDTH):
            row = builder.add(column, ir.Constant(ir.IntType(64), k))
            kinds = types.void(signature.args[3], types.int64)
            vectors.append(builder.load(_address(context, builder, kinds, (array, row)), align=8))
        addresses = _row_addresses(context, builder, signature.args, matrix, rows, column)
        for address, vector in zip(addresses, _transposed(builder, vectors), strict=True):
            builder.store(vector, address, align=8)
        return context.get_dummy_value()

    return types.void(matrix, rows, types.int64, array), generate


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
_larger, _magnitude, _root = _call("maxnum", 2), _call("fabs", 1), _call("sqrt", 1)


def like(value: Any, number: float) -> Any:
    """A number, in all lanes where ``value`` is lanes."""


@overload(like)
def _choose_like(value, number):  # type: ignore[no-untyped-def]
    return (lambda value, number: splat(number)) if value is _LANES else (lambda value, number: number)


def larger(a: Any, b: Any) -> Any:
    """The larger of two numbers, or lane by lane."""


@overload(larger)
def _choose_larger(a, b):  # type: ignore[no-untyped-def]
    return (lambda a, b: _larger(a, b)) if a is _LANES else (lambda a, b: max(a, b))


def magnitude(a: Any) -> Any:
    """The number, or lanes, without sign."""


@overload(magnitude)
def _choose_magnitude(a):  # type: ignore[no-untyped-def]
    return (lambda a: _magnitude(a)) if a is _LANES else (lambda a: abs(a))


def root(a: Any) -> Any:
    """The square root of a number, or lane by lane."""


@overload(root)
def _choose_root(a):  # type: ignore[no-untyped-def]
    return (lambda a: _root(a)) if a is _LANES else (lambda a: math.sqrt(a))


def where_less(a: Any, b: Any, chosen: Any, other: Any) -> Any:
    """``chosen`` where a < b, else ``other``: numbers, or lane by lane."""


def where_equal(a: Any, b: Any, chosen: Any, other: Any) -> Any:
    """``chosen`` where a == b, else ``other``: numbers, or lane by lane."""


def _where(condition: str) -> Any:
    """An intrinsic that selects lanes."""

    def typed(typing_context: Any, a: Any, b: Any, chosen: Any, other: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            a, b, chosen, other = map(functools.partial(_as_lanes, builder), signature.args, arguments)
            return builder.select(builder.fcmp_ordered(condition, a, b), chosen, other)

        return _LANES(a, b, chosen, other), generate

    return intrinsic(typed)


_lanes_where_less, _lanes_where_equal = _where("<"), _where("==")


@overload(where_less)
def _choose_where_less(a, b, chosen, other):  # type: ignore[no-untyped-def]
    if _LANES in (a, b, chosen, other):
        return lambda a, b, chosen, other: _lanes_where_less(a, b, chosen, other)
    return lambda a, b, chosen, other: chosen if a < b else other


@overload(where_equal)
def _choose_where_equal(a, b, chosen, other):  # type: ignore[no-untyped-def]
    if _LANES in (a, b, chosen, other):
        return lambda a, b, chosen, other: _lanes_where_equal(a, b, chosen, other)
    return lambda a, b, chosen, other: chosen if a == b else other


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


def entries(axes: int) -> tuple[Any, Any]:
    """What reads and what writes an entry, for equations that are written once for numbers and for lanes of them.

    Args:
        axes: of an array of numbers; an array of lanes has one more. Entries are counted over all of these, unchecked.
    """

    def read(array: Any, k: Any) -> Any:
        """Entry ``k``, a float64 or lanes."""

    def write(array: Any, k: Any, value: Any) -> None:
        """Replace entry ``k``; lanes may be given one number for all."""

    def choose_read(array, k):  # type: ignore[no-untyped-def]
        if array.ndim == axes:
            return lambda array, k: _number(array, k)
        return lambda array, k: load(array, k)

    def choose_write(array, k, value):  # type: ignore[no-untyped-def]
        if array.ndim == axes:
            return lambda array, k, value: _set_number(array, k, value)
        if value is _LANES:
            return lambda array, k, value: store(array, k, value)
        return lambda array, k, value: store(array, k, splat(value))

    overload(read)(choose_read)
    overload(write)(choose_write)
    return read, write


def _define(symbol: Any, name: str, n_arguments: int) -> None:
    """Let an operator of Python be an instruction of LLVM; beside lanes a float64 is the same number in all of them."""
    operands = [kinds for kinds in itertools.product((_LANES, types.float64), repeat=n_arguments) if _LANES in kinds]

    @infer_global(symbol)  # type: ignore[untyped-decorator]
    class _Typing(ConcreteTemplate):  # type: ignore[misc]
        cases = [signature(_LANES, *kinds) for kinds in operands]  # noqa: RUF012

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return getattr(builder, name)(*map(functools.partial(_as_lanes, builder), signature.args, arguments))

    for kinds in operands:
        lower_builtin(symbol, *kinds)(generate)


for _symbol, _name, _n_arguments in (
    (operator.add, "fadd", 2),
    (operator.iadd, "fadd", 2),
    (operator.sub, "fsub", 2),
    (operator.isub, "fsub", 2),
    (operator.mul, "fmul", 2),
    (operator.truediv, "fdiv", 2),
    (operator.neg, "fneg", 1),
):
    _define(_symbol, _name, _n_arguments)
