"""The ledger of test results by what was learned: what several trainings of each method reach, task by task."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from rl2grid.analysis.ledger_overview import KINDS, best_row, by_task, kind_of
from rl2grid.analysis.ledger_table import LedgerRow
from rl2grid.analysis.table import markdown_row, with_interval
from rl2grid.envs.tasks import short_id
from rl2grid.errors import UsageError
from rl2grid.records.ledger import HashedTest
from rl2grid.records.statistics import aggregated, estimate
from rl2grid.records.trainings import IMITATION

SEVERAL = 2
"""Trainings that a method needs to have a cell."""
BESIDE = KINDS[:-1]
"""What learned nothing, the best of each kind."""


def learned_table(results: Mapping[str, HashedTest]) -> str:
    """What methods of several trainings reach beside the best of what learned nothing, as Markdown, a row per task.

    Of a method the rows with its commonest number of decisions are compared, of several of a task that with most
    trainings. All values of a row are of the same months, the first that all of them played.

    Args:
        results: of a ledger.

    Raises:
        UsageError: nothing was trained twice.
    """
    rows = by_task(results)
    learned = {task: [row for row in each if len(row.results) >= SEVERAL] for task, each in rows.items()}
    decisions = _commonest([row for each in learned.values() for row in each])
    if not decisions:
        raise UsageError("No configuration of this ledger was trained with several seeds: test more of a run's seeds.")
    names = ["task", "months", *BESIDE, *(_headed(player, number) for player, number in decisions.items())]
    lines = [markdown_row(names), "|:--|" + "--:|" * (len(names) - 1)]
    for task, each in rows.items():
        chosen = [_chosen(learned[task], player, number) for player, number in decisions.items()]
        if any(row is not None for row in chosen):
            beside = [best_row([row for row in each if kind_of(row.first) == kind]) for kind in BESIDE]
            lines.append(markdown_row([short_id(task), *_cells([*beside, *chosen])]))
    return "\n".join(lines)


def _headed(player: str, number: int) -> str:
    """A method and what it learned from: of imitation, which plays nothing, that are labels."""
    return f"{player}, {number:,} labels" if player.split(",")[0] == IMITATION else f"{player}, {number:,}"


def _commonest(rows: Sequence[LedgerRow]) -> dict[str, int]:
    """Of each method, the decisions with which it was trained for most tasks; of as many, the fewest."""
    tasks: dict[str, Counter[int]] = {}
    for player, number, _ in {(row.first.player, _decisions(row), row.first.task) for row in rows}:
        tasks.setdefault(player, Counter())[number] += 1
    found = {player: min(counts, key=lambda one: (-counts[one], one)) for player, counts in tasks.items()}
    return dict(sorted(found.items()))


def _decisions(row: LedgerRow) -> int:
    return int(row.first.configuration["hyperparameters"]["total_timesteps"])


def _chosen(rows: Sequence[LedgerRow], player: str, decisions: int) -> LedgerRow | None:
    able = [row for row in rows if row.first.player == player and _decisions(row) == decisions]
    return max(able, key=lambda row: len(row.results), default=None)


def _cells(rows: Sequence[LedgerRow | None]) -> list[str]:
    """The number of months, and what each came to on them; the highest is bold."""
    there = [row for row in rows if row is not None]
    months = min(int(row.first.months["number"]) for row in there)
    highest = max(aggregated(row.scores("survival", months)) for row in there)
    return [str(months), *("" if row is None else _cell(row, months, highest) for row in rows)]


def _cell(row: LedgerRow, months: int, highest: float) -> str:
    scores = row.scores("survival", months)
    is_highest = aggregated(scores) == highest
    if not row.first.training:
        survival = f"{aggregated(scores):.3f}"
        return f"**{survival}**" if is_highest else survival
    survival = with_interval(estimate(scores), 3)
    return f"{f'**{survival}**' if is_highest else survival} ({len(row.results)})"
