"""Figures: training curves, survival by agent, and the loading of every line through an episode.

Colours are those of Okabe and Ito, told apart by people with any colour vision; nothing is said by colour
alone. Figures are drawn without pyplot: nothing global changes, and no display is needed.
"""

from __future__ import annotations

import io
import itertools
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Annotation
from matplotlib.ticker import FuncFormatter, PercentFormatter
from numpy.typing import NDArray

from rl2grid.analysis.curves import SMOOTHED_EPISODES, STEPS_PER_DAY, Line, leading_curves, training_lines
from rl2grid.arrays import F64
from rl2grid.drawing.theme import (
    FULL_SCALE,
    GREEN,
    LIGHT,
    PURPLE,
    SAFE_LOADING,
    VERMILLION,
    Theme,
    loading_colours,
    style,
)
from rl2grid.records.evaluations import Evaluation
from rl2grid.records.files import write_bytes
from rl2grid.records.metrics import SURVIVAL
from rl2grid.records.recordings import Recording
from rl2grid.records.trainings import TrainingCurve

MAX_COLUMNS = 360
"""Columns of a heatmap: more steps are pooled, each pool showing its highest loading, so that an overload of one
step is wide enough to be seen."""
MAX_LABELS = 40
LABEL_LETTERS = 30
"""Of a line of a label beside axes."""
Dashes = str | tuple[int, tuple[float, ...]]
"""A line style of Matplotlib."""
DASHES: tuple[Dashes, ...] = ("-", (0, (5, 2)), (0, (1, 1.5)))


def training_curves(
    curves: Sequence[TrainingCurve], *, x: str = "decisions", theme: Theme = LIGHT, title: str = "Survival in training"
) -> Figure:
    """Survival of training episodes against the budget; runs with one label are one line.

    Means over the last :data:`~rl2grid.analysis.curves.SMOOTHED_EPISODES` episodes (paper, Section 5): one run over
    points that stay visible, several runs as their mean with a 95% interval over runs. Diamonds are validation. Of many
    labels, those that end highest.

    Args:
        curves: at least one; see :func:`rl2grid.records.trainings.read_training_curve`.
        x: ``"decisions"`` or ``"grid_steps"``.
        theme: colours.
        title: of the figure.
    """
    shown, of_all = leading_curves(curves)
    lines = training_lines(shown, SURVIVAL, x=x, validation=True)
    with matplotlib.rc_context(style(theme)):
        figure = Figure(figsize=(7.4, height_beside([line.label for line in lines])), layout="constrained")
        axes = figure.subplots()
        draw_metric(axes, lines, x=x, theme=theme)
        axes.set_ylim(0, 1.03)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        _headline(axes, title, of_all + training_sentence(shown, "share of the episode survived"))
        handles, _ = axes.get_legend_handles_labels()
        if any(line.marks for line in lines):
            handles.append(_marker("D", theme.text, "validation"))
        legend_beside(axes, handles)
    return figure


def draw_metric(axes: Axes, lines: Sequence[Line], *, x: str = "decisions", theme: Theme = LIGHT) -> None:
    """A metric of training episodes against the budget, on axes that may hold others; see :func:`training_curves`."""
    for line in lines:
        draw_line(axes, line, theme, linewidth=2.0, band=0.2)
        if line.marks:
            axes.plot(
                line.marks.x, line.marks.y, "D", color=look(line, theme)[0], markersize=5.5,
                markeredgecolor=theme.background, zorder=4,
            )  # fmt: skip
    axes.set_xlabel("Decisions" if x == "decisions" else "Grid steps")
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(FuncFormatter(_thousands))
    axes.grid(axis="y")


def draw_line(axes: Axes, line: Line, theme: Theme, *, linewidth: float, band: float, steps: bool = False) -> None:
    """A curve with its dots and its band, which is as opaque as ``band`` says; ``steps`` draws a staircase."""
    colour, dashes = look(line, theme)
    if line.dots:
        axes.plot(line.dots.x, line.dots.y, ".", color=colour, alpha=0.25, markersize=3, markeredgewidth=0)
    if line.low is not None and line.high is not None:
        step = {"step": "post"} if steps else {}
        axes.fill_between(line.x, line.low, line.high, color=colour, alpha=band, linewidth=0, **step)  # type: ignore[arg-type]
    drawstyle = "steps-post" if steps else "default"
    axes.plot(
        line.x, line.y, color=colour, linestyle=dashes, linewidth=linewidth, drawstyle=drawstyle,
        label=wrapped_label(line.label),
    )  # fmt: skip


def look(line: Line, theme: Theme) -> tuple[str, Dashes]:
    """Colour and dashes of a curve; dashes change when the colours are used up."""
    return look_of(line.look, theme)


def look_of(place: int, theme: Theme) -> tuple[str, Dashes]:
    """Colour and dashes of the method in a place."""
    n = len(theme.series)
    return theme.series[place % n], DASHES[place // n % len(DASHES)]


def legend_beside(axes: Axes, handles: Sequence[Any] | None = None) -> None:
    """A legend to the right of the axes, where it covers neither curves nor the headline."""
    chosen = axes.get_legend_handles_labels()[0] if handles is None else list(handles)
    axes.legend(handles=chosen, loc="upper left", bbox_to_anchor=(1.015, 1.0), borderaxespad=0.0, handlelength=2.2)


def height_beside(labels: Sequence[str]) -> float:
    """Height in inches of a figure beside which a legend with these labels, and one more line, has room."""
    lines = 1 + sum(1 + wrapped_label(label).count("\n") for label in labels)
    return max(3.8, 1.3 + 0.165 * lines)


def legend_columns(labels: Sequence[str], width: float) -> int:
    """How many columns of a legend go below a figure that is ``width`` inches wide."""
    longest = max((len(line) for label in labels for line in label.splitlines()), default=1)
    return int(np.clip(width / (0.075 * longest + 0.55), 1, max(len(labels), 1)))


def wrapped_label(label: str) -> str:
    """A label in lines of :data:`LABEL_LETTERS` letters: what is beside or below axes takes their room."""
    return "\n".join(textwrap.wrap(label, LABEL_LETTERS)) or label


def training_sentence(curves: Sequence[TrainingCurve], measure: str) -> str:
    """What is drawn of ``measure``, in words."""
    several = len({curve.label for curve in curves}) < len(curves)
    band = "; band: 95% interval over runs" if several else ""
    return f"{measure}, mean over {SMOOTHED_EPISODES} episodes{band}"


def survival_by_agent(
    results: Sequence[Evaluation], *, theme: Theme = LIGHT, title: str = "Survival by agent"
) -> Figure:
    """Every episode as a dot, the mean with its 95% interval, and both in numbers; the best agent on top."""
    ranked = sorted(results, key=lambda result: result.summary.survival.value)
    with matplotlib.rc_context(style(theme)):
        figure = Figure(figsize=(6.4, 1.35 + 0.62 * len(ranked)), layout="constrained")
        axes = figure.subplots()
        for row, result in enumerate(ranked):
            _draw_agent(axes, row, result, theme.series[0] if row == len(ranked) - 1 else theme.muted, theme)
        axes.set_yticks(range(len(ranked)), [_agent_label(result) for result in ranked])
        axes.set(xlim=(-0.015, 1.015), ylim=(-0.55, len(ranked) - 0.45))
        axes.xaxis.set_major_formatter(PercentFormatter(1.0))
        axes.set_xlabel("Share of the episode survived")
        axes.grid(axis="x")
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_visible(False)
        first = ranked[0].summary
        counted = _counted(first.scenarios, "scenario") + (
            f", {_counted(first.seeds, 'seed')} each" if first.seeds > 1 else ""
        )
        _headline(axes, title, f"dots: episodes ({counted}); diamond and bar: mean and 95% interval")
    return figure


def episode_loading(recording: Recording, *, theme: Theme = LIGHT) -> Figure:
    """Loading of every line through one episode, with outages, the agent's decisions, and how it ended.

    Lines are ordered by their loading, the most loaded on top.
    """
    n_line = len(recording.line_names)
    with matplotlib.rc_context(style(theme)):
        height = float(np.clip(0.13 * n_line, 2.2, 7.0))
        figure = Figure(figsize=(8.4, height + 2.5), layout="constrained")
        peak, heat, marks = figure.subplots(
            3, 1, sharex=True, gridspec_kw={"height_ratios": [0.9, height, 0.5], "hspace": 0.02}
        )
        unit = STEPS_PER_DAY if recording.n_steps > 2 * STEPS_PER_DAY else 12
        time = np.arange(len(recording.rho)) / unit
        _draw_peak(peak, recording, time, theme)
        image, legend = _draw_heat(heat, recording, time[-1], theme)
        _draw_decisions(marks, recording, unit, theme)
        _draw_ending([peak, heat, marks], recording, time[-1], theme)
        marks.set_xlabel("Days" if unit == STEPS_PER_DAY else "Hours")
        marks.set_xlim(0, time[-1] * 1.012 if time[-1] else 1)
        bar = figure.colorbar(image, ax=heat, pad=0.01, fraction=0.03, aspect=28, extend="max")
        bar.ax.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        bar.set_ticks([0, 0.5, 1, FULL_SCALE])
        bar.outline.set_visible(False)
        bar.set_label("Loading")
        if legend:
            figure.legend(handles=legend, loc="outside lower right", ncols=len(legend), frameon=False, handlelength=1.2)
        _headline(peak, *_episode_words(recording))
    return figure


def save_figure(figure: Figure, path: Path, *, formats: Sequence[str] = ("png", "pdf")) -> list[Path]:
    """Write a figure as ``path`` with each of the suffixes, each file whole or not at all."""
    written = []
    for suffix in formats:
        target = path.with_name(f"{path.name}.{suffix}")
        write_bytes(target, _render(figure, suffix))
        written.append(target)
    return written


def png_bytes(figure: Figure) -> bytes:
    """A figure as PNG."""
    return _render(figure, "png")


def _render(figure: Figure, suffix: str) -> bytes:
    file = io.BytesIO()
    # Without a date in it: the same results give the same file.
    metadata = {"png": {"Software": None}, "pdf": {"CreationDate": None}}.get(suffix)
    figure.savefig(file, format=suffix, dpi=200, metadata=metadata, facecolor=figure.get_facecolor())
    return file.getvalue()


def _draw_agent(axes: Axes, row: int, result: Evaluation, colour: str, theme: Theme) -> None:
    survival = np.array([episode.survival for episode in result.episodes])
    estimate = result.summary.survival
    axes.plot(
        survival,
        row - 0.12 + 0.34 * _spread(survival),
        "o",
        color=colour,
        alpha=0.45,
        markersize=4.5,
        markeredgewidth=0,
    )
    axes.plot(
        [estimate.low, estimate.high], [row - 0.27] * 2, color=colour, linewidth=4, solid_capstyle="round", alpha=0.55
    )
    axes.plot(estimate.value, row - 0.27, "D", color=colour, markersize=7, markeredgecolor=theme.background, zorder=4)
    axes.annotate(
        f"{100 * estimate.value:.1f}%\n[{100 * estimate.low:.1f}, {100 * estimate.high:.1f}]",
        (1.0, row),
        xycoords=("axes fraction", "data"),
        xytext=(8, 0),
        textcoords="offset points",
        va="center",
        fontsize=8,
        color=theme.text,
    )


def _draw_peak(axes: Axes, recording: Recording, time: F64, theme: Theme) -> None:
    peak = np.where(recording.line_status, recording.rho, 0).max(axis=1)
    axes.plot(time, peak, color=theme.series[0], linewidth=0.9)
    axes.axhline(SAFE_LOADING, color=VERMILLION, linewidth=0.9, linestyle=(0, (4, 2)))
    axes.fill_between(
        time, SAFE_LOADING, peak, where=peak > SAFE_LOADING, color=VERMILLION, linewidth=0, interpolate=True
    )
    axes.set_ylim(0, max(1.15, float(peak.max()) * 1.05))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axes.set_yticks([0, SAFE_LOADING])
    axes.set_ylabel("Highest", rotation=0, ha="right", va="center")
    axes.tick_params(axis="x", length=0)


def _draw_heat(axes: Axes, recording: Recording, end: float, theme: Theme) -> tuple[Any, list[Patch]]:
    """Returns the image and what its flat colours mean."""
    order = np.argsort(-np.quantile(np.where(recording.line_status, recording.rho, 0), 0.95, axis=0), kind="stable")
    pools = _pools(len(recording.rho))
    loading = np.where(recording.line_status, recording.rho, np.nan)[:, order]
    loading = np.stack([_highest(loading[pool]) for pool in pools], axis=1)
    extent = (0.0, max(end, 1e-9), len(order) - 0.5, -0.5)
    image = axes.imshow(
        loading,
        cmap=loading_colours(theme),
        norm=Normalize(0, FULL_SCALE),
        aspect="auto",
        extent=extent,
        interpolation="nearest",
    )
    legend = []
    if np.isnan(loading).any():
        legend.append(Patch(color=theme.out, label="out of service"))
    for name, flags, colour in (("attacked", recording.attacked, PURPLE), ("maintenance", recording.maintained, GREEN)):
        pooled = np.stack([flags[pool][:, order].any(axis=0) for pool in pools], axis=1)
        if not pooled.any():
            continue
        axes.imshow(
            np.where(pooled, 1.0, np.nan),
            cmap=ListedColormap([colour]),
            aspect="auto",
            extent=extent,
            interpolation="nearest",
        )
        legend.append(Patch(color=colour, label=name))
    step = -(-len(order) // MAX_LABELS)
    shown = range(0, len(order), step)
    axes.set_yticks(list(shown), [recording.line_names[order[row]] for row in shown], fontsize=6)
    axes.tick_params(axis="both", length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)
    return image, legend


def _draw_decisions(axes: Axes, recording: Recording, unit: int, theme: Theme) -> None:
    asked = np.array(recording.decision_steps, np.float64) / unit
    acted = asked[[bool(words) for words in recording.actions]] if len(asked) else asked
    axes.eventplot(
        [asked, acted], colors=[theme.muted, VERMILLION], lineoffsets=[1, 0], linelengths=0.8, linewidths=0.8
    )
    axes.set_yticks([0, 1], [f"acts ({len(acted):,})", f"decides ({len(asked):,})"], fontsize=7)
    axes.set_ylim(-0.6, 1.6)
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)


def _draw_ending(panels: Sequence[Axes], recording: Recording, end: float, theme: Theme) -> None:
    if not recording.game_over:
        return
    for axes in panels:
        axes.axvline(end, color=theme.text, linewidth=1.6)
    panels[0].annotate(
        "game over", (end, 0.0), xycoords=("data", "axes fraction"), xytext=(-5, 4), textcoords="offset points",
        ha="right", va="bottom", fontsize=8, fontweight="bold", color=theme.text,
    )  # fmt: skip


def _episode_words(recording: Recording) -> tuple[str, str]:
    """Headline and sentence below it."""
    task = recording.task.removeprefix("rl2grid/")
    with_heuristic = "" if recording.heuristic == "none" else f" + {recording.heuristic}"
    survived = f"survived {recording.n_steps:,} of {recording.episode_length:,} steps"
    completed = recording.n_steps >= recording.episode_length
    ending = recording.game_over or ("the episode was completed" if completed else "it was not played further")
    return (
        f"Line loading: {recording.agent}{with_heuristic} on {task}",
        f"scenario {recording.scenario}, seed {recording.seed}: {survived}; {ending}",
    )


def _pools(n_steps: int) -> list[slice]:
    bounds = np.linspace(0, n_steps, min(n_steps, MAX_COLUMNS) + 1).astype(int)
    return [slice(int(first), int(last)) for first, last in itertools.pairwise(bounds)]


def _highest(loading: NDArray[np.float32]) -> NDArray[np.float32]:
    """Highest loading over the first axis; NaN only where a line was out all the time."""
    highest = np.where(np.isnan(loading), -np.inf, loading).max(axis=0)
    return np.where(np.isinf(highest), np.nan, highest).astype(np.float32)


def _spread(values: F64) -> F64:
    """Heights in [0, 1] that keep dots with near values apart: the golden ratio's sequence in order of value."""
    heights = np.empty(len(values))
    heights[np.argsort(values, kind="stable")] = (np.arange(len(values)) * 0.6180339887) % 1.0
    return heights


def _agent_label(result: Evaluation) -> str:
    summary = result.summary
    return summary.agent if summary.heuristic == "none" else f"{summary.agent}\n+ {summary.heuristic}"


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' if number != 1 else ''}"


def _marker(symbol: str, colour: str, label: str) -> Line2D:
    return Line2D([], [], linestyle="", marker=symbol, color=colour, markersize=5, label=label)


def _headline(axes: Axes, title: str, sentence: str) -> None:
    axes.set_title(sentence, loc="left", fontsize=8, color=matplotlib.rcParams["xtick.color"], pad=6)
    axes.annotate(
        title,
        (0, 1),
        xycoords="axes fraction",
        xytext=(0, 20),
        textcoords="offset points",
        fontsize=11,
        fontweight="bold",
    )


def headline_of_panels(figure: Figure, title: str, sentence: str) -> None:
    """Headline and sentence above several panels, whose widths they leave alone."""
    words = figure.suptitle(f"{title}\n", x=0.012, ha="left", fontsize=11, fontweight="bold")
    note = Annotation(
        sentence, (0, 0), xycoords=words, xytext=(0, 4), textcoords="offset points", fontsize=8,
        color=matplotlib.rcParams["xtick.color"],
    )  # fmt: skip
    note.set_in_layout(False)
    figure.add_artist(note)


def _thousands(value: float, _: int | None) -> str:
    if value >= 1e6:
        return f"{value / 1e6:g}M"
    return f"{value / 1e3:g}k" if value >= 1e3 else f"{value:g}"
