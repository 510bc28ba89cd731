"""The ledger of test results: what came out when a frozen configuration played the test months, its one time.

A ledger is one JSON file of results by the hash of their configuration. A result holds hashes in place of episodes: who
has the agent can play the months again and compare, bit for bit. What anyone can check without the agent is an entry of
a leaderboard, :mod:`rl2grid.records.entries`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rl2grid.errors import UsageError
from rl2grid.records.evaluations import Evaluation, identity_hash
from rl2grid.records.files import write_json
from rl2grid.records.statistics import Estimate

_FIGURES = ("survival", "completed", "cost_lsi", "cost_tlo", "safe_lsi", "safe_tlo", "decisions")


@dataclass(frozen=True)
class HashedTest:
    """A frozen configuration and what its test gave, with hashes in place of the episodes.

    No :class:`rl2grid.records.entries.PlayableEntry`, which says why.
    """

    configuration: Mapping[str, Any]
    """Task, algorithm, hyperparameters and keywords of the environment, or agent, task and heuristic."""
    training: Mapping[str, Any]
    """How it came to be: command, decisions, minutes, hash of the policy; empty without training."""
    identity_hash: str
    """Of the evaluation."""
    episodes_hash: str
    """Of what must be equal wherever the episodes are played."""
    test: Mapping[str, Any]
    """Number of episodes, and value, low and high end of each figure, rounded."""

    @property
    def heuristic(self) -> str | None:
        """``"idle"``, ``"recovery"``, ``"careful"`` or None."""
        keywords = self.configuration.get("env_keywords", self.configuration)
        chosen: str | None = keywords["heuristic"]
        return chosen

    @property
    def agent(self) -> str:
        """The algorithm, or the agent without training."""
        return str(self.configuration.get("algorithm") or self.configuration["agent"])


def hashed_test(configuration: Mapping[str, Any], training: Mapping[str, Any], evaluation: Evaluation) -> HashedTest:
    """What the ledger keeps of an evaluation."""
    rows = [[row.scenario, row.seed, row.grid_steps, row.decisions, row.episode_return] for row in evaluation.episodes]
    summary = evaluation.summary
    figures = {name: _interval(getattr(summary, name)) for name in _FIGURES}
    return HashedTest(
        configuration=dict(configuration),
        training=dict(training),
        identity_hash=identity_hash(evaluation.identity),
        episodes_hash=identity_hash({"rows": rows}),
        test={"episodes": summary.episodes, **figures},
    )


def read_ledger(path: Path) -> dict[str, HashedTest]:
    """Results by the hash of their configuration, in the order in which they were entered; none without a file.

    Raises:
        UsageError: the file is no ledger.
    """
    if not path.exists():
        return {}
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        return {digest: HashedTest(**result) for digest, result in stored.items()}
    except OSError as error:
        raise UsageError(f"{path} cannot be read as a ledger of test results: {error.strerror}.") from None
    except (ValueError, TypeError, AttributeError):
        raise UsageError(
            f"{path} is no ledger of test results: give a file that 'rl2grid leaderboard test' wrote, or one that "
            "does not exist yet."
        ) from None


def add_test(path: Path, result: HashedTest) -> None:
    """Add a result to a ledger, or replace that of its configuration."""
    results = {**read_ledger(path), identity_hash(result.configuration): result}
    write_json(path, {digest: asdict(one) for digest, one in results.items()}, indent=1)


def _interval(estimate: Estimate) -> list[float]:
    return [round(float(value), 4) for value in (estimate.value, estimate.low, estimate.high)]
