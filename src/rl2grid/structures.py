"""Structures of arrays, each field of which is declared once.

A structure is a NamedTuple whose fields are arrays, and structures. The environment is the first axis of a field that
every environment has. What a field is stands in its annotation, and there alone::

    class HiddenState(NamedTuple):
        protection: Annotated[I32, row("line", "overloaded steps counted by the protections", blank=0)]

Allocation (:func:`allocate`), copies of an environment (:func:`copy_row`, :func:`row_of`), the values of one that
shows nothing (:func:`blank_row`), what has to be saved of it (:func:`fields_of`), the layout that compiled code knows
(:mod:`rl2grid.handles`) and the table in the documentation (:func:`describe`) follow from that.

:func:`copy_row` and :func:`blank_row` are there in compiled code too.
"""

from __future__ import annotations

import enum
import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

Structure = TypeVar("Structure", bound=tuple[Any, ...])
"""A NamedTuple whose fields are declared."""


class Role(enum.Enum):
    """How long the values of a field matter, and to whom."""

    CONSTANT = "constant"
    """No environment axis; only read."""
    EPISODE = "fixed in an episode"
    """Of one environment, written when its episode begins."""
    ADDRESS = "address"
    """As EPISODE, but an address in this process: void in another, and as soon as what it points at is let go."""
    KEPT = "kept"
    """Of one environment: what follows depends on it, or somebody looks at it."""
    SCRATCH = "scratch"
    """Of one environment: every step writes it before it reads it."""
    WORKSPACE = "workspace"
    """No environment axis; of one thread, whose every call writes it before it reads it."""


_CACHE_LINE = 64
"""Bytes."""
_SHARED = (Role.CONSTANT, Role.WORKSPACE)
_SAVED = (Role.EPISODE, Role.ADDRESS, Role.KEPT)


@dataclass(frozen=True)
class Field:
    """What is declared of an array."""

    axes: tuple[str | int, ...]
    """Names of axes, or sizes that never differ; that of the environment is left out."""
    meaning: str
    unit: str
    grid2op: str
    """Grid2Op's attribute where it has another name; empty: the same name, or none."""
    role: Role
    blank: float | None
    """Value in a row that shows nothing; None: :func:`blank_row` leaves the field alone."""
    dtype: np.dtype[Any]
    """Of the annotated type of array."""

    @property
    def per_environment(self) -> bool:
        """Whether the first axis is the environment."""
        return self.role not in _SHARED

    @property
    def saved(self) -> bool:
        """Whether an environment that is restored without it would not play on as it did."""
        return self.role in _SAVED

    @property
    def ndim(self) -> int:
        """Number of axes, that of the environment included."""
        return len(self.axes) + self.per_environment


def constant(axes: str, meaning: str = "", unit: str = "", *, grid2op: str = "") -> Field:
    """Declare what is only read; ``axes`` are names and sizes with spaces between them."""
    return _declare(axes, meaning, unit, grid2op, Role.CONSTANT, None)


def row(axes: str, meaning: str = "", unit: str = "", *, grid2op: str = "", blank: float | None = None) -> Field:
    """Declare what an environment keeps from step to step."""
    return _declare(axes, meaning, unit, grid2op, Role.KEPT, blank)


def episode(axes: str, meaning: str = "", unit: str = "", *, grid2op: str = "", blank: float | None = None) -> Field:
    """Declare what is fixed in an episode of an environment."""
    return _declare(axes, meaning, unit, grid2op, Role.EPISODE, blank)


def address(axes: str, meaning: str = "") -> Field:
    """Declare addresses of what an environment plays in its episode."""
    return _declare(axes, meaning, "", "", Role.ADDRESS, None)


def scratch(axes: str, meaning: str = "", unit: str = "", *, grid2op: str = "", blank: float | None = None) -> Field:
    """Declare what is written anew in each step of an environment before it is read."""
    return _declare(axes, meaning, unit, grid2op, Role.SCRATCH, blank)


def workspace(axes: str, meaning: str = "", unit: str = "") -> Field:
    """Declare what one thread uses within a call."""
    return _declare(axes, meaning, unit, "", Role.WORKSPACE, None)


def _declare(axes: str, meaning: str, unit: str, grid2op: str, role: Role, blank: float | None) -> Field:
    parts = tuple(int(axis) if axis.isdigit() else axis for axis in axes.split())
    return Field(parts, meaning, unit, grid2op, role, blank, np.dtype(np.void))


class Declaration(NamedTuple):
    """What a structure is made of, in its order."""

    fields: dict[str, Field]
    """Arrays."""
    parts: dict[str, type[tuple[Any, ...]]]
    """Structures."""


@functools.cache
def declaration_of(kind: type[tuple[Any, ...]]) -> Declaration:
    """What the fields of a structure are declared as.

    Raises:
        TypeError: a field is not declared.
    """
    fields: dict[str, Field] = {}
    parts: dict[str, type[tuple[Any, ...]]] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        declared = next((extra for extra in get_args(hint)[1:] if isinstance(extra, Field)), None)
        if get_origin(hint) is Annotated and declared is not None:
            fields[name] = replace(declared, dtype=_dtype_of(get_args(hint)[0]))
        elif isinstance(hint, type) and issubclass(hint, tuple):
            parts[name] = hint
        else:
            raise TypeError(f"{kind.__name__}.{name} is not declared: annotate it with a field or a structure.")
    return Declaration(fields, parts)


@functools.cache
def is_structure(kind: type[object]) -> bool:
    """Whether it is a NamedTuple all fields of which are declared."""
    if not issubclass(kind, tuple) or not hasattr(kind, "_fields"):
        return False
    try:
        declaration = declaration_of(kind)
    except TypeError:
        return False
    return all(map(is_structure, declaration.parts.values()))


def _dtype_of(array: Any) -> np.dtype[Any]:
    """The dtype of ``NDArray[scalar]``, which up to NumPy 2.4 is another name of ``ndarray[shape, dtype[scalar]]``."""
    last = get_args(array)[-1]
    dtype: np.dtype[Any] = np.dtype(get_args(last)[0] if get_origin(last) is np.dtype else last)
    return dtype


def fields_of(kind: type[tuple[Any, ...]], *roles: Role) -> dict[str, Field]:
    """The arrays of a structure with one of the roles, all of them if none is named; in order."""
    return {name: field for name, field in declaration_of(kind).fields.items() if not roles or field.role in roles}


@functools.cache
def blanks_of(kind: type[tuple[Any, ...]]) -> dict[str, float]:
    """The values of a row that shows nothing, of the fields that have one."""
    return {name: field.blank for name, field in fields_of(kind).items() if field.blank is not None}


def allocate(kind: type[Structure], sizes: Mapping[str, int], n: int = 0, /, **given: Any) -> Structure:
    """A structure of zeros for ``n`` environments.

    Args:
        kind: the structure.
        sizes: size of each axis.
        n: environments.
        given: fields that are there already, arrays and structures.

    Raises:
        TypeError: an array that is given is not what was declared.
    """
    values: dict[str, Any] = dict(given)
    for name, field in declaration_of(kind).fields.items():
        if name not in values:
            shape = tuple(axis if isinstance(axis, int) else sizes[axis] for axis in field.axes)
            values[name] = _zeros((n, *shape) if field.per_environment else shape, field.dtype)
    structure = kind(**values)
    check(structure)
    return structure


def _zeros(shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Zeros that begin where a line of the cache does, so that no SIMD register is filled from two of them."""
    size = math.prod(shape) * dtype.itemsize
    memory = np.zeros(size + _CACHE_LINE, np.uint8)
    begin = -memory.ctypes.data % _CACHE_LINE
    return memory[begin : begin + size].view(dtype).reshape(shape)


def check(structure: tuple[Any, ...]) -> None:
    """See that all arrays are what they were declared as, which compiled code takes for granted.

    Raises:
        TypeError: one is not.
    """
    kind = type(structure)
    for name, field in declaration_of(kind).fields.items():
        array: NDArray[Any] = getattr(structure, name)
        if array.dtype != field.dtype or array.ndim != field.ndim or not array.flags.c_contiguous:
            raise TypeError(
                f"{kind.__name__}.{name} has to be a contiguous {field.dtype} array with {field.ndim} axes, not "
                f"{array.dtype} with shape {array.shape} and strides {array.strides}."
            )


def copy_row(source: Structure, i: int, target: Structure, j: int) -> None:
    """Copy what environment ``i`` keeps from step to step to environment ``j`` of another structure of the kind."""
    for name in fields_of(type(source), Role.KEPT):
        getattr(target, name)[j] = getattr(source, name)[i]


def blank_row(structure: tuple[Any, ...], i: int) -> None:
    """Write to environment ``i`` what is declared as blank."""
    for name, value in blanks_of(type(structure)).items():
        getattr(structure, name)[i] = value


def row_of(structure: Structure, i: int) -> Structure:
    """Environment ``i`` alone, in arrays of its own; constants and workspace are shared."""
    own = {
        name: getattr(structure, name)[i : i + 1].copy()
        for name, field in fields_of(type(structure)).items()
        if field.per_environment
    }
    replaced: Structure = structure._replace(**own)  # type: ignore[attr-defined]
    return replaced


def with_own_workspace(structure: Structure) -> Structure:
    """The same arrays with a workspace of its own, for another thread."""
    own = {
        name: _zeros(getattr(structure, name).shape, field.dtype)
        for name, field in fields_of(type(structure), Role.WORKSPACE).items()
    }
    replaced: Structure = structure._replace(**own)  # type: ignore[attr-defined]
    return replaced


def describe(kind: type[tuple[Any, ...]]) -> str:
    """A table in Markdown: name, dtype, shape, unit and meaning of each array."""
    rows = ["| field | dtype | shape | unit | meaning |", "|---|---|---|---|---|"]
    for name, field in fields_of(kind).items():
        shape = ", ".join([*(["n"] if field.per_environment else []), *map(str, field.axes)])
        meaning = "; ".join(part for part in (field.meaning, _origin(field), _role(field)) if part)
        rows.append(f"| `{name}` | {field.dtype} | [{shape}] | {field.unit} | {meaning} |")
    return "\n".join(rows)


def _origin(field: Field) -> str:
    return f"Grid2Op's `{field.grid2op}`" if field.grid2op else ""


def _role(field: Field) -> str:
    return "" if field.role is Role.KEPT else field.role.value
