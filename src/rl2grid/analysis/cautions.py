"""What results are too few to prove, in sentences that stand beside them.

The limits are what ``benchmarks/intervals.py`` tried: 20 and 200 months, and 3, 5 and 10 trainings
(``docs/statistics.md``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rl2grid.envs.tasks import short_id
from rl2grid.records.methods import Method

FEWEST_MONTHS = 20
FEWEST_RUNS = 3
MONTHS_OF_SOLVED = 200
"""With fewer, intervals of a method that loses hardly a month are too narrow."""
SOLVED = 0.95
"""Share of months completed from which on this is so."""
MOST_NAMES = 3


def cautions(methods: Mapping[str, Sequence[Method]]) -> list[str]:
    """What the results cannot tell, a sentence each; tasks of which the same is true share one.

    Args:
        methods: by task.
    """
    tasks: dict[str, list[str]] = {}
    for task, group in methods.items():
        for sentence in task_cautions(group):
            tasks.setdefault(sentence, []).append(short_id(task))
    if len(methods) == 1:
        return list(tasks)
    return [f"{_listed(names, 'tasks')}: {sentence}" for sentence, names in tasks.items()]


def task_cautions(methods: Sequence[Method]) -> list[str]:
    """What the results of one task cannot tell."""
    months = methods[0].scores("survival").months
    sentences = []
    if months == 1:
        sentences.append("One month says nothing of other months: there are no intervals, and no order is shown by it.")
    elif months < FEWEST_MONTHS:
        sentences.append(
            f"{months} months are too few to prove an order. Intervals and p-values were tried with {FEWEST_MONTHS} "
            "months and more; take them here as a first impression."
        )
    trained = {method.label: len(method.evaluations) for method in methods if method.is_trained}
    for runs in range(1, FEWEST_RUNS):
        names = [label for label, number in trained.items() if number == runs]
        if names:
            sentences.append(_few_runs(_listed(names, "methods"), runs))
    solved = [
        method.label
        for method in methods
        if 1 < months < MONTHS_OF_SOLVED and method.scores("completed").values.mean() >= SOLVED
    ]
    if solved:
        sentences.append(
            f"{_listed(solved, 'methods')}: hardly a month was lost, and what {months} months did not show is in no "
            f"interval. {MONTHS_OF_SOLVED} months tell more."
        )
    return sentences


def _few_runs(names: str, runs: int) -> str:
    if runs == 1:
        return f"{names}: one training. The interval is over months alone; another training may end elsewhere."
    return f"{names}: {runs} trainings. Intervals over trainings were tried with {FEWEST_RUNS} and more."


def _listed(names: Sequence[str], noun: str) -> str:
    return ", ".join(names) if len(names) <= MOST_NAMES else f"{len(names)} {noun}"
