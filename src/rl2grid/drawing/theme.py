"""Colours of paper, ink and loadings, in light and dark.

Colours are those of Okabe and Ito, told apart by people with any colour vision; nothing is said by colour alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from matplotlib.colors import Colormap, LinearSegmentedColormap, ListedColormap

BLUE, VERMILLION, GREEN, ORANGE, SKY, PURPLE = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#56B4E9", "#CC79A7"
SAFE_LOADING, FULL_SCALE = 1.0, 1.5
CALM_LOADING, ALARM_LOADING = 0.8, 0.95
"""Between them colours change most: at the second one heuristics hand over to the agent."""


@dataclass(frozen=True)
class Theme:
    """Colours of paper and ink."""

    name: str
    background: str
    text: str
    muted: str
    rule: str
    loading: tuple[str, ...]
    """From a line without load to one near its limit; the last two are at :data:`CALM_LOADING` and from
    :data:`ALARM_LOADING` on."""
    overload: tuple[str, ...]
    """From a line at its limit to one at :data:`FULL_SCALE`, and beyond."""
    out: str
    """A line out of service."""
    series: tuple[str, ...]
    """Of lines and dots, in order of use."""


LIGHT = Theme(
    name="light",
    background="#ffffff",
    text="#1b1f24",
    muted="#667079",
    rule="#e4e7ea",
    loading=("#f4f7fa", "#a9cbe6", "#4a8fc7", "#0b2545"),
    overload=("#ec6a13", "#cc3311", "#a50f15", "#7a0010"),
    out="#b9bec4",
    series=(BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY),
)
DARK = Theme(
    name="dark",
    background="#15181c",
    text="#e8eaed",
    muted="#9aa3ad",
    rule="#30363d",
    loading=("#1b232c", "#1f4f7d", "#4a8fc7", "#dff1ff"),
    overload=("#ffa94d", "#ff7043", "#ff3355", "#ff1744"),
    out="#5b626b",
    series=(SKY, ORANGE, GREEN, PURPLE, VERMILLION, BLUE),
)


def style(theme: Theme) -> dict[str, Any]:
    """Settings of Matplotlib for figures in a theme, for :func:`matplotlib.rc_context`."""
    return {
        "figure.facecolor": theme.background,
        "axes.facecolor": theme.background,
        "savefig.facecolor": theme.background,
        "text.color": theme.text,
        "axes.labelcolor": theme.text,
        "axes.titlecolor": theme.text,
        "xtick.color": theme.muted,
        "ytick.color": theme.muted,
        "xtick.labelcolor": theme.text,
        "ytick.labelcolor": theme.text,
        "axes.edgecolor": theme.muted,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.linewidth": 0.8,
        "axes.axisbelow": True,
        "grid.color": theme.rule,
        "grid.linewidth": 0.8,
        "font.family": "DejaVu Sans",
        "font.size": 9,
        "axes.labelsize": 9,
        "xtick.labelsize": 8,
        "ytick.labelsize": 8,
        "legend.fontsize": 8,
        "legend.frameon": True,
        "legend.facecolor": theme.background,
        "legend.edgecolor": theme.rule,
        "legend.framealpha": 0.9,
        "figure.constrained_layout.w_pad": 0.12,
        "figure.constrained_layout.h_pad": 0.12,
        "pdf.fonttype": 42,
    }


def loading_colours(theme: Theme) -> Colormap:
    """Colours of loadings from 0 to :data:`FULL_SCALE`.

    Up to :data:`SAFE_LOADING` from empty to full, beyond it another hue: an overload is never a shade of normal. Most
    of the way from pale to dark (in the dark theme, to light) lies between 80 and 95%, so that these are told apart by
    brightness alone, with any colour vision.
    """
    *calm, alarm = theme.loading
    places = [*(k * CALM_LOADING / (len(calm) - 1) for k in range(len(calm))), ALARM_LOADING, SAFE_LOADING]
    below = LinearSegmentedColormap.from_list("below", list(zip(places, [*calm, alarm, alarm], strict=True)))
    *stages, beyond = theme.overload
    above = LinearSegmentedColormap.from_list("above", stages)
    n = 300
    limit = round(n * SAFE_LOADING / FULL_SCALE)
    colours = [below(k / (limit - 1)) for k in range(limit)] + [above(k / (n - limit - 1)) for k in range(n - limit)]
    return ListedColormap(colours).with_extremes(bad=theme.out, over=beyond)
