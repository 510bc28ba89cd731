"""The state that both engines fill and that features, rewards, costs and heuristics read.

One :class:`GridState` holds many environments: dynamic arrays have the environment as first axis,
constants of the grid have none. Compiled functions take ``(state, i)`` and read row ``i``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.grids import Grid

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
Flags = NDArray[np.bool_]

SURVIVE, OVERLOAD, COST = 0, 1, 2
"""Columns of the reward components."""
LSI, TLO = 0, 1
"""Columns of the costs."""
MARGIN_SCORE, OVERLOAD_SCORE, TOPOLOGY_SCORE = 0, 1, 2
"""Columns of the scores of the paper's Section 5."""


class GridState(NamedTuple):
    """Structure of arrays: ``n`` environments of one grid.

    Names and meanings are Grid2Op's where Grid2Op has the attribute. Shapes are given in brackets.
    """

    # Constants of the grid, no environment axis.
    thermal_limit: F32  # [line] A
    gen_pmin: F32  # [gen] MW
    gen_pmax: F32  # [gen] MW
    gen_max_ramp_up: F32  # [gen] MW per step
    gen_max_ramp_down: F32  # [gen] MW per step
    gen_redispatchable: Flags  # [gen]
    gen_renewable: Flags  # [gen]
    gen_cost_per_mw: F32  # [gen] cost per MWh
    line_or_to_subid: I32  # [line]
    line_ex_to_subid: I32  # [line]
    line_or_pos_topo_vect: I32  # [line]
    line_ex_pos_topo_vect: I32  # [line]
    gen_pos_topo_vect: I32  # [gen]
    load_pos_topo_vect: I32  # [load]
    storage_pos_topo_vect: I32  # [storage]
    element_to_subid: I32  # [topo]
    sub_first_element: I32  # [sub]
    sub_info: I32  # [sub]
    slack_gen: I32  # [1] generator that balances the flow

    # What Grid2Op observes after a step (its observation's attributes).
    gen_p: F32  # [n, gen] MW
    gen_theta: F32  # [n, gen] degrees
    load_p: F32  # [n, load] MW
    load_theta: F32  # [n, load] degrees
    p_or: F32  # [n, line] MW at the origin
    a_or: F32  # [n, line] A at the origin
    rho: F32  # [n, line] a_or / thermal_limit
    line_status: Flags  # [n, line]
    topo_vect: I32  # [n, topo] busbar of each element, -1 when disconnected
    timestep_overflow: I32  # [n, line] steps overloaded so far
    time_before_cooldown_line: I32  # [n, line] steps
    time_before_cooldown_sub: I32  # [n, sub] steps
    time_next_maintenance: I32  # [n, line] steps, 0 during, -1 when none is planned
    duration_next_maintenance: I32  # [n, line] steps
    target_dispatch: F32  # [n, gen] MW
    actual_dispatch: F32  # [n, gen] MW
    gen_margin_up: F32  # [n, gen] MW
    gen_margin_down: F32  # [n, gen] MW
    gen_p_before_curtail: F32  # [n, gen] MW
    curtailment: F32  # [n, gen] share of pmax curtailed
    curtailment_limit: F32  # [n, gen] share of pmax allowed
    storage_charge: F32  # [n, storage] MWh
    storage_power_target: F32  # [n, storage] MW, positive charges
    storage_power: F32  # [n, storage] MW, positive charges
    storage_theta: F32  # [n, storage] degrees

    # The episode.
    step: I32  # [n] steps played since the reset (Grid2Op's nb_time_step)
    episode_length: I32  # [n] steps of a completed episode, T
    terminated: Flags  # [n] game over
    truncated: Flags  # [n] the episode was completed
    game_over: I32  # [n] rl2grid.mdp.termination.GameOver
    illegal: Flags  # [n] the last action broke a rule
    ambiguous: Flags  # [n] the last action had no single meaning
    attacked: Flags  # [n, line] out by the opponent in this step
    excused: Flags  # [n, line] left out of TLO: see rl2grid.mdp.constraints
    final_topo_vect: I32  # [n, topo] the topology with which a game over happened

    # Sums over the transition in progress (one agent step and the heuristic steps behind it).
    n_steps: I32  # [n] grid steps
    transition_reward: F64  # [n]
    transition_discounted: F64  # [n] sum of gamma^k times the reward of step k
    transition_discount: F64  # [n] gamma^n_steps, the factor of the next step
    transition_components: F64  # [n, 3]
    transition_costs: F64  # [n, 2] LSI, TLO

    # Sums over the episode.
    episode_return: F64  # [n]
    episode_components: F64  # [n, 3]
    episode_costs: F64  # [n, 2]
    episode_scores: F64  # [n, 3] margin, overload, topology: sums over steps
    decisions: I32  # [n] agent actions


_ELEMENT_AXES = {
    "gen_p": "gen",
    "gen_theta": "gen",
    "load_p": "load",
    "load_theta": "load",
    "p_or": "line",
    "a_or": "line",
    "rho": "line",
    "line_status": "line",
    "topo_vect": "topo",
    "timestep_overflow": "line",
    "time_before_cooldown_line": "line",
    "time_before_cooldown_sub": "sub",
    "time_next_maintenance": "line",
    "duration_next_maintenance": "line",
    "target_dispatch": "gen",
    "actual_dispatch": "gen",
    "gen_margin_up": "gen",
    "gen_margin_down": "gen",
    "gen_p_before_curtail": "gen",
    "curtailment": "gen",
    "curtailment_limit": "gen",
    "storage_charge": "storage",
    "storage_power_target": "storage",
    "storage_power": "storage",
    "storage_theta": "storage",
    "attacked": "line",
    "excused": "line",
    "final_topo_vect": "topo",
    "transition_components": "component",
    "transition_costs": "cost",
    "episode_components": "component",
    "episode_costs": "cost",
    "episode_scores": "score",
}
_SCALARS = (
    "step",
    "episode_length",
    "terminated",
    "truncated",
    "game_over",
    "illegal",
    "ambiguous",
    "n_steps",
    "transition_reward",
    "transition_discounted",
    "transition_discount",
    "episode_return",
    "decisions",
)
_F64 = tuple(name for name in (*_ELEMENT_AXES, *_SCALARS) if name.startswith(("transition_", "episode_")))
_FLAGS = ("line_status", "terminated", "truncated", "illegal", "ambiguous", "attacked", "excused")
_FLOATS = (
    "gen_p",
    "gen_theta",
    "load_p",
    "load_theta",
    "p_or",
    "a_or",
    "rho",
    "target_dispatch",
    "actual_dispatch",
    "gen_margin_up",
    "gen_margin_down",
    "gen_p_before_curtail",
    "curtailment",
    "curtailment_limit",
    "storage_charge",
    "storage_power_target",
    "storage_power",
    "storage_theta",
)
_CONSTANTS = GridState._fields[: GridState._fields.index("gen_p")]
OBSERVED = GridState._fields[GridState._fields.index("gen_p") : GridState._fields.index("storage_charge")]
"""Attributes of Grid2Op's observation, those of storage excepted."""
OBSERVED_STORAGE = GridState._fields[GridState._fields.index("storage_charge") : GridState._fields.index("step")]
"""Attributes of Grid2Op's observation on grids with storage."""


def new_state(grid: Grid, n: int) -> GridState:
    """A blank state for ``n`` environments of ``grid``; the constants are shared, not copied."""
    sizes = {
        "gen": grid.n_gen,
        "load": grid.n_load,
        "line": grid.n_line,
        "topo": grid.dim_topo,
        "sub": grid.n_sub,
        "storage": grid.n_storage,
        "component": 3,
        "cost": 2,
        "score": 3,
    }
    arrays: dict[str, NDArray[np.generic]] = {}
    for name in _CONSTANTS:
        arrays[name] = np.array([grid.slack_gen], np.int32) if name == "slack_gen" else getattr(grid, name)
    for name in (*_ELEMENT_AXES, *_SCALARS):
        shape = (n, sizes[_ELEMENT_AXES[name]]) if name in _ELEMENT_AXES else (n,)
        arrays[name] = np.zeros(shape, _dtype(name))
    return GridState(**arrays)  # type: ignore[arg-type]


def _dtype(name: str) -> type[np.generic]:
    if name in _FLAGS:
        return np.bool_
    if name in _FLOATS:
        return np.float32
    if name in _F64 and name != "episode_length":
        return np.float64
    return np.int32
