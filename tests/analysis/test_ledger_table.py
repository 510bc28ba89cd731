"""The ledger as a table."""

from __future__ import annotations

from pathlib import Path

import pytest
from sample_ledger import MONTHS, ledger, on, trained, untrained
from sample_results import TASK, result

from rl2grid.analysis.ledger_figure import draw_ledger
from rl2grid.analysis.ledger_overview import overview_table
from rl2grid.analysis.ledger_table import LEGEND, ledger_table, short_ledger_table
from rl2grid.errors import UsageError
from rl2grid.records.ledger import HashedTest, hashed_test, read_ledger

ROOT = Path(__file__).parents[2]


def cells(table: str, start: str) -> dict[str, str]:
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines() if "|" in line]
    (row,) = [line for line in lines if " ".join(line).startswith(start)]
    return dict(zip(lines[0], row, strict=True))


def test_the_table_of_the_documentation_is_the_ledger():
    table = ledger_table(read_ledger(ROOT / "benchmarks" / "results" / "baselines.json"))
    assert table in (ROOT / "docs" / "results.md").read_text()


def test_seeds_stand_together_and_are_compared_on_the_same_months():
    table = ledger_table(
        ledger(
            untrained("do-nothing", [0.1, 0.2, 0.3, 0.4]),
            trained(1, [0.6, 0.6, 0.8, 1.0], last=[0.2, 0.3, 0.3, 0.4]),
            trained(2, [0.5, 0.7, 0.8, 1.0]),
        )
    )
    row = cells(table, "bus14-T0 ppo idle")
    assert row["months"] == "4 (list 2)"
    assert row["decisions (grid steps)"] == "1,000 (5.0 M)"
    assert row["test survival"].startswith("**0.750 [")
    assert row["test survival"].endswith("]** of 0.750, 0.750")
    assert row["last"] == "0.525"  # 0.3 and, where the last is the best, 0.75
    assert row["to do-nothing"].startswith("+0.500 [+0.")
    assert float(row["p"].removeprefix("< ")) < 0.01
    assert row["completed"].startswith("25% [")
    assert row["marks"] == ""
    assert cells(table, "bus14-T0 do-nothing")["completed"] == "0% [0, 49]"
    assert table.endswith(LEGEND.format(heading="To do-nothing"))


def test_what_cannot_be_compared_is_marked():
    other = trained(1, [0.5, 0.5], steps=5000)
    results = ledger(
        untrained("do-nothing", [0.1, 0.2]),
        trained(1, [0.6, 0.8]),
        trained(2, [0.6, 0.9]),
        other,
        trained(1, [0.7, 0.8], network="mlp", targets_version=1, tested_before=True),
    )
    rows = [line.split("|")[-2].strip() for line in ledger_table(results).splitlines() if "| ppo |" in line]
    assert sorted(rows) == ["", "a1 b", "a2 s t"]
    to_ppo = ledger_table(results, TASK, "ppo + idle")
    assert to_ppo.count("other budget") >= 1


def test_configurations_of_one_label_and_budget_are_told_apart_by_their_hyperparameters():
    def wide(seed: int, layers: list[int], steps: int = 1000) -> HashedTest:
        hyperparameters = {"seed": seed, "total_timesteps": steps, "gamma": 0.9, "layers": layers}
        return trained(seed, [0.6, 0.8], steps=steps, hyperparameters=hyperparameters)

    results = ledger(wide(1, [64, 32]), wide(2, [64, 32]), wide(1, [8]), wide(1, [4], steps=5000))
    agents = sorted(line.split("|")[2].strip() for line in ledger_table(results).splitlines()[2:-2])
    assert agents == ["ppo", "ppo (layers 64 32)", "ppo (layers 8)"]
    assert "| ppo + idle (layers 8) |" in short_ledger_table(results, TASK).replace("**", "")


@pytest.mark.parametrize(
    ("reward", "words"), [("default", ""), ("trips", ", reward trips"), ([1.0, 2.0, 0.5], ", reward 1,2,0.5")]
)
def test_another_reward_than_the_default_is_named(reward, words):
    one = trained(1, [0.6, 0.8], env_keywords={"heuristic": "idle", "reward": reward})
    assert one.label == f"ppo{words} + idle"


def test_another_network_than_an_mlp_is_named():
    others = [trained(1, [0.6, 0.8], hyperparameters={"seed": 1, "network": name}) for name in ("mlp", "gnn")]
    assert [one.label for one in others] == ["ppo + idle", "ppo, gnn + idle"]
    assert trained(1, [0.6, 0.8]).label == "ppo + idle"


def test_rows_are_compared_with_the_reference_by_its_present_rules():
    results = ledger(
        untrained("do-nothing", [0.1, 0.2]),
        untrained("planner", [0.8, 0.9]),
        untrained("planner", [0.5, 0.7], rules=2),
    )
    table = ledger_table(results, TASK, "planner")
    assert cells(table, "bus14-T0 do-nothing")["to planner"].startswith("-0.450 [")


def test_a_row_that_a_hyperparameter_tells_from_others_is_compared_with_by_its_whole_name():
    common = {"seed": 1, "total_timesteps": 1000}
    results = ledger(
        *(
            trained(1, survivals, hyperparameters={**common, "gamma": gamma})
            for gamma, survivals in ((0.9, [0.2, 0.4]), (0.99, [0.7, 0.9]))
        )
    )
    by_name = ledger_table(results, TASK, "ppo + idle (gamma 0.99)")
    assert cells(by_name, "bus14-T0 ppo (gamma 0.9)")["to ppo + idle (gamma 0.99)"].startswith("-0.500 [")
    of_both = ledger_table(results, TASK, "ppo + idle")
    assert of_both.count("0.500 [") == 1  # with whichever is first


def test_what_later_rules_of_an_agent_replaced_is_marked_and_left_out_of_short_tables():
    results = ledger(
        untrained("do-nothing", [0.1, 0.2]), untrained("planner", [0.7, 0.8]), untrained("planner", [0.6, 0.8], rules=2)
    )
    marks = [line.split("|")[-2].strip() for line in ledger_table(results).splitlines() if "| planner |" in line]
    assert sorted(marks) == ["a1", "r"]
    short = short_ledger_table(results, TASK)
    assert short.count("planner") == 1
    assert "0.700 [" in short
    (axes,) = draw_ledger(results, TASK).axes
    assert len(axes.get_yticklabels()) == 2
    assert "**0.700** (2 months)" in overview_table(results)


def test_a_constrained_task_is_told_by_its_own_cost():
    task = "rl2grid/bus14-T0-LSI-v0"
    safer = on(task, trained(1, [0.6, 1.0]))
    longer = on(task, trained(2, [0.9, 0.9], algorithm="dqn"))
    table = short_ledger_table(ledger(longer, safer), task)
    assert "**ppo + idle**" in table
    row = cells(table.replace("**", ""), "ppo")
    assert row["cost LSI"] == "0.5"
    assert row["LSI safe"].startswith("50% [")
    assert "TLO" not in "".join(row)


def test_an_unknown_reference_is_refused():
    results = ledger(untrained("do-nothing", [0.1, 0.2]))
    with pytest.raises(UsageError, match="Reference 'greedy' does not exist: choose one of do-nothing"):
        ledger_table(results, TASK, "greedy")


def test_the_figure_has_a_line_per_configuration_the_longest_lived_on_top():
    results = ledger(
        untrained("do-nothing", [0.1, 0.2]), trained(1, [0.6, 0.8]), trained(2, [0.6, 0.9]), untrained("greedy", [1, 1])
    )
    (axes,) = draw_ledger(results, TASK).axes
    names = [label.get_text().replace("\n", " ") for label in axes.get_yticklabels()]
    assert names == ["do-nothing", "ppo + idle (1,000 decisions, 2 seeds)", "greedy"]
    points = [line.get_xdata()[0] for line in axes.lines if line.get_marker() == "o"]
    assert points == pytest.approx([0.15, 0.725, 1.0])
    with pytest.raises(ValueError, match="no result of rl2grid/bus14-R-v0"):
        draw_ledger(results, "rl2grid/bus14-R-v0")


def test_policies_of_the_package_are_drawn_as_trained():
    configuration = {"agent": "pretrained/bus14-T0", "policy_hash": "0" * 16, "task": TASK, "heuristic": None}
    policy = hashed_test(configuration, {}, result("pretrained/bus14-T0", [[0.9], [1.0]], **MONTHS))
    none = untrained("do-nothing", [0.1, 0.2])
    figure = draw_ledger({"a": none, "b": policy}, TASK)
    (axes,) = figure.axes
    _, nothing, _, package = (line.get_color() for line in axes.lines)
    untrained_handle, trained_handle = figure.legends[0].legend_handles
    assert (nothing, package) == (untrained_handle.get_color(), trained_handle.get_color())
