"""Handles: compiled code sees the very arrays of a structure, whatever their dtype and shape."""

import copy
import pickle
from typing import Annotated, Any, NamedTuple

import numba
import numpy as np
import pytest
from numba.core.errors import TypingError
from numpy.typing import NDArray

from rl2grid.arrays import F32, F64, I32, Flags
from rl2grid.handles import AsOpened, Handle, opener
from rl2grid.structures import allocate, blank_row, constant, copy_row, episode, row, scratch, workspace

DTYPES = (
    *("bool", "int32", "float64"),
    *(
        pytest.param(dtype, marks=pytest.mark.slow)
        for dtype in ("int8", "int64", "uint16", "uint32", "uint64", "float32")
    ),
)
SIZES = {"a": 5, "b": 3, "c": 4}


def block_of(dtype: str) -> Any:
    """A structure whose arrays are all of one type."""
    array = NDArray[getattr(np, {"bool": "bool_"}.get(dtype, dtype))]
    fields = {
        "flat": Annotated[array, constant("a")],
        "table": Annotated[array, constant("b c")],
        "block": Annotated[array, constant("2 b c")],
        "four": Annotated[array, constant("2 1 3 2")],
    }
    return NamedTuple(f"Block_{dtype}", list(fields.items()))


@pytest.mark.parametrize("dtype", DTYPES)
def test_every_element_is_read_and_written_in_place(dtype):
    kind = block_of(dtype)
    open_block = opener(kind)

    @numba.njit
    def move(source, target):
        """Copy element by element, by row, and by slice; returns the sizes met."""
        mine, theirs = open_block(source), open_block(target)
        for k in range(mine.flat.shape[0]):
            theirs.flat[k] = mine.flat[k]
        for j in range(mine.table.shape[0]):
            theirs.table[j] = mine.table[j]
        for i in range(mine.block.shape[0]):
            for j in range(mine.block.shape[1]):
                for k in range(mine.block.shape[2]):
                    theirs.block[i, j, k] = mine.block[i, j, k]
        theirs.four[:, 0, 1:] = mine.four[:, 0, 1:]
        theirs.four[:, 0, 0] = mine.four[:, 0, 0]
        return mine.flat.size, mine.table.shape, mine.block.strides, mine.four.size

    random = np.random.default_rng(3)
    arrays, blank = allocate(kind, SIZES), allocate(kind, SIZES)
    for array in arrays:
        array[:] = random.integers(0, 100, array.shape)
    source, target = Handle(arrays), Handle(blank)
    size, shape, strides, elements = move(source.address, target.address)
    for mine, theirs in zip(blank, arrays, strict=True):
        np.testing.assert_array_equal(mine, theirs)
        assert theirs.any()
    assert (size, shape, strides, elements) == (5, (3, 4), arrays.block.strides, 12)


class Mixed(NamedTuple):
    """Fields of different kinds."""

    flags: Annotated[Flags, constant("rows columns")]
    numbers: Annotated[F64, constant("numbers")]
    empty: Annotated[F32, constant("2 none")]


def mixed_arrays(rows: int = 2, columns: int = 3, numbers: int = 4) -> Mixed:
    return allocate(
        Mixed, {"rows": rows, "columns": columns, "none": 0}, numbers=np.arange(float(numbers), dtype=np.float64)
    )


open_mixed = opener(Mixed)


def test_fields_of_different_kinds_lie_side_by_side_and_may_be_empty():
    @numba.njit
    def touch(address):
        mixed = open_mixed(address)
        mixed.flags[1, 2] = mixed.empty.shape == (2, 0)
        mixed.numbers[:] += 0.5
        return mixed.empty.sum()

    mixed = mixed_arrays()
    handle = Handle(mixed)
    assert touch(handle.address) == 0.0
    assert mixed.flags.tolist() == [[False, False, False], [False, False, True]]
    assert mixed.numbers.tolist() == [0.5, 1.5, 2.5, 3.5]


def test_a_handle_serves_functions_written_for_the_named_tuple():
    @numba.njit
    def total(arrays, k):
        return arrays.numbers[k:].sum()

    @numba.njit
    def through_a_handle(address):
        return total(open_mixed(address), 1)

    mixed = mixed_arrays()
    handle = Handle(mixed)
    assert through_a_handle(handle.address) == total(mixed, 1) == 6.0


def test_one_function_serves_arrays_of_any_size():
    @numba.njit
    def count(address):
        return open_mixed(address).numbers.size

    for size in (0, 1, 1000):
        handle = Handle(mixed_arrays(1, 1, size))
        assert count(handle.address) == size


class Whole(NamedTuple):
    """Structures in a structure."""

    first: Mixed
    scale: Annotated[F64, constant("1")]
    second: Mixed


def whole_arrays() -> Whole:
    return Whole(mixed_arrays(), np.array([10.0]), mixed_arrays())


def test_a_structure_may_hold_structures():
    open_whole = opener(Whole)

    @numba.njit
    def add(mixed, amount):
        mixed.numbers[:] += amount

    @numba.njit
    def work(address):
        whole = open_whole(address)
        add(whole.second, whole.scale[0])
        whole.first.flags[1, 0] = True

    whole = whole_arrays()
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
    open_whole = opener(Whole)

    @numba.njit
    def work(address):
        open_whole(address).first.numbers[0] = 7.0

    original = Handle(whole_arrays())
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
    "array",
    [
        np.zeros((4, 4))[:, ::2],
        np.zeros((4, 3)).T,
        np.zeros(6)[::2],
        np.asfortranarray(np.zeros((3, 2))),
        np.zeros((3, 2)),
        np.zeros(3, np.float32),
    ],
)
def test_arrays_that_are_not_as_declared_are_refused(array):
    with pytest.raises(TypeError, match=r"Mixed\.numbers has to be a contiguous float64 array with 1 axes"):
        Handle(mixed_arrays()._replace(numbers=array))


def test_an_attribute_that_is_no_field_does_not_compile():
    @numba.njit
    def wrong(address):
        return open_mixed(address).letters

    handle = Handle(mixed_arrays())
    with pytest.raises(TypingError, match="letters"):
        wrong(handle.address)


class Rows(NamedTuple):
    """One field for every way in which copying or blanking may go wrong."""

    limit: Annotated[F64, constant("k")]
    single: Annotated[I32, row("", blank=-3)]
    table: Annotated[F32, row("k 2", blank=0.5)]
    flags: Annotated[Flags, row("k", blank=1)]
    zeros: Annotated[F64, row("2 k", blank=0)]
    empty: Annotated[F64, row("none", blank=2)]
    unblanked: Annotated[I32, row("k")]
    plan: Annotated[I32, episode("k", blank=4)]
    passing: Annotated[F64, scratch("k")]
    bench: Annotated[F64, workspace("k")]


def rows_of(n: int, seed: int) -> Rows:
    random = np.random.default_rng(seed)
    rows = allocate(Rows, {"k": 3, "none": 0}, n)
    for array in rows:
        array[:] = random.integers(2, 99, array.shape)
    return rows


open_rows = opener(Rows)


def both(source: Rows, i: int, target: Rows, j: int) -> tuple[Rows, Rows]:
    """The target after the copy, by Python and by compiled code."""

    @numba.njit
    def compiled(source, i, target, j):
        copy_row(open_rows(source), i, open_rows(target), j)

    mine, theirs = copy.deepcopy(target), copy.deepcopy(target)
    copy_row(source, i, mine, j)
    handles = Handle(source), Handle(theirs)
    compiled(handles[0].address, i, handles[1].address, j)
    return mine, theirs


def test_a_row_is_copied_but_for_what_is_fixed_shared_or_passing():
    source, target = rows_of(4, 1), rows_of(3, 2)
    before = copy.deepcopy(target)
    mine, theirs = both(source, 3, target, 1)
    for name in Rows._fields:
        np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name), err_msg=name)
        expected = np.array(getattr(before, name))
        if name in ("single", "table", "flags", "zeros", "unblanked"):
            expected[1] = getattr(source, name)[3]
        np.testing.assert_array_equal(getattr(mine, name), expected, err_msg=name)


def test_a_row_is_blanked_as_declared():
    @numba.njit
    def compiled(address, i):
        blank_row(open_rows(address), i)

    mine, theirs = rows_of(3, 5), rows_of(3, 5)
    blank_row(mine, 1)
    handle = Handle(theirs)
    compiled(handle.address, 1)
    expected = rows_of(3, 5)
    for name, value in {"single": -3, "table": 0.5, "flags": True, "zeros": 0, "plan": 4}.items():
        getattr(expected, name)[1] = value
    for name in Rows._fields:
        np.testing.assert_array_equal(getattr(mine, name), getattr(expected, name), err_msg=name)
        np.testing.assert_array_equal(getattr(theirs, name), getattr(expected, name), err_msg=name)


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")
def test_python_and_compiled_callers_share_the_machine_code():
    class Pair(NamedTuple):
        flat: Annotated[F64, constant("a")]
        table: Annotated[I32, constant("b c")]

    @numba.njit
    def total(pair, k):
        return pair.flat[k] + pair.table[k, 0]

    open_pair = opener(Pair)

    @numba.njit
    def twice(address, k):
        return 2 * total(open_pair(address), k)

    pair = allocate(Pair, SIZES)
    pair.flat[:], pair.table[:] = 0.5, 3
    opened = AsOpened()
    assert twice(Handle(pair).address, 1) == 7.0
    assert total(opened(pair), 1) == 3.5
    assert len(total.signatures) == 1
    other = allocate(Pair, SIZES)
    other.flat[:], other.table[:] = 1.5, 4
    assert [total(opened(each), 2) for each in (pair, other, pair)] == [3.5, 5.5, 3.5]
    assert len(total.signatures) == 1
