"""Handles: compiled code sees the very arrays of a NamedTuple, whatever their dtype and shape."""

from collections import namedtuple
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.errors import TypingError

from rl2grid.handles import layout_of, opener, table_of

DTYPES = ("bool", "int8", "int32", "int64", "uint16", "uint32", "uint64", "float32", "float64")
Arrays = namedtuple("Arrays", "flat table block four")
SHAPES = {"flat": (5,), "table": (3, 4), "block": (2, 3, 4), "four": (2, 1, 3, 2)}


def arrays_of(dtype: str) -> Any:
    random = np.random.default_rng(3)
    return Arrays(**{name: random.integers(0, 100, shape).astype(dtype) for name, shape in SHAPES.items()})


def address_of(arrays: Any) -> tuple[int, Any]:
    """Where the table lies, and the table, which has to be kept."""
    table = table_of(arrays)
    return table.ctypes.data, table


@pytest.mark.parametrize("dtype", DTYPES)
def test_every_element_is_read_and_written_in_place(dtype):
    arrays = arrays_of(dtype)
    open_arrays = opener(f"Arrays {dtype}", layout_of(arrays))

    @numba.njit
    def move(source, target):
        """Copy element by element, by row, and by slice; returns the sizes met."""
        mine, theirs = open_arrays(source), open_arrays(target)
        for k in range(mine.flat.shape[0]):
            theirs.flat[k] = mine.flat[k]
        for row in range(mine.table.shape[0]):
            theirs.table[row] = mine.table[row]
        for i in range(mine.block.shape[0]):
            for j in range(mine.block.shape[1]):
                for k in range(mine.block.shape[2]):
                    theirs.block[i, j, k] = mine.block[i, j, k]
        theirs.four[:, 0, 1:] = mine.four[:, 0, 1:]
        theirs.four[:, 0, 0] = mine.four[:, 0, 0]
        return mine.flat.size, mine.table.shape, mine.block.strides, mine.four.size

    blank = Arrays(*(np.zeros_like(array) for array in arrays))
    (source, table), (target, other) = address_of(arrays), address_of(blank)
    size, shape, strides, elements = move(source, target)
    for mine, theirs in zip(blank, arrays, strict=True):
        np.testing.assert_array_equal(mine, theirs)
        assert theirs.any()
    assert (size, shape, strides, elements) == (5, (3, 4), arrays.block.strides, 12)
    assert len(table) == len(other) == sum(1 + len(shape) for shape in SHAPES.values())


Mixed = namedtuple("Mixed", "flags numbers empty")


def test_fields_of_different_kinds_lie_side_by_side_and_may_be_empty():
    mixed = Mixed(np.zeros((2, 3), np.bool_), np.arange(4.0), np.zeros((2, 0), np.float32))
    open_mixed = opener("Mixed", layout_of(mixed))

    @numba.njit
    def touch(address):
        handle = open_mixed(address)
        handle.flags[1, 2] = handle.empty.shape == (2, 0)
        handle.numbers[:] += 0.5
        return handle.empty.sum()

    address, table = address_of(mixed)
    assert touch(address) == 0.0
    assert mixed.flags.tolist() == [[False, False, False], [False, False, True]]
    assert mixed.numbers.tolist() == [0.5, 1.5, 2.5, 3.5]
    assert table[-2:].tolist() == [2, 0]


def test_a_handle_serves_functions_written_for_the_named_tuple():
    mixed = Mixed(np.zeros((2, 3), np.bool_), np.arange(4.0), np.zeros((2, 0), np.float32))
    open_mixed = opener("Mixed", layout_of(mixed))

    @numba.njit
    def total(arrays, k):
        return arrays.numbers[k:].sum()

    @numba.njit
    def through_a_handle(address):
        return total(open_mixed(address), 1)

    address, table = address_of(mixed)
    assert through_a_handle(address) == total(mixed, 1) == 6.0
    assert table.dtype == np.int64


def test_one_function_serves_arrays_of_any_size():
    open_mixed = opener(
        "Mixed", layout_of(Mixed(np.zeros((0, 0), np.bool_), np.zeros(0), np.zeros((0, 0), np.float32)))
    )

    @numba.njit
    def total(address):
        return open_mixed(address).numbers.sum()

    for size in (0, 1, 1000):
        mixed = Mixed(np.zeros((1, 1), np.bool_), np.ones(size), np.zeros((1, 1), np.float32))
        address, table = address_of(mixed)
        assert total(address) == size
        assert table[3] == mixed.numbers.ctypes.data


@pytest.mark.parametrize(
    "array", [np.zeros((4, 4))[:, ::2], np.zeros((4, 3)).T, np.zeros(6)[::2], np.asfortranarray(np.zeros((3, 2)))]
)
def test_arrays_that_are_not_contiguous_are_refused(array):
    with pytest.raises(ValueError, match=r"Mixed\.numbers is not contiguous"):
        table_of(Mixed(np.zeros((1, 1), np.bool_), array, np.zeros((1, 1), np.float32)))


def test_an_attribute_that_is_no_array_does_not_compile():
    mixed = Mixed(np.zeros((1, 1), np.bool_), np.zeros(1), np.zeros((1, 1), np.float32))
    open_mixed = opener("Mixed", layout_of(mixed))

    @numba.njit
    def wrong(address):
        return open_mixed(address).letters

    address, _ = address_of(mixed)
    with pytest.raises(TypingError, match="letters"):
        wrong(address)
