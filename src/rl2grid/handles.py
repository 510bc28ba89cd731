"""A structure of arrays, handed to compiled code as one address.

Numba passes a NamedTuple by copying every array of it, at each call from Python and at each call that is not
inlined. A simulator whose state has hundreds of arrays would spend its time there. A :class:`Handle` writes the
addresses and shapes of the arrays into one integer array, a table; in compiled code :func:`opener` turns the
address of the table into a value whose attributes are the arrays, so that functions written for the NamedTuple
(``state.rho[i, line]``) compile for it unchanged. A field may be a structure itself
(``environments.state.rho[i, line]``): all that an engine works with is then one number, passed on for nothing.

A function that takes an opened structure can be called from Python with the NamedTuple too, of which a handle is made
(:func:`opened`). Who calls often keeps one (:class:`AsOpened`), which Numba recognises in a tenth of the time.

The handle must be kept for as long as its address is used, and the arrays must not be replaced.
"""

from __future__ import annotations

import copy
import functools
import hashlib
from collections import deque
from collections.abc import Callable
from typing import Any, Generic, cast

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.core.extending import (
    NativeValue,
    intrinsic,
    lower_builtin,
    lower_getattr_generic,
    register_model,
    type_callable,
    unbox,
)
from numba.core.imputils import impl_ret_borrowed
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.np.arrayobj import make_array, populate_array
from numba.np.numpy_support import from_dtype

from rl2grid.structures import Role, Structure, blank_row, blanks_of, check, copy_row, declaration_of, is_structure

_WORD = ir.IntType(64)


class Handle(Generic[Structure]):
    """Where compiled code finds a structure. A copy, or one that was pickled, points at arrays of its own.

    Raises:
        TypeError: an array is not what was declared.
    """

    def __init__(self, structure: Structure) -> None:
        check(structure)
        self.structure = structure
        declaration = declaration_of(type(structure))
        self._parts: dict[str, Handle[Any]] = {name: Handle(getattr(structure, name)) for name in declaration.parts}
        words: list[int] = []
        for name in declaration.fields:
            array = getattr(structure, name)
            words += [array.ctypes.data, *array.shape]
        self._first_part = len(words)
        words += [part.address for part in self._parts.values()]
        self._table = np.array(words, np.int64)
        self.address: int = self._table.ctypes.data

    @property
    def _numba_type_(self) -> HandleType:
        """What a compiled function takes it for that is called with it."""
        return opened_type(type(self.structure))

    def point_at(self, name: str, part: Handle[Any]) -> None:
        """Let compiled code see another structure of the same kind as ``name``; the caller keeps it."""
        self._table[self._first_part + list(self._parts).index(name)] = part.address

    def __deepcopy__(self, memo: dict[int, Any]) -> Handle[Structure]:
        return Handle(copy.deepcopy(self.structure, memo))

    def __reduce__(self) -> tuple[Any, ...]:
        return Handle, (self.structure,)


class HandleType(types.Type):  # type: ignore[misc]
    """Type of a handle in compiled code: which attributes it has, and where in the table."""

    def __init__(self, kind: type[tuple[Any, ...]]) -> None:
        self.kind = kind
        self.attributes: dict[str, Any] = {}
        self.slots: dict[str, int] = {}
        declaration = declaration_of(kind)
        slot = 0
        for name, field in declaration.fields.items():
            self.attributes[name] = types.Array(from_dtype(field.dtype), field.ndim, "C")
            self.slots[name] = slot
            slot += 1 + field.ndim
        for name, part in declaration.parts.items():
            self.attributes[name] = HandleType(part)
            self.slots[name] = slot
            slot += 1
        # The name goes into the symbol of every function that takes the handle: it had better be short.
        digest = hashlib.sha256(repr((self.attributes, declaration.fields)).encode()).hexdigest()[:16]
        super().__init__(name=f"{kind.__name__}.{digest}")


@functools.cache
def opened_type(kind: type[tuple[Any, ...]]) -> HandleType:
    """What compiled code takes an opened structure for."""
    return HandleType(kind)


@unbox(HandleType)  # type: ignore[untyped-decorator]
def _unbox_handle(handle: HandleType, value: Any, context: Any) -> Any:
    address = context.pyapi.object_getattr_string(value, "address")
    number = context.pyapi.long_as_longlong(address)
    context.pyapi.decref(address)
    return NativeValue(number)


_LAST: deque[Handle[Any]] = deque(maxlen=4)
"""Handles that were made for Python: to make one takes longer than most functions."""


def opened(argument: Any) -> Any:
    """A structure as a handle, and anything else as it is.

    Raises:
        TypeError: an array of a structure is not what was declared.
    """
    if not (isinstance(argument, tuple) and is_structure(type(argument))):
        return argument
    for handle in tuple(_LAST):  # another thread may add to them
        if handle.structure is argument:
            return handle
    handle = Handle(argument)
    _LAST.append(handle)
    return handle


class AsOpened(Generic[Structure]):
    """Hands structures from Python to compiled functions as these hand them to one another.

    It remembers the handle of the last structure. Where Numba is told not to compile, structures stay what they are.
    """

    def __init__(self) -> None:
        self._handle: Handle[Structure] | None = None

    def __call__(self, structure: Structure) -> Structure:
        """The structure, for a compiled function."""
        if numba.config.DISABLE_JIT:
            return structure
        if self._handle is None or self._handle.structure is not structure:
            self._handle = Handle(structure)
        return cast(Structure, self._handle)


@register_model(HandleType)
class _HandleModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, handle: HandleType) -> None:
        super().__init__(manager, handle, _WORD)


@infer_getattr
class _HandleAttributes(AttributeTemplate):  # type: ignore[misc]
    key = HandleType

    def generic_resolve(self, handle: HandleType, attribute: str) -> Any:
        return handle.attributes.get(attribute)


def _word(builder: Any, address: Any, slot: int) -> Any:
    """An entry of a table."""
    table = builder.inttoptr(address, _WORD.as_pointer())
    loaded = builder.load(builder.gep(table, [_WORD(slot)]))
    # Tables never change: the compiler may keep what it has read of them.
    loaded.set_metadata("invariant.load", builder.module.add_metadata([]))
    return loaded


@lower_getattr_generic(HandleType)  # type: ignore[untyped-decorator]
def _read_attribute(context: Any, builder: Any, handle: HandleType, address: Any, attribute: str) -> Any:
    kind, slot = handle.attributes[attribute], handle.slots[attribute]
    if isinstance(kind, HandleType):
        return _word(builder, address, slot)
    shape = [_word(builder, address, slot + 1 + axis) for axis in range(kind.ndim)]
    item_size = context.get_abi_sizeof(context.get_data_type(kind.dtype))
    strides = [_WORD(item_size)]
    for extent in reversed(shape[1:]):
        strides.insert(0, builder.mul(strides[0], extent))
    array = make_array(kind)(context, builder)
    data = builder.inttoptr(_word(builder, address, slot), context.get_data_type(kind.dtype).as_pointer())
    populate_array(array, data, shape, strides, _WORD(item_size), None)
    return impl_ret_borrowed(context, builder, kind, array._getvalue())


def opener(kind: type[Structure]) -> Callable[[int], Structure]:
    """A function for compiled code that turns the address of a handle to a structure into the structure."""
    handle = opened_type(kind)

    @intrinsic  # type: ignore[untyped-decorator]
    def open_handle(typing_context: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return arguments[0]

        return handle(types.int64), generate

    result: Callable[[int], Structure] = open_handle
    return result


def _row_of_field(
    context: Any, builder: Any, handle: HandleType, address: Any, name: str, row: Any
) -> tuple[Any, Any, Any]:
    """Pointer to the row of a field, and the number and type of its entries."""
    kind, slot = handle.attributes[name], handle.slots[name]
    size = _WORD(1)
    for axis in range(1, kind.ndim):
        size = builder.mul(size, _word(builder, address, slot + 1 + axis))
    entry = context.get_data_type(kind.dtype)
    data = builder.inttoptr(_word(builder, address, slot), entry.as_pointer())
    return builder.gep(data, [builder.mul(row, size)]), size, entry


@type_callable(copy_row)  # type: ignore[untyped-decorator]
def _type_copy_row(context: Any) -> Any:
    def typer(source: Any, i: Any, target: Any, j: Any) -> Any:
        if isinstance(source, HandleType) and source == target:
            return types.void(source, types.intp, target, types.intp)
        return None

    return typer


@lower_builtin(copy_row, HandleType, types.intp, HandleType, types.intp)  # type: ignore[untyped-decorator]
def _generate_copy_row(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    handle = signature.args[0]
    source, i, target, j = arguments
    for name, field in declaration_of(handle.kind).fields.items():
        if field.role is Role.KEPT:
            from_pointer, size, entry = _row_of_field(context, builder, handle, source, name, i)
            to_pointer, _, _ = _row_of_field(context, builder, handle, target, name, j)
            if field.axes:
                cgutils.raw_memmove(builder, to_pointer, from_pointer, size, context.get_abi_sizeof(entry))
            else:
                builder.store(builder.load(from_pointer), to_pointer)
    return context.get_dummy_value()


@type_callable(blank_row)  # type: ignore[untyped-decorator]
def _type_blank_row(context: Any) -> Any:
    def typer(structure: Any, i: Any) -> Any:
        return types.void(structure, types.intp) if isinstance(structure, HandleType) else None

    return typer


@lower_builtin(blank_row, HandleType, types.intp)  # type: ignore[untyped-decorator]
def _generate_blank_row(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    handle = signature.args[0]
    address, i = arguments
    for name, value in blanks_of(handle.kind).items():
        _fill_row(context, builder, _row_of_field(context, builder, handle, address, name, i), value)
    return context.get_dummy_value()


def _fill_row(context: Any, builder: Any, row: tuple[Any, Any, Any], value: float) -> None:
    pointer, size, entry = row
    if value == 0:
        n_bytes = builder.mul(size, _WORD(context.get_abi_sizeof(entry)))
        cgutils.memset(builder, pointer, n_bytes, 0)
        return
    number = ir.Constant(entry, int(value) if isinstance(entry, ir.IntType) else float(value))
    with cgutils.for_range(builder, size) as loop:
        builder.store(number, builder.gep(pointer, [loop.index]))
