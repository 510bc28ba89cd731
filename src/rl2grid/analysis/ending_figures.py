"""Figures of where grids collapse: lines and substations that the rows of lost episodes name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from rl2grid.analysis import figures
from rl2grid.arrays import F64
from rl2grid.drawing.grid_drawing import GridDrawing, reference_scene
from rl2grid.drawing.theme import LIGHT, Theme, style
from rl2grid.grids import Grid
from rl2grid.records.episodes import Episode

MOST = 12
"""Lines or substations drawn as bars."""


@dataclass(frozen=True, eq=False)
class EndingCounts:
    """In how many lost episodes each line and substation was named."""

    lost: int
    """Lost episodes."""
    overloads: F64
    """[line] above its limit in the state before."""
    outages: F64
    """[line] out of service at the end."""
    cut_off: F64
    """[sub] cut off from the grid."""


def count_endings(grid: Grid, episodes: Sequence[Episode]) -> EndingCounts:
    """Count over the episodes that were lost."""
    lost = [episode for episode in episodes if not episode.completed]
    return EndingCounts(
        len(lost),
        _count((episode.last_overloads for episode in lost), grid.n_line),
        _count((episode.last_outages for episode in lost), grid.n_line),
        _count((episode.last_cut_off for episode in lost), grid.n_sub),
    )


def draw_ending_bars(grid: Grid, episodes: Sequence[Episode], *, title: str, theme: Theme = LIGHT) -> Figure:
    """The lines and substations that most of the lost episodes name."""
    counts = count_endings(grid, episodes)
    lines = [f"{k}: {_line(grid, k)}" for k in range(grid.n_line)]
    substations = [f"substation {k}" for k in range(grid.n_sub)]
    panels = (
        ("overloaded in the state before", counts.overloads, lines, theme.series[1]),
        ("out of service at the end", counts.outages, lines, theme.series[0]),
        ("cut off", counts.cut_off, substations, theme.series[2]),
    )
    with matplotlib.rc_context(style(theme)):
        rows = max(1, max(min(MOST, int(np.count_nonzero(values))) for _, values, _, _ in panels))
        figure = Figure(figsize=(8.6, 1.5 + 0.2 * rows), layout="constrained")
        grid_of_axes: list[Axes] = list(figure.subplots(1, len(panels)))
        for axes, (heading, values, names, colour) in zip(grid_of_axes, panels, strict=True):
            chosen = [k for k in np.argsort(-values, kind="stable")[:MOST].tolist() if values[k]]
            axes.barh(range(len(chosen)), values[chosen], height=0.7, color=colour)
            axes.set_yticks(range(len(chosen)), [names[k] for k in chosen], fontsize=7)
            axes.set_ylim(rows - 0.4, -0.6)
            axes.set_xlim(0, max(1.0, 1.05 * float(values.max())))
            axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
            axes.set_xlabel("Lost episodes")
            axes.annotate(
                heading, (0, 1), xycoords="axes fraction", xytext=(0, 3), textcoords="offset points", fontsize=8
            )
            axes.tick_params(axis="y", length=0)
            axes.grid(axis="x")
        sentence = f"how many of {counts.lost} lost episodes name a line (ends) or substation, the most frequent first"
        figures.headline_of_panels(figure, title, sentence)
    return figure


def draw_ending_map(grid: Grid, episodes: Sequence[Episode], *, title: str, theme: Theme = LIGHT) -> Figure:
    """The same on the grid: lines by how often they were overloaded or out, substations by how often cut off."""
    counts = count_endings(grid, episodes)
    named = _count((_either(episode) for episode in episodes if not episode.completed), grid.n_line)
    lost = max(counts.lost, 1)
    colours = LinearSegmentedColormap.from_list("endings", [theme.rule, *_ending_colours(theme)])
    with matplotlib.rc_context(style(theme)):
        figure = Figure(figsize=(8.4, 5.2))
        axes = figure.add_axes((0.01, 0.02, 0.87, 0.86))
        drawing = GridDrawing(grid, axes, theme=theme)
        drawing.show(reference_scene(grid))
        centre = np.array(grid.layout, np.float64)
        segments = np.stack((centre[grid.line_or_to_subid], centre[grid.line_ex_to_subid]), axis=1)
        share = named / lost
        # The most frequent on top, above the grey of the drawing and below its discs.
        order = [line for line in np.argsort(share, kind="stable").tolist() if share[line] > 0]
        relative = share[order] / max(share.max(), 1e-9)
        lines = LineCollection(list(segments[order]), colors=colours(relative), zorder=2.035, capstyle="round")
        lines.set_linewidth(list((1.5 + 6 * relative) * drawing.points / 60))
        axes.add_collection(lines)
        cut = counts.cut_off / lost
        diameter = (0.5 + 0.5 * cut[cut > 0]) * drawing.points
        x, y = centre[cut > 0].T
        axes.scatter(x, y, s=diameter**2, color=theme.series[0], alpha=0.35, linewidth=0, zorder=1.9)
        bar = figure.colorbar(
            ScalarMappable(Normalize(0, max(float(share.max()), 1e-9)), colours),
            cax=figure.add_axes((0.9, 0.15, 0.016, 0.55)),
        )
        bar.outline.set_visible(False)
        bar.ax.yaxis.set_major_formatter(matplotlib.ticker.PercentFormatter(1.0, decimals=0))
        bar.set_label("Lost episodes that name the line")
        figure.text(0.012, 0.95, title, fontsize=11, fontweight="bold")
        sentence = (
            f"{counts.lost} lost episodes; lines: overloaded in the state before the end, or out at the end; "
            "blue: substations cut off, the wider the more often"
        )
        figure.text(0.012, 0.91, sentence, fontsize=8, color=theme.muted)
    return figure


def _ending_colours(theme: Theme) -> tuple[str, str]:
    """Colours of a line that some, and that most of the lost episodes name."""
    return ("#F28E2B", "#A50F15") if theme.name == "light" else ("#F28E2B", "#FF6B57")


def _either(episode: Episode) -> str:
    return " ".join(sorted({*episode.last_overloads.split(), *episode.last_outages.split()}, key=int))


def _count(names: Iterable[str], n: int) -> F64:
    counted = Counter(int(name) for text in names for name in text.split())
    return np.array([counted[k] for k in range(n)], np.float64)


def _line(grid: Grid, line: int) -> str:
    return f"{grid.line_or_to_subid[line]} to {grid.line_ex_to_subid[line]}"
