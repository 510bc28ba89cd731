"""An evaluation as it is stored: episodes, what they are results of, and the command that made them."""

from __future__ import annotations

import functools
import hashlib
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import NoneType
from typing import Any

from rl2grid.envs.options import OBSERVED_WITH
from rl2grid.errors import UsageError
from rl2grid.records.episodes import EPISODES_FILE, Episode, read_episodes
from rl2grid.records.files import checksum, read_json, write_record
from rl2grid.records.statistics import Estimate
from rl2grid.records.summary import Summary, summarise
from rl2grid.records.versions import processor

EVALUATION_FILE = "evaluation.json"
_ROWS_HASH = "episodes_sha256"
_DESCRIPTION = {
    "identity": {"task": str, "agent": str, "heuristic": (str, NoneType), "split": str},
    "command": str,
    "jobs": list,
    "complete": bool,
    "summary": (dict, NoneType),
}
_OF_THE_END = ("complete", "summary", _ROWS_HASH, "processor")
"""What a description says besides the request."""


@dataclass(frozen=True)
class Evaluation:
    """All episodes of one agent on one task."""

    episodes: tuple[Episode, ...]
    """In the order of scenarios, then seeds."""
    identity: Mapping[str, Any]
    """Everything that defines the result: task, engine, data, actions, agent, versions."""
    command: str
    """What to type to obtain it again."""
    folder: Path | None = None
    """Where it is stored; None: nowhere."""
    processor: str | None = None
    """Kind of the processor on which it was finished; None: not stored."""

    @functools.cached_property
    def summary(self) -> Summary:
        """Aggregates of the episodes."""
        return summarise(self.episodes)

    @property
    def foresight(self) -> bool:
        """Whether the agent knew in some episode what no operator knows: the true future."""
        return any(episode.foresight for episode in self.episodes)


def identity_hash(identity: Mapping[str, Any]) -> str:
    """Short hash of an identity, whatever the order of its entries."""
    return checksum(identity)


def labels(identity: Mapping[str, Any]) -> dict[str, Any]:
    """What an evaluation with this identity decides of its episodes: :data:`~rl2grid.records.episodes.LABELS`."""
    agent = identity["agent_identity"]
    return {
        "task": identity["task"],
        "agent": identity["agent"],
        "heuristic": identity["heuristic"] or "none",
        "split": identity["split"],
        "engine": identity["engine"],
        "scenario_pack_hash": identity["scenario_pack_hash"],
        "action_set_hash": identity["action_set_hash"] or "",
        "agent_hash": identity_hash(agent) if agent else "",
        "identity": identity_hash(identity),
    }


def write_evaluation(path: Path, request: Mapping[str, Any], summary: Summary | None) -> None:
    """Write the description of an evaluation; once it is complete, with its aggregates and the hash of its rows."""
    record = {**request, "complete": summary is not None, "summary": None}
    if summary is not None:
        record["summary"] = {name: _plain(value) for name, value in vars(summary).items()}
        rows = path.with_name(EPISODES_FILE)
        record[_ROWS_HASH] = _file_hash(rows) if rows.is_file() else None
        record["processor"] = processor()
    write_record(path, record)


def _file_hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _plain(value: Any) -> Any:
    """A figure as JSON has it, which knows no NaN: an interval that there is not has no ends."""
    if not isinstance(value, Estimate):
        return value
    return {name: None if math.isnan(number) else number for name, number in asdict(value).items()}


@dataclass(frozen=True)
class Description:
    """What :func:`write_evaluation` wrote."""

    request: Mapping[str, Any]
    """``identity``, ``identity_hash``, ``jobs`` and ``command``."""
    complete: bool
    rows_hash: str | None
    """SHA-256 of the file of its rows; None: not stored."""
    processor: str | None
    """See :class:`Evaluation`."""


def read_description(folder: Path) -> Description:
    """The description of the evaluation in a folder.

    Raises:
        UsageError: there is none, or it was changed.
    """
    path, remedy = folder / EVALUATION_FILE, "give a folder as 'rl2grid evaluate' wrote it"
    record: dict[str, Any] = read_json(path, "a description of an evaluation", remedy, _DESCRIPTION)
    stated = record.get("identity_hash")
    if stated not in (None, identity_hash(record["identity"])):
        raise UsageError(f"{path} was changed: its identity does not have the hash {stated!r}; {remedy}.")
    request = {name: value for name, value in record.items() if name not in _OF_THE_END}
    return Description(request, record["complete"], record.get(_ROWS_HASH), record.get("processor"))


def is_evaluation(folder: Path) -> bool:
    """Whether a folder holds an evaluation, finished or not."""
    return (folder / EVALUATION_FILE).is_file()


def load_evaluation(folder: Path) -> Evaluation:
    """A finished evaluation.

    Raises:
        UsageError: the folder holds none, or one that was interrupted.
    """
    if not is_evaluation(folder):
        raise UsageError(f"{folder} holds no evaluation: give a folder that 'rl2grid evaluate' wrote.")
    description = read_description(folder)
    request = description.request
    if not (folder / EPISODES_FILE).is_file():
        raise UsageError(f"The evaluation in {folder} is unfinished: continue it with {_continuing(request, folder)}.")
    episodes = read_finished(folder, description)
    return Evaluation(episodes, request["identity"], request["command"], folder, description.processor)


def read_finished(folder: Path, description: Description) -> tuple[Episode, ...]:
    """The rows of a finished evaluation.

    Raises:
        UsageError: they are not those that its description was written for.
    """
    path = folder / EPISODES_FILE
    episodes = read_episodes(path)
    if description.rows_hash not in (None, _file_hash(path)):
        raise UsageError(
            f"{path} was changed since it was written, or belongs to another evaluation: restore it, or remove the "
            "folder and evaluate again."
        )
    return episodes


def _continuing(request: Mapping[str, Any], folder: Path) -> str:
    """The stored command says what is played, not where it is stored."""
    command: str = request["command"]
    if command.startswith("rl2grid "):
        return f"{command} {shlex.join(('--output', str(folder)))}"
    return f"{command}, with output={str(folder)!r}"


def check_comparable(results: Sequence[Evaluation]) -> None:
    """Refuse results that do not belong into one table.

    Agents and heuristics may differ, the question asked of them may not.

    Raises:
        UsageError: no results, or results of different tasks, scenarios, engines or versions, or of agents that know
            the future and others.
    """
    if not results:
        raise UsageError("There are no results: give at least one evaluation.")
    check_same_question(results)
    first, *others = results
    for other in others:
        if first.foresight != other.foresight:
            knowing, unaware = (first, other) if first.foresight else (other, first)
            raise UsageError(
                f"Results with and without foresight do not belong into one table: {knowing.summary.agent} stepped "
                f"saved true worlds, which know the future, {unaware.summary.agent} did not."
            )


def check_same_question(results: Sequence[Evaluation]) -> None:
    """Refuse results of one task that did not answer the same question.

    Args:
        results: at least one.

    Raises:
        UsageError: results of different tasks, scenarios, engines or versions.
    """
    first, *others = results
    for other in others:
        for key in sorted({*first.identity, *other.identity} - _MAY_DIFFER):
            mine, theirs = first.identity.get(key), other.identity.get(key)
            if mine != theirs:
                raise UsageError(
                    f"Results of different {key} do not belong into one table: "
                    f"{first.summary.agent} has {mine!r}, {other.summary.agent} has {theirs!r}."
                )
        if _played(first) != _played(other):
            raise UsageError(
                f"Results of different scenarios or seeds do not belong into one table: {first.summary.agent} played "
                f"{len(first.episodes)} episodes, {other.summary.agent} {len(other.episodes)} others."
            )


_MAY_DIFFER = frozenset({"agent", "agent_identity", "heuristic", *OBSERVED_WITH})


def _played(result: Evaluation) -> set[tuple[str, int, int]]:
    return {(episode.scenario, episode.seed, episode.start) for episode in result.episodes}
