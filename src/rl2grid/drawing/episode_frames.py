"""What a picture of a moment of an episode shows and says."""

from __future__ import annotations

from datetime import datetime

import numpy as np

from rl2grid.drawing.grid_drawing import Caption, Scene, reference_scene
from rl2grid.grids import Grid
from rl2grid.mdp.state import GridState
from rl2grid.mdp.termination import GAME_OVER_TEXT, GameOver


def scene_of(grid: Grid, state: GridState, i: int) -> Scene:
    """Environment ``i`` as it is; after a game over, the topology with which it happened, without flows."""
    nothing = reference_scene(grid)
    lost = bool(state.terminated[i])
    return Scene(
        topo_vect=(state.final_topo_vect if lost else state.topo_vect)[i],
        rho=nothing.rho if lost else state.rho[i],
        attacked=state.attacked[i],
        maintained=state.time_next_maintenance[i] == 0,
        highlighted=nothing.highlighted,
        gen_p=nothing.gen_p if lost else state.gen_p[i],
        load_p=nothing.load_p if lost else state.load_p[i],
        storage_power=nothing.storage_power if lost else state.storage_power[i],
    )


def caption_of(grid: Grid, state: GridState, i: int, clock: datetime, action: str) -> Caption:
    """Time, worst loading and survival of environment ``i``, the agent's last ``action`` in words, and the ending."""
    step, length = int(state.step[i]), int(state.episode_length[i])
    reason = GameOver(int(state.game_over[i]))
    if reason:
        headline = f"{_time(clock)}   game over after {step - 1:,} of {length:,} steps ({(step - 1) / length:.1%})"
        return Caption(headline, f"{GAME_OVER_TEXT[reason]}; last action: {action or 'none'}")
    line = int(np.argmax(state.rho[i]))
    return describe_moment(
        clock, step, length, float(state.rho[i, line]), f"line {line}", f"last action: {action or 'none'}"
    )


def describe_moment(clock: datetime, step: int, length: int, loading: float, line: str, sentence: str) -> Caption:
    """The caption of a moment in which the grid is alive; ``loading`` is that of the most loaded ``line``."""
    return Caption(
        f"{_time(clock)}   worst loading {loading:.0%} ({line})   survived {step:,} of {length:,} steps"
        f" ({step / length:.1%})",
        sentence,
    )


def _time(clock: datetime) -> str:
    return f"{clock:%a %d %b %H:%M}"
