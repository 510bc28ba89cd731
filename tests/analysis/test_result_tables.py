"""Tables: their numbers, which are bold, and the three formats."""

from __future__ import annotations

import csv
import io
import re

import pytest
from sample_results import TASK, result

from rl2grid.analysis.comparison_table import comparison_table, reference_table
from rl2grid.analysis.result_tables import (
    HEURISTIC_LETTERS,
    aggregate_table,
    constraint_table,
    ending_table,
    ranking_table,
    result_tables,
    score_table,
    survival_table,
)
from rl2grid.analysis.table import (
    MISSING,
    Cell,
    Column,
    ResultTable,
    mean_cell,
    table_csv,
    table_latex,
    table_markdown,
)
from rl2grid.engines import HEURISTICS
from rl2grid.records.methods import group_methods
from rl2grid.records.statistics import Estimate

CONTINUOUS = "rl2grid/bus14-R-v0"
METHODS = group_methods(
    [
        result("ppo", [[1.0], [0.9]], "recovery", agent_hash="a"),
        result("ppo", [[0.5], [0.3]], agent_hash="b"),
        result("do-nothing", [[0.2], [0.1]]),
        result("do-nothing", [[0.2], [0.1]], task=CONTINUOUS),
        result("td3", [[0.2], [0.1]], task=CONTINUOUS, agent_hash="c"),
        result("ppo", [[0.4], [0.2]], "recovery", task="rl2grid/bus36-M-T1-v0", agent_hash="d"),
    ]
)


def texts(row):
    return [cell.text for cell in row]


def test_survival_has_the_shape_of_the_paper():
    table = survival_table(METHODS, "T")
    assert [(column.group, column.heading) for column in table.columns] == [
        ("", "Env."),
        ("", "Diff."),
        ("Baselines", "do-nothing"),
        ("ppo", "V"),
        ("ppo", "R"),
    ]
    assert texts(table.rows[0]) == ["bus14", "0", "0.15 ± 0.10", "0.40 ± 0.18", "0.95 ± 0.11"]
    assert [cell.best for cell in table.rows[0]] == [False, False, False, False, True]
    assert texts(table.rows[1]) == ["bus36-M", "1", MISSING.text, MISSING.text, "0.30 ± 0.18"]
    assert not table.rows[1][-1].best  # alone
    continuous = survival_table(METHODS, "R")
    assert [column.heading for column in continuous.columns[2:]] == ["do-nothing", "V"]
    assert not any(cell.best for cell in continuous.rows[0])  # equal as printed


def test_every_heuristic_has_a_letter_that_the_caption_explains():
    caption = survival_table(METHODS, "T").caption
    assert all(f"{HEURISTIC_LETTERS[name]}: {name}" in caption for name in HEURISTICS)


def test_joint_tasks_have_a_table_of_their_own():
    joint = group_methods([result("greedy", [[0.7], [0.5]], task="rl2grid/bus14-H1-v0")])
    table = next(table for table in result_tables({**METHODS, **joint}) if table.name == "survival-joint")
    assert texts(table.rows[0])[:3] == ["bus14", "1", "0.60 ± 0.18"]
    assert "joint actions" in table.caption
    assert survival_table(METHODS, "T").name == "survival-topology"


def test_the_least_gap_is_best():
    rows = {row[1].text: row for row in aggregate_table({TASK: METHODS[TASK]}).rows}
    assert rows["ppo + recovery"][-1].text.startswith("0.050 [")
    assert rows["ppo + recovery"][-1].best
    assert not rows["ppo"][-1].best
    assert rows["do-nothing"][2].estimate.value == pytest.approx(0.15)


def test_constraints_scores_and_endings():
    (row, *_) = constraint_table(METHODS).rows
    assert texts(row)[:5] == ["bus14-T0", "ppo + recovery", "0.95 ± 0.11", "0.5 ± 2.6", "0.50 ± 0.41"]
    assert row[7].text == "1.00 ± 0.33"  # TLO is kept by both,
    assert row[8].text == "0.50 ± 0.41"  # one of which was completed
    assert row[8].best
    assert texts(score_table(METHODS).rows[0])[2:] == ["11.000 ± 0.000", "-0.250 ± 0.000", "-2.000 ± 0.000"]
    endings = ending_table(METHODS)
    assert [column.heading for column in endings.columns[2:]] == ["episodes", "completed", "divergence"]
    assert texts(endings.rows[0])[2:] == ["2", "1", "1"]
    assert "voltage collapse" in endings.caption


def test_every_pair_is_compared():
    rows = [texts(row) for row in comparison_table({TASK: METHODS[TASK]}).rows]
    assert [row[1:3] for row in rows] == [
        ["ppo + recovery", "ppo"],
        ["ppo + recovery", "do-nothing"],
        ["ppo", "do-nothing"],
    ]
    assert rows[0][3:6] == ["+0.550 [+0.086, +1.000]", "0.115", "1.000 [0.342, 1.000]"]
    assert rows[2][6:8] == ["30", "10"]


def test_a_ranking_compares_with_its_first_row():
    table = ranking_table(METHODS[TASK])
    assert texts(table.rows[0])[:5] == ["ppo + recovery", "0.950 [0.764, 0.991]", "-", "-", "50% [9, 91]"]
    assert texts(table.rows[1])[:5] == ["ppo", "0.400 [0.234, 0.593]", "-0.550 [-1.000, -0.086]", "0.115", "0% [0, 66]"]
    assert [row[-1].text for row in table.rows] == ["1 x 2 x 1", "1 x 2 x 1", "- x 2 x 1"]
    assert "over months alone for the one training run of ppo + recovery, ppo, which says nothing" in table.caption


def test_trainings_with_other_budgets_are_no_pair():
    def one(agent: str, decisions: int, survivals: list[list[float]]):
        trained = {"seed": 1, "budget": {"decisions": decisions}}
        return result(agent, survivals, agent_hash=agent, agent_identity={"algorithm": agent, "trained_with": trained})

    methods = group_methods([one("ppo", 1000, [[1.0], [0.9]]), one("sac", 5000, [[0.5], [0.3]])])
    (row,) = comparison_table(methods).rows
    assert texts(row)[3:5] == ["other budget", MISSING.text]
    assert texts(ranking_table(methods[TASK]).rows[1])[2:4] == ["other budget", MISSING.text]
    assert texts(reference_table(methods[TASK]).rows[0])[1:3] == ["other budget", MISSING.text]


def test_methods_are_compared_with_one_of_them():
    table = reference_table(METHODS[TASK], reference=2)
    assert [row[0].text for row in table.rows] == ["ppo + recovery", "ppo"]
    assert table.rows[1][1].text == "+0.250 [-0.214, +0.714]"
    assert table.rows[1][2].text == "0.126"
    assert "Holm's correction over these 2 comparisons" in table.caption


def test_nothing_to_compare_is_no_table():
    alone = group_methods([result("a", [[1.0]])])
    assert [table.name for table in result_tables(alone)] == [
        "survival-topology",
        "aggregates",
        "constraints",
        "scores",
        "endings",
    ]


TABLE = ResultTable(
    "some-table",
    "100% of {it} & more.",
    (Column("a_b", words=True), Column("x", "Group"), Column("y", "Group")),
    (
        (Cell("50% | more"), mean_cell(Estimate(0.5, 0.25, 0.65), best=True), Cell("7")),
        (Cell("#1"), MISSING, Cell("8")),
    ),
)


def test_markdown_keeps_its_columns():
    lines = table_markdown(TABLE).splitlines()
    assert lines[0] == "| a_b | Group x | Group y |"
    assert lines[1] == "| :-- | --: | --: |"
    assert lines[2] == "| 50% &#124; more | **0.50 ± 0.20** | 7 |"
    assert lines[-1] == TABLE.caption


def test_latex_is_escaped_and_balanced():
    text = table_latex(TABLE)
    assert r"\caption{100\% of \{it\} \& more.}" in text
    assert r"50\% $|$ more & \textbf{0.50 $\pm$ 0.20} & 7 \\" in text
    assert r" & \multicolumn{2}{c}{Group} \\" in text
    assert r"\cmidrule(lr){2-3}" in text
    assert r"\#1 & - & 8 \\" in text
    assert r"\begin{tabular}{lrr}" in text
    begun, ended = (re.findall(rf"\\{word}{{(\w+)}}", text) for word in ("begin", "end"))
    assert begun == ended[::-1] == ["table", "tabular"]
    bare = re.sub(r"\\[{}]", "", text)
    assert bare.count("{") == bare.count("}")
    body = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert len(body) == 4
    assert text.isascii()


def test_csv_has_all_digits():
    rows = list(csv.reader(io.StringIO(table_csv(TABLE))))
    assert rows[0] == ["a_b", "Group x", "Group x low", "Group x high", "Group y"]
    assert rows[1] == ["50% | more", "0.5", "0.25", "0.65", "7"]
    assert rows[2] == ["#1", "", "", "", "8"]


def test_a_row_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="has 1 cells, the table 2 columns"):
        ResultTable("t", "", (Column("a"), Column("b")), ((Cell("1"),),))
