"""Tables: their numbers, which are bold, and the three formats."""

from __future__ import annotations

import csv
import io
import re

import pytest
from sample_results import TASK, result

from rl2grid.analysis.result_tables import (
    aggregate_table,
    comparison_table,
    constraint_table,
    ending_table,
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
    assert texts(table.rows[0]) == ["bus14", "0", "0.15 ± 0.05", "0.40 ± 0.10", "0.95 ± 0.05"]
    assert [cell.best for cell in table.rows[0]] == [False, False, False, False, True]
    assert texts(table.rows[1]) == ["bus36-M", "1", MISSING.text, MISSING.text, "0.30 ± 0.10"]
    assert not table.rows[1][-1].best  # alone
    continuous = survival_table(METHODS, "R")
    assert [column.heading for column in continuous.columns[2:]] == ["do-nothing", "V"]
    assert not any(cell.best for cell in continuous.rows[0])  # equal as printed


def test_the_least_gap_is_best():
    rows = {row[1].text: row for row in aggregate_table({TASK: METHODS[TASK]}).rows}
    assert rows["ppo + recovery"][-1].text.startswith("0.050 [")
    assert rows["ppo + recovery"][-1].best
    assert not rows["ppo"][-1].best
    assert rows["do-nothing"][2].estimate.value == pytest.approx(0.15)


def test_constraints_scores_and_endings():
    (row, *_) = constraint_table(METHODS).rows
    assert texts(row)[:5] == ["bus14-T0", "ppo + recovery", "0.95 ± 0.05", "0.5 ± 0.5", "0.50 ± 0.50"]
    assert row[7].text == "1.00 ± 0.00"  # TLO is kept by both,
    assert row[8].text == "0.50 ± 0.50"  # one of which was completed
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
    assert rows[0][3] == "1.000 [1.000, 1.000]"
    assert rows[2][4:6] == ["30", "10"]


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
