"""A NamedTuple of arrays, handed to compiled code as one address.

Numba passes a NamedTuple by copying every array of it, at each call from Python and at each call that is not
inlined. A simulator whose state has hundreds of arrays would spend its time there. A :class:`Handle` writes the
addresses and shapes of the arrays into one integer array, a table; in compiled code :func:`opener` turns the
address of the table into a value whose attributes are the arrays, so that functions written for the NamedTuple
(``state.rho[i, line]``) compile for it unchanged. A field may be such a NamedTuple itself
(``environments.state.rho[i, line]``): all that an engine works with is then one number, passed on for nothing.

The handle must be kept for as long as its address is used, and the arrays must not be replaced.
"""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar

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

Structure = TypeVar("Structure", bound=tuple[Any, ...])
"""A NamedTuple of arrays and of such NamedTuples."""

_WORD = ir.IntType(64)


class Layout(NamedTuple):
    """What compiled code has to know of a structure; sizes may differ from one to the next."""

    label: str
    fields: tuple[tuple[str, Layout | str, int], ...]
    """Name, dtype and number of axes of each array; name, layout and 0 of each structure."""


def layout_of(structure: Any) -> Layout:
    """The layout of a NamedTuple."""
    fields = zip(structure._fields, structure, strict=True)
    return Layout(type(structure).__name__, tuple((name, *_kind_of(value)) for name, value in fields))


def _kind_of(value: Any) -> tuple[Layout | str, int]:
    return (layout_of(value), 0) if isinstance(value, tuple) else (value.dtype.str, value.ndim)


class Handle(Generic[Structure]):
    """Where compiled code finds a structure. A copy, or one that was pickled, points at arrays of its own.

    Raises:
        ValueError: an array is not C-contiguous, which compiled code takes for granted.
    """

    def __init__(self, structure: Structure) -> None:
        self.structure = structure
        fields: tuple[str, ...] = structure._fields  # type: ignore[attr-defined]
        self._parts: dict[str, Handle[Any]] = {}
        self._slots: dict[str, int] = {}
        words: list[int] = []
        for name, value in zip(fields, structure, strict=True):
            self._slots[name] = len(words)
            if isinstance(value, tuple):
                self._parts[name] = Handle(value)
                words.append(self._parts[name].address)
            elif value.flags.c_contiguous:
                words += [value.ctypes.data, *value.shape]
            else:
                raise ValueError(f"{type(structure).__name__}.{name} is not contiguous.")
        self._table: NDArray[np.int64] = np.array(words, np.int64)
        self.address: int = self._table.ctypes.data

    def point_at(self, name: str, part: Handle[Any]) -> None:
        """Let compiled code see another structure of the same layout as ``name``; the caller keeps it."""
        self._table[self._slots[name]] = part.address

    def __deepcopy__(self, memo: dict[int, Any]) -> Handle[Structure]:
        return Handle(copy.deepcopy(self.structure, memo))

    def __reduce__(self) -> tuple[Any, ...]:
        return Handle, (self.structure,)


class HandleType(types.Type):  # type: ignore[misc]
    """Type of a handle in compiled code: which attributes it has."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.attributes: dict[str, Any] = {}
        self.slots: dict[str, int] = {}
        slot = 0
        for field, kind, ndim in layout.fields:
            if isinstance(kind, Layout):
                self.attributes[field] = HandleType(kind)
            else:
                self.attributes[field] = types.Array(from_dtype(np.dtype(kind)), ndim, "C")
            self.slots[field] = slot
            slot += 1 + ndim
        # The name goes into the symbol of every function that takes the handle: it had better be short.
        digest = hashlib.sha256(repr(layout).encode()).hexdigest()[:16]
        super().__init__(name=f"{layout.label}.{digest}")


@register_model(HandleType)
class _HandleModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, handle: HandleType) -> None:
        super().__init__(manager, handle, _WORD)


@infer_getattr
class _HandleAttributes(AttributeTemplate):  # type: ignore[misc]
    key = HandleType

    def generic_resolve(self, handle: HandleType, attribute: str) -> Any:
        return handle.attributes.get(attribute)


@lower_getattr_generic(HandleType)  # type: ignore[untyped-decorator]
def _read_attribute(context: Any, builder: Any, handle: HandleType, value: Any, attribute: str) -> Any:
    kind = handle.attributes[attribute]
    table = builder.inttoptr(value, _WORD.as_pointer())

    def word(slot: int) -> Any:
        address = builder.gep(table, [_WORD(slot)])
        loaded = builder.load(address)
        # Tables never change: the compiler may keep what it has read of them.
        loaded.set_metadata("invariant.load", builder.module.add_metadata([]))
        return loaded

    slot = handle.slots[attribute]
    if isinstance(kind, HandleType):
        return word(slot)
    shape = [word(slot + 1 + axis) for axis in range(kind.ndim)]
    item_size = context.get_abi_sizeof(context.get_data_type(kind.dtype))
    strides = [_WORD(item_size)]
    for extent in reversed(shape[1:]):
        strides.insert(0, builder.mul(strides[0], extent))
    array = make_array(kind)(context, builder)
    data = builder.inttoptr(word(slot), context.get_data_type(kind.dtype).as_pointer())
    populate_array(array, data, shape, strides, _WORD(item_size), None)
    return impl_ret_borrowed(context, builder, kind, array._getvalue())


def opener(layout: Layout) -> Callable[[int], Any]:
    """A function for compiled code that turns the address of a handle to such a structure into the structure."""
    handle = HandleType(layout)

    @intrinsic  # type: ignore[untyped-decorator]
    def open_handle(typing_context: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return arguments[0]

        return handle(types.int64), generate

    result: Callable[[int], Any] = open_handle
    return result
