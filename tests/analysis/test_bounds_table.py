"""Who knows the future stands beside the others in a table of its own, and nowhere else."""

from __future__ import annotations

import pytest
from sample_results import TASK, result, with_foresight

from rl2grid.analysis.section import plan_section
from rl2grid.errors import UsageError

OTHER = "rl2grid/bus14-T1-v0"
GREEDY = result("greedy", [[0.5], [0.3]])
NOTHING = result("do-nothing", [[0.2], [0.2]])
BOUND = with_foresight(result("foresight", [[1.0], [0.6]]))


def texts(table):
    return [[cell.text for cell in row] for row in table.rows]


def test_every_method_stands_beside_the_bound_and_the_bound_in_no_ranking():
    section = plan_section([BOUND, NOTHING, GREEDY])
    *others, table = section.tables
    assert table.name == "foresight"
    rows = [[row[1], row[3], row[5]] for row in texts(table)]
    bound = "foresight (with foresight)"
    assert rows == [["greedy", bound, "50%"], ["do-nothing", bound, "25%"]]
    assert texts(table)[0][4].startswith("0.800 [")
    assert not any("foresight" in cell for other in others for row in texts(other) for cell in row)
    assert [method.agent for method in section.methods[TASK]] == ["do-nothing", "greedy"]


def test_a_bound_of_a_task_that_nobody_else_played_stands_alone():
    elsewhere = with_foresight(result("foresight", [[0.0], [0.0]], task=OTHER))
    section = plan_section([GREEDY, BOUND, elsewhere])
    *_, (task, method, _, _, survival, reached) = texts(section.tables[-1])
    assert (task, method, reached) == ("bus14-T1", "-", "-")
    assert survival.startswith("0.000")


def test_bounds_alone_are_analysed_as_any_result():
    section = plan_section([BOUND])
    assert section.methods[TASK][0].label == "foresight (with foresight)"
    assert "foresight" not in [table.name for table in section.tables]


def test_a_bound_of_other_months_is_refused():
    with pytest.raises(UsageError, match="different scenarios or seeds do not belong"):
        plan_section([GREEDY, with_foresight(result("foresight", [[1.0], [1.0], [1.0]]))])
