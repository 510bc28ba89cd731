"""Structures: everything that follows from the declaration of a field."""

from types import GenericAlias
from typing import Annotated, Any, NamedTuple

import numpy as np
import pytest

from rl2grid.arrays import F32, F64, I32, I64, Flags
from rl2grid.structures import (
    Role,
    address,
    allocate,
    check,
    constant,
    declaration_of,
    describe,
    episode,
    fields_of,
    row,
    row_of,
    scratch,
    with_own_workspace,
    workspace,
)


class Example(NamedTuple):
    """One field of each role."""

    limit: Annotated[F32, constant("line", "largest current", "A")]
    series: Annotated[I64, address("4", "of the first row")]
    length: Annotated[I32, episode("", "of the episode", "steps")]
    rho: Annotated[F32, row("line", "loading", blank=0)]
    pairs: Annotated[F64, row("line 2", grid2op="_pairs")]
    tripped: Annotated[Flags, scratch("line")]
    step: Annotated[F64, workspace("line line")]


class Spelled(NamedTuple):
    """``NDArray[np.float32]``, as NumPy spells it up to 2.4, and as from 2.5 on: an alias with the scalar alone."""

    before: Annotated[np.ndarray[Any, np.dtype[np.float32]], row("line")]
    after: Annotated[GenericAlias(list, (np.float32,)), row("line")]  # type: ignore[valid-type]


class Outer(NamedTuple):
    """A structure in a structure."""

    count: Annotated[I32, constant("1")]
    example: Example


def test_the_type_of_numbers_is_read_from_both_spellings_of_numpy():
    assert [field.dtype for field in fields_of(Spelled).values()] == [np.float32, np.float32]


def test_allocation_follows_from_the_declaration():
    limit = np.ones(3, np.float32)
    example = allocate(Example, {"line": 3}, 5, limit=limit)
    assert example.limit is limit
    found = {name: (array.dtype, array.shape) for name, array in example._asdict().items() if name != "limit"}
    assert found == {
        "series": (np.int64, (5, 4)),
        "length": (np.int32, (5,)),
        "rho": (np.float32, (5, 3)),
        "pairs": (np.float64, (5, 3, 2)),
        "tripped": (np.bool_, (5, 3)),
        "step": (np.float64, (3, 3)),
    }
    assert not any(array.any() for name, array in example._asdict().items() if name != "limit")
    check(example)


def test_arrays_begin_where_a_line_of_the_cache_does():
    example = allocate(Example, {"line": 3}, 5)
    for made in (example, with_own_workspace(example)):
        assert made.step.ctypes.data % 64 == 0
    assert with_own_workspace(example).step.ctypes.data != example.step.ctypes.data


@pytest.mark.parametrize("wrong", [np.zeros((5, 3)), np.zeros((5, 3, 1), np.float32), np.zeros((3, 5), np.float32).T])
def test_an_array_that_is_not_as_declared_is_refused(wrong):
    with pytest.raises(TypeError, match=r"Example\.rho has to be a contiguous float32 array with 2 axes"):
        check(allocate(Example, {"line": 3}, 5, rho=wrong))


def test_roles_say_what_is_saved_and_what_every_environment_has():
    fields = fields_of(Example)
    assert [name for name, field in fields.items() if field.per_environment] == [
        "series", "length", "rho", "pairs", "tripped",
    ]  # fmt: skip
    assert [name for name, field in fields.items() if field.saved] == ["series", "length", "rho", "pairs"]
    assert list(fields_of(Example, Role.KEPT)) == ["rho", "pairs"]
    assert list(fields_of(Example, Role.WORKSPACE, Role.CONSTANT)) == ["limit", "step"]


def test_structures_in_a_structure_are_parts_and_no_fields():
    declaration = declaration_of(Outer)
    assert list(declaration.fields) == ["count"]
    assert declaration.parts == {"example": Example}


def test_a_field_without_declaration_is_refused():
    class Careless(NamedTuple):
        rho: F32

    with pytest.raises(TypeError, match=r"Careless\.rho is not declared"):
        declaration_of(Careless)


def test_a_row_alone_has_arrays_of_its_own():
    example = allocate(Example, {"line": 3}, 5)
    example.rho[:] = np.arange(15).reshape(5, 3)
    example.tripped[2] = True
    alone = row_of(example, 2)
    assert alone.rho.tolist() == [[6.0, 7.0, 8.0]]
    assert alone.tripped.all()
    assert alone.limit is example.limit
    alone.rho[0] = -1
    assert example.rho[2].tolist() == [6.0, 7.0, 8.0]
    check(alone)


def test_another_thread_shares_all_but_the_workspace():
    example = allocate(Example, {"line": 3}, 5)
    other = with_own_workspace(example)
    assert [name for name in Example._fields if getattr(other, name) is not getattr(example, name)] == ["step"]
    assert other.step.shape == example.step.shape


def test_the_description_holds_every_field_with_its_shape():
    lines = describe(Example).splitlines()
    assert lines[2] == "| `limit` | float32 | [line] | A | largest current; constant |"
    assert lines[3] == "| `series` | int64 | [n, 4] |  | of the first row; address |"
    assert lines[6] == "| `pairs` | float64 | [n, line, 2] |  | Grid2Op's `_pairs` |"
    assert len(lines) == 2 + len(Example._fields)
