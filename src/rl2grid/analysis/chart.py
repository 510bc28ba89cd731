"""Curves that can be read in a browser: values under the pointer, zoom, and methods switched on and off.

A chart is a figure element with its numbers as JSON; a page that has some embeds one small script, which draws all of
them. Nothing is fetched.
"""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rl2grid.analysis.curves import (
    SMOOTHED_EPISODES,
    Line,
    leading,
    lifetime_lines,
    profile_lines,
    training_lines,
)
from rl2grid.analysis.figures import DASHES
from rl2grid.analysis.page import embedded, resource_text
from rl2grid.analysis.training_figures import Panel
from rl2grid.arrays import F64
from rl2grid.drawing.theme import DARK, LIGHT, Theme
from rl2grid.records.methods import Method, interval_units
from rl2grid.records.metrics import SURVIVAL
from rl2grid.records.trainings import TrainingCurve

MOST_POINTS = 400
"""Of a curve: a screen shows no more, and neither tells more."""
DIGITS = 4
"""Significant digits of the numbers under the pointer."""
LOOKS = len(LIGHT.series) * len(DASHES)
"""Curves that look different."""
FIRST_SHOWN = 8
"""Curves switched on when the page is opened: the best ones."""


@dataclass(frozen=True)
class ChartPanel:
    """One pair of axes."""

    title: str
    lines: tuple[Line, ...]
    share: bool = False
    """Whether values are between 0 and 1, to be shown as percent."""
    threshold: float | None = None


@dataclass(frozen=True)
class Chart:
    """Panels side by side, over the same budget, time or share, with one legend."""

    title: str
    sentence: str
    """What is drawn, below the title."""
    x: str
    """What is on the horizontal axis."""
    panels: tuple[ChartPanel, ...]
    steps: bool = False
    """Whether curves are staircases."""
    x_share: bool = False


def training_chart(
    curves: Mapping[str, Sequence[TrainingCurve]], panels: Sequence[Panel], *, title: str, x: str = "decisions"
) -> Chart:
    """Metrics of training episodes against the budget; validation is marked where survival is drawn."""
    runs = [run for group in curves.values() for run in group]
    drawn = tuple(
        ChartPanel(
            panel.title,
            tuple(training_lines(runs, panel.metric, x=x, validation=panel.metric == SURVIVAL)),
            share=panel.metric == SURVIVAL,
            threshold=panel.threshold,
        )
        for panel in panels
    )
    sentence = f"Means over {SMOOTHED_EPISODES} episodes."
    if any(line.low is not None for panel in drawn for line in panel.lines):
        sentence += " Bands: 95% intervals over runs."
    if any(line.dots for panel in drawn for line in panel.lines):
        sentence += " Dots: iterations of one run."
    if any(line.marks for panel in drawn for line in panel.lines):
        sentence += " Diamonds: validation."
    return Chart(title, sentence, "Decisions" if x == "decisions" else "Grid steps", drawn)


def profile_chart(methods: Sequence[Method], *, title: str) -> Chart:
    """Performance profiles."""
    panel = ChartPanel("Share of episodes that survive beyond it", tuple(profile_lines(methods)), share=True)
    sentence = f"Bands: 95% intervals over {interval_units(methods)}."
    return Chart(title, sentence, "Share of the episode survived", (panel,), x_share=True)


def lifetime_chart(methods: Sequence[Method], *, title: str) -> Chart:
    """Kaplan-Meier curves."""
    panel = ChartPanel("Grids alive", tuple(lifetime_lines(methods)), share=True)
    sentence = (
        f"Kaplan-Meier; bands: 95% intervals over {interval_units(methods)}. "
        "Diamonds: completed episodes, which end there."
    )
    return Chart(title, sentence, "Days", (panel,), steps=True)


def chart_html(chart: Chart, caption: str, made: str = "") -> str:
    """A chart as a figure, with its caption and, as HTML, what made it."""
    title, sentence = html.escape(chart.title), html.escape(chart.sentence)
    return (
        f"<section><figure class=chart><h3>{title}</h3><p class=note>{sentence}</p>"
        f'<script type="application/json">{embedded(chart_data(chart))}</script>'
        "<noscript>Curves need JavaScript; <code>rl2grid analyse</code> draws them as PNG and PDF.</noscript>"
        f"<figcaption>{html.escape(caption)}{made}</figcaption></figure></section>"
    )


def chart_data(chart: Chart) -> dict[str, Any]:
    """What the page embeds, ready for JSON."""
    scores = {line.label: [line.score] for panel in chart.panels[:1] for line in panel.lines}
    first, _ = leading(scores, FIRST_SHOWN)
    # Where looks repeat, at least the best ones differ.
    looks = {label: place for place, label in enumerate(scores)} if len(scores) > LOOKS else {}
    return {
        "x": chart.x,
        "xShare": chart.x_share,
        "steps": chart.steps,
        "first": first,
        "panels": [
            {
                "title": panel.title,
                "share": panel.share,
                "threshold": panel.threshold,
                "lines": [
                    _line_data(replace(line, look=looks.get(line.label, line.look)), chart.steps)
                    for line in panel.lines
                ],
            }
            for panel in chart.panels
        ],
    }


def chart_assets() -> str:
    """Rules and the script that a page with charts embeds once, behind the last of them."""
    return f"<style>{resource_text('chart.css')}{_colours()}</style><script>{resource_text('chart.js')}</script>"


def _line_data(line: Line, steps: bool) -> dict[str, Any]:
    thinned = _thinned(line, steps)
    data: dict[str, Any] = {
        "label": line.label,
        "look": line.look,
        "x": _numbers(thinned.x),
        "y": _numbers(thinned.y),
    }
    if thinned.low is not None and thinned.high is not None:
        data |= {"low": _numbers(thinned.low), "high": _numbers(thinned.high)}
    for name, points in (("dots", line.dots), ("marks", line.marks)):
        if points is not None:
            chosen = _evenly(len(points.x))
            data[name] = {"x": _numbers(points.x[chosen]), "y": _numbers(points.y[chosen])}
    return data


def _thinned(line: Line, steps: bool) -> Line:
    """The curve at :data:`MOST_POINTS` of its points; a staircase is exact where it is read."""
    if len(line.x) <= MOST_POINTS:
        return line
    chosen = _evenly(len(line.x))
    if steps:
        moments = np.linspace(line.x[0], line.x[-1], MOST_POINTS)
        chosen = np.unique(np.searchsorted(line.x, moments, side="right") - 1)
    low, high = (None if band is None else band[chosen] for band in (line.low, line.high))
    return replace(line, x=line.x[chosen], y=line.y[chosen], low=low, high=high)


def _evenly(n: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.unique(np.linspace(0, n - 1, min(n, MOST_POINTS)).round().astype(np.int64))


def _numbers(values: F64) -> list[float | int | None]:
    """Rounded, whole numbers without a point; what is no number is a gap."""
    rounded = [float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None for value in values.tolist()]
    return [int(value) if value is not None and value.is_integer() else value for value in rounded]


def _colours() -> str:
    def rule(theme: Theme) -> str:
        return ":root{" + "".join(f"--curve-{k}:{colour};" for k, colour in enumerate(theme.series)) + "}"

    return f"{rule(LIGHT)}@media (prefers-color-scheme: dark){{{rule(DARK)}}}"
