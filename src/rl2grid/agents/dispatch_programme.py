"""The linear programme of dispatch: what controls inject away from rest, built from arrays and solved by HiGHS."""

from __future__ import annotations

import highspy
import numpy as np

from rl2grid.agents.dispatch import Control
from rl2grid.arrays import F64, I64


class DispatchProgramme:
    """A linear programme under construction: what the controls inject away from rest, above and below it, and more.

    Args:
        control: the controls, whose changes sum to zero.
        price: of a MW of each away from rest.
    """

    def __init__(self, control: Control, price: F64) -> None:
        self.n_control = len(control.now)
        self._control = control
        least, most = control.least - control.at_rest, control.most - control.at_rest
        self._lower = [np.maximum(least, 0.0), np.maximum(-most, 0.0)]
        self._upper = [np.maximum(most, 0.0), np.maximum(-least, 0.0)]
        self._cost = [price, price]
        self._bounds: list[F64] = []
        self._row: list[I64] = []
        self._column: list[I64] = []
        self._value: list[F64] = []
        self._n_columns, self._n_rows = 2 * self.n_control, 0

    def add(self, lower: F64, cost: F64) -> int:
        """New columns, without upper bound; returns the first."""
        first = self._n_columns
        self._lower.append(lower)
        self._upper.append(np.full(len(lower), np.inf))
        self._cost.append(cost)
        self._n_columns += len(lower)
        return first

    def at_most(self, effect: F64, bound: F64, *others: tuple[int, F64]) -> None:
        """Ask for ``effect @ injected + sum of others <= bound``.

        Args:
            effect: per MW that each control injects, [row, control].
            bound: [row]
            others: first column and coefficients, [row, column], or [row] where every row has a column of its own.
        """
        self._enter(0, effect)
        self._enter(self.n_control, -effect)
        for first, coefficients in others:
            self._enter(first, coefficients)
        self._bounds.append(bound - effect @ self._control.at_rest)
        self._n_rows += len(bound)

    def solve(self) -> F64 | None:
        """MW that each control injects at the least cost, float64 [control]; None: the solver found nothing."""
        n, at_rest = self.n_control, self._control.at_rest
        model = highspy.Highs()  # type: ignore[no-untyped-call]
        model.setOptionValue("output_flag", False)
        model.setOptionValue("threads", 1)
        model.passModel(self._model())
        model.run()
        if model.getModelStatus() != highspy.HighsModelStatus.kOptimal:
            return None
        found = np.array(model.getSolution().col_value[: 2 * n], np.float64)
        return at_rest + found[:n] - found[n:]

    def _model(self) -> highspy.HighsLp:
        """The programme as HiGHS takes it; its first row is the balance."""
        n = self.n_control
        total = float((self._control.now - self._control.at_rest).sum())
        row = np.concatenate((np.zeros(2 * n, np.int64), *(1 + row for row in self._row)))
        column = np.concatenate((np.arange(2 * n), *self._column))
        value = np.concatenate((np.ones(n), -np.ones(n), *self._value))
        order = np.argsort(row, kind="stable")
        programme = highspy.HighsLp()
        programme.num_col_, programme.num_row_ = self._n_columns, 1 + self._n_rows
        programme.col_cost_ = np.concatenate(self._cost)
        programme.col_lower_, programme.col_upper_ = np.concatenate(self._lower), np.concatenate(self._upper)
        programme.row_lower_ = np.concatenate(([total], np.full(self._n_rows, -np.inf)))
        programme.row_upper_ = np.concatenate(([total], *self._bounds))
        matrix = programme.a_matrix_
        matrix.format_ = highspy.MatrixFormat.kRowwise
        matrix.start_ = np.concatenate(([0], np.cumsum(np.bincount(row, minlength=1 + self._n_rows)))).astype(np.int32)
        matrix.index_, matrix.value_ = column[order].astype(np.int32), value[order]
        return programme

    def _enter(self, first: int, coefficients: F64) -> None:
        if coefficients.ndim == 1:
            row = column = np.arange(len(coefficients))
            value = coefficients
        else:
            row, column = np.nonzero(coefficients)
            value = coefficients[row, column]
        self._row.append(self._n_rows + row)
        self._column.append(first + column)
        self._value.append(value)
