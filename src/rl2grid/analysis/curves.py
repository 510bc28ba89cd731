"""Curves of methods, computed once for figures and for charts of pages: training, profiles and lifetimes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rl2grid.analysis.lifetimes import kaplan_meier, lifetimes
from rl2grid.arrays import F64
from rl2grid.records.methods import Method
from rl2grid.records.statistics import curve_band, episode_mean, profile_band
from rl2grid.records.trainings import Metric, TrainingCurve

STEPS_PER_DAY = 288
CURVE_POINTS = 200
"""Of the mean of several runs, which log at different budgets."""
SMOOTHED_EPISODES = 500
"""Episodes over which training curves are smoothed (paper, Section 5)."""
THRESHOLDS_DRAWN = 201
"""Points of a performance profile."""
MOST_LINES = 10
"""Curves that can be told apart in one figure: of more, the best are drawn."""


@dataclass(frozen=True, eq=False)
class Points:
    """Single points."""

    x: F64
    y: F64


@dataclass(frozen=True, eq=False)
class Line:
    """A curve and what belongs to it."""

    label: str
    x: F64
    y: F64
    low: F64 | None = None
    """Lower end of its band; None: there is no band."""
    high: F64 | None = None
    dots: Points | None = None
    """What the curve is a mean of."""
    marks: Points | None = None
    """Validation, or the end of episodes that were completed."""
    score: float = field(default=0.0, kw_only=True)
    """By which curves are ordered, the highest first."""
    look: int = field(default=0, kw_only=True)
    """Place of its colour and dashes: that of the method, which looks alike on all tasks."""


def training_lines(
    curves: Sequence[TrainingCurve], metric: str, *, x: str = "decisions", validation: bool = False
) -> list[Line]:
    """A metric of training episodes against the budget, a line per label, the one that ends highest first.

    Means over the last :data:`SMOOTHED_EPISODES` episodes (paper, Section 5): of one run, with its iterations as dots;
    of several, their mean with a 95% interval over runs. Labels without the metric have no line.

    Args:
        curves: of any labels.
        metric: name of a metric.
        x: ``"decisions"`` or ``"grid_steps"``.
        validation: whether survival on the validation months is marked.
    """
    lines = []
    for look, (label, runs) in enumerate(_labelled(curves).items()):
        logged = [run.metrics[metric] for run in runs if metric in run.metrics]
        if logged:
            line = _of_runs(label if len(logged) == 1 else f"{label} ({len(logged)} runs)", logged, x)
            lines.append(replace(line, marks=_validation(runs, x) if validation else None, look=look))
    return _best_first(lines)


def profile_lines(methods: Sequence[Method]) -> list[Line]:
    """Performance profiles: the share of episodes that survived longer than each share, with 95% bands; best first."""
    levels = np.linspace(0, 1, THRESHOLDS_DRAWN)
    lines = []
    for look, method in enumerate(methods):
        # Nothing is longer than a completed episode: the last point would always be 0.
        share, low, high = (values[:-1] for values in profile_band(method.scores("survival"), levels))
        lines.append(Line(method.label, levels[:-1], share, low, high, score=method.survival, look=look))
    return _best_first(lines)


def lifetime_lines(methods: Sequence[Method]) -> list[Line]:
    """Kaplan-Meier staircases over days, with 95% bands; best first. Marks: episodes were completed."""
    end = max(episode.episode_length for method in methods for episode in method.episodes) / STEPS_PER_DAY
    lines = []
    for look, method in enumerate(methods):
        curve = kaplan_meier(lifetimes([result.episodes for result in method.evaluations]))
        alive, low, high = (np.append(values, values[-1]) for values in (curve.alive, curve.low, curve.high))
        marks = Points(np.array([end]), alive[-1:]) if curve.censored.size else None
        days = np.append(curve.steps / STEPS_PER_DAY, end)
        lines.append(Line(method.label, days, alive, low, high, marks=marks, score=method.survival, look=look))
    return _best_first(lines)


def leading(scores: Mapping[str, Sequence[float]], most: int = MOST_LINES) -> tuple[list[str], str]:
    """Of more than ``most`` labels those with the highest mean score, and words that say so.

    Labels stay in their order.
    """
    best = sorted(scores, key=lambda label: -float(np.mean(scores[label])))[:most]
    words = f"the best {most} of {len(scores)}; " if len(scores) > most else ""
    return [label for label in scores if label in best], words


def leading_methods(methods: Sequence[Method]) -> tuple[tuple[Method, ...], str]:
    """:func:`leading` of methods of one task, by survival."""
    labels, words = leading({method.label: [method.survival] for method in methods})
    return tuple(method for method in methods if method.label in labels), words


def leading_curves(curves: Sequence[TrainingCurve]) -> tuple[list[TrainingCurve], str]:
    """:func:`leading` of trainings, by the survival that they end with."""
    ends = {
        label: [_of_runs(label, [run.survival for run in runs], "decisions").score]
        for label, runs in _labelled(curves).items()
    }
    labels, words = leading(ends)
    return [curve for curve in curves if curve.label in labels], words


def _best_first(lines: Sequence[Line]) -> list[Line]:
    return sorted(lines, key=lambda line: -line.score)


def _labelled(curves: Sequence[TrainingCurve]) -> dict[str, list[TrainingCurve]]:
    """Runs by label, in order of appearance."""
    by_label: dict[str, list[TrainingCurve]] = {}
    for curve in curves:
        by_label.setdefault(curve.label, []).append(curve)
    return by_label


def _of_runs(label: str, runs: Sequence[Metric], x: str) -> Line:
    budgets = [np.asarray(getattr(run, x), np.float64) for run in runs]
    smoothed = [episode_mean(run.values, run.episodes, SMOOTHED_EPISODES) for run in runs]
    if len(runs) == 1:
        dots = Points(budgets[0], np.asarray(runs[0].values, np.float64))
        return Line(label, budgets[0], smoothed[0], dots=dots, score=float(smoothed[0][-1]))
    position = np.linspace(max(budget[0] for budget in budgets), min(budget[-1] for budget in budgets), CURVE_POINTS)
    values = [np.interp(position, budget, line) for budget, line in zip(budgets, smoothed, strict=True)]
    average, low, high = curve_band(values)
    return Line(label, position, average, low, high, score=float(average[-1]))


def _validation(runs: Sequence[TrainingCurve], x: str) -> Points | None:
    """Survival on the validation scenarios: mean over runs, at the points of the run with the fewest."""
    validated = [(getattr(run.validation, x), run.validation.values) for run in runs if run.validation]
    if not validated:
        return None
    position = min((budget for budget, _ in validated), key=len)
    survival = np.mean([np.interp(position, *points) for points in validated], axis=0)
    return Points(np.asarray(position, np.float64), np.asarray(survival))
