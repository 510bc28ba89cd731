"""Handles: compiled code sees the very arrays of a NamedTuple, whatever their dtype and shape."""

import copy
import pickle
from collections import namedtuple
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.errors import TypingError

from rl2grid.handles import Handle, layout_of, opener

DTYPES = ("bool", "int8", "int32", "int64", "uint16", "uint32", "uint64", "float32", "float64")
Arrays = namedtuple("Arrays", "flat table block four")
SHAPES = {"flat": (5,), "table": (3, 4), "block": (2, 3, 4), "four": (2, 1, 3, 2)}


def arrays_of(dtype: str) -> Any:
    random = np.random.default_rng(3)
    return Arrays(**{name: random.integers(0, 100, shape).astype(dtype) for name, shape in SHAPES.items()})


@pytest.mark.parametrize("dtype", DTYPES)
def test_every_element_is_read_and_written_in_place(dtype):
    arrays = arrays_of(dtype)
    open_arrays = opener(layout_of(arrays))

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
    source, target = Handle(arrays), Handle(blank)
    size, shape, strides, elements = move(source.address, target.address)
    for mine, theirs in zip(blank, arrays, strict=True):
        np.testing.assert_array_equal(mine, theirs)
        assert theirs.any()
    assert (size, shape, strides, elements) == (5, (3, 4), arrays.block.strides, 12)


Mixed = namedtuple("Mixed", "flags numbers empty")


def mixed_arrays(flags: Any = (2, 3), numbers: Any = 4) -> Any:
    return Mixed(np.zeros(flags, np.bool_), np.arange(float(numbers)), np.zeros((2, 0), np.float32))


def test_fields_of_different_kinds_lie_side_by_side_and_may_be_empty():
    mixed = mixed_arrays()
    open_mixed = opener(layout_of(mixed))

    @numba.njit
    def touch(address):
        handle = open_mixed(address)
        handle.flags[1, 2] = handle.empty.shape == (2, 0)
        handle.numbers[:] += 0.5
        return handle.empty.sum()

    handle = Handle(mixed)
    assert touch(handle.address) == 0.0
    assert mixed.flags.tolist() == [[False, False, False], [False, False, True]]
    assert mixed.numbers.tolist() == [0.5, 1.5, 2.5, 3.5]


def test_a_handle_serves_functions_written_for_the_named_tuple():
    mixed = mixed_arrays()
    open_mixed = opener(layout_of(mixed))

    @numba.njit
    def total(arrays, k):
        return arrays.numbers[k:].sum()

    @numba.njit
    def through_a_handle(address):
        return total(open_mixed(address), 1)

    handle = Handle(mixed)
    assert through_a_handle(handle.address) == total(mixed, 1) == 6.0


def test_one_function_serves_arrays_of_any_size():
    open_mixed = opener(layout_of(mixed_arrays((0, 0), 0)))

    @numba.njit
    def count(address):
        return open_mixed(address).numbers.size

    for size in (0, 1, 1000):
        handle = Handle(mixed_arrays((1, 1), size))
        assert count(handle.address) == size


Whole = namedtuple("Whole", "first scale second")


def test_a_structure_may_hold_structures():
    whole = Whole(mixed_arrays(), np.array([10.0]), mixed_arrays())
    open_whole = opener(layout_of(whole))

    @numba.njit
    def add(mixed, amount):
        mixed.numbers[:] += amount

    @numba.njit
    def work(address):
        whole = open_whole(address)
        add(whole.second, whole.scale[0])
        whole.first.flags[1, 0] = True

    handle = Handle(whole)
    work(handle.address)
    assert whole.first.numbers.tolist() == [0.0, 1.0, 2.0, 3.0]
    assert whole.second.numbers.tolist() == [10.0, 11.0, 12.0, 13.0]
    assert whole.first.flags.sum() == 1
    other = mixed_arrays()
    kept = Handle(other)
    handle.point_at("second", kept)
    work(handle.address)
    assert other.numbers.tolist() == whole.second.numbers.tolist() == [10.0, 11.0, 12.0, 13.0]


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda handle: pickle.loads(pickle.dumps(handle))])
def test_a_copy_of_a_handle_points_at_arrays_of_its_own(duplicate):
    open_whole = opener(layout_of(Whole(mixed_arrays(), np.zeros(1), mixed_arrays())))

    @numba.njit
    def work(address):
        open_whole(address).first.numbers[0] = 7.0

    original = Handle(Whole(mixed_arrays(), np.zeros(1), mixed_arrays()))
    twin = duplicate(original)
    work(twin.address)
    assert twin.structure.first.numbers[0] == 7.0
    assert original.structure.first.numbers[0] == 0.0


def test_a_copy_of_who_holds_structure_and_handle_holds_one_copy_of_the_arrays():
    mixed = mixed_arrays()
    holder = {"structure": mixed, "handle": Handle(mixed)}
    twin = copy.deepcopy(holder)
    assert twin["handle"].structure.numbers is twin["structure"].numbers is not mixed.numbers


@pytest.mark.parametrize(
    "array", [np.zeros((4, 4))[:, ::2], np.zeros((4, 3)).T, np.zeros(6)[::2], np.asfortranarray(np.zeros((3, 2)))]
)
def test_arrays_that_are_not_contiguous_are_refused(array):
    with pytest.raises(ValueError, match=r"Mixed\.numbers is not contiguous"):
        Handle(Mixed(np.zeros((1, 1), np.bool_), array, np.zeros((1, 1), np.float32)))


def test_an_attribute_that_is_no_array_does_not_compile():
    mixed = mixed_arrays()
    open_mixed = opener(layout_of(mixed))

    @numba.njit
    def wrong(address):
        return open_mixed(address).letters

    handle = Handle(mixed)
    with pytest.raises(TypingError, match="letters"):
        wrong(handle.address)
