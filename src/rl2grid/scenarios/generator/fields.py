"""Noise that is smooth in time and shared by neighbours.

Independent numbers on a mesh of places, one set every ``spacing`` rows, are joined by cubic B-splines in time and
by inverse distances in space; every value has mean 0 and variance 1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rl2grid.arrays import F64, I32
from rl2grid.compile import jit
from rl2grid.grids import Grid
from rl2grid.scenarios.generator.arithmetic import gaussians
from rl2grid.scenarios.generator.draws import Channel, Portion

_MESH = 4
"""Places of the mesh per direction."""


class Field(NamedTuple):
    """Noise of several elements."""

    knots: F64  # [knot, element]
    first: int  # number of the first knot; knot 0 is that of row 0
    blend: F64  # [spacing, 4] weights of the four knots around a row


def new_field(portion: Portion, channel: Channel, spacing: int, weights: F64) -> Field:
    """A field that varies over some ``spacing`` rows.

    Args:
        portion: rows it must cover.
        channel: where its numbers come from.
        spacing: rows between two knots.
        weights: float64 [element, place], each row of unit length.
    """
    places = _independent(portion, channel, spacing, weights.shape[1])
    return Field(_spread(places, weights), portion.first // spacing, _blend(spacing))


def new_independent_field(portion: Portion, channel: Channel, spacing: int, n: int) -> Field:
    """A field of ``n`` elements that share nothing."""
    return Field(_independent(portion, channel, spacing, n), portion.first // spacing, _blend(spacing))


def _independent(portion: Portion, channel: Channel, spacing: int, n: int) -> F64:
    """The numbers of all knots that the rows of a portion need, float64 [knot, n]."""
    count = portion.stop // spacing - portion.first // spacing + 4
    return gaussians(portion.draws(channel), count * n).reshape(count, n)


def neighbourly(grid: Grid, subs: I32) -> F64:
    """Weights of elements at the substations ``subs``: near ones vary together."""
    layout = np.array(grid.layout)
    low = layout.min(axis=0)
    place = (layout[subs] - low) / (layout.max(axis=0) - low).max() * (_MESH - 1)
    return _inverse_distances(place, _MESH)


@jit
def value(field: Field, row: int, element: int) -> float:
    """The noise of one element in one row."""
    spacing = field.blend.shape[0]
    w = field.blend[row % spacing]
    first = row // spacing - field.first
    knots = field.knots
    return float(
        w[0] * knots[first, element]
        + w[1] * knots[first + 1, element]
        + w[2] * knots[first + 2, element]
        + w[3] * knots[first + 3, element]
    )


@jit
def _spread(places: F64, weights: F64) -> F64:
    knots = np.zeros((places.shape[0], weights.shape[0]))
    for k in range(places.shape[0]):
        for element in range(weights.shape[0]):
            total = 0.0
            for place in range(weights.shape[1]):
                total += weights[element, place] * places[k, place]
            knots[k, element] = total
    return knots


@jit
def _blend(spacing: int) -> F64:
    """B-spline weights, scaled to unit length so that the noise has the same variance in every row."""
    blend = np.empty((spacing, 4))
    for row in range(spacing):
        x = row / spacing
        y = 1.0 - x
        w = blend[row]
        w[0] = y * y * y / 6.0
        w[1] = (4.0 - x * x * (6.0 - 3.0 * x)) / 6.0
        w[2] = (4.0 - y * y * (6.0 - 3.0 * y)) / 6.0
        w[3] = x * x * x / 6.0
        length = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2] + w[3] * w[3])
        for k in range(4):
            w[k] /= length
    return blend


@jit
def _inverse_distances(place: F64, mesh: int) -> F64:
    weights = np.empty((place.shape[0], mesh * mesh))
    for element in range(place.shape[0]):
        total = 0.0
        for k in range(mesh * mesh):
            dx, dy = place[element, 0] - k // mesh, place[element, 1] - k % mesh
            weight = 1.0 / (dx * dx + dy * dy + 0.25)
            weights[element, k] = weight
            total += weight * weight
        length = np.sqrt(total)
        for k in range(mesh * mesh):
            weights[element, k] /= length
    return weights
