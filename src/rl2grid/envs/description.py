"""What a task's environments take, show and say of themselves: spaces, checks of actions, words."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rl2grid.envs.tasks import Task
from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.mdp.actions import describe, inject, level_catalogue, level_ids, validate_continuous
from rl2grid.mdp.features import feature_slices, observation_size


def check_action(task: Task, action: Any) -> None:
    """Refuse an action of the wrong shape or value.

    Raises:
        UsageError: what is wrong with it and what is allowed.
    """
    if task.kind == "T":
        action_number(action, task.n_actions)
    else:
        validate_continuous(task.grid, action)


def action_number(action: Any, n_actions: int) -> int:
    """A discrete action as a Python integer.

    Raises:
        UsageError: it is not an integer in 0 .. n_actions - 1.
    """
    array = np.asarray(action)
    if array.shape != () or not np.issubdtype(array.dtype, np.integer) or not 0 <= int(array) < n_actions:
        raise UsageError(f"Action {action!r} does not exist: give an integer from 0 to {n_actions - 1}.")
    return int(array)


def single_spaces(task: Task) -> tuple[gymnasium.spaces.Box, gymnasium.Space[Any]]:
    """Observation and action space of one environment."""
    size = observation_size(task.grid, task.kind)
    observations = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
    if task.kind == "T":
        return observations, gymnasium.spaces.Discrete(task.n_actions)
    return observations, gymnasium.spaces.Box(-1.0, 1.0, (task.n_actions,), np.float32)


class TaskDescription:
    """What the single and the vector environment say about their task."""

    task: Task

    @property
    def grid(self) -> Grid:
        """The task's grid."""
        return self.task.grid

    @property
    def observation_slices(self) -> dict[str, slice]:
        """Where each feature lies in an observation."""
        return feature_slices(self.task.grid, self.task.kind)

    @property
    def action_catalogue_ids(self) -> NDArray[np.int32]:
        """For each discrete action its id in the grid's full catalogue, int32 [action]."""
        if self.task.kind != "T":
            raise UsageError(f"{self.task.id} has continuous actions: only topology tasks have a catalogue.")
        return level_ids(self.task.grid, self.task.level)

    def describe_action(self, action: Any) -> str:
        """The action in words.

        Raises:
            UsageError: the action does not exist.
        """
        if self.task.kind == "T":
            catalogue = level_catalogue(self.task.grid, self.task.level)
            return describe(self.task.grid, catalogue[action_number(action, len(catalogue))])
        values = validate_continuous(self.task.grid, action)
        return describe(self.task.grid, inject(values))
