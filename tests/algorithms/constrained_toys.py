"""Small environments with costs, whose best policies are known or whose rules are those of the grid."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from toy_grid import Row, ToyGrid

PAYS = np.array([1.0, 0.5])
"""What the risky action pays in the two states of a chain."""


class CostlyToyGrid(ToyGrid):
    """A toy grid with both costs: LSI of 2 at a game over, TLO of 1 per grid step that ends far from the middle."""

    def _info(self, row: Row, discounted: float = 0.0, n_steps: int = 0) -> dict[str, Any]:
        played = n_steps > 0
        costs = {
            "LSI": 2.0 * (played and row.terminated),
            "TLO": float(n_steps) * (played and not row.terminated and abs(row.position) > 0.3),
        }
        return {**super()._info(row, discounted, n_steps), "costs": costs}


class Chain(gymnasium.vector.VectorEnv[NDArray[np.float32], Any, NDArray[Any]]):
    """Two states, one after the other, and the episode is over; in both, the risky action 1 pays and costs 1.

    It pays 1 in the first state and 0.5 in the second. With at most d costs per episode, 1 < d < 2, the best
    policy always takes the risk in the first state and takes it with probability d - 1 in the second; a unit
    of cost is then worth 0.5 of reward. The costs of the two states are also told one by one.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self.single_observation_space = gymnasium.spaces.Box(0.0, 1.0, (2,), np.float32)
        self.single_action_space = gymnasium.spaces.Discrete(2)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self._state = np.arange(self.num_envs) % 2
        return self._observations(), {}

    def step(self, actions: Any) -> Any:
        everywhere = np.ones(self.num_envs, np.bool_)
        ended = self._state == 1
        rewards = PAYS[self._state] * actions
        risks = {"both": actions * 1.0, "first": actions * 1.0 * ~ended, "second": actions * 1.0 * ended}
        costs = {**risks, **{f"_{name}": everywhere for name in risks}}
        self._state = 1 - self._state
        infos = {"costs": costs, "_costs": everywhere, "final_info": {"costs": costs}, "_final_info": ended}
        return self._observations(), rewards, ended, np.zeros_like(ended), infos

    def _observations(self) -> NDArray[np.float32]:
        return np.eye(2, dtype=np.float32)[self._state]


class Lever(gymnasium.vector.VectorEnv[NDArray[np.float32], Any, NDArray[Any]]):
    """Episodes of one decision between -1 and 1: pays -(action - best)^2, costs the action where it is positive."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self.single_observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self._random = np.random.default_rng(seed)
        return self._next_observations(), {}

    def step(self, actions: Any) -> Any:
        assert np.abs(actions).max() <= 1.0
        rewards = -np.square(actions[:, 0] - self.best(self._observations[:, 0]))
        ended = np.ones(self.num_envs, np.bool_)
        costs = {"effort": np.maximum(actions[:, 0], 0.0).astype(float), "_effort": ended}
        infos = {"costs": costs, "_costs": ended, "final_info": {"costs": costs}, "_final_info": ended}
        return self._next_observations(), rewards, ended, np.zeros_like(ended), infos

    @staticmethod
    def best(observations: Any) -> Any:
        """The action that pays most."""
        return 0.2 + 0.5 * observations

    def _next_observations(self) -> NDArray[np.float32]:
        self._observations = self._random.uniform(-1.0, 1.0, (self.num_envs, 1)).astype(np.float32)
        return self._observations
