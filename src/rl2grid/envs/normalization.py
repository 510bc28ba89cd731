"""Observations scaled by running statistics that all environments share."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from rl2grid.errors import UsageError

CLIP = 10.0
"""Normalised observations lie in [-CLIP, CLIP]: a feature that was constant for long may not explode when it moves."""

_EPSILON = 1e-8


class ObservationNormalizer:
    """The mean and variance of every feature over all observations seen, and the scaling by them.

    Statistics are exact (no prior, no forgetting), kept in float64 and updated by whole batches with the
    pairwise formula of Chan, Golub and LeVeque (1983), so that they depend on the batches alone.
    """

    def __init__(self, size: int) -> None:
        """``size``: the number of features of an observation."""
        self.count = 0
        self.mean = np.zeros(size, np.float64)
        self._squares = np.zeros(size, np.float64)
        self._frozen = False
        self._deviation: NDArray[np.float64] | None = None

    @property
    def frozen(self) -> bool:
        """Whether ``update`` leaves the statistics as they are."""
        return self._frozen

    @property
    def variance(self) -> NDArray[np.float64]:
        """Population variance of every feature [size]; 1 before the first observation."""
        return self._squares / self.count if self.count else np.ones_like(self._squares)

    @property
    def deviation(self) -> NDArray[np.float64]:
        """Standard deviation of every feature [size], as it is divided by: never 0."""
        if self._deviation is None:
            self._deviation = np.sqrt(self.variance + _EPSILON)
        return self._deviation

    def freeze(self) -> None:
        """Ignore all further updates; evaluation must not move what training learned to read."""
        self._frozen = True

    def update(self, observations: NDArray[Any]) -> None:
        """Take a batch of observations [batch, size] into the statistics."""
        if self._frozen or not len(observations):
            return
        batch = observations.astype(np.float64)
        count = len(batch)
        mean = batch.mean(axis=0)
        shift = mean - self.mean
        total = self.count + count
        self._squares += np.square(batch - mean).sum(axis=0) + np.square(shift) * (self.count * count / total)
        self.mean += shift * (count / total)
        self.count = total
        self._deviation = None

    def normalize(self, observations: NDArray[Any]) -> NDArray[np.float32]:
        """Observations [..., size] as multiples of the standard deviation around the mean, clipped, float32."""
        scaled = observations - self.mean
        scaled /= self.deviation
        np.maximum(scaled, -CLIP, out=scaled)
        np.minimum(scaled, CLIP, out=scaled)
        return scaled.astype(np.float32)

    def state_dict(self) -> dict[str, Any]:
        """The statistics, as arrays of their own."""
        return {"count": self.count, "mean": self.mean.copy(), "squares": self._squares.copy()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take over the statistics that ``state_dict`` returned.

        Raises:
            UsageError: they are of observations with another number of features.
        """
        mean, squares = np.array(state["mean"], np.float64), np.array(state["squares"], np.float64)
        if mean.shape != self.mean.shape or squares.shape != self.mean.shape:
            raise UsageError(
                f"Statistics of {mean.size} observed features were given where {self.mean.size} are observed: those "
                "of another version or of another task."
            )
        self.count, self.mean, self._squares = int(state["count"]), mean, squares
        self._deviation = None

    @property
    def normaliser_hash(self) -> str:
        """A short SHA-256 of the statistics: part of the identity of a result."""
        digest = hashlib.sha256(np.int64(self.count).tobytes())
        digest.update(self.mean.astype("<f8").tobytes())
        digest.update(self._squares.astype("<f8").tobytes())
        return digest.hexdigest()[:16]


class NormalizeObservation(VectorWrapper[Any, Any, Any, Any, Any]):
    """Normalises the observations of a vector environment by the statistics of all its environments.

    Every observation that the agent is shown (one per environment at ``reset`` and at ``step``) enters the
    statistics once, before it is scaled. ``infos["final_obs"]``, on which nobody acts, is scaled only.
    Made for SAME_STEP autoreset; observations are flat boxes.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        """Wrap ``env``, with empty statistics.

        Raises:
            UsageError: observations that are no vectors.
        """
        super().__init__(env)
        shape = env.single_observation_space.shape
        if shape is None or len(shape) != 1:
            raise UsageError(f"Only flat observations can be normalised, not observations of shape {shape}.")
        self.normalizer = ObservationNormalizer(shape[0])
        self.single_observation_space = gymnasium.spaces.Box(-CLIP, CLIP, shape, np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Reset all environments; the observations enter the statistics."""
        observations, infos = self.env.reset(seed=seed, options=options)
        return self._shown(observations), infos

    def step(
        self, actions: Any
    ) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Step all environments; the observations enter the statistics, last ones of episodes do not."""
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        normalized = self._shown(observations)
        if "final_obs" in infos:
            infos = {**infos, "final_obs": self._final(infos["final_obs"], infos["_final_obs"])}
        return normalized, rewards, terminations, truncations, infos

    def freeze(self) -> None:
        """Keep the statistics as they are from now on."""
        self.normalizer.freeze()

    @property
    def normaliser_hash(self) -> str:
        """A short SHA-256 of the statistics: part of the identity of a result."""
        return self.normalizer.normaliser_hash

    def action_masks(self) -> NDArray[np.bool_]:
        """The legal actions [num_envs, n_actions] of the wrapped environment."""
        masks: NDArray[np.bool_] = self._inner.action_masks()
        return masks

    def state_dict(self) -> dict[str, Any]:
        """The statistics and the state of the wrapped environment."""
        return {"normalizer": self.normalizer.state_dict(), "env": self._inner.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Restore what ``state_dict`` returned; observations and infos are those of then.

        The replay behind it touches no statistics, and the observations, which were counted then, are not again.
        """
        self.normalizer.load_state_dict(state["normalizer"])
        observations, infos = self._inner.load_state_dict(state["env"])
        return self.normalizer.normalize(observations), infos

    @property
    def _inner(self) -> Any:
        return self.env

    def _shown(self, observations: NDArray[Any]) -> NDArray[np.float32]:
        self.normalizer.update(observations)
        return self.normalizer.normalize(observations)

    def _final(self, final: NDArray[Any], present: NDArray[np.bool_]) -> NDArray[np.object_]:
        normalized = np.full(len(final), None, dtype=object)
        for i in np.flatnonzero(present):
            normalized[i] = self.normalizer.normalize(np.asarray(final[i]))
        return normalized
