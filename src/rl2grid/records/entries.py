"""Entries of a leaderboard: the episodes of an evaluation with every action, so that anyone can play them again.

An entry is one JSON file; ``docs/leaderboard.md`` describes it. Actions are the agent's, one for each decision, as
little-endian numbers, compressed (zlib) and written in base64: ids in as few bytes as the task's number of actions
needs, continuous actions as float32, joint ones as float32 with the id before the continuous ones.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import UsageError
from rl2grid.records.episodes import FACTS, OPERATION, Episode, check_values
from rl2grid.records.evaluations import Evaluation, identity_hash, labels
from rl2grid.records.files import printable, read_json, write_record

FORMAT, VERSION = "rl2grid leaderboard entry", 1
_REMEDY = "give files that 'rl2grid leaderboard entry' wrote, or a ledger of test results as --ledger"
MAX_BYTES = 500_000_000
"""Of the unpacked actions of one episode: a file that claims more is no entry."""

Actions = NDArray[Any]
"""Unsigned integers [decision] on topology tasks, float32 [decision, continuous] on redispatching tasks; on joint tasks
float32 [decision, 1 + continuous], of which the first column is the id, exact below 2^24."""

_ALLOWED: dict[type, tuple[type, ...]] = {str: (str,), int: (int,), float: (int, float), bool: (bool,)}


@dataclass(frozen=True, eq=False)
class PlayedActions:
    """What happened in an episode, and the actions that made it happen."""

    episode: Episode
    """Without the labels of an evaluation."""
    actions: Actions

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"{self.episode.scenario}, seed {self.episode.seed}"


@dataclass(frozen=True, eq=False)
class PlayableEntry:
    """An evaluation with all its actions, which can be played again without its agent.

    A :class:`rl2grid.records.ledger.HashedTest` is another thing, and neither can be made of the other. An entry proves
    itself to those who have nothing else, and is as large as its actions are many; what its agent was is what the
    sender says. A hashed test is that of a frozen configuration, small enough for hundreds to stand in one file, and
    proves nothing without the agent.
    """

    label: str
    """What tables call the agent."""
    identity: Mapping[str, Any]
    """Of the evaluation; see :class:`~rl2grid.records.evaluations.Evaluation`."""
    command: str
    """What made the evaluation."""
    training: Mapping[str, Any] | None
    """Facts of the training run; None for agents without one."""
    episodes: tuple[PlayedActions, ...]

    @functools.cached_property
    def evaluation(self) -> Evaluation:
        """The evaluation, as tables take it; the time that episodes took is unknown, 0."""
        words = {**labels(self.identity), "agent": self.label}
        episodes = tuple(replace(one.episode, wall_time_s=0.0, **words) for one in self.episodes)
        return Evaluation(episodes, self.identity, self.command)


def facts_of(episode: Episode) -> dict[str, Any]:
    """The facts of an episode, by the names of :data:`~rl2grid.records.episodes.FACTS`.

    Behind them what operation cost, where that is known.
    """
    columns = (*FACTS, *OPERATION) if episode.knows_operation else FACTS
    return {column.name: getattr(episode, column.name) for column in columns}


def episode_hash(facts: Mapping[str, Any], foresight: int = 0) -> str:
    """Short hash of what happened in an episode, to the last bit of every number.

    The sums and means over its grid steps are among the facts, so that any difference on the way shows. Foresight
    counts where there is some.
    """
    values = [float(facts[name]) if kind is float else facts[name] for name, kind, *_ in FACTS]
    values += [float(facts[column.name]) for column in OPERATION if column.name in facts]
    if foresight:
        values.append(foresight)
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()[:16]


def write_entry(path: Path, entry: PlayableEntry) -> None:
    """Write an entry, whole or not at all."""
    contents = {
        "format": FORMAT,
        "version": VERSION,
        "label": entry.label,
        "identity": dict(entry.identity),
        "identity_hash": identity_hash(entry.identity),
        "command": entry.command,
        "training": entry.training,
        "episodes": [_stored(one) for one in entry.episodes],
    }
    write_record(path, contents, indent=1)


def read_entry(path: Path) -> PlayableEntry:
    """Read an entry and check that it agrees with itself.

    Raises:
        UsageError: the file is no entry, one of another version, or was changed.
    """
    contents = read_json(path, "an entry of a leaderboard", _REMEDY)
    if not isinstance(contents, dict) or contents.get("format") != FORMAT:
        raise UsageError(f"{path} is no entry of a leaderboard: {_REMEDY}.")
    if contents.get("version") != VERSION:
        raise UsageError(
            f"{path} is an entry of version {contents.get('version')!r}: this rl2grid reads version {VERSION}."
        )
    try:
        return _parse(path, contents)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, MemoryError, zlib.error) as error:
        if isinstance(error, UsageError):
            raise
        raise UsageError(f"{path} is a damaged entry of a leaderboard: {error!r}.") from None


def action_dtype(n_actions: int) -> np.dtype[Any]:
    """The smallest unsigned integers that hold the ids of ``n_actions`` topology actions."""
    return np.min_scalar_type(n_actions - 1).newbyteorder("<")


def _parse(path: Path, contents: Mapping[str, Any]) -> PlayableEntry:
    identity = dict(contents["identity"])
    if identity_hash(identity) != contents["identity_hash"]:
        raise UsageError(f"{path} was changed: its identity does not have the hash {contents['identity_hash']!r}.")
    if not isinstance(identity["versions"], dict):
        raise ValueError(f"versions are {identity['versions']!r}")
    episodes = tuple(_episode(path, stored) for stored in contents["episodes"])
    if not episodes:
        raise UsageError(f"{path} is an entry without episodes.")
    keys = {(one.episode.scenario, one.episode.seed, one.episode.start) for one in episodes}
    if len(keys) != len(episodes):
        raise UsageError(f"{path} was changed: it has an episode twice.")
    entry = PlayableEntry(
        printable(str(contents["label"])), identity, str(contents["command"]), contents["training"], episodes
    )
    _ = entry.evaluation.summary  # refuses what is no table of scenarios and seeds
    return entry


def _stored(played: PlayedActions) -> dict[str, Any]:
    facts, foresight = facts_of(played.episode), played.episode.foresight
    known = {"foresight": foresight} if foresight else {}
    return {**facts, **known, "hash": episode_hash(facts, foresight), **_packed(played.actions)}


def _episode(path: Path, stored: Mapping[str, Any]) -> PlayedActions:
    columns = (*FACTS, *(column for column in OPERATION if OPERATION[0].name in stored))
    facts = {column.name: stored[column.name] for column in columns}
    for column in columns:
        value, allowed = facts[column.name], _ALLOWED[column.type]
        if not isinstance(value, allowed) or (isinstance(value, bool) and bool not in allowed):
            raise UsageError(f"{path} is a damaged entry of a leaderboard: {column.name} is {value!r}.")
    try:
        check_values(facts)
    except ValueError as error:
        raise UsageError(f"{path} is a damaged entry of a leaderboard: {error}.") from None
    foresight = stored.get("foresight", 0)
    if type(foresight) is not int or foresight < 0:
        raise UsageError(f"{path} is a damaged entry of a leaderboard: foresight is {foresight!r}.")
    played = PlayedActions(Episode(**facts, wall_time_s=0.0, foresight=foresight), _unpacked(stored))
    if episode_hash(facts, foresight) != stored["hash"]:
        raise UsageError(f"{path} was changed: the episode {played.name} does not have the hash {stored['hash']!r}.")
    if len(played.actions) != played.episode.decisions:
        raise UsageError(
            f"{path} was changed: the episode {played.name} has {played.episode.decisions} decisions and "
            f"{len(played.actions)} actions."
        )
    return played


def _packed(actions: Actions) -> dict[str, Any]:
    packed = base64.b64encode(zlib.compress(np.ascontiguousarray(actions).tobytes(), 9)).decode()
    return {"dtype": actions.dtype.str, "shape": list(actions.shape), "actions": packed}


def _unpacked(stored: Mapping[str, Any]) -> Actions:
    dtype, shape = np.dtype(str(stored["dtype"])), tuple(int(size) for size in stored["shape"])
    if dtype.kind not in "uf" or len(shape) not in (1, 2) or min(shape) < 0:
        raise ValueError(f"actions of {dtype} with shape {shape}")
    n_bytes = dtype.itemsize * int(np.prod(shape, dtype=np.float64))
    if n_bytes > MAX_BYTES:
        raise ValueError(f"actions of {n_bytes} bytes")
    unpacking = zlib.decompressobj()
    unpacked = unpacking.decompress(base64.b64decode(stored["actions"], validate=True), n_bytes + 1)
    if len(unpacked) != n_bytes or not unpacking.eof:
        raise ValueError(f"not {n_bytes} bytes of actions")
    return np.frombuffer(unpacked, dtype).reshape(shape)
