"""Episode files, aggregates and tables."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console
from sample_folders import write_made_up_evaluation
from sample_results import episode, result, with_foresight

from rl2grid.analysis.summary_table import HEADINGS, markdown_table, summary_table
from rl2grid.analysis.table import result_table_rich
from rl2grid.errors import UsageError
from rl2grid.records.episodes import COLUMN_NAMES, read_episodes, write_episodes
from rl2grid.records.evaluations import check_comparable, load_evaluation, write_evaluation
from rl2grid.records.metrics import read_validations
from rl2grid.records.shares import wilson_interval
from rl2grid.records.summary import by_scenario, summarise
from rl2grid.records.trainings import read_training_curve
from rl2grid.records.versions import processor


def test_episodes_survive_a_file_digit_by_digit(tmp_path):
    episodes = (episode(survival=1 / 3), episode('comma, "quote"', 1, cost_tlo=1e-17))
    write_episodes(tmp_path / "episodes.csv", episodes)
    assert read_episodes(tmp_path / "episodes.csv") == episodes
    assert [path.name for path in tmp_path.iterdir()] == ["episodes.csv"]


def test_a_torn_last_line_is_ignored(tmp_path):
    path = tmp_path / "episodes.csv"
    write_episodes(path, [episode(seed=0), episode(seed=1)])
    path.write_text(path.read_text()[:-1])
    assert [row.seed for row in read_episodes(path)] == [0]


HEADER = ",".join(COLUMN_NAMES) + "\n"


@pytest.mark.parametrize(
    "text", ["", "a,b\n1,2\n", f"{HEADER}1,2\n", HEADER + ",".join(["x"] * len(COLUMN_NAMES)) + "\n"]
)
def test_other_files_are_refused(tmp_path, text):
    path = tmp_path / "episodes.csv"
    path.write_text(text)
    with pytest.raises(UsageError, match=r"episodes\.csv"):
        read_episodes(path)


def test_missing_files_are_refused(tmp_path):
    with pytest.raises(UsageError, match="cannot be read"):
        read_episodes(tmp_path / "none.csv")
    with pytest.raises(UsageError, match="holds no evaluation"):
        load_evaluation(tmp_path)
    with pytest.raises(UsageError, match="is no metrics file"):
        read_training_curve(tmp_path, "ppo")


def test_a_summary_by_hand():
    summary = result("someone", [[1.0, 0.5], [0.2, 0.3]]).summary
    assert summary.survival.value == pytest.approx(0.5)
    assert (summary.episodes, summary.scenarios, summary.seeds) == (4, 2, 2)
    assert summary.completed.value == 0.25
    assert summary.episode_return.value == pytest.approx(45.0)
    assert summary.survival_iqm.value == pytest.approx(0.4)
    assert summary.game_over == {"DIVERGENCE": 3}
    assert summary.wall_time_s == 2.0
    # Two months with means 0.75 and 0.25: a variance of 1/16 of their mean, as of five attempts of which half succeed.
    np.testing.assert_allclose((summary.survival.low, summary.survival.high), wilson_interval(2.5, 5.0))
    # One of the four was completed: shares of 0.5 and 0 in the two months.
    np.testing.assert_allclose((summary.completed.low, summary.completed.high), wilson_interval(1.0, 4.0))


def test_dying_early_is_not_safe():
    harmless = [episode(seed=0, survival=0.1, cost_lsi=0.0, cost_tlo=0.0), episode(seed=1, cost_tlo=50.0)]
    harmful = [episode(seed=2, cost_tlo=50.5), episode(seed=3, cost_lsi=1.0)]
    summary = summarise(harmless + harmful)
    assert summary.safe_tlo.value == 0.5  # seeds 1 and 3
    assert summary.safe_lsi.value == 0.5  # seeds 1 and 2


def test_a_month_alone_is_stored_without_the_ends_of_intervals(tmp_path):
    write_evaluation(tmp_path / "evaluation.json", {}, result("someone", [[0.5, 0.7]]).summary)
    stored = json.loads((tmp_path / "evaluation.json").read_text(), parse_constant=pytest.fail)["summary"]
    assert stored["episode_return"] == {"value": 54.0, "low": None, "high": None}
    assert stored["survival"]["low"] < 0.6 < stored["survival"]["high"]


def test_an_evaluation_names_the_processor_that_finished_it(tmp_path):
    write_made_up_evaluation(tmp_path / "one")
    assert load_evaluation(tmp_path / "one").processor == processor()
    assert re.fullmatch(r"\w+ [\w-]+", processor())


def test_the_interval_is_over_months():
    summary = result("someone", [[0.2], [0.9], [1.0], [0.4]]).summary
    assert summary.survival.low < 0.5 < summary.survival.value < 0.8 < summary.survival.high


def test_summaries_of_a_mixture_are_refused():
    with pytest.raises(ValueError, match="one agent on one task"):
        summarise([episode(), episode(seed=1, agent="another")])
    with pytest.raises(ValueError, match="once with every seed"):
        summarise([episode("may", 0), episode("may", 1), episode("june", 0)])


def test_values_are_ordered_by_scenario_and_seed():
    rows = [episode("b", 1, 0.4), episode("a", 1, 0.2), episode("b", 0, 0.3), episode("a", 0, 0.1)]
    np.testing.assert_array_equal(by_scenario(rows, "survival"), [[0.1, 0.2], [0.3, 0.4]])


def test_who_knows_the_future_is_marked_and_never_the_best():
    bound = with_foresight(result("foresight", [[1.0, 1.0]])).summary
    greedy, nothing = result("greedy", [[0.9, 0.4]]).summary, result("do-nothing", [[0.5, 0.1]]).summary
    marked, best, other = markdown_table([bound, greedy, nothing]).splitlines()[2:]
    assert "foresight (with foresight)" in marked
    assert "**" not in marked
    assert "**0.650 [" in best
    assert "**" not in other
    assert "**" not in markdown_table([bound, greedy])


def test_tables_name_the_best():
    summaries = [result("ppo", [[1.0, 0.9]], "idle").summary, result("a|b", [[0.5, 0.1]]).summary]
    lines = markdown_table(summaries).splitlines()
    assert len({line.count("|") for line in lines}) == 1
    assert len(lines) == 4
    assert "**0.950 [" in lines[2]
    assert "**" not in lines[3]
    assert lines[0] == "| " + " | ".join(HEADINGS) + " |"
    console = Console(width=80)
    with console.capture() as captured:
        others = [result("do-nothing", [[0.5, 0.1]], "idle"), result("lagrangian-ppo-of-mine", [[0.5]], "recovery")]
        table = summary_table([*summaries, *(other.summary for other in others)])
        console.print(result_table_rich(table, "Results"))
    text = captured.get()
    assert "50%" in text
    assert "[5, 95]" in text
    assert "do-nothing" in text
    assert "+ idle" in text
    assert "survival" in text
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= 80


def test_only_comparable_results_share_a_table():
    first = result("a", [[1.0]])
    check_comparable([first, result("b", [[0.5]], "idle")])
    with pytest.raises(UsageError, match="different versions do not belong"):
        check_comparable([first, result("b", [[0.5]], versions={"rl2grid": "1"})])
    with pytest.raises(UsageError, match="different scenarios or seeds"):
        check_comparable([first, result("b", [[0.5, 0.6]])])
    other_month = replace(first, episodes=(replace(first.episodes[0], scenario="another month"),))
    with pytest.raises(UsageError, match="different scenarios or seeds"):
        check_comparable([first, other_month])
    with pytest.raises(UsageError, match="at least one"):
        check_comparable([])


METRICS = """step,grid_steps,wall_time,name,value
100,1200,1.0,charts/survival,0.25
100,1200,1.0,charts/episodes,20
100,1200,1.0,losses/value,3.0
200,2500,2.0,charts/survival,nan
300,3500,3.0,charts/survival,0.5
300,3500,3.0,charts/episodes,40
300,3500,3.0,validation/survival,0.75
"""


def test_a_training_curve_is_what_the_run_wrote(tmp_path):
    (tmp_path / "metrics.csv").write_text(METRICS)
    curve = read_training_curve(tmp_path, "ppo")
    np.testing.assert_array_equal(curve.survival.decisions, [100, 300])
    np.testing.assert_array_equal(curve.survival.grid_steps, [1200, 3500])
    np.testing.assert_array_equal(curve.survival.values, [0.25, 0.5])
    np.testing.assert_array_equal(curve.survival.episodes, [20, 40])
    np.testing.assert_array_equal(curve.validation.decisions, [300])
    np.testing.assert_array_equal(curve.validation.values, [0.75])


def test_a_run_without_episodes_has_no_curve(tmp_path):
    (tmp_path / "metrics.csv").write_text(METRICS.replace("charts/survival", "charts/other"))
    with pytest.raises(UsageError, match="no episode has ended"):
        read_training_curve(tmp_path / "metrics.csv", "ppo")


def test_replacing_a_row_changes_only_it():
    rows = [episode(seed=0), episode(seed=1)]
    better = summarise([rows[0], replace(rows[1], survival=0.5)])
    assert better.survival.value == 0.75


@pytest.mark.parametrize("cut", [1, 3, 12, 24])
def test_a_torn_last_line_of_metrics_is_ignored(tmp_path, cut):
    head = "step,grid_steps,wall_time,name,value\n"
    rows = [f"{step},9,0.5,{kind}/survival,0.{step}" for step in (10, 25) for kind in ("charts", "validation")]
    (tmp_path / "metrics.csv").write_text((head + "\n".join(rows) + "\n")[:-cut])
    assert read_validations(tmp_path) == {10: {"survival": 0.1}}
    curve = read_training_curve(tmp_path, "ppo")
    assert curve.validation is not None
    assert curve.validation.values.tolist() == [0.1]
    assert curve.survival.values.tolist() == [0.1, 0.25]
