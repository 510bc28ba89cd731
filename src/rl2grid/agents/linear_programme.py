"""Mixed-integer linear programmes, put together column by column and solved by HiGHS (through SciPy)."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from rl2grid.arrays import F64

Terms = Iterable[tuple[int, float]]
"""(column, coefficient); a column may occur several times."""
_GAP = 1e-6
"""Relative gap at which an incumbent counts as optimal."""


class Affine(NamedTuple):
    """A constant plus a sum over columns."""

    constant: float = 0.0
    terms: Mapping[int, float] = {}

    def times(self, factor: float) -> Affine:
        """The expression times a number."""
        return Affine(factor * self.constant, {column: factor * value for column, value in self.terms.items()})

    def plus(self, other: Affine) -> Affine:
        """The sum of two expressions."""
        terms = dict(self.terms)
        for column, value in other.terms.items():
            terms[column] = terms.get(column, 0.0) + value
        return Affine(self.constant + other.constant, terms)

    def complement(self) -> Affine:
        """One minus this expression: the opposite of a binary."""
        return Affine(1.0).plus(self.times(-1.0))


class Programme:
    """A programme under construction: minimise the cost of the columns, subject to rows."""

    def __init__(self) -> None:
        self._cost: list[float] = []
        self._bounds: list[tuple[float, float]] = []
        self._integer: list[bool] = []
        self._entries: list[tuple[int, int, float]] = []
        self._rows: list[tuple[float, float]] = []

    def column(self, lower: float, upper: float, cost: float = 0.0) -> int:
        """A new continuous variable; returns its number."""
        return self._add(lower, upper, cost, False)

    def binary(self) -> int:
        """A new variable that is 0 or 1; returns its number."""
        return self._add(0.0, 1.0, 0.0, True)

    def row(self, lower: float, terms: Terms, upper: float) -> None:
        """Ask for ``lower <= sum of terms <= upper``; either may be infinite."""
        number = len(self._rows)
        self._rows.append((lower, upper))
        self._entries.extend((number, column, value) for column, value in terms)

    def at_most(self, terms: Terms, bound: Affine) -> None:
        """Ask for ``sum of terms <= bound``."""
        self.row(-np.inf, (*terms, *bound.times(-1.0).terms.items()), bound.constant)

    def within(self, terms: Terms, bound: Affine, centre: float = 0.0) -> None:
        """Ask for ``|sum of terms - centre| <= bound``."""
        terms = tuple(terms)
        self.at_most(terms, bound.plus(Affine(centre)))
        self.at_most(((column, -value) for column, value in terms), bound.plus(Affine(-centre)))

    def solve(self, time_limit: float, node_limit: int | None = None) -> F64 | None:
        """The best values found, float64 [column]; None if there are none, or none were found within the limits.

        Args:
            time_limit: seconds that the solver may take.
            node_limit: nodes of the branch-and-bound tree that it may solve; None: any number.
        """
        from scipy.optimize import Bounds, LinearConstraint, milp  # slow to import, and few agents solve anything
        from scipy.sparse import csr_array

        shape = len(self._rows), len(self._cost)
        row, column, value = np.array(self._entries, np.float64).reshape(-1, 3).T
        matrix = csr_array((value, (row.astype(np.int32), column.astype(np.int32))), shape)
        lower, upper = np.array(self._rows, np.float64).reshape(-1, 2).T
        options = {"time_limit": time_limit, "mip_rel_gap": _GAP}
        if node_limit is not None:
            options["node_limit"] = node_limit
        with _silent_standard_output():
            result = milp(
                np.array(self._cost),
                integrality=np.array(self._integer, np.int64),
                bounds=Bounds(*np.array(self._bounds).T),
                constraints=LinearConstraint(matrix, lower, upper),
                options=options,
            )
        return None if result.x is None else np.asarray(result.x, np.float64)

    def _add(self, lower: float, upper: float, cost: float, integer: bool) -> int:
        self._cost.append(cost)
        self._bounds.append((lower, upper))
        self._integer.append(integer)
        return len(self._cost) - 1


@contextmanager
def _silent_standard_output() -> Iterator[None]:
    """Drop what compiled code prints.

    HiGHS prints a line from ``transformNewIntegerFeasibleSolution`` with ``printf``, whatever it is told about output.
    """
    c_library = ctypes.CDLL(None)
    sys.stdout.flush()
    c_library.fflush(None)
    kept = os.dup(1)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 1)
        yield
    finally:
        c_library.fflush(None)  # what is still in the library's buffer would be written after the return
        os.dup2(kept, 1)
        os.close(kept)
