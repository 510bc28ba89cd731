"""Evaluations put together: one method is one agent with one heuristic on one task, trained once or several times."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rl2grid.envs.options import OBSERVED_WITH
from rl2grid.envs.tasks import Task, find_task
from rl2grid.errors import UsageError
from rl2grid.mdp.constraint_table import CONSTRAINTS, THRESHOLDS
from rl2grid.records.episodes import Episode
from rl2grid.records.evaluations import Evaluation, check_comparable, check_same_question
from rl2grid.records.statistics import UNIT, Scores
from rl2grid.records.summary import column_scores, safe_scores

COSTS: dict[str, str] = {name: constraint.column for name, constraint in CONSTRAINTS.items()}
"""Column of each cost in the rows of episodes."""
_OF_THE_TASK = frozenset({"task", "grid_hash", "scenario_pack_hash", "action_set_hash", "constraint"})
_OF_THE_AGENT = frozenset({"agent", "agent_identity", "heuristic", *OBSERVED_WITH})


@dataclass(frozen=True, eq=False)
class Method:
    """Results of one agent with one heuristic on one task; with several of them, each is of another training run."""

    evaluations: tuple[Evaluation, ...]

    @property
    def first(self) -> Episode:
        """Any episode: task, agent and heuristic are those of all."""
        return self.evaluations[0].episodes[0]

    @property
    def task(self) -> Task:
        return find_task(self.first.task)

    @property
    def agent(self) -> str:
        return self.first.agent

    @property
    def heuristic(self) -> str:
        """``none``, ``idle``, ``recovery``, ``careful`` or ``secure``."""
        return self.first.heuristic

    @property
    def label(self) -> str:
        """What tables and figures call it."""
        known = any(result.foresight for result in self.evaluations)
        return f"{method_label(self.first)} (with foresight)" if known else method_label(self.first)

    @property
    def is_trained(self) -> bool:
        return bool(self.first.agent_hash)

    @property
    def budget(self) -> Mapping[str, Any]:
        """Decisions and validations of each of its trainings; empty where nothing was trained, or nothing says."""
        return _trained_with(self.evaluations[0]).get("budget") or {}

    @property
    def episodes(self) -> tuple[Episode, ...]:
        """Of all runs."""
        return tuple(episode for result in self.evaluations for episode in result.episodes)

    @property
    def scenarios(self) -> tuple[str, ...]:
        """Ids in the order in which scores have them."""
        return tuple(sorted({episode.scenario for episode in self.evaluations[0].episodes}))

    def scores(self, column: str) -> Scores:
        """A column of :class:`~rl2grid.records.episodes.Episode`."""
        return column_scores([result.episodes for result in self.evaluations], column)

    @property
    def survival(self) -> float:
        """Mean over runs and episodes."""
        return float(self.scores("survival").values.mean())

    def within(self, constraint: str) -> Scores:
        """1 for episodes whose cost reached its threshold at most, else 0."""
        return Scores((self.scores(COSTS[constraint]).values <= THRESHOLDS[constraint]).astype(np.float64), UNIT)

    def safe(self, constraint: str) -> Scores:
        """1 for episodes that were completed as well: dying early is not safety."""
        return safe_scores([result.episodes for result in self.evaluations], constraint)


def is_fair(x: Method, y: Method) -> bool:
    """Whether a difference is one of methods: nothing says that their trainings had different budgets."""
    return not (x.budget and y.budget) or x.budget == y.budget


def method_label(episode: Episode) -> str:
    """What tables and figures call the method of an episode."""
    return episode.agent if episode.heuristic == "none" else f"{episode.agent} + {episode.heuristic}"


def group_methods(results: Sequence[Evaluation]) -> dict[str, tuple[Method, ...]]:
    """Methods by task, both in order of appearance.

    Raises:
        UsageError: no results, results that do not belong into one table, or one that was given twice.
    """
    if not results:
        raise UsageError("There are no results: give at least one evaluation.")
    by_task: dict[str, list[Evaluation]] = {}
    for result in results:
        by_task.setdefault(str(result.identity["task"]), []).append(result)
    for group in by_task.values():
        check_comparable(group)
    _check_same_question([group[0] for group in by_task.values()])
    return {task: _methods(group) for task, group in by_task.items()}


def group_bounds(
    results: Sequence[Evaluation], methods: Mapping[str, Sequence[Method]]
) -> dict[str, tuple[Method, ...]]:
    """Methods with foresight, by task: bounds, which stand beside the methods and are not ranked with them.

    Args:
        results: with foresight, at least one.
        methods: without foresight, by task.

    Raises:
        UsageError: they do not belong together, or did not answer the question of the methods of their task.
    """
    bounds = group_methods(results)
    for task, group in bounds.items():
        check_same_question([method.evaluations[0] for method in (*methods.get(task, ()), *group)])
    return bounds


def interval_units(methods: Iterable[Method]) -> str:
    """What intervals of these methods are over, in few words."""
    repeated = {len(method.evaluations) > 1 for method in methods}
    if repeated == {True}:
        return "runs and months"
    return "runs and months (one run: months)" if True in repeated else "months alone"


def interval_words(methods: Iterable[Method]) -> str:
    """What 95% intervals of these methods are about, as a sentence without its end."""
    known = list({(method.label, method.is_trained, len(method.evaluations)): None for method in methods})
    crossed = [label for label, _, runs in known if runs > 1]
    alone = [label for label, is_trained, runs in known if is_trained and runs == 1]
    untrained = [label for label, is_trained, runs in known if not is_trained and runs == 1]
    parts = ["training runs and months, crossed"] if crossed else []
    if untrained:
        parts.append("months alone where nothing was trained" if crossed or alone else "months, as nothing was trained")
    if alone:
        names = ", ".join(dict.fromkeys(alone))
        parts.append(f"months alone for the one training run of {names}, which says nothing of other trainings")
    return f"95% intervals over {'; over '.join(parts)}"


def _methods(results: Sequence[Evaluation]) -> tuple[Method, ...]:
    groups: dict[tuple[str, str], list[Evaluation]] = {}
    for result in results:
        group = groups.setdefault((result.episodes[0].agent, result.episodes[0].heuristic), [])
        if any(result.episodes[0].agent_hash == other.episodes[0].agent_hash for other in group):
            raise UsageError(
                f"The same evaluation of {result.episodes[0].agent} on {result.episodes[0].task} was given twice: "
                "leave one out."
            )
        _check_other_training(result, group)
        group.append(result)
    return tuple(Method(tuple(group)) for group in groups.values())


def _check_other_training(result: Evaluation, group: Sequence[Evaluation]) -> None:
    """Evaluations of one method are repeated trainings: of other seeds, by the same algorithm."""
    mine = _training(result)
    if mine is None:
        return
    who, task = result.episodes[0].agent, result.episodes[0].task
    for theirs in filter(None, map(_training, group)):
        if mine[0] != theirs[0]:
            raise UsageError(
                f"Evaluations called {who} on {task} are of policies by {theirs[0]} and by {mine[0]}: tell them "
                "apart as LABEL=FOLDER."
            )
        for name in sorted({*mine[2]} & {*theirs[2]}):
            if mine[2][name] != theirs[2][name]:
                raise UsageError(
                    f"Evaluations called {who} on {task} are of policies trained with {name}={theirs[2][name]} and "
                    f"{mine[2][name]}: tell them apart as LABEL=FOLDER."
                )
        if mine[1] == theirs[1]:
            raise UsageError(
                f"Two evaluations of {who} on {task} are of different policies trained with seed {mine[1]}: leave one "
                "out, or tell them apart as LABEL=FOLDER."
            )


def _training(result: Evaluation) -> tuple[str | None, int, Mapping[str, Any]] | None:
    """Algorithm, seed and budget with which the agent was trained; None where its identity does not say."""
    trained = _trained_with(result)
    if "seed" not in trained:
        return None
    return result.identity["agent_identity"].get("algorithm"), int(trained["seed"]), trained.get("budget") or {}


def _trained_with(result: Evaluation) -> Mapping[str, Any]:
    identity = result.identity.get("agent_identity") or {}
    trained: Mapping[str, Any] = identity.get("trained_with", {})
    return trained


def _check_same_question(results: Sequence[Evaluation]) -> None:
    """Tasks may differ, what is asked on each of them may not."""
    first = results[0].identity
    for other in (result.identity for result in results[1:]):
        for key in sorted({*first, *other} - _OF_THE_TASK - _OF_THE_AGENT):
            if first.get(key) != other.get(key):
                raise UsageError(
                    f"Results of different {key} do not belong into one table: {first['task']} has {first.get(key)!r}, "
                    f"{other['task']} has {other.get(key)!r}."
                )
