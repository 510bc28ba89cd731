"""The course of one episode, grid step by grid step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Recording:
    """One episode of one environment. ``step`` counts the rows played, row 0 is what reset showed.

    The step of a game over has no flows and is not among the rows.
    """

    task: str
    agent: str
    heuristic: str
    scenario: str
    seed: int
    start: int
    began: str
    """Time of row 0 in the scenario, ISO 8601."""
    episode_length: int
    """Steps of a completed episode."""
    game_over: str
    """Why the episode ended, in words; empty when it was completed."""
    line_names: tuple[str, ...]
    decision_steps: tuple[int, ...]
    """Steps after which the agent was asked."""
    actions: tuple[str, ...]
    """What it did at each of them, in words; empty for do nothing."""
    rho: NDArray[np.float32]
    """[step, line] loading: current over thermal limit."""
    line_status: NDArray[np.bool_]
    """[step, line]"""
    attacked: NDArray[np.bool_]
    """[step, line] out by the opponent."""
    maintained: NDArray[np.bool_]
    """[step, line] out for planned maintenance."""
    topo_vect: NDArray[np.int8]
    """[step, topo] busbar of each element, -1 when disconnected."""
    gen_p: NDArray[np.float32]
    """[step, gen] MW."""
    load_p: NDArray[np.float32]
    """[step, load] MW."""
    storage_power: NDArray[np.float32]
    """[step, storage] MW, positive charges."""

    @property
    def n_steps(self) -> int:
        """Steps survived."""
        return len(self.rho) - 1
