"""Test results as a ledger keeps them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from sample_results import TASK, result

from rl2grid.records.evaluations import identity_hash
from rl2grid.records.ledger import HashedTest, hashed_test

MONTHS = {"split": "test", "split_version": "2", "generator_version": "1"}


def untrained(agent: str, survivals: list[float], rules: int = 1) -> HashedTest:
    configuration = {"agent": agent, "task": TASK, "heuristic": None} | ({"rules": rules} if rules > 1 else {})
    return hashed_test(configuration, {}, result(agent, [[one] for one in survivals], **MONTHS))


def trained(
    seed: int, survivals: list[float], last: list[float] | None = None, steps: int = 1000, **changes: Any
) -> HashedTest:
    hyperparameters = {"seed": seed, "total_timesteps": steps}
    configuration = {"algorithm": "ppo", "task": TASK, "hyperparameters": hyperparameters, "targets_version": 2}
    configuration |= {"env_keywords": {"heuristic": "idle"}}
    training = {"grid_steps": 5_000_000, "minutes": 3.0, "validation_survival": 0.75, "decisions": steps}
    training |= {"identity": {}, "tested_before": changes.pop("tested_before", False)}
    played = [
        None if values is None else result("ppo", [[one] for one in values], "idle", **MONTHS)
        for values in (survivals, last)
    ]
    assert played[0] is not None
    return hashed_test({**configuration, **changes}, training, played[0], played[1])


def on(task: str, test: HashedTest, **changes: Any) -> HashedTest:
    """The same test on another task, and what else of its configuration is to be another."""
    return replace(test, configuration={**test.configuration, "task": task, **changes})


def ledger(*results: HashedTest) -> dict[str, HashedTest]:
    return {identity_hash(one.configuration): one for one in results}


def cells(table: str) -> list[list[str]]:
    """What stands in a Markdown table, line by line."""
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
