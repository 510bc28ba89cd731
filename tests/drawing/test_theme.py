"""Colours of loadings: told apart on both papers and with any colour vision."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from rl2grid.drawing.grid_drawing import loading_colours
from rl2grid.drawing.theme import DARK, FULL_SCALE, LIGHT

# Machado, Oliveira and Fernandes (2009), linear RGB, complete dichromacy.
VISIONS = {
    "any": np.eye(3),
    "no red": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "no green": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "no blue": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}
TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
WHITE = np.array([0.95047, 1.0, 1.08883])
TELLING = 25
"""Distance in CIELAB of colours that are told apart on thin lines; 2.3 is just noticed on large areas."""
SEEN = 3.0
"""Least contrast of graphics that matter (WCAG 2.1, 1.4.11)."""


def linear(colour):
    value = np.array(to_rgb(colour))
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def lab(light):
    share = TO_XYZ @ np.clip(light, 0, 1) / WHITE
    x, y, z = np.where(share > 216 / 24389, np.cbrt(share), (24389 / 27 * share + 16) / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def contrast(one, other):
    dark, light = sorted(float(TO_XYZ[1] @ linear(colour)) for colour in (one, other))
    return (light + 0.05) / (dark + 0.05)


def colour_of(theme, loading):
    return loading_colours(theme)(loading / FULL_SCALE)[:3]


@pytest.mark.parametrize("vision", VISIONS)
@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=lambda theme: theme.name)
def test_calm_alarm_and_overload_are_told_apart(theme, vision):
    shades = [lab(VISIONS[vision] @ linear(colour_of(theme, loading))) for loading in (0.5, 0.8, 0.95, 1.05)]
    for one, other in itertools.combinations(shades[1:], 2):
        assert np.linalg.norm(one - other) > TELLING
    assert np.linalg.norm(shades[0] - shades[2]) > TELLING


@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=lambda theme: theme.name)
def test_loaded_lines_are_seen_on_paper(theme):
    for loading in (0.8, 0.9, 0.95, 1.0, 1.05, 1.2, 1.4, 2.0):
        assert contrast(colour_of(theme, loading), theme.background) > SEEN, loading


@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=lambda theme: theme.name)
def test_brightness_alone_orders_loadings_up_to_the_limit(theme):
    brightness = [lab(linear(colour_of(theme, loading)))[0] for loading in (0.0, 0.4, 0.8, 0.9, 0.95)]
    assert brightness == sorted(brightness, reverse=theme is LIGHT)
