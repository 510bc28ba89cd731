"""The course of one episode, grid step by grid step."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import UsageError


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


_ARRAYS = ("rho", "line_status", "attacked", "maintained", "topo_vect", "gen_p", "load_p", "storage_power")
_WORDS = "description"


def save_recording(path: Path, recording: Recording) -> None:
    """Write a recording (NumPy's ``.npz``), whole or not at all."""
    values = {field.name: getattr(recording, field.name) for field in fields(recording)}
    arrays: dict[str, Any] = {name: values.pop(name) for name in _ARRAYS}
    arrays[_WORDS] = np.array(json.dumps(values))
    temporary = path.with_name(f"{path.name}.tmp")
    with temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)
    os.replace(temporary, path)


def load_recording(path: Path) -> Recording:
    """Read a recording.

    Raises:
        UsageError: the file is missing or no recording.
    """
    try:
        with np.load(path) as file:
            words = json.loads(str(file[_WORDS]))
            arrays = {name: file[name] for name in _ARRAYS}
    except (OSError, ValueError, KeyError) as error:
        raise UsageError(f"{path} is no recording of an episode: {error}.") from None
    for name, value in words.items():
        words[name] = tuple(value) if isinstance(value, list) else value
    return Recording(**words, **arrays)
