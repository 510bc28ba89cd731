"""Figures and the folder of a results section: that they show what they claim, and that all of it is listed."""

from __future__ import annotations

import re

import numpy as np
import pytest
from sample_results import TASK, curve, result

from rl2grid.analysis import comparison_figures as compare
from rl2grid.analysis.curves import SMOOTHED_EPISODES
from rl2grid.analysis.ending_figures import count_endings, draw_ending_bars
from rl2grid.analysis.section import plan_section, results_section
from rl2grid.analysis.training_figures import COST_PANELS, SCORE_PANELS, draw_panels, logs
from rl2grid.drawing.theme import DARK
from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.records.methods import group_methods
from rl2grid.records.statistics import curve_band, episode_mean
from rl2grid.records.trainings import TrainingRun

RESULTS = [
    result("ppo", [[1.0], [0.9], [1.0]], "idle", agent_hash="a"),
    result("ppo", [[0.5], [0.3], [0.4]], agent_hash="b"),
    result("do-nothing", [[0.2], [0.1], [1.0]]),
]
METHODS = group_methods(RESULTS)[TASK]


def lines(axes, **wanted):
    return [line for line in axes.lines if all(getattr(line, f"get_{k}")() == v for k, v in wanted.items())]


def test_a_profile_is_the_share_beyond_each_threshold():
    axes = compare.draw_profiles(METHODS).axes[0]
    (line,) = lines(axes, label="ppo")
    for tau, share in zip(*line.get_data(), strict=True):
        assert share == pytest.approx(np.mean(np.array([0.5, 0.3, 0.4]) > tau))
    (best,) = lines(axes, label="ppo + idle")
    assert best.get_ydata()[-1] == pytest.approx(2 / 3)  # of the episodes, beyond 99.5%


def test_lifetimes_fall_where_grids_are_lost():
    axes = compare.draw_lifetimes(METHODS).axes[0]
    (line,) = lines(axes, label="ppo")
    np.testing.assert_allclose(line.get_xdata()[:-1] * 288, [0, 30, 40, 50])
    np.testing.assert_allclose(line.get_ydata()[:-1], [1, 2 / 3, 1 / 3, 0], atol=1e-12)
    assert len(lines(axes, marker="|")) == 2  # of the methods with completed episodes


def test_improvements_name_every_ordered_pair():
    axes = compare.draw_improvements(METHODS).axes[0]
    numbers = [text.get_text() for text in axes.texts if re.fullmatch(r"\d\.\d\d", text.get_text())]
    assert numbers == ["1.00", "0.83", "0.00", "0.67", "0.17", "0.33"]


def test_two_methods_show_every_month():
    pair = compare.best_pair(METHODS)
    assert [method.label for method in pair] == ["do-nothing", "ppo + idle"]
    axes = compare.draw_two_methods(*pair).axes[0]
    np.testing.assert_allclose(axes.collections[0].get_offsets(), [[0.1, 0.9], [0.2, 1.0], [1.0, 1.0]])
    assert "ppo + idle: longer in 2 months, shorter in 0, as long in 1" in axes.get_title(loc="left")


def test_months_are_ordered_by_difficulty():
    axes = compare.draw_scenarios(METHODS).axes[0]
    shown = axes.images[0].get_array()
    assert [label.get_text() for label in axes.get_xticklabels()] == ["scenario 1", "scenario 0", "scenario 2"]
    np.testing.assert_allclose(shown, [[0.9, 1.0, 1.0], [0.1, 0.2, 1.0], [0.3, 0.5, 0.4]])


def test_costs_show_their_thresholds():
    panels = compare.draw_costs(METHODS).axes
    assert [lines(panels[k], color="#D55E00")[0].get_xdata()[0] for k in (0, 2)] == [0.0, 50.0]
    assert [bar.get_width() for bar in panels[2].patches] == [10.0] * 3


def test_what_heuristics_and_levels_are_worth():
    axes = compare.draw_heuristics(compare.varied(METHODS)).axes[0]
    (line,) = lines(axes, label="ppo")
    np.testing.assert_allclose(line.get_xydata(), [[0, 0.4], [1, 2.9 / 3]])
    harder = group_methods([result("do-nothing", [[0.3]], task="rl2grid/bus14-T1-v0")])["rl2grid/bus14-T1-v0"]
    (line,) = lines(compare.draw_levels([*METHODS, *harder]).axes[0], label="do-nothing")
    np.testing.assert_allclose(line.get_ydata(), [1.3 / 3, 0.3])


def test_training_is_smoothed_over_episodes_with_a_band_over_runs():
    runs = [curve(seed=k) for k in range(5)]
    axes = draw_panels({"ppo": runs}, COST_PANELS, title="Costs").axes[2]
    (line,) = lines(axes, label="ppo (5 runs)")
    smoothed = []
    for run in runs:
        metric = run.metrics["charts/cost_tlo"]
        values = episode_mean(metric.values, metric.episodes, SMOOTHED_EPISODES)
        smoothed.append(np.interp(line.get_xdata(), metric.decisions, values))
    average, low, high = curve_band(smoothed)
    np.testing.assert_allclose(line.get_ydata(), average)
    corners = axes.collections[0].get_paths()[0].vertices[:, 1]
    assert corners.min() == pytest.approx(low.min())
    assert corners.max() == pytest.approx(high.max())
    assert lines(axes, color="#D55E00")[-1].get_ydata()[0] == 50.0


def test_panels_need_their_metrics():
    curves = {"ppo": [curve()]}
    assert not logs(curves, SCORE_PANELS)  # the sample has the margin only
    assert logs(curves, SCORE_PANELS[:1])


def test_lost_episodes_are_counted_by_line_and_substation():
    grid = load_grid("bus14")
    episodes = METHODS[1].episodes + METHODS[2].episodes
    counts = count_endings(grid, episodes)
    assert counts.lost == 5
    assert {k: n for k, n in enumerate(counts.overloads) if n} == {3: 5, 17: 5}
    assert {k: n for k, n in enumerate(counts.outages) if n} == {4: 5}
    assert not counts.cut_off.any()
    overloads, outages, cut_off = draw_ending_bars(grid, episodes, title="Lost", theme=DARK).axes
    assert [label.get_text() for label in outages.get_yticklabels()] == ["4: 1 to 4"]
    assert len(overloads.patches) == 2
    assert len(cut_off.patches) == 0


def training_run(tmp_path, seed=1):
    return TrainingRun(tmp_path / f"run-{seed}", TASK, {"gamma": 0.9}, seed, curve("ppo + idle", seed))


def test_a_section_lists_every_file_it_holds(tmp_path, monkeypatch):
    # Files are rendered in another test; here it is about which.
    monkeypatch.setattr("rl2grid.analysis.figures._render", lambda figure, suffix: b"")
    told = []
    runs = [training_run(tmp_path, seed) for seed in (1, 2)]
    index = results_section(tmp_path / "out", RESULTS, runs, command="rl2grid analyse a b", on_file=told.append)
    text = index.read_text(encoding="utf-8")
    listed = set(re.findall(r"\]\(([^)]+)\)", text))
    held = {path.relative_to(index.parent).as_posix() for path in index.parent.rglob("*") if path.is_file()}
    assert listed == held - {"index.md"}
    assert {name.rsplit(".", 1)[0].split("/")[1] for name in listed} == set(told)
    for words in ("rl2grid analyse a b", "rl2grid evaluate do-nothing", "run-2", "seed 2"):
        assert words in text
    assert {"training-bus14-T0", "heuristics-bus14-T0", "endings-map-bus14-T0-ppo-idle"} <= set(told)


def test_each_method_alone_and_in_the_dark_can_be_drawn():
    for one in RESULTS:
        for picture in plan_section([one]).pictures:
            assert picture.draw(DARK).axes


def test_labels_make_names_of_files_that_can_be_and_differ(tmp_path):
    labels = ("PPO w/o masks", "PPO w-o masks", "ppo W/O masks", "PPO w-o masks 2")
    names = [one.name for one in plan_section([result(label, [[0.5], [1.0]]) for label in labels]).pictures]
    assert len({name.lower() for name in names}) == len(names)
    for name in names:
        (tmp_path / f"{name}.png").touch()
    assert {"endings-map-bus14-T0-PPO-w-o-masks", "endings-map-bus14-T0-PPO-w-o-masks-2"} <= set(names)


def test_without_results_there_is_no_section(tmp_path):
    with pytest.raises(UsageError, match="nothing to analyse"):
        results_section(tmp_path / "out", [])
    with pytest.raises(UsageError, match="given twice"):
        results_section(tmp_path / "out", [RESULTS[0], RESULTS[0]])
    assert not (tmp_path / "out").exists()
