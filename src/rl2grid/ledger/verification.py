"""Verifying what a ledger holds: whoever plays again must find the same, bit for bit.

An entry of a leaderboard is played again from its stored actions, a test result of the ledger by its agent.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from rl2grid.agents.agent import Action, Info, Observation
from rl2grid.envs.tasks import Task, find_task
from rl2grid.errors import UsageError
from rl2grid.ledger.replay import (
    OnProgress,
    after,
    check_question,
    difference,
    environment,
    keywords_of,
    other_versions,
    play_again,
    scenarios_of,
)
from rl2grid.ledger.subjects import Subject, play_test
from rl2grid.mdp.actions import INJECTION, TOPOLOGY
from rl2grid.records.entries import Actions, PlayableEntry, PlayedActions
from rl2grid.records.ledger import HashedTest
from rl2grid.scenarios.library import check_in_split


def check_entry(entry: PlayableEntry, name: str) -> None:
    """Refuse an entry that cannot be played here, or that is about other data or actions.

    Args:
        entry: as it was read.
        name: what messages call it.

    Raises:
        UsageError: what is different.
    """
    task, keywords = find_task(entry.identity["task"]), keywords_of(entry.identity, name)
    scenarios = scenarios_of(entry.evaluation.episodes)
    for scenario in scenarios:
        try:
            check_in_split(task.grid_id, keywords["split"], scenario)
        except UsageError as error:
            raise UsageError(f"{name} cannot be played: {error}") from None
    check_question(task, keywords, entry.identity, scenarios, name)
    for episode in entry.episodes:
        _check_actions(episode, task, name)
        if episode.episode.start != entry.identity["start"]:
            raise UsageError(f"{name} was changed: episode {episode.name} begins at another row.")


def verify_entry(entry: PlayableEntry, on_progress: OnProgress = lambda played: None) -> str | None:
    """Play the stored actions again.

    Args:
        entry: one that :func:`check_entry` accepts.
        on_progress: told how far it is.

    Returns:
        Which episode differs, and how; None if all are exactly as stored.
    """
    task = find_task(entry.identity["task"])
    with environment(task, keywords_of(entry.identity, "")) as env:
        for number, stored in enumerate(entry.episodes):
            agent = _StoredActions(stored.actions, task.kind)
            try:
                again = play_again(agent, env, stored.episode, [], after(number, on_progress))
            except _NoMoreActionsError:
                return f"Episode {stored.name} goes on after its {len(stored.actions)} stored actions"
            except UsageError as error:
                return f"Episode {stored.name} cannot be played: {str(error).removesuffix('.')}"
            found = difference(stored.episode, again)
            if found:
                return f"Episode {stored.name} differs: {found}{other_versions(entry.identity)}"
    on_progress(len(entry.episodes))
    return None


def verify_test(stored: HashedTest, subject: Subject) -> str | None:
    """Play the test months again with the agent.

    Args:
        stored: of the ledger, of the configuration of ``subject``.
        subject: the run or agent.

    Returns:
        The names of what differs; None if policy and episodes are exactly those of the ledger.
    """
    again = play_test(subject)
    differing = [name for name in ("episodes_hash", "test", "last") if getattr(again, name) != getattr(stored, name)]
    if subject.training and subject.training["policy_hash"] != stored.training["policy_hash"]:
        differing.append("policy_hash")
    return ", ".join(differing) or None


class _NoMoreActionsError(Exception):
    """An episode asks for more actions than are stored."""


class _StoredActions:
    """Plays actions in the order in which they are stored."""

    name = "stored actions"

    def __init__(self, actions: Actions, kind: str) -> None:
        self._actions, self._kind = iter(actions), kind

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Nothing to look at."""

    def reset(self, i: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation, info: Info) -> Action:
        """The next action, whatever is observed."""
        action = next(self._actions, None)
        if action is None:
            raise _NoMoreActionsError
        if self._kind == "H":
            return {TOPOLOGY: int(action[0]), INJECTION: action[1:]}
        return int(action) if self._kind == "T" else action


def _check_actions(episode: PlayedActions, task: Task, name: str) -> None:
    actions = episode.actions
    if task.kind == "T":
        fits = actions.ndim == 1 and actions.dtype.kind == "u" and bool((actions < task.n_actions).all())
        allowed = f"ids of 0 to {task.n_actions - 1}"
    else:
        ids = int(task.kind == "H")
        fits = actions.shape[1:] == (ids + task.n_injections,) and actions.dtype == np.float32
        fits = fits and bool((np.abs(actions[:, ids:]) <= 1).all())
        fits = fits and bool(np.isin(actions[:, :ids], np.arange(task.n_topology_actions)).all())
        allowed = f"float32 of {task.n_injections} values between -1 and 1"
        allowed += f" behind an id of 0 to {task.n_topology_actions - 1}" if ids else ""
    if not fits:
        raise UsageError(f"{name} was changed: actions of the episode {episode.name} are not {allowed}.")
