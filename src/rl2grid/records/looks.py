"""Looks at test months: how often a list was looked at, and who was entered after what was seen.

Everything here follows from the order of a ledger, so that nobody has to remember it. A *look* is the test of one
choice: a configuration, whose further seeds repeat the training and choose nothing. What is chosen after earlier looks
may have been chosen because of them; the best of many looks is lucky by some standard errors, however large a list is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rl2grid.envs.tasks import find_task
from rl2grid.records.ledger import HashedTest

LOOKS = 100
"""At the test months of one grid: then the list is used up. Of so many equal agents the luckiest looks 2.5 standard
errors better than it is."""


def looks(results: Mapping[str, HashedTest], grid_id: str, split_version: str | None) -> list[str]:
    """The choices that were tested on a list of a grid, in the order of their first test.

    Args:
        results: of a ledger.
        grid_id: whose test months.
        split_version: of the list.
    """
    tested = [one.choice for one in results.values() if _list_of(one) == (grid_id, split_version)]
    return list(dict.fromkeys(tested))


def earlier_choices(results: Mapping[str, HashedTest], method: tuple[Any, ...], choice: str) -> list[str]:
    """Other choices of a method that had had their test on the same list before one of it.

    Args:
        results: of a ledger.
        method: of the choice, see :func:`method_of`.
        choice: in the ledger, or still to be entered.
    """
    seen: list[str] = []
    for one in results.values():
        if one.choice == choice:
            break
        if method_of(one) == method and one.choice not in seen:
            seen.append(one.choice)
    return seen


def latest_rules(results: Mapping[str, HashedTest]) -> dict[tuple[Any, ...], int]:
    """By what latest rules an agent has had a test on a task, with any heuristic, and by what latest ones of each.

    For :func:`is_outdated`.
    """
    latest: dict[tuple[Any, ...], int] = {}
    for one in results.values():
        for player, rules in _rules_of(one).items():
            latest[player] = max(rules, latest.get(player, rules))
    return latest


def is_outdated(result: HashedTest, latest: Mapping[tuple[Any, ...], int]) -> bool:
    """Whether an agent without training has had a test by later rules, of :func:`latest_rules`, than this one."""
    return any(rules < latest[player] for player, rules in _rules_of(result).items())


def by_present_rules(results: Mapping[str, HashedTest]) -> dict[str, HashedTest]:
    """Without what is outdated."""
    latest = latest_rules(results)
    return {digest: one for digest, one in results.items() if not is_outdated(one, latest)}


def method_of(result: HashedTest) -> tuple[Any, ...]:
    """What the tests of one method on one list have in common: task, agent, heuristic and the version of the list."""
    return result.task, result.agent, result.heuristic, result.months["split_version"]


def budget(result: HashedTest) -> tuple[tuple[str, Any], ...]:
    """What a training had: decisions, and validations to pick the best policy from; empty without training."""
    if not result.training:
        return ()
    decisions = result.configuration["hyperparameters"]["total_timesteps"]
    return tuple(sorted({"decisions": decisions, **result.training["identity"].get("budget", {})}.items()))


def _rules_of(result: HashedTest) -> dict[tuple[Any, ...], int]:
    """The rules of the agent, and of the heuristic beside it."""
    agent = result.task, result.agent, result.months["split_version"]
    return {agent: result.rules, (*agent, result.heuristic): result.heuristic_rules}


def _list_of(result: HashedTest) -> tuple[str, Any]:
    return find_task(result.task).grid_id, result.months["split_version"]
