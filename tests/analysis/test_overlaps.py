"""Words of figures cover neither curves nor each other, and stay on the paper: measured by their boxes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import pytest
from made_up_ranking import made_up_arrays, use_ranking
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from sample_results import TASK, curve, result

from rl2grid.analysis import comparison_figures as compare
from rl2grid.analysis.action_figures import draw_ranking
from rl2grid.analysis.curves import MOST_LINES
from rl2grid.analysis.figures import training_curves
from rl2grid.analysis.training_figures import Panel, draw_panels
from rl2grid.grids import load_grid
from rl2grid.records.methods import group_methods
from rl2grid.records.metrics import SURVIVAL

LABELS = [f"an-agent-with-a-rather-long-name-{k} w/o masks" for k in range(MOST_LINES + 4)]
SURVIVALS = np.random.default_rng(0).uniform(0, 1, (len(LABELS), 4, 1)).round(2)
METHODS = group_methods(
    [result(label, survival.tolist(), "recovery") for label, survival in zip(LABELS, SURVIVALS, strict=True)]
)[TASK]
CURVES = [curve(label, seed, n=12) for label in LABELS for seed in range(2)]


def legends(figure: Figure) -> Iterator[Bbox]:
    every = [*figure.legends, *(axes.get_legend() for axes in figure.axes)]
    yield from (one.get_window_extent() for one in every if one is not None)


def words(figure: Figure) -> Iterator[tuple[str, Bbox]]:
    """Every text but numbers at ticks, some of which are never drawn, and those within legends."""
    within = {id(text) for axes in figure.axes if (legend := axes.get_legend()) for text in legend.get_texts()}
    within |= {id(text) for legend in figure.legends for text in legend.get_texts()}
    for axes in figure.axes:
        within |= {id(text) for axis in (axes.xaxis, axes.yaxis) for text in axis.findobj(Text)} - {
            id(axes.xaxis.label),
            id(axes.yaxis.label),
        }
    for text in figure.findobj(Text):
        if text.get_visible() and text.get_text().strip() and id(text) not in within:
            yield text.get_text(), text.get_window_extent()


def overlap(one: Bbox, other: Bbox) -> bool:
    common = Bbox.intersection(one, other)
    return common is not None and common.width > 1 and common.height > 1


def check(figure: Figure) -> None:
    FigureCanvasAgg(figure).draw()
    seen, boxes = list(words(figure)), list(legends(figure))
    paper = figure.bbox.padded(2)
    for box in (*boxes, *(box for _, box in seen)):
        assert paper.contains(box.x0, box.y0)
        assert paper.contains(box.x1, box.y1)
    for legend in boxes:
        assert [name for name, box in seen if overlap(legend, box)] == []
        assert not any(overlap(legend, axes.get_window_extent()) for axes in figure.axes)
    top = max(axes.get_window_extent().y1 for axes in figure.axes)
    # The second line of a headline of panels is empty: the sentence stands there.
    headings = [(name, box) for name, box in seen if box.y0 > top and not name.endswith("\n")]
    assert [(a, b) for (a, one), (b, other) in itertools.combinations(headings, 2) if overlap(one, other)] == []


@pytest.mark.parametrize(
    "draw",
    [
        lambda: training_curves(CURVES),
        lambda: training_curves(CURVES[:4]),
        lambda: compare.draw_profiles(METHODS),
        lambda: compare.draw_lifetimes(METHODS),
        lambda: compare.draw_heuristics(METHODS),
        lambda: draw_panels({"all": CURVES}, [Panel(SURVIVAL, "Survival")] * 3, title="Costs"),
    ],
    ids=["training of many", "training of two", "profiles", "lifetimes", "heuristics", "panels"],
)
def test_legends_cover_nothing(draw):
    check(draw())


def test_of_many_methods_the_best_are_drawn_and_it_is_said():
    figure = compare.draw_profiles(METHODS)
    (axes,) = figure.axes
    shown = {text.get_text().replace("\n", "").replace(" ", "") for text in axes.get_legend().get_texts()}
    means = dict(zip(LABELS, SURVIVALS.mean(axis=(1, 2)), strict=True))
    best = sorted(means, key=lambda label: -means[label])[:MOST_LINES]
    assert shown == {f"{label}+recovery".replace(" ", "") for label in best}
    assert axes.get_title(loc="left").startswith(f"the best {MOST_LINES} of {len(LABELS)}; ")
    assert "the best" not in compare.draw_profiles(METHODS[:MOST_LINES]).axes[0].get_title(loc="left")


def test_many_months_are_not_all_named():
    many = group_methods([result("a", [[0.5]] * 200), result("b", [[0.4]] * 200)])[TASK]
    figure = compare.draw_scenarios(many)
    FigureCanvasAgg(figure).draw()
    boxes = [label.get_window_extent() for label in figure.axes[0].get_xticklabels()]
    assert 20 < len(boxes) <= compare.MOST_MONTHS_NAMED
    assert not any(overlap(one, other) for one, other in itertools.pairwise(boxes))


def test_the_ranking_has_no_words_on_its_curves(tmp_path, monkeypatch):
    arrays = made_up_arrays("bus14")
    use_ranking(monkeypatch, tmp_path, "bus14", arrays)
    figure = draw_ranking(load_grid("bus14"))
    check(figure)
    upper = figure.axes[0]
    curves = [upper.transData.transform(line.get_xydata()) for line in upper.get_lines()[:1]]
    for text in upper.texts[1:]:
        box = text.get_window_extent()
        assert not any(box.contains(*point) for points in curves for point in points)
    assert "dotted: do nothing" in upper.get_title(loc="left")
