"""Tasks whose best policies and values are known, for algorithms to find."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

Observation = np.ndarray[Any, np.dtype[np.float32]]


class Chain(gymnasium.Env[Observation, int]):
    """Five states in a row, left and right; behind the last one are a reward of 1 and the end. Given up after 15 steps,
    which ends nothing: the value of a state does not depend on the time.
    """

    observation_space = gymnasium.spaces.Box(0.0, 1.0, (5,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._state, self._steps = int(self.np_random.integers(5)), 0
        return np.eye(5, dtype=np.float32)[self._state], {}

    def step(self, action: int) -> Any:
        self._state += 1 if action == 1 else -1
        self._steps += 1
        self._state = max(self._state, 0)
        done = self._state == 5
        observation = np.eye(5, dtype=np.float32)[min(self._state, 4)]
        return observation, float(done), done, self._steps >= 15 and not done, {}


class Follow(gymnasium.Env[Observation, Observation]):
    """One step: the action that repeats the number shown is the best."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._shown = self.np_random.uniform(-0.8, 0.8, 1).astype(np.float32)
        return self._shown, {}

    def step(self, action: Observation) -> Any:
        return self._shown, -float(np.square(action - self._shown)[0]), True, False, {}


class Arms(gymnasium.Env[Observation, int]):
    """One step: three arms that pay 0, 0.5 and 1."""

    observation_space = gymnasium.spaces.Box(0.0, 1.0, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(3)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.ones(1, np.float32), {}

    def step(self, action: int) -> Any:
        return np.ones(1, np.float32), 0.5 * int(action), True, False, {}


def vector(make: Callable[[], gymnasium.Env[Any, Any]], num_envs: int) -> Any:
    """Several of them, with the autoreset of ours."""
    return SyncVectorEnv([make] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
