"""Lanes, one by one, are what numbers are."""

from __future__ import annotations

import math

import numba
import numpy as np
import pytest

from rl2grid.powerflow.lanes import (
    WIDTH,
    entries,
    larger,
    like,
    load_columns,
    magnitude,
    root,
    store_columns,
    where_equal,
    where_less,
)

_at, _set = entries(1)
_pair_at, _set_pair = entries(2)


@numba.njit
def combine(a, b, out):
    """A number of each kind of operation, entry by entry, of numbers or of lanes."""
    x, y = _at(a, 0), _at(b, 0)
    total = like(x, 0.0)
    total += 2.0 * x - y / 3.0
    total -= -x * y
    _set(out, 0, total)
    _set(out, 1, larger(x, y))
    _set(out, 2, magnitude(x) + root(magnitude(y)))
    _set(out, 3, where_less(x, y, 1.0, x))
    _set(out, 4, where_equal(x, 0.5, y, where_less(0.5, x, x, -y)))
    _set(out, 5, 7.0)


@numba.njit
def swap_pairs(values):
    """Exchange the two entries of a row of two axes, which count as one."""
    first, second = _pair_at(values, 2), _pair_at(values, 3)
    _set_pair(values, 2, second)
    _set_pair(values, 3, first)


@numba.njit
def transpose_in(matrix, rows, column, lanes):
    load_columns(matrix, rows, column, lanes)


@numba.njit
def transpose_out(matrix, rows, column, lanes):
    store_columns(matrix, rows, column, lanes)


def test_equations_are_written_once_for_numbers_and_for_lanes():
    random = np.random.default_rng(0)
    a, b = random.normal(size=(2, 1, WIDTH))
    a[0, 2], b[0, 4] = 0.5, math.nan
    together = np.zeros((6, WIDTH))
    combine(a, b, together)
    for lane in range(WIDTH):
        alone = np.zeros(6)
        combine(a[:, lane].copy(), b[:, lane].copy(), alone)
        is_number = [True, lane != 4, True, True, True, True]  # of two the larger, if one is no number, is anything
        np.testing.assert_array_equal(together[is_number, lane], alone[is_number])
    assert together[4, 2] == b[0, 2], "of lanes that differ each takes its own branch"


def test_axes_before_the_lanes_count_as_one():
    numbers = np.arange(6.0).reshape(3, 2)
    swap_pairs(numbers)
    assert numbers.tolist() == [[0, 1], [3, 2], [4, 5]]
    lanes = np.repeat(np.arange(6.0), WIDTH).reshape(3, 2, WIDTH)
    swap_pairs(lanes)
    assert lanes[:, :, 0].tolist() == numbers.tolist()


@pytest.mark.parametrize("column", [0, 5])
def test_columns_of_chosen_rows_are_rows_of_lanes(column):
    matrix = np.random.default_rng(1).normal(size=(12, 20))
    rows = np.array([3, 0, 11, 7, 7, 2, 5, 1])
    lanes = np.zeros((20, WIDTH))
    transpose_in(matrix, rows, column, lanes)
    inside = slice(column, column + WIDTH)
    np.testing.assert_array_equal(lanes[inside], matrix[rows, inside].T)
    lanes[inside] = 0.0
    assert not lanes.any()


def test_rows_of_lanes_are_written_to_columns_of_chosen_rows():
    matrix, rows = np.zeros((12, 20)), np.array([3, 0, 11, 7, 4, 2, 5, 1])
    lanes = np.random.default_rng(2).normal(size=(20, WIDTH))
    transpose_out(matrix, rows, 6, lanes)
    np.testing.assert_array_equal(matrix[rows, 6:14], lanes[6:14].T)
    matrix[rows, 6:14] = 0.0
    assert not matrix.any()
