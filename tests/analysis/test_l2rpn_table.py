"""Tables of what operation cost and of L2RPN's scores: of whom it is known, and of nobody else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from sample_results import TASK, result

from rl2grid.analysis.l2rpn_table import COSTS, l2rpn_table, operation_table, stored_scores
from rl2grid.analysis.result_tables import ranking_table, result_tables
from rl2grid.records.episodes import OPERATION
from rl2grid.records.evaluations import Evaluation
from rl2grid.records.l2rpn import Baselines, write_scores
from rl2grid.records.methods import group_methods


def with_costs(evaluation: Evaluation, folder: Path | None = None) -> Evaluation:
    """Every part of the cost is 100, and twice as much in the second month."""
    episodes = tuple(
        replace(episode, **{column.name: 100.0 * (1 + k % 2) for column in OPERATION})
        for k, episode in enumerate(evaluation.episodes)
    )
    return replace(evaluation, episodes=episodes, folder=folder)


def test_what_operation_cost_is_shown_where_it_is_known():
    methods = group_methods([with_costs(result("greedy", [[0.5], [0.8]])), result("do-nothing", [[0.1], [0.3]])])
    table = operation_table(methods)
    assert table is not None
    (row,) = table.rows
    assert [column.heading for column in table.columns] == ["Task", "Method", *COSTS]
    assert [cell.text for cell in row[:2]] == ["bus14-T0", "greedy"]
    assert row[-1].estimate is not None
    assert row[-1].estimate.value == 5 * 150
    assert operation_table(group_methods([result("do-nothing", [[0.1], [0.3]])])) is None
    assert "operation" in {one.name for one in result_tables(methods)}


def test_scores_beside_the_episodes_are_shown(tmp_path: Path):
    played = with_costs(result("greedy", [[0.5], [0.8]]), tmp_path)
    cheap = dict.fromkeys((column.name for column in OPERATION), 0.0)
    baselines = Baselines(10_000.0, {**cheap, "cost_blackout": 1000.0}, {**cheap, "cost_losses": 200.0})
    write_scores(tmp_path, played.episodes, [baselines] * 2)
    methods = group_methods([played, with_costs(result("do-nothing", [[0.1], [0.3]]), tmp_path / "nothing")])
    scores = stored_scores(methods)
    assert list(scores) == [id(methods[TASK][0])]
    table = l2rpn_table(methods, scores)
    assert table is not None
    ((_, method, cost, score, *_),) = table.rows
    assert (method.text, cost.estimate.value if cost.estimate else None) == ("greedy", 750)
    # Costs of 500 and 1,000 lie between 80 points at 200 and none at 1,000.
    assert score.estimate is not None
    assert score.estimate.value == (50 + 0) / 2
    assert l2rpn_table(methods, {}) is None


def test_a_ranking_names_a_length_that_was_chosen():
    (usual,) = group_methods([result("greedy", [[0.5], [0.8]])]).values()
    (weeks,) = group_methods([result("greedy", [[0.5], [0.8]], episode_length=2016)]).values()
    assert "steps" not in ranking_table(usual).caption
    assert "Episodes of 2,016 steps." in ranking_table(weeks).caption
