"""N-1 security as an additional component of the reward."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import UsageError


class SecurityReward(gymnasium.Wrapper[NDArray[np.float32], Any, NDArray[np.float32], Any]):
    """Adds ``weight`` times the N-1 score to every reward, and both to ``info``.

    The score is the share of the lines in service whose loss would leave neither an overload nor a collapse, in the
    state at the next decision (``info["n_minus_1"]``); 0 when the game is over. ``info["reward_components"]`` gets
    ``"security"``, the weighted score.

    Raises:
        UsageError: ``weight`` is no finite number, or the environment plays the reference engine.
    """

    def __init__(self, env: gymnasium.Env[NDArray[np.float32], Any], weight: float = 1.0) -> None:
        super().__init__(env)
        if not isinstance(weight, int | float) or not math.isfinite(weight):
            raise UsageError(f"weight={weight!r} is not allowed: give a finite number.")
        base: Any = env.unwrapped
        if base.options.engine != "native":
            raise UsageError('The N-1 score is computed by the native engine only: choose engine="native".')
        self._base = base
        self._weight = float(weight)

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Step the environment, and score where it leads."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        score = 0.0 if terminated or truncated or info["over"] else self._base.n_minus_1_score()
        security = self._weight * score
        info["n_minus_1"] = score
        info["reward_components"] = {**info["reward_components"], "security": security}
        return observation, float(reward) + security, terminated, truncated, info
