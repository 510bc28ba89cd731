"""Figures that compare methods on one task: profiles, aggregates, improvements, months, lifetimes and costs."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, PercentFormatter

from rl2grid.analysis import figures
from rl2grid.analysis.curves import leading, leading_methods, lifetime_lines, profile_lines
from rl2grid.analysis.result_tables import AGGREGATES
from rl2grid.drawing.theme import BLUE, LIGHT, VERMILLION, Theme, style
from rl2grid.engines import HEURISTICS
from rl2grid.mdp.constraint_table import THRESHOLDS
from rl2grid.records.comparisons import probability_of_improvement
from rl2grid.records.methods import COSTS, Method, interval_units
from rl2grid.records.statistics import Estimate, estimate

MOST_MONTHS_NAMED = 64
"""Below a figure with a column per month: of more, every second or third."""
_SURVIVAL = "Share of the episode survived"


def draw_profiles(methods: Sequence[Method], *, theme: Theme = LIGHT) -> Figure:
    """Performance profiles: the share of episodes that survived longer than each share, with 95% bands."""
    shown, of_all = leading_methods(methods)
    with matplotlib.rc_context(style(theme)):
        figure, axes = _figure([method.label for method in shown])
        for line in profile_lines(shown):
            figures.draw_line(axes, line, theme, linewidth=1.8, band=_band(shown))
        axes.set(xlim=(0, 1), ylim=(0, 1.03), xlabel=f"{_SURVIVAL}, τ", ylabel="Share of episodes beyond τ")
        _percent(axes.xaxis, axes.yaxis)
        axes.grid()
        figures.legend_beside(axes)
        sentence = f"{of_all}band: 95% interval over {interval_units(shown)}"
        figures._headline(axes, _title("Performance profiles", methods), sentence)
    return figure


def draw_aggregates(methods: Sequence[Method], *, theme: Theme = LIGHT) -> Figure:
    """Mean, median, interquartile mean and optimality gap of survival, each with its 95% interval."""
    with matplotlib.rc_context(style(theme)):
        figure = Figure(figsize=(8.4, 1.3 + 0.27 * len(methods)), layout="constrained")
        panels = list(figure.subplots(1, len(AGGREGATES), sharey=True))
        for axes, (name, rule) in zip(panels, AGGREGATES.items(), strict=True):
            values = [estimate(method.scores("survival"), rule) for method in methods]
            _draw_intervals(axes, values, theme)
            axes.set_xlabel(f"{name[0].upper()}{name[1:]}")
            axes.xaxis.set_major_formatter(PercentFormatter(1.0, symbol=""))
        _name_rows(panels[0], methods)
        sentence = f"95% interval over {interval_units(methods)}; gap: less is better"
        figures.headline_of_panels(figure, _title("Survival in %", methods), sentence)
    return figure


def draw_improvements(methods: Sequence[Method], *, theme: Theme = LIGHT) -> Figure:
    """P(row survives longer than column) in the same month, with 95% intervals in small print."""
    methods, of_all = leading_methods(methods)
    n = len(methods)
    with matplotlib.rc_context(style(theme)):
        figure = Figure(figsize=(max(5.4, 2.2 + 0.72 * n), 1.9 + 0.5 * n), layout="constrained")
        axes = figure.subplots()
        colours = LinearSegmentedColormap.from_list("improvement", [VERMILLION, theme.background, BLUE])
        for row, column in itertools.product(range(n), repeat=2):
            if row == column:
                continue
            value = probability_of_improvement(methods[row].scores("survival"), methods[column].scores("survival"))
            # Half of the hue at most: the numbers have to be read on it.
            shade = colours(Normalize(-0.5, 1.5)(value.value))
            axes.fill_between([column - 0.48, column + 0.48], row - 0.46, row + 0.46, color=shade, linewidth=0)
            axes.text(column, row - 0.1, f"{value.value:.2f}", ha="center", va="center", fontsize=8)
            axes.text(
                column, row + 0.24, f"[{value.low:.2f}, {value.high:.2f}]", ha="center", va="center", fontsize=5.5
            )
        labels = [figures.wrapped_label(method.label) for method in methods]
        axes.set_xticks(range(n), labels, rotation=35, ha="right")
        axes.set_yticks(range(n), labels)
        axes.set(xlim=(-0.5, n - 0.5), ylim=(n - 0.5, -0.5), xlabel="Y", ylabel="X")
        _no_frame(axes)
        sentence = f"{of_all}blue: X survives longer than Y in the same month; 95% intervals below"
        figures._headline(axes, _title("P(X > Y)", methods), sentence)
    return figure


def draw_two_methods(x: Method, y: Method, *, theme: Theme = LIGHT) -> Figure:
    """Two methods month by month: one dot per scenario, means over its repetitions."""
    a, b = (method.scores("survival").by_month for method in (x, y))
    with matplotlib.rc_context(style(theme)):
        figure = Figure(figsize=(4.4, 4.5), layout="constrained")
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1], color=theme.muted, linewidth=0.9, linestyle=(0, (4, 2)))
        places, counts = np.unique(np.stack((a, b), axis=1), axis=0, return_counts=True)
        axes.scatter(
            places[:, 0],
            places[:, 1],
            s=34 * counts,
            color=theme.series[0],
            alpha=0.6,
            linewidth=0,
            clip_on=False,
            zorder=3,
        )
        for (left, up), count in zip(places, counts, strict=True):
            if count > 1:
                axes.annotate(str(count), (left, up), ha="center", va="center", fontsize=7, zorder=4)
        axes.set(
            xlim=(-0.02, 1.02), ylim=(-0.02, 1.02), xlabel=f"Survival of {x.label}", ylabel=f"Survival of {y.label}"
        )
        axes.set_aspect("equal")
        _percent(axes.xaxis, axes.yaxis)
        axes.grid()
        above, below = int((b > a).sum()), int((b < a).sum())
        ties = len(a) - above - below
        sentence = f"{y.label}: longer in {figures._counted(above, 'month')}, shorter in {below}, as long in {ties}"
        figures._headline(axes, _title("Month by month", (x,)), sentence)
    return figure


def draw_scenarios(methods: Sequence[Method], *, theme: Theme = LIGHT) -> Figure:
    """Survival of every method in every month: the hardest months on the left, the best method on top."""
    survival = np.stack([method.scores("survival").by_month for method in methods])
    rows, columns = np.argsort(-survival.mean(axis=1), kind="stable"), np.argsort(survival.mean(axis=0), kind="stable")
    names = [methods[0].scenarios[column] for column in columns]
    with matplotlib.rc_context(style(theme)):
        width = float(np.clip(2.6 + 0.26 * len(names), 5.0, 11.0))
        figure = Figure(figsize=(width, 2.1 + 0.28 * len(methods)), layout="constrained")
        axes = figure.subplots()
        colours = LinearSegmentedColormap.from_list("survival", theme.loading)
        image = axes.imshow(survival[rows][:, columns], cmap=colours, norm=Normalize(0, 1), aspect="auto")
        complete = np.argwhere(survival[rows][:, columns] == 1)
        axes.plot(complete[:, 1], complete[:, 0], ".", color=theme.background, markersize=3)
        axes.set_yticks(range(len(methods)), [figures.wrapped_label(methods[row].label) for row in rows])
        every = -(-len(names) // MOST_MONTHS_NAMED)
        axes.set_xticks(range(0, len(names), every), names[::every], rotation=90, fontsize=6)
        _no_frame(axes)
        bar = figure.colorbar(image, ax=axes, pad=0.01, fraction=0.03)
        bar.ax.yaxis.set_major_formatter(PercentFormatter(1.0))
        bar.outline.set_visible(False)
        bar.set_label("Survival")
        figures._headline(axes, _title("Survival by month", methods), "dot: completed; hardest months on the left")
    return figure


def draw_lifetimes(methods: Sequence[Method], *, theme: Theme = LIGHT) -> Figure:
    """Kaplan-Meier curves: the share of grids alive over time, completed episodes being censored (ticks)."""
    shown, of_all = leading_methods(methods)
    with matplotlib.rc_context(style(theme)):
        figure, axes = _figure([method.label for method in shown])
        lines = lifetime_lines(shown)
        for line in lines:
            figures.draw_line(axes, line, theme, linewidth=1.8, band=_band(shown), steps=True)
            if line.marks:
                colour, _ = figures.look(line, theme)
                axes.plot(
                    line.marks.x, line.marks.y, "|", color=colour, markersize=9, markeredgewidth=1.6, clip_on=False
                )
        axes.set(xlim=(0, lines[0].x[-1]), ylim=(0, 1.03), xlabel="Days", ylabel="Grids alive")
        _percent(axes.yaxis)
        axes.grid()
        figures.legend_beside(axes)
        sentence = f"{of_all}Kaplan-Meier, 95% bands over {interval_units(shown)}; tick: completed episodes"
        figures._headline(axes, _title("Time to failure", methods), sentence)
    return figure


def draw_costs(methods: Sequence[Method], *, theme: Theme = LIGHT) -> Figure:
    """Mean cost of an episode against its threshold, and how often it is kept and the episode completed."""
    with matplotlib.rc_context(style(theme)):
        figure = Figure(figsize=(8.4, 1.5 + 0.3 * len(methods)), layout="constrained")
        panels = list(figure.subplots(1, 2 * len(COSTS), sharey=True))
        for cost, share, (name, column) in zip(panels[::2], panels[1::2], COSTS.items(), strict=True):
            _draw_bars(cost, [estimate(method.scores(column)) for method in methods], theme.series[0], theme)
            cost.axvline(THRESHOLDS[name], color=VERMILLION, linewidth=1.6)
            cost.set_xlabel(f"{name} cost")
            cost.xaxis.set_major_formatter(FuncFormatter(figures._thousands))
            _draw_bars(share, [estimate(method.safe(name)) for method in methods], theme.series[2], theme)
            share.set(xlim=(0, 1), xlabel=f"{name} kept and completed")
            _percent(share.xaxis)
        _name_rows(panels[0], methods)
        sentence = f"red: threshold of the cost; black: 95% interval over {interval_units(methods)}"
        figures.headline_of_panels(figure, _title("Costs of an episode", methods), sentence)
    return figure


def draw_heuristics(methods: Sequence[Method], *, theme: Theme = LIGHT) -> Figure:
    """What the heuristics are worth: survival of each agent without and with each of those that were played."""
    ticks = [name for name in ("none", *HEURISTICS) if any(method.heuristic == name for method in methods)]
    points = [(method.agent, method.heuristic, method) for method in methods]
    return _draw_ablation(points, ticks, "Heuristic", _title("Survival by heuristic", methods), theme)


def draw_levels(methods: Sequence[Method], *, theme: Theme = LIGHT) -> Figure:
    """What the difficulty does: survival of each method on the levels of one grid."""
    levels = sorted({method.task.level for method in methods})
    points = [(method.label, str(method.task.level), method) for method in methods]
    title = f"Survival by level: {methods[0].task.grid_id}"
    return _draw_ablation(points, [str(level) for level in levels], "Level of difficulty", title, theme)


def varied(methods: Sequence[Method]) -> tuple[Method, ...]:
    """Those whose agent was played with several heuristics."""
    agents = Counter(method.agent for method in methods)
    return tuple(method for method in methods if agents[method.agent] > 1)


def best_pair(methods: Sequence[Method]) -> tuple[Method, Method]:
    """The two methods that survive longest on average, the better one last."""
    first, second = sorted(methods, key=lambda method: -method.survival)[:2]
    return second, first


def _draw_ablation(
    points: Sequence[tuple[str, str, Method]], ticks: Sequence[str], axis: str, title: str, theme: Theme
) -> Figure:
    """Survival of (line, tick, method); lines side by side, so that their intervals are seen."""
    estimates = [(label, ticks.index(tick), estimate(method.scores("survival"))) for label, tick, method in points]
    labels, of_all = leading({label: [e.value for name, _, e in estimates if name == label] for label, *_ in points})
    with matplotlib.rc_context(style(theme)):
        figure, axes = _figure(labels)
        for k, label in enumerate(labels):
            own = sorted((place, e.value, e.low, e.high) for name, place, e in estimates if name == label)
            place, values, low, high = np.array(own).T
            x = place + 0.5 * (k - (len(labels) - 1) / 2) / len(labels)
            colour, dashes = figures.look_of(k, theme)
            axes.vlines(x, low, high, color=colour, alpha=0.5, linewidth=4)
            name = figures.wrapped_label(label)
            axes.plot(x, values, color=colour, linestyle=dashes, marker="o", linewidth=1, markersize=5, label=name)
        axes.set_xticks(range(len(ticks)), ticks)
        axes.set(xlim=(-0.5, len(ticks) - 0.5), ylim=(0, 1.03), xlabel=axis, ylabel=_SURVIVAL)
        _percent(axes.yaxis)
        axes.grid(axis="y")
        figures.legend_beside(axes)
        units = interval_units([method for label, _, method in points if label in labels])
        figures._headline(axes, title, f"{of_all}bar: 95% interval over {units}")
    return figure


def _band(methods: Sequence[Method]) -> float:
    """How opaque bands are: many of them would hide each other."""
    return min(0.2, 0.7 / len(methods))


def _figure(labels: Sequence[str]) -> tuple[Figure, Axes]:
    """With room for a legend beside the axes."""
    figure = Figure(figsize=(7.4, figures.height_beside(labels)), layout="constrained")
    return figure, figure.subplots()


def _draw_intervals(axes: Axes, values: Sequence[Estimate], theme: Theme) -> None:
    for row, value in enumerate(values):
        colour, _ = figures.look_of(row, theme)
        axes.fill_between([value.low, value.high], row - 0.32, row + 0.32, color=colour, alpha=0.45, linewidth=0)
        axes.plot([value.value] * 2, [row - 0.36, row + 0.36], color=theme.text, linewidth=1.8)
    axes.grid(axis="x")


def _draw_bars(axes: Axes, values: Sequence[Estimate], colour: str, theme: Theme) -> None:
    axes.barh(range(len(values)), [value.value for value in values], height=0.62, color=colour, alpha=0.75)
    for row, value in enumerate(values):
        axes.plot([value.low, value.high], [row] * 2, color=theme.text, linewidth=1.3)
    axes.set_xlim(left=0)
    axes.grid(axis="x")


def _name_rows(axes: Axes, methods: Sequence[Method]) -> None:
    axes.set_yticks(range(len(methods)), [figures.wrapped_label(method.label) for method in methods])
    axes.set_ylim(len(methods) - 0.45, -0.55)
    figure = axes.get_figure()
    assert figure is not None
    for panel in figure.axes:
        panel.tick_params(axis="y", length=0)
        panel.spines["left"].set_visible(False)


def _no_frame(axes: Axes) -> None:
    axes.tick_params(length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _percent(*sides: matplotlib.axis.Axis) -> None:
    for side in sides:
        side.set_major_formatter(PercentFormatter(1.0))


def _title(words: str, methods: Sequence[Method]) -> str:
    return f"{words}: {methods[0].task.id.removeprefix('rl2grid/')}"
