"""What every algorithm reads of its environments: what they report of a transition, metrics of what was played, and
their way back to a checkpoint.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from rl2grid.errors import UsageError


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


class Tally:
    """What happened during an iteration, for the metrics."""

    def __init__(self) -> None:
        self._began = time.perf_counter()
        self._environment_seconds = 0.0
        self._decisions = self._grid_steps = self._ineffective = 0
        self._episodes: dict[str, list[float]] = {}

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
        self._episodes.setdefault("charts/episodic_return", []).extend(episode_returns[ended].tolist())
        self._episodes.setdefault("charts/episodic_length", []).extend(episode_lengths[ended].tolist())
        survival = infos.get("final_info", {}).get("survival")
        if survival is not None:
            self._episodes.setdefault("charts/survival", []).extend(np.asarray(survival)[ended].tolist())

    def metrics(self) -> dict[str, float]:
        """Means over decisions and over the episodes that ended (none of the latter if none did)."""
        return {
            **{name: float(np.mean(values)) for name, values in self._episodes.items()},
            "charts/episodes": float(len(self._episodes.get("charts/episodic_return", ()))),
            "charts/n_steps_per_decision": self._grid_steps / self._decisions,
            "charts/ineffective_actions": self._ineffective / self._decisions,
            "charts/environment_share": self._environment_seconds / (time.perf_counter() - self._began),
        }


def resume_environments(envs: VectorEnv[Any, Any, Any], state: Any, expected: NDArray[np.float32]) -> None:
    """Bring environments back to ``state``, where they show the observations ``expected``.

    Raises:
        UsageError: the environments, played again, are not where they were.
    """
    observations, _ = envs.load_state_dict(state)  # type: ignore[attr-defined]
    if not np.array_equal(observations, expected):
        raise UsageError(
            "The environments do not come back to the observations of the checkpoint: it can only be resumed with "
            "the data and the library versions that it was made with."
        )
