"""The scores of the L2RPN competitions, for commands that print them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from rl2grid.analysis.l2rpn_table import l2rpn_table
from rl2grid.analysis.table import ResultTable
from rl2grid.cli.output import Output
from rl2grid.records.methods import Method


def add_scores_flag(parser: argparse.ArgumentParser) -> None:
    """Add the flag that asks for the scores."""
    parser.add_argument(
        "--l2rpn",
        action="store_true",
        help="also the scores of the L2RPN competitions, for which two baselines are played",
    )


def scored_table(methods: Sequence[Method], output: Output) -> ResultTable:
    """The scores of methods of one task; the two baselines are played where they have not been.

    Raises:
        UsageError: the episodes do not say what operation cost.
    """
    # Imported here: nothing else of these commands needs the compiled engine.
    from rl2grid.evaluation.l2rpn import l2rpn_scores

    scores = {}
    for method in methods:
        found = []
        for result in method.evaluations:
            with output.counting("Playing L2RPN's baselines", len(result.episodes)) as show:
                found.append(l2rpn_scores(result, show))
        scores[id(method)] = found
    table = l2rpn_table({methods[0].first.task: methods}, scores)
    assert table is not None
    return table
