"""The ledger of test results by ways of learning: what several trainings reach by each, task by task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rl2grid.analysis.ledger_overview import KINDS, best_row, by_task, kind_of, survival_of
from rl2grid.analysis.ledger_table import LedgerRow
from rl2grid.analysis.table import highlighted, markdown_row, with_interval
from rl2grid.envs.tasks import short_id
from rl2grid.errors import UsageError
from rl2grid.records.ledger import STARTED_FROM, HashedTest, looking_of
from rl2grid.records.statistics import aggregated, estimate
from rl2grid.records.trainings import IMITATION

SEVERAL = 2
"""Trainings that a configuration needs to have a cell."""
BESIDE = KINDS[:-1]
"""What learned nothing, the best of each kind."""
_ON_POLICY, _OFF_POLICY = "PPO", "SAC, TD3 or DQN"
_OF_ALGORITHMS = {
    "ppo": _ON_POLICY,
    "lagrangian-ppo": _ON_POLICY,
    "sac": _OFF_POLICY,
    "td3": _OFF_POLICY,
    "dqn": _OFF_POLICY,
}
_GOING_ON, _LOOKING = "going on from a policy", "looking before acting"
WAYS = (_ON_POLICY, _OFF_POLICY, IMITATION, _GOING_ON, _LOOKING)
"""How policies learn, and whether they look: the columns, where there is something in them; behind them are algorithms
that are none of the package's."""


def learned_table(results: Mapping[str, HashedTest]) -> str:
    """What each way of learning reaches beside the best of what learned nothing, as Markdown, a row per task.

    Of each way the configuration of several trainings with the highest mean survival is shown, with the number of
    trainings and the decisions of each. All values of a row are of the same months, the first that all of them played.

    Args:
        results: of a ledger.

    Raises:
        UsageError: nothing was trained twice.
    """
    rows = by_task(results)
    shown = {task: _of_ways([row for row in each if len(row.results) >= SEVERAL]) for task, each in rows.items()}
    found = {way for ways in shown.values() for way in ways}
    if not found:
        raise UsageError("No configuration of this ledger was trained with several seeds: test more of a run's seeds.")
    ways = [*(way for way in WAYS if way in found), *sorted(found - {*WAYS})]
    lines = [markdown_row(["task", "months", *BESIDE, *ways]), "|:--|" + "--:|" * (1 + len(BESIDE) + len(ways))]
    for task, each in rows.items():
        if shown[task]:
            beside = [best_row([row for row in each if kind_of(row.first) == kind]) for kind in BESIDE]
            lines.append(markdown_row([short_id(task), *_cells([*beside, *(shown[task].get(way) for way in ways)])]))
    return "\n".join(lines)


def _way_of(result: HashedTest) -> str:
    """Which of :data:`WAYS` a policy was made by; of an algorithm of none of them, its name."""
    configuration = result.configuration
    if looking_of(configuration):
        return _LOOKING
    if STARTED_FROM in configuration:
        return _GOING_ON
    algorithm = str(configuration["algorithm"])
    return _OF_ALGORITHMS.get(algorithm, algorithm)


def _of_ways(rows: Sequence[LedgerRow]) -> dict[str, LedgerRow]:
    """The row of each way with the highest mean survival."""
    return {_way_of(row.first): row for row in sorted(rows, key=survival_of)}


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
        return highlighted(f"{aggregated(scores):.3f}", is_highest)
    return f"{highlighted(with_interval(estimate(scores), 3), is_highest)} ({trainings_text(row)})"


def trainings_text(row: LedgerRow) -> str:
    """The number of trainings and the decisions of each, as "3 of 100,000"."""
    decisions = int(row.first.configuration["hyperparameters"]["total_timesteps"])
    return f"{len(row.results)} of {decisions:,}"
