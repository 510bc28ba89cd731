"""What a task's environments take, show and say of themselves: spaces, checks of actions, words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Sized
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rl2grid.envs.options import TaskOptions
from rl2grid.envs.tasks import Task
from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.mdp.actions import (
    INJECTION,
    TOPOLOGY,
    ActionCatalogue,
    Ids,
    StepAction,
    describe,
    inject,
    joint,
    level_catalogue,
    level_ids,
    validate_continuous,
)
from rl2grid.mdp.features import feature_slices, observation_size


def step_action(task: Task, grid: Grid, catalogue: ActionCatalogue | None, action: Any) -> StepAction:
    """An action of a task as what an engine plays.

    Args:
        task: the task.
        grid: its grid; environments keep that with which they were made.
        catalogue: the topology actions of the task, if it has some.
        action: what an agent gave.

    Raises:
        UsageError: it has the wrong shape or value, and what is allowed.
    """
    if catalogue is None:
        return inject(validate_continuous(grid, action))
    if not task.injects:
        return catalogue[action_number(action, len(catalogue))]
    check_parts(task, action)
    change = catalogue[action_number(action[TOPOLOGY], len(catalogue))]
    return joint(change, inject(validate_continuous(grid, action[INJECTION])))


def task_catalogue(task: Task, grid: Grid) -> ActionCatalogue | None:
    """The topology actions of a task; None where there are none."""
    return level_catalogue(grid, task.level) if task.changes_topology else None


def action_number(action: Any, n_actions: int) -> int:
    """A discrete action as a Python integer.

    Raises:
        UsageError: it is not an integer in 0 .. n_actions - 1.
    """
    array = np.asarray(action)
    if array.shape != () or not np.issubdtype(array.dtype, np.integer) or not 0 <= int(array) < n_actions:
        raise UsageError(f"Action {action!r} does not exist: give an integer from 0 to {n_actions - 1}.")
    return int(array)


def action_numbers(actions: Sequence[Any], n_actions: int) -> Ids:
    """Discrete actions as int32 [action].

    Raises:
        UsageError: one of them is not an integer in 0 .. n_actions - 1.
    """
    if isinstance(actions, np.ndarray) and actions.ndim == 1 and actions.dtype.kind in "iu":
        if ((actions >= 0) & (actions < n_actions)).all():
            return actions.astype(np.int32)
    elif all(type(action) is int and 0 <= action < n_actions for action in actions):
        return np.array(actions, np.int32)  # as a policy's best come: no array is asked
    return np.array([action_number(action, n_actions) for action in actions], np.int32)


def check_parts(task: Task, action: Any) -> None:
    """Refuse what is not the two parts of a joint task's action, whatever they hold.

    Raises:
        UsageError: a part is missing, or there is another one.
    """
    if not _has_parts(action):
        raise UsageError(
            f"Action {action!r:.80} is none of {task.id}, whose actions are joint: give a dict with {TOPOLOGY!r}, an "
            f"integer from 0 to {task.n_topology_actions - 1}, and {INJECTION!r}, {task.n_injections} numbers from -1 "
            "to 1."
        )


def _has_parts(action: Any) -> bool:
    return isinstance(action, Mapping) and set(action) == {TOPOLOGY, INJECTION}


def check_number(task: Task, actions: Any, n: int) -> None:
    """Refuse actions of a vector that are not one for each of ``n`` environments.

    Raises:
        UsageError: there are more or fewer of them, or of a part of theirs.
    """
    if task.kind == "H" and not _has_parts(actions):
        raise UsageError(
            f"Actions {actions!r:.80} are none of a vector of {task.id}, whose actions are joint: give one dict with "
            f"{TOPOLOGY!r}, {n} integers from 0 to {task.n_topology_actions - 1}, and {INJECTION!r}, numbers of shape "
            f"({n}, {task.n_injections}) from -1 to 1."
        )
    for part in (actions[TOPOLOGY], actions[INJECTION]) if task.kind == "H" else (actions,):
        given = len(part) if isinstance(part, Sized) and np.iterable(part) else 1
        if given != n:
            raise UsageError(f"{given} actions were given for {n} environments: give one each.")


def one_by_one(task: Task, actions: Any) -> Iterable[Any]:
    """The actions of a vector, :func:`check_number` having passed them, one for each environment."""
    if task.kind != "H":
        return actions  # type: ignore[no-any-return]
    pairs = zip(actions[TOPOLOGY], actions[INJECTION], strict=True)
    return [{TOPOLOGY: topology, INJECTION: injection} for topology, injection in pairs]


def single_spaces(
    task: Task, operator_features: str | None = None
) -> tuple[gymnasium.spaces.Box, gymnasium.Space[Any]]:
    """Observation and action space of one environment; ``operator_features``: the keyword of ``gymnasium.make``."""
    size = observation_size(task.grid, task.kind, operator_features)
    observations = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
    parts: dict[str, gymnasium.Space[Any]] = {}
    if task.changes_topology:
        parts[TOPOLOGY] = gymnasium.spaces.Discrete(task.n_topology_actions)
    if task.injects:
        parts[INJECTION] = gymnasium.spaces.Box(-1.0, 1.0, (task.n_injections,), np.float32)
    if len(parts) == 1:
        (space,) = parts.values()
        return observations, space
    # Pairs keep their order; of a dict, Gymnasium sorts the keys.
    return observations, gymnasium.spaces.Dict(list(parts.items()))


class TaskDescription:
    """What the single and the vector environment say about their task."""

    task: Task
    options: TaskOptions

    @property
    def grid(self) -> Grid:
        """The task's grid."""
        return self.task.grid

    @property
    def observation_slices(self) -> dict[str, slice]:
        """Where each feature lies in an observation."""
        return feature_slices(self.task.grid, self.task.kind, self.options.operator_features)

    @property
    def action_catalogue_ids(self) -> NDArray[np.int32]:
        """For each topology action its id in the grid's full catalogue, int32 [action].

        Raises:
            UsageError: the task has none.
        """
        if not self.task.changes_topology:
            raise UsageError(f"{self.task.id} has continuous actions: only topology actions have a catalogue.")
        return level_ids(self.task.grid, self.task.level)

    def describe_action(self, action: Any) -> str:
        """The action in words.

        Raises:
            UsageError: the action does not exist.
        """
        task, grid = self.task, self.task.grid
        return describe(grid, step_action(task, grid, task_catalogue(task, grid), action))
