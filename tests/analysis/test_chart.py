"""Charts hold the numbers of the figures, few enough for a screen, and text that is nothing else."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from sample_results import TASK, curve, result

from rl2grid.analysis import comparison_figures as compare
from rl2grid.analysis.chart import (
    FIRST_SHOWN,
    LOOKS,
    MOST_POINTS,
    chart_assets,
    chart_data,
    chart_html,
    lifetime_chart,
    profile_chart,
    training_chart,
)
from rl2grid.analysis.curves import lifetime_lines
from rl2grid.analysis.section import plan_section
from rl2grid.analysis.training_figures import COST_PANELS, SURVIVAL_PANELS
from rl2grid.records.methods import group_methods
from rl2grid.records.trainings import TrainingRun

METHODS = group_methods(
    [
        result("ppo", [[1.0], [0.9], [1.0]], "idle", agent_hash="a"),
        result("do-<script>nothing", [[0.2], [0.1], [1.0]]),
    ]
)[TASK]


def test_a_chart_shows_what_the_figure_shows():
    axes = compare.draw_profiles(METHODS).axes[0]
    drawn = {line.get_label(): line for line in axes.lines}
    (panel,) = chart_data(profile_chart(METHODS, title="Profiles"))["panels"]
    assert [line["label"] for line in panel["lines"]] == ["ppo + idle", "do-<script>nothing"]
    for line in panel["lines"]:
        np.testing.assert_allclose(line["x"], drawn[line["label"]].get_xdata(), rtol=1e-3)
        np.testing.assert_allclose(line["y"], drawn[line["label"]].get_ydata(), rtol=1e-3, atol=1e-12)
        assert all(low <= y <= high for low, y, high in zip(line["low"], line["y"], line["high"], strict=True))


def test_training_has_its_panels_its_dots_its_validation_and_its_threshold():
    data = chart_data(training_chart({"ppo": [curve()]}, COST_PANELS, title="Costs"))
    survival, lsi, tlo = data["panels"]
    assert survival["share"]
    assert len(survival["lines"][0]["dots"]["x"]) == 30
    assert len(survival["lines"][0]["marks"]["x"]) == 3
    assert lsi["lines"] == []  # the sample did not log it
    assert tlo["threshold"] == 50
    assert "marks" not in tlo["lines"][0]


def test_what_is_not_drawn_is_not_named():
    one = training_chart({"ppo": [curve()]}, SURVIVAL_PANELS, title="Training").sentence
    several = training_chart({"ppo": [curve(seed=k) for k in range(2)]}, SURVIVAL_PANELS, title="Training").sentence
    assert one.endswith("Dots: iterations of one run. Diamonds: validation.")
    assert several.endswith("Bands: 95% intervals over runs. Diamonds: validation.")


def test_a_long_staircase_is_thinned_and_stays_exact_where_it_is_read():
    survivals = np.random.default_rng(0).uniform(0, 0.999, (600, 1)).tolist()
    (method,) = group_methods([result("a", survivals, episode_length=8064)])[TASK]
    (line,) = lifetime_lines([method])
    (panel,) = chart_data(lifetime_chart([method], title="Lives"))["panels"]
    (thin,) = panel["lines"]
    assert len(thin["x"]) <= MOST_POINTS
    for x, y in zip(thin["x"], thin["y"], strict=True):
        near = np.flatnonzero(np.isclose(line.x, x, rtol=1e-3))
        assert any(y == pytest.approx(line.y[k], rel=1e-3, abs=1e-9) for k in near)


@pytest.mark.parametrize("number", [FIRST_SHOWN + 5, LOOKS + 5])
def test_of_many_methods_the_best_are_switched_on_and_look_different(number):
    curves = {f"agent {k}": [curve(f"agent {k}", k)] for k in range(number)}
    data = chart_data(training_chart(curves, SURVIVAL_PANELS, title="Training"))
    (panel,) = data["panels"]
    assert len(panel["lines"]) == len(curves)
    assert len(data["first"]) == FIRST_SHOWN
    looks = {line["look"] % LOOKS for line in panel["lines"] if line["label"] in data["first"]}
    assert len(looks) == FIRST_SHOWN
    ends = {line["label"]: line["y"][-1] for line in panel["lines"]}
    assert min(ends[label] for label in data["first"]) >= max(v for k, v in ends.items() if k not in data["first"])


def test_a_method_has_one_colour_in_training_and_in_evaluations():
    results = [result("do-nothing", [[0.1]] * 3), result("ppo", [[0.9]] * 3), result("dqn", [[0.5]] * 3)]
    runs = [TrainingRun(Path(f"runs/{label}"), TASK, {}, 1, curve(label)) for label in ("dqn", "ppo")]
    charts = {one.name: one.chart for one in plan_section(results, runs).pictures if one.chart}
    looks = [
        {line["label"]: line["look"] for line in chart_data(charts[f"{name}-bus14-T0"]())["panels"][0]["lines"]}
        for name in ("training", "profiles", "lifetimes")
    ]
    assert looks[1] == looks[2] == {**looks[0], "do-nothing": 2}


def test_text_of_strangers_stays_text():
    page = chart_html(profile_chart(METHODS, title="<b>Profiles"), "A <i>caption", " <a href='#x'>made</a>")
    assert "<b>" not in page
    assert "<i>" not in page
    assert "<a href='#x'>made</a>" in page
    (data,) = re.findall(r'<script type="application/json">(.*?)</script>', page)
    assert json.loads(data)["panels"][0]["lines"][1]["label"] == "do-<script>nothing"


def test_the_script_fetches_nothing_and_is_small():
    assets = chart_assets()
    assert "http" not in assets
    assert "fetch(" not in assets
    assert len(assets) < 30_000
