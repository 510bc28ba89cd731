"""Figures of action spaces (paper, Section 3.1 and Appendix A), and of one action on the grid."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter, PercentFormatter
from numpy.typing import NDArray

from rl2grid.analysis import figures
from rl2grid.analysis.action_space import (
    SubstationShare,
    changed_elements,
    element_names,
    substation_shares,
    switches_held,
    topology_after,
)
from rl2grid.arrays import F64
from rl2grid.drawing.grid_drawing import GridDrawing, add_legend, reference_scene
from rl2grid.drawing.theme import LIGHT, Theme, style
from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.grids.ranking import Trials
from rl2grid.grids.rankings import ranking, trials
from rl2grid.mdp.actions import ActionKind, StepAction, describe
from rl2grid.records.shares import wilson_interval

MAX_POINTS = 600
"""Columns of a curve over actions: more actions are pooled."""
LOGARITHMIC_FROM = 1000
"""Ranks are drawn on a logarithmic axis from this number of actions on, so that the first levels are seen."""
MAX_BAR_NUMBERS = 60
LABEL_DISTANCES = (0.95, 1.15, 1.35, 1.55, 1.75)
"""From a substation to the names of its elements, in units of the drawing; the first without an overlap is used."""


def draw_shares(grid: Grid, *, theme: Theme = LIGHT) -> Figure:
    """Share of every substation's moves, and of the line switches, that each level holds; most moves first.

    The highest level holds every action: its panel shows how many that is.
    """
    shares = substation_shares(grid)
    n_levels, place = len(grid.level_sizes), np.arange(len(shares))
    apart = len(shares) + max(0.5, 0.02 * len(shares))
    with matplotlib.rc_context(style(theme)):
        figure = Figure(figsize=(float(np.clip(0.16 * len(shares) + 1.5, 6.4, 11.0)), 1.35 * n_levels + 1.1),
                        layout="constrained")  # fmt: skip
        _close_rows(figure)
        panels: list[Axes] = list(figure.subplots(n_levels, 1, sharex=True, squeeze=False)[:, 0])
        for level, axes in enumerate(panels[:-1]):
            held = np.array([share.held[level] for share in shares])
            height = held / np.array([share.moves for share in shares])
            axes.bar(place, height, width=0.78, color=theme.series[0])
            switches = switches_held(grid, level)
            axes.bar(apart, switches / grid.n_line, width=_switch_width(shares), color=theme.series[1])
            _number_bars(axes, [*place, apart], [*height, switches / grid.n_line], [*held, switches], theme)
            axes.set_ylim(0, 1.22)
            axes.set_ylabel("Share held")
            axes.set_yticks([0, 0.5, 1])
            axes.yaxis.set_major_formatter(PercentFormatter(1.0))
            _panel_title(axes, f"level {level}: {grid.level_sizes[level]:,} actions")
        last = panels[-1]
        moves = [share.moves for share in shares]
        last.bar(place, moves, width=0.78, color=theme.muted)
        last.bar(apart, grid.n_line, width=_switch_width(shares), color=theme.muted)
        last.set_yscale("log")
        last.set_ylabel("Actions")
        last.set_ylim(0.7, 12 * max(moves))
        last.yaxis.set_major_formatter(FuncFormatter(figures._thousands))
        last.yaxis.set_minor_formatter(NullFormatter())
        _panel_title(last, f"level {n_levels - 1}: all {grid.level_sizes[-1]:,} actions")
        crowded = len(shares) > MAX_BAR_NUMBERS
        labels = [str(share.substation) for share in shares]
        last.set_xticks(
            [*place, apart], [*labels, "lines"], fontsize=5 if crowded else 7, rotation=90 if crowded else 0
        )
        last.set_xlim(-0.8, apart + 0.5 + _switch_width(shares) / 2)
        last.set_xlabel("Substation, the one with most actions first")
        for axes in panels:
            axes.grid(axis="y")
            axes.tick_params(axis="x", length=0)
        counted = "" if crowded else ", and how many"
        sentence = f"share of each substation's moves that a level holds{counted}; right: switches of lines"
        figures._headline(panels[0], f"Actions of {grid.id} by substation", sentence)
    return figure


def draw_trials(grid: Grid, *, theme: Theme = LIGHT) -> Figure:
    """How often each action was tried, in the order of the catalogue, with their distribution.

    Raises:
        UsageError: the ranking tells nothing of trials.
    """
    counts = trials(grid.id).trials[1:].astype(np.float64)
    pools = np.array_split(np.arange(len(counts)), min(len(counts), MAX_POINTS))
    position = [1 + pool.mean() for pool in pools]
    with matplotlib.rc_context(style(theme)):
        figure = Figure(figsize=(6.4, 3.2), layout="constrained")
        axes, side = figure.subplots(1, 2, sharey=True, gridspec_kw={"width_ratios": [4, 1], "wspace": 0.02})
        if len(pools) < len(counts):
            low, high = ([pick(counts[pool]) for pool in pools] for pick in (np.min, np.max))
            axes.fill_between(position, low, high, color=theme.series[0], alpha=0.3, linewidth=0)
            axes.plot(position, [counts[pool].mean() for pool in pools], color=theme.series[0], linewidth=1)
        else:
            axes.plot(position, counts, ".", color=theme.series[0], markersize=4, markeredgewidth=0)
        spread = 1.96 * np.sqrt(counts.mean())
        for target in (axes, side):
            target.axhspan(counts.mean() - spread, counts.mean() + spread, color=theme.muted, alpha=0.18, linewidth=0)
            target.axhline(counts.mean(), color=theme.text, linewidth=0.9, linestyle=(0, (4, 2)))
        axes.set(xlim=(0, len(counts) + 1), ylim=(0, 1.15 * max(counts.max(), counts.mean() + spread)))
        axes.set(xlabel="Action (catalogue id)", ylabel="Trials")
        axes.xaxis.set_major_formatter(FuncFormatter(figures._thousands))
        axes.yaxis.set_major_formatter(FuncFormatter(figures._thousands))
        bins = max(10, min(25, int(counts.max() - counts.min())))
        side.hist(counts, bins=bins, orientation="horizontal", color=theme.series[0])
        side.set_xlabel("Actions")
        side.xaxis.set_major_locator(MaxNLocator(3, integer=True))
        side.xaxis.set_major_formatter(FuncFormatter(figures._thousands))
        side.tick_params(axis="y", length=0)
        figures._headline(
            axes,
            f"Trials of every action of {grid.id}",
            f"{counts.mean():,.0f} per action on average; grey: where 95% of uniform draws fall"
            + ("; blue: range" if len(pools) < len(counts) else ""),
        )
    return figure


def draw_ranking(grid: Grid, *, theme: Theme = LIGHT) -> Figure:
    """Survival and margin of the actions in the order of the ranking; dashed: where a level ends.

    Raises:
        UsageError: the ranking tells nothing of trials.
    """
    tried, ids = trials(grid.id), ranking(grid.id).ids
    low, high = wilson_interval(tried.survived[ids], tried.trials[ids])
    margin = np.where(tried.survived[ids] > 0, tried.margin[ids], np.nan).astype(np.float64)
    logarithmic = len(ids) >= LOGARITHMIC_FROM
    pools = _rank_pools(len(ids), logarithmic)
    position = np.array([1 + pool.mean() for pool in pools])
    with matplotlib.rc_context(style(theme)):
        figure = Figure(figsize=(7.2, 4.2), layout="constrained")
        upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [2.2, 1]})
        _close_rows(figure)
        colour = theme.series[0]
        upper.fill_between(position, _pooled(low, pools), _pooled(high, pools), color=colour, alpha=0.22, linewidth=0)
        upper.plot(position, _pooled(tried.survival[ids], pools), color=colour, linewidth=1.5)
        upper.yaxis.set_major_formatter(PercentFormatter(1.0))
        upper.set_ylabel("Survival")
        lower.plot(position, _pooled(margin, pools), color=theme.series[1], linewidth=1.0)
        lower.set(ylabel="Mean margin", xlabel="Rank")
        if logarithmic:
            upper.set_xscale("log")
        upper.set_xlim(1, len(ids))
        upper.set_ylim(top=1.0 + 0.03 * (1.0 - upper.get_ylim()[0]))
        lower.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
        for axes in (upper, lower):
            axes.grid(axis="y")
        _draw_nothing(upper, lower, tried, theme)
        _draw_boundaries((upper, lower), grid, theme)
        nothing = "; dotted: do nothing" if tried.survived[0] else ""
        sentence = f"share of trials without a collapse; band: 95% of one action; dashed: end of a level{nothing}"
        figures._headline(upper, f"Ranking of the actions of {grid.id}", sentence)
    return figure


def draw_action(grid: Grid, action: StepAction, *, theme: Theme = LIGHT) -> Figure:
    """A move or switch of the catalogue: where it is on the grid, and its surroundings before and after.

    Raises:
        UsageError: the action does nothing.
    """
    if not action.changes:
        raise UsageError("Do nothing changes nothing, so there is nothing to draw: choose another action.")
    highlighted = np.zeros(grid.dim_topo, np.bool_)
    highlighted[changed_elements(grid, action)] = True
    before = dataclasses.replace(reference_scene(grid), highlighted=highlighted)
    after = dataclasses.replace(before, topo_vect=topology_after(grid, action))
    acted = sorted(set(grid.element_to_subid[highlighted].tolist()))
    sentence = (
        "from the reference topology, everything in service and on busbar 1; yellow: what the action changes; "
        "bars: busbar 1 above, busbar 2 below"
    )
    with matplotlib.rc_context(style(theme)):
        figure = Figure(figsize=(12.0, 4.6))
        overview = figure.add_axes((0.01, 0.08, 0.415, 0.76))
        GridDrawing(grid, overview, theme=theme).show(before)
        for left, heading, scene in ((0.44, "before", before), (0.725, "after", after)):
            axes = figure.add_axes((left, 0.08, 0.265, 0.74))
            drawing = GridDrawing(grid, axes, theme=theme, substations=acted, border=1.9)
            drawing.show(scene)
            _label_elements(axes, drawing, grid, action, theme)
            axes.set_title(heading, fontsize=9, fontweight="bold", loc="left", pad=2)
            figure.add_artist(Line2D([left - 0.01] * 2, [0.1, 0.84], color=theme.rule, linewidth=0.8))
        words = describe(grid, action)
        figure.text(0.012, 0.94, words[0].upper() + words[1:], fontsize=11, fontweight="bold")
        figure.text(0.012, 0.89, sentence, fontsize=8, color=theme.muted)
        add_legend(figure, grid, theme, known_loading=False)
    return figure


def _switch_width(shares: Sequence[SubstationShare]) -> float:
    """The bar of the switches is as wide as its label needs."""
    return max(0.78, 0.012 * len(shares))


def _number_bars(
    axes: Axes, places: Sequence[float], heights: Sequence[float], numbers: Sequence[int], theme: Theme
) -> None:
    if len(places) > MAX_BAR_NUMBERS:
        return
    for place, height, number in zip(places, heights, numbers, strict=True):
        if number:
            axes.annotate(
                _compact(number), (place, height), xytext=(0, 1.5), textcoords="offset points", ha="center",
                fontsize=5.5 if len(places) > 20 else 7, color=theme.text,
            )  # fmt: skip


def _compact(number: int) -> str:
    """Two digits of what has more than three, as "11k"."""
    return figures._thousands(round(number, 2 - len(str(number))) if number >= 1000 else number, None)


def _close_rows(figure: Figure) -> None:
    """Panels above each other share an axis: less space between them."""
    engine = figure.get_layout_engine()
    assert isinstance(engine, ConstrainedLayoutEngine)
    engine.set(h_pad=0.06, hspace=0.0)


def _panel_title(axes: Axes, text: str) -> None:
    axes.annotate(
        text, (1, 1), xycoords="axes fraction", xytext=(-2, -1), textcoords="offset points", ha="right", va="top",
        fontsize=8, fontweight="bold",
        bbox={"boxstyle": "square,pad=0.15", "facecolor": axes.get_facecolor(), "edgecolor": "none", "alpha": 0.85},
    )  # fmt: skip


def _rank_pools(n: int, logarithmic: bool) -> list[NDArray[np.int64]]:
    """Neighbouring ranks, from 0 on, of about the same width on the axis."""
    if not logarithmic:
        return np.array_split(np.arange(n), min(n, MAX_POINTS))
    bounds = np.unique(np.geomspace(1, n + 1, MAX_POINTS).astype(np.int64)) - 1
    return [np.arange(first, last) for first, last in itertools.pairwise(bounds.tolist())]


def _pooled(values: F64, pools: Sequence[NDArray[np.int64]]) -> F64:
    """Mean of each pool over the values that are known; NaN where none is."""
    known = [values[pool][~np.isnan(values[pool])] for pool in pools]
    return np.array([pool.mean() if pool.size else np.nan for pool in known])


def _draw_nothing(upper: Axes, lower: Axes, tried: Trials, theme: Theme) -> None:
    """Survival and margin of doing nothing, for comparison."""
    if not tried.survived[0]:
        return
    for axes, value in ((upper, tried.survival[0]), (lower, tried.margin[0])):
        axes.axhline(value, color=theme.muted, linewidth=1.0, linestyle=(0, (1, 1.5)))


def _draw_boundaries(panels: Sequence[Axes], grid: Grid, theme: Theme) -> None:
    """Dashed lines behind the last action of each level but the highest; do nothing has no rank."""
    for level, size in enumerate(grid.level_sizes[:-1]):
        for axes in panels:
            axes.axvline(size - 0.5, color=theme.text, linewidth=0.9, linestyle=(0, (4, 2)))
        panels[0].annotate(
            f"level {level}\n{size:,}", (size - 0.5, 0), xycoords=("data", "axes fraction"), xytext=(-3, 4),
            textcoords="offset points", ha="right", va="bottom", fontsize=7, color=theme.text,
        )  # fmt: skip


def _label_elements(axes: Axes, drawing: GridDrawing, grid: Grid, action: StepAction, theme: Theme) -> None:
    """Short names of the changed elements, each as near as the others leave room."""
    for change in action.changes:
        if change.kind == ActionKind.SWITCH:
            _label_line(axes, drawing, grid, change.target, theme)
    names = element_names(grid)
    taken: list[tuple[float, float]] = []
    moves = StepAction(tuple(change for change in action.changes if change.kind == ActionKind.MOVE))
    for element in changed_elements(grid, moves).tolist():
        name = names[element].split(" to ")[0].replace("generator", "gen")
        # About what a label takes, in the units of the layout.
        size = (5.6 * len(name) / drawing.points * drawing.unit, 12.0 / drawing.points * drawing.unit)
        farthest = drawing.reach(element)
        spots = [drawing.beside(element, min(distance, farthest)) for distance in LABEL_DISTANCES]
        spot = next((spot for spot in spots if not _overlaps(spot, taken, size)), spots[-1])
        taken.append(spot)
        axes.annotate(name, spot, ha="center", va="center", **_label_style(theme))


def _label_line(axes: Axes, drawing: GridDrawing, grid: Grid, line: int, theme: Theme) -> None:
    """The name of a line beside its middle: above it, or to its right where it is steep."""
    origin = int(grid.line_or_pos_topo_vect[line])
    start, middle = drawing.beside(origin, 0.0), drawing.beside(origin, drawing.reach(origin))
    steep = abs(middle[1] - start[1]) > abs(middle[0] - start[0])
    placing: dict[str, Any] = {"xytext": (9, 0), "va": "center"} if steep else {"xytext": (0, 9), "ha": "center"}
    axes.annotate(f"line {line}", middle, textcoords="offset points", **placing, **_label_style(theme))


def _label_style(theme: Theme) -> dict[str, Any]:
    box = {"boxstyle": "round,pad=0.12", "facecolor": theme.background, "edgecolor": "none", "alpha": 0.85}
    return {"fontsize": 7.5, "fontweight": "bold", "color": theme.text, "zorder": 5, "clip_on": True, "bbox": box}


def _overlaps(spot: tuple[float, float], taken: Sequence[tuple[float, float]], size: tuple[float, float]) -> bool:
    return any(abs(spot[0] - x) < size[0] and abs(spot[1] - y) < size[1] for x, y in taken)
