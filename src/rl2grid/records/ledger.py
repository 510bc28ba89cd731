"""The ledger of test results: what came out when a frozen configuration played the test months, its one time.

A ledger is one JSON file of results by the hash of their configuration, in the order in which they were entered. A
result holds what every month came to in place of episodes: who has the agent can play the months again and compare,
bit for bit, and who has two results of the same months can compare the agents. What anyone can check without the agent
is an entry of a leaderboard, :mod:`rl2grid.records.entries`. What the order says of each result is in
:mod:`rl2grid.records.looks`.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from rl2grid.arrays import F64
from rl2grid.records.evaluations import Evaluation, identity_hash
from rl2grid.records.files import CHECKSUM, checksum, misfit, not_what, read_json, write_json
from rl2grid.records.locks import locked
from rl2grid.records.month_values import pack_months, unpack_months
from rl2grid.records.trainings import chosen_of_labels, chosen_of_start

_REMEDY = "give a file that 'rl2grid leaderboard test' wrote, or one that does not exist yet"
_TEST = {
    "configuration": {"task": str},
    "training": dict,
    "identity_hash": str,
    "episodes_hash": str,
    "test": {"episodes": int, "survival": float},
    "months": dict,
}
STARTED_FROM = "started_from"
"""In a configuration: algorithm, decisions and hash of the policy that a training began with."""
LABELS = "labels"
"""In a configuration: teacher, rounds, months of each round and hashes of the labels that it learned from."""
_FIGURES = ("survival", "completed", "cost_lsi", "cost_tlo", "safe_lsi", "safe_tlo", "decisions")


@dataclass(frozen=True)
class HashedTest:
    """A frozen configuration and what its test gave, with hashes in place of the episodes.

    No :class:`rl2grid.records.entries.PlayableEntry`, which says why.
    """

    configuration: Mapping[str, Any]
    """Task, algorithm, hyperparameters and keywords of the environment, or agent, task and heuristic; which months."""
    training: Mapping[str, Any]
    """How it came to be: command, decisions, minutes, hash of the policy; empty without training."""
    identity_hash: str
    """Of the evaluation."""
    episodes_hash: str
    """Of what must be equal wherever the episodes are played."""
    test: Mapping[str, Any]
    """Number of episodes and each figure, rounded; intervals follow from :attr:`values` and are in no file."""
    months: Mapping[str, Any]
    """Which months: split, its version, that of the generator, number of months and of seeds."""
    values: Mapping[str, str]
    """What every month came to, see :mod:`rl2grid.records.month_values`."""
    last: Mapping[str, str]
    """The same of the run's last policy; empty where that is the best one, or nothing was trained."""
    checksum: str = field(default="", compare=False)
    """Of all else; empty where it was left out because a change is meant."""

    @property
    def task(self) -> str:
        """Id of the task."""
        return str(self.configuration["task"])

    @property
    def heuristic(self) -> str | None:
        """``"idle"``, ``"recovery"``, ``"careful"``, ``"secure"`` or None."""
        keywords = self.configuration.get("env_keywords", self.configuration)
        chosen: str | None = keywords["heuristic"]
        return chosen

    @property
    def agent(self) -> str:
        """See :func:`agent_of`."""
        return agent_of(self.configuration)

    @property
    def rules(self) -> int:
        """Version of the rules of an agent without training."""
        return int(self.configuration.get("rules", 1))

    @property
    def heuristic_rules(self) -> int:
        """Version of the rules of the heuristic beside an agent without training."""
        return int(self.configuration.get("heuristic_rules", 1))

    @property
    def policy(self) -> str:
        """The agent, and what is not as usual: network, features, reward."""
        network = self.configuration.get("hyperparameters", {}).get("network", "mlp")
        keywords = self.configuration.get("env_keywords", {})
        features, reward = keywords.get("operator_features"), keywords.get("reward", "default")
        observing = "" if features is None else f", observing {features}"
        paid = "" if reward == "default" else f", reward {_reward_text(reward)}"
        with_network = "" if network == "mlp" else f", {network}"
        return f"{self.agent}{with_network}{observing}{paid}"

    @property
    def player(self) -> str:
        """See :attr:`policy`, and how it looks before it acts."""
        return f"{self.policy}{looking_of(self.configuration)}"

    @property
    def label(self) -> str:
        """Player and heuristic."""
        return f"{self.player} + {self.heuristic}" if self.heuristic else self.player

    @property
    def has_learned(self) -> bool:
        """Whether a policy was played; of those of the package, the ledger tells no training."""
        return bool(self.training) or "policy_hash" in self.configuration

    @functools.cached_property
    def by_month(self) -> dict[str, F64]:
        """See :func:`~rl2grid.records.month_values.unpack_months`: of the best policy, or of the agent."""
        return unpack_months(self.values, int(self.months["seeds"]))

    @functools.cached_property
    def last_by_month(self) -> dict[str, F64]:
        """The same of the last policy."""
        return unpack_months(self.last, int(self.months["seeds"])) if self.last else self.by_month

    @functools.cached_property
    def choice(self) -> str:
        """See :func:`choice_hash`."""
        return choice_hash(self.configuration)


def agent_of(configuration: Mapping[str, Any]) -> str:
    """The agent without training, or the algorithm; of one that began with another's policy, both."""
    began = configuration.get(STARTED_FROM)
    name = str(configuration.get("algorithm") or configuration["agent"])
    return name if began is None else f"{name} from {began['algorithm']}"


def _reward_text(reward: str | Sequence[float]) -> str:
    """A preset's name, or weights as they are typed."""
    return reward if isinstance(reward, str) else ",".join(f"{weight:g}" for weight in reward)


def looking_of(configuration: Mapping[str, Any]) -> str:
    """How a policy looks before it acts, as it follows its name; empty where it does not."""
    top_k, rehearse = configuration.get("top_k"), configuration.get("rehearse")
    best = "" if top_k is None else f", best of {top_k}"
    return best if rehearse is None else f"{best}, rehearsing {rehearse} steps"


def choice_hash(configuration: Mapping[str, Any]) -> str:
    """Hash of what was chosen: a configuration without its seed, which repeats a training and chooses nothing.

    So do a policy that it began with, if that is another one of the same algorithm and budget, and labels of as many
    other months by the same teacher.
    """
    chosen = dict(configuration)
    chosen["hyperparameters"] = _without(configuration.get("hyperparameters", {}), "seed")
    if STARTED_FROM in configuration:
        chosen[STARTED_FROM] = chosen_of_start(configuration[STARTED_FROM])
    if LABELS in configuration:
        chosen[LABELS] = chosen_of_labels(configuration[LABELS])
    return identity_hash(chosen)


def _without(values: Mapping[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in values.items() if key != name}


def hashed_test(
    configuration: Mapping[str, Any],
    training: Mapping[str, Any],
    evaluation: Evaluation,
    last: Evaluation | None = None,
) -> HashedTest:
    """What the ledger keeps of an evaluation.

    Args:
        configuration: frozen.
        training: how the policy came to be; empty without training.
        evaluation: of the best policy by validation, or of the agent.
        last: of the last policy on the same months; None: it is the best one.
    """
    rows = [[row.scenario, row.seed, row.grid_steps, row.decisions, row.episode_return] for row in evaluation.episodes]
    summary, identity = evaluation.summary, evaluation.identity
    figures = {name: round(getattr(summary, name).value, 4) for name in _FIGURES}
    made = HashedTest(
        configuration=dict(configuration),
        training=dict(training),
        identity_hash=identity_hash(identity),
        episodes_hash=identity_hash({"rows": rows}),
        test={"episodes": summary.episodes, **figures},
        months={
            "split": identity["split"],
            "split_version": identity.get("split_version"),
            "generator_version": identity.get("generator_version"),
            "number": summary.scenarios,
            "seeds": summary.seeds,
        },
        values=pack_months(evaluation.episodes),
        last={} if last is None else pack_months(last.episodes),
    )
    return replace(made, checksum=_checksum(made))


def read_ledger(path: Path) -> dict[str, HashedTest]:
    """Results by the hash of their configuration, in the order in which they were entered; none without a file.

    Raises:
        UsageError: the file is no ledger.
    """
    if not path.exists():
        return {}
    stored = read_json(path, "a ledger of test results", _REMEDY, dict)
    return {digest: _read_test(path, digest, result) for digest, result in stored.items()}


def _read_test(path: Path, digest: str, stored: Any) -> HashedTest:
    complaint = misfit(stored, _TEST, digest)
    if complaint:
        raise not_what(path, "a ledger of test results", complaint, _REMEDY)
    try:
        result = HashedTest(**stored)
    except TypeError as error:
        raise not_what(path, "a ledger of test results", f"{digest} has other entries ({error})", _REMEDY) from None
    if digest != identity_hash(result.configuration) or result.checksum not in ("", _checksum(result)):
        raise not_what(path, "a ledger of test results", f"the result {digest} was changed", _REMEDY)
    return result


def _checksum(result: HashedTest) -> str:
    return checksum(_stored(replace(result, checksum="")))


def _stored(result: HashedTest) -> dict[str, Any]:
    """A result as it stands in a ledger."""
    entries = {entry.name: getattr(result, entry.name) for entry in fields(result)}
    if not result.checksum:
        del entries[CHECKSUM]
    return entries


def add_test(path: Path, result: HashedTest) -> None:
    """Add a result to a ledger, or replace that of its configuration; processes that do so at once lose nothing."""
    with locked(path.parent, f".{path.name}.lock", wait=True):
        results = {**read_ledger(path), identity_hash(result.configuration): result}
        write_json(path, {digest: _stored(one) for digest, one in results.items()}, indent=1)
