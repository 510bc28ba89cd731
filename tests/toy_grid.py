"""Small stand-ins for the environments, which play by the same rules and take microseconds."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from rl2grid.envs.tasks import Task, find_task

N_ACTIONS = 3
EPISODE_LENGTH = 25
"""Grid steps after which an episode is completed."""
_PUSH = (0.0, -0.4, 0.4)


class Row:
    """One environment: a point drifts, actions push it, it is lost beyond +-1.

    A pure function of (seed, episode number, actions), strict about its actions, with transitions of
    several grid steps, as a heuristic makes them, and episodes that end inside ``reset``.
    """

    def __init__(self, seed: int, *, gamma: float, continuous: bool) -> None:
        self.seed, self.gamma, self.continuous = seed, gamma, continuous
        self.number = -1
        self.begin()

    def begin(self) -> None:
        self.number += 1
        self.actions: list[Any] = []
        self.random = np.random.Generator(np.random.Philox(key=[self.seed, self.number]))
        self.position = float(self.random.uniform(-0.5, 0.5))
        self.drift = float(self.random.uniform(-0.15, 0.15))
        self.grid_step = 0
        self.terminated = self.truncated = False
        self.over = bool(self.random.uniform() < 0.1)
        if self.over:
            self.position, self.terminated = 2.0, True

    def mask(self) -> NDArray[np.bool_]:
        return np.array([True, self.position > -0.5, self.position < 0.5])

    def play(self, action: Any) -> tuple[float, float, int]:
        """Reward, discounted reward and number of grid steps of a transition."""
        self.actions.append(action)
        if self.over:
            self.over = False
            return 0.0, 0.0, 1
        push = self._push(action)
        rewards = []
        for _ in range(int(self.random.integers(1, 5))):
            self.position += self.drift + push + float(self.random.normal(0.0, 0.05))
            push = 0.0
            self.grid_step += 1
            self.terminated = abs(self.position) > 1.0
            self.truncated = not self.terminated and self.grid_step >= EPISODE_LENGTH
            rewards.append(0.0 if self.terminated else 1.0 - abs(self.position))
            if self.terminated or self.truncated:
                break
        return sum(rewards), sum(reward * self.gamma**k for k, reward in enumerate(rewards)), len(rewards)

    def observation(self) -> NDArray[np.float32]:
        return np.array([self.position, self.drift, self.grid_step / EPISODE_LENGTH, 1.0], np.float32)

    def _push(self, action: Any) -> float:
        if not self.continuous:
            assert self.mask()[action], f"action {action} is illegal at {self.position}"
            return _PUSH[action]
        values = np.asarray(action)
        assert values.shape == (2,), f"an action of shape {values.shape}"
        assert np.all(np.abs(values) <= 1.0), f"an action out of bounds: {values}"
        return float(0.4 * values.mean())


class ToyGrid(gymnasium.vector.VectorEnv[NDArray[np.float32], Any, NDArray[Any]]):
    """A vector of toy grids with the interface of ``PowerGridVectorEnv``."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, num_envs: int, *, gamma: float | None = 0.9, continuous: bool = False) -> None:
        self.num_envs, self.gamma, self.continuous = num_envs, gamma, continuous
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float32)
        self.single_action_space: gymnasium.Space[Any] = gymnasium.spaces.Discrete(N_ACTIONS)
        if continuous:
            self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.rows: list[Row] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        assert seed is not None
        self.rows = [self._row(seed + i) for i in range(self.num_envs)]
        return self._observations(), self._infos([self._info(row) for row in self.rows])

    def step(self, actions: Any) -> Any:
        rewards, ended = np.zeros(self.num_envs), []
        infos = []
        for i, (row, action) in enumerate(zip(self.rows, actions, strict=True)):
            rewards[i], discounted, n_steps = row.play(action.tolist())
            ended.append((row.terminated, row.truncated))
            info = {**self._info(row, discounted, n_steps), "illegal": False, "ambiguous": n_steps == 4}
            if row.terminated or row.truncated:
                final = row.observation()
                row.begin()
                info = {**self._info(row), "final_obs": final, "final_info": info}
            infos.append(info)
        terminated, truncated = np.array(ended).T
        return self._observations(), rewards, terminated, truncated, self._infos(infos)

    def action_masks(self) -> NDArray[np.bool_]:
        return np.stack([row.mask() for row in self.rows])

    def state_dict(self) -> dict[str, Any]:
        return {"rows": [{"seed": r.seed, "number": r.number, "actions": list(r.actions)} for r in self.rows]}

    def load_state_dict(self, state: dict[str, Any]) -> Any:
        self.rows = []
        for saved in state["rows"]:
            row = self._row(saved["seed"])
            row.number = saved["number"] - 1
            row.begin()
            for action in saved["actions"]:
                row.play(action)
            self.rows.append(row)
        return self._observations(), self._infos([self._info(row) for row in self.rows])

    def _row(self, seed: int) -> Row:
        return Row(seed, gamma=self.gamma or 1.0, continuous=self.continuous)

    def _observations(self) -> NDArray[np.float32]:
        return np.stack([row.observation() for row in self.rows])

    def _info(self, row: Row, discounted: float = 0.0, n_steps: int = 0) -> dict[str, Any]:
        info = {"n_steps": n_steps, "over": row.over, "survival": row.grid_step / EPISODE_LENGTH}
        return info if self.gamma is None else {**info, "discounted_reward": discounted}

    def _infos(self, infos: list[dict[str, Any]]) -> dict[str, Any]:
        batched: dict[str, Any] = {}
        for i, info in enumerate(infos):
            self._add_info(batched, info, i)
        return batched


class SingleToyGrid(gymnasium.Env[NDArray[np.float32], Any]):
    """One toy grid with the interface of ``PowerGridEnv``, as agents see it."""

    def __init__(self, task: str = "rl2grid/bus14-T0-v0", *, normalize: str | None = "physical") -> None:
        self.task: Task = find_task(task)
        self.options = SimpleNamespace(normalize=normalize, operator_features=None)
        vector = ToyGrid(1, continuous=self.task.kind == "R")
        self.observation_space = vector.single_observation_space
        self.action_space = vector.single_action_space
        self._row = Row(0, gamma=0.9, continuous=vector.continuous)

    def action_masks(self) -> NDArray[np.bool_]:
        return self._row.mask()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self._row.begin()
        return self._row.observation(), {}

    def step(self, action: Any) -> Any:
        reward, _, _ = self._row.play(action)
        return self._row.observation(), reward, self._row.terminated, self._row.truncated, {}
