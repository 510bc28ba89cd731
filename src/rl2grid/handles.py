"""A NamedTuple of arrays, handed to compiled code as one address.

Numba passes a NamedTuple by copying every array of it, at each call from Python and at each call that is not
inlined. A simulator whose state has hundreds of arrays would spend its time there. :func:`table_of` writes the
addresses and shapes of the arrays into one integer array; in compiled code :func:`opener` turns the address of
that table into a handle whose attributes are the arrays, so that functions written for the NamedTuple
(``state.rho[i, line]``) compile for the handle unchanged.

The table must be kept for as long as the handle is used, and the arrays must not be replaced.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.core.datamodel import models
from numba.core.extending import intrinsic, lower_getattr_generic, register_model
from numba.core.imputils import impl_ret_borrowed
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.np.arrayobj import make_array, populate_array
from numba.np.numpy_support import from_dtype
from numpy.typing import NDArray

Table = NDArray[np.int64]
"""What :func:`table_of` returns."""

_WORD = ir.IntType(64)


class HandleType(types.Type):  # type: ignore[misc]
    """Type of a handle: which arrays it has."""

    def __init__(self, label: str, layout: tuple[tuple[str, str, int], ...]) -> None:
        self.label, self.layout = label, layout
        self.arrays: dict[str, Any] = {}
        self.slots: dict[str, int] = {}
        slot = 0
        for field, dtype, ndim in layout:
            self.arrays[field] = types.Array(from_dtype(np.dtype(dtype)), ndim, "C")
            self.slots[field] = slot
            slot += 1 + ndim
        super().__init__(name=f"Handle({label}, {layout})")


@register_model(HandleType)
class _HandleModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, handle: HandleType) -> None:
        super().__init__(manager, handle, _WORD)


@infer_getattr
class _HandleAttributes(AttributeTemplate):  # type: ignore[misc]
    key = HandleType

    def generic_resolve(self, handle: HandleType, attribute: str) -> Any:
        return handle.arrays.get(attribute)


@lower_getattr_generic(HandleType)  # type: ignore[untyped-decorator]
def _read_attribute(context: Any, builder: Any, handle: HandleType, value: Any, attribute: str) -> Any:
    array_type = handle.arrays[attribute]
    table = builder.inttoptr(value, _WORD.as_pointer())

    def word(slot: int) -> Any:
        address = builder.gep(table, [_WORD(slot)])
        loaded = builder.load(address)
        # Tables never change: the compiler may keep what it has read of them.
        loaded.set_metadata("invariant.load", builder.module.add_metadata([]))
        return loaded

    slot = handle.slots[attribute]
    shape = [word(slot + 1 + axis) for axis in range(array_type.ndim)]
    item_size = context.get_abi_sizeof(context.get_data_type(array_type.dtype))
    strides = [_WORD(item_size)]
    for extent in reversed(shape[1:]):
        strides.insert(0, builder.mul(strides[0], extent))
    array = make_array(array_type)(context, builder)
    data = builder.inttoptr(word(slot), context.get_data_type(array_type.dtype).as_pointer())
    populate_array(array, data, shape, strides, _WORD(item_size), None)
    return impl_ret_borrowed(context, builder, array_type, array._getvalue())


def layout_of(arrays: Any) -> tuple[tuple[str, str, int], ...]:
    """Name, dtype and number of axes of each array of a NamedTuple."""
    return tuple((name, array.dtype.str, array.ndim) for name, array in zip(arrays._fields, arrays, strict=True))


def table_of(arrays: Any) -> Table:
    """Addresses and shapes of the arrays of a NamedTuple.

    Raises:
        ValueError: an array is not C-contiguous, which compiled code takes for granted.
    """
    words: list[int] = []
    for name, array in zip(arrays._fields, arrays, strict=True):
        if not array.flags.c_contiguous:
            raise ValueError(f"{type(arrays).__name__}.{name} is not contiguous.")
        words += [array.ctypes.data, *array.shape]
    return np.array(words, np.int64)


def opener(label: str, layout: tuple[tuple[str, str, int], ...]) -> Callable[[int], Any]:
    """A function for compiled code that turns the address of a table of this layout into a handle."""
    handle = HandleType(label, layout)

    @intrinsic  # type: ignore[untyped-decorator]
    def open_handle(typing_context: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return arguments[0]

        return handle(types.int64), generate

    result: Callable[[int], Any] = open_handle
    return result
