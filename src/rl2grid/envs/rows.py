"""Rows of a vector environment, stepped together in one process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.envs.player import TaskPlayer
from rl2grid.envs.tasks import TaskOptions, find_task
from rl2grid.mdp.features import observation_size


@dataclass
class Batch:
    """What a step or reset of several rows returns, row by row."""

    observations: NDArray[np.float32]
    """float32 [row, feature]."""
    infos: list[dict[str, Any]]
    rewards: NDArray[np.float64]
    """float64 [row]; zero after a reset."""
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class Rows:
    """Some rows of a vector environment; an ended episode makes way for the next in the same step."""

    def __init__(self, task_id: str, options: TaskOptions, n: int) -> None:
        task = find_task(task_id)
        self._player = TaskPlayer(task, options, n)
        self._n = n
        self._size = observation_size(task.grid, task.kind)
        self._n_actions = task.n_actions

    def reset(self, seeds: list[int | None], options: dict[str, Any] | None) -> Batch:
        """Begin an episode in every row."""
        for i, seed in enumerate(seeds):
            self._player.reset(i, seed, options)
        return self._batch()

    def step(self, actions: list[Any]) -> Batch:
        """Step every row (``AutoresetMode.SAME_STEP``): ``final_obs`` and ``final_info`` hold the ending."""
        player = self._player
        rewards = np.zeros(self._n)
        terminated, truncated = np.zeros(self._n, np.bool_), np.zeros(self._n, np.bool_)
        endings: dict[int, dict[str, Any]] = {}
        for i, action in enumerate(actions):
            player.step(i, action)
            rewards[i] = player.reward(i)
            terminated[i], truncated[i] = player.state.terminated[i], player.state.truncated[i]
            if player.is_over(i):
                endings[i] = {"final_obs": self._observation(i), "final_info": player.info(i)}
                player.reset(i, None, None)
        batch = self._batch()
        batch.rewards, batch.terminated, batch.truncated = rewards, terminated, truncated
        for i, ending in endings.items():
            batch.infos[i] |= ending
        return batch

    def action_masks(self) -> NDArray[np.bool_]:
        """Legal actions, bool [row, action]."""
        masks = np.zeros((self._n, self._n_actions), np.bool_)
        for i in range(self._n):
            self._player.write_action_mask(i, masks[i])
        return masks

    def state_dict(self) -> list[dict[str, Any]]:
        """See :meth:`rl2grid.envs.vector.PowerGridVectorEnv.state_dict`."""
        return self._player.state_dict()

    def load_state_dict(self, rows: list[dict[str, Any]]) -> Batch:
        """Bring every row to where it was."""
        self._player.load_state_dict(rows)
        return self._batch()

    def close(self) -> None:
        """Free the simulators."""
        self._player.close()

    def _batch(self) -> Batch:
        observations = np.stack([self._observation(i) for i in range(self._n)])
        infos = [self._player.info(i) for i in range(self._n)]
        off = np.zeros(self._n, np.bool_)
        return Batch(observations, infos, np.zeros(self._n), off, off.copy())

    def _observation(self, i: int) -> NDArray[np.float32]:
        observation = np.zeros(self._size, np.float32)
        self._player.write_observation(i, observation)
        return observation
