"""What every algorithm asks of its environments: that they can be learned, what they report of a transition, metrics of
what was played, and their way back to a checkpoint.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict, Discrete
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, VectorEnv
from numpy.typing import NDArray

from rl2grid.errors import UsageError
from rl2grid.mdp.constraint_table import CONSTRAINTS


def check_environments(algorithm: str, envs: VectorEnv[Any, Any, Any], *, num_envs: int, mask_actions: bool) -> bool:
    """Whether actions are continuous, once it is clear that the environments can be learned.

    Args:
        algorithm: What messages call the algorithm.
        envs: The environments.
        num_envs: How many there must be.
        mask_actions: Whether the algorithm excludes illegal actions.

    Raises:
        UsageError: they cannot be learned like this.
    """
    if envs.num_envs != num_envs:
        raise UsageError(f"{algorithm} was to play {num_envs} environments, but was given {envs.num_envs}.")
    if envs.metadata.get("autoreset_mode") != AutoresetMode.SAME_STEP:
        raise UsageError(f"{algorithm} needs a vector environment with SAME_STEP autoreset.")
    space = envs.single_action_space
    if isinstance(space, Discrete):
        if mask_actions and not hasattr(envs, "action_masks"):
            raise UsageError("The environment offers no action_masks(): set mask_actions to False.")
        return False
    if isinstance(space, Dict):
        raise UsageError(
            f"{algorithm} plays Discrete and Box actions, not the Dict of a joint task: wrap the environments in "
            "VectorJointAsBox or VectorJointAsDiscrete of rl2grid.envs.joint."
        )
    if not isinstance(space, Box):
        raise UsageError(f"{algorithm} plays Discrete and Box actions, not {type(space).__name__}.")
    if mask_actions:
        raise UsageError("Only discrete actions can be masked: set mask_actions to False for this task.")
    if not (np.all(space.low == -1.0) and np.all(space.high == 1.0)):
        raise UsageError(f"{algorithm} plays continuous actions in Box(-1, 1), which this environment does not have.")
    return True


def check_discount(algorithm: str, envs: VectorEnv[Any, Any, Any], gamma: float) -> None:
    """Rewards of transitions must be discounted as what follows them.

    Raises:
        UsageError: an environment that discounts the grid steps of its transitions does so by another factor.
    """
    for options in _options_of(envs):
        theirs = getattr(options, "gamma", None)
        if theirs is not None and theirs != gamma:
            raise UsageError(
                f"The environments discount the steps of a transition by gamma={theirs}, {algorithm} learns with "
                f"gamma={gamma}: give both the same."
            )


def _options_of(envs: VectorEnv[Any, Any, Any]) -> list[Any]:
    """Options of our environments, of a vector of ours or of several in one of Gymnasium's; none of others."""
    vector: Any = envs.unwrapped
    if isinstance(vector, AsyncVectorEnv):
        # Asking a process for what its environment has not would end all of them.
        return list(vector.get_attr("options")) if all(vector.call("has_wrapper_attr", "options")) else []
    played = [vector, *(env.unwrapped for env in getattr(vector, "envs", ()))]
    return [each.options for each in played if hasattr(each, "options")]


def reported(infos: Mapping[str, Any], key: str, missing: NDArray[Any]) -> NDArray[Any]:
    """An array of ``infos``, with the values of ``missing`` where an environment reported none."""
    if key not in infos:
        return missing
    return np.where(infos.get(f"_{key}", True), infos[key], missing)


def of_transition(infos: Mapping[str, Any], key: str, ended: NDArray[np.bool_], missing: NDArray[Any]) -> NDArray[Any]:
    """What ``infos`` tell about the transitions just played [num_envs].

    Where an episode ended, ``infos`` already describe the next one; its last transition is in ``final_info``.
    """
    last = reported(infos.get("final_info", {}), key, missing)
    return np.where(ended, last, reported(infos, key, missing))


_OF_EPISODES: dict[str, tuple[str, ...]] = {
    "charts/survival": ("survival",),
    "charts/score_margin": ("scores", "margin"),
    "charts/score_overload": ("scores", "overload"),
    "charts/score_topology": ("scores", "topology"),
    **{f"charts/{constraint.column}": ("episode_costs", name) for name, constraint in CONSTRAINTS.items()},
}
"""Metrics of an episode that ended, and where its last ``info`` tells them."""


def _entry(info: Mapping[str, Any], path: tuple[str, ...]) -> Any:
    """What ``info`` holds under nested keys; None where an environment does not report it."""
    for key in path:
        if key not in info:
            return None
        info = info[key]
    return info


class Tally:
    """What happened during an iteration, for the metrics."""

    def __init__(self) -> None:
        self._began = time.perf_counter()
        self._environment_seconds = 0.0
        self._decisions = self._grid_steps = self._ineffective = 0
        self._episodes: dict[str, list[NDArray[Any]]] = {}

    def note(
        self,
        n_steps: NDArray[np.int64],
        seconds: float,
        infos: Mapping[str, Any],
        ended: NDArray[np.bool_],
        episode_returns: NDArray[np.float64],
        episode_lengths: NDArray[np.int64],
    ) -> None:
        """Count one decision per environment; the last two are of the episodes so far."""
        self._decisions += len(n_steps)
        self._grid_steps += int(n_steps.sum())
        self._environment_seconds += seconds
        nowhere = np.zeros_like(ended)
        illegal = of_transition(infos, "illegal", ended, nowhere)
        ambiguous = of_transition(infos, "ambiguous", ended, nowhere)
        self._ineffective += int((illegal | ambiguous).sum())
        if not ended.any():
            return
        self._episodes.setdefault("charts/episodic_return", []).append(episode_returns[ended])
        self._episodes.setdefault("charts/episodic_length", []).append(episode_lengths[ended])
        final = infos.get("final_info", {})
        for metric, path in _OF_EPISODES.items():
            values = _entry(final, path)
            if values is not None:
                self._episodes.setdefault(metric, []).append(np.asarray(values)[ended])

    def metrics(self) -> dict[str, float]:
        """Means over decisions and over the episodes that ended (none of the latter if none did)."""
        episodes = {name: np.concatenate(values).astype(np.float64) for name, values in self._episodes.items()}
        return {
            **{name: float(values.mean()) for name, values in episodes.items()},
            "charts/episodes": float(len(episodes.get("charts/episodic_return", ()))),
            "charts/n_steps_per_decision": self._grid_steps / self._decisions,
            "charts/ineffective_actions": self._ineffective / self._decisions,
            "charts/environment_share": self._environment_seconds / (time.perf_counter() - self._began),
        }


def resume_environments(envs: VectorEnv[Any, Any, Any], state: Any, expected: NDArray[np.float32]) -> None:
    """Bring environments back to ``state``, where they show the observations ``expected``.

    Raises:
        UsageError: the state is of other environments, or these are not where those were.
    """
    observations, _ = envs.load_state_dict(state)  # type: ignore[attr-defined]
    if not np.array_equal(observations, expected):
        raise UsageError(
            "The environments do not come back to the observations of the checkpoint: it can only be resumed with "
            "the data and the library versions that it was made with."
        )
