"""The state that both engines fill and that features, rewards, costs and heuristics read.

One :class:`GridState` holds many environments: dynamic arrays have the environment as first axis,
constants of the grid have none. Compiled functions take ``(state, i)`` and read row ``i``.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from rl2grid.arrays import F32, F64, I32, Flags
from rl2grid.grids import Grid
from rl2grid.grids.axes import axis_sizes
from rl2grid.mdp.constraint_table import CONSTRAINTS
from rl2grid.structures import Role, allocate, constant, fields_of, row

SURVIVE, OVERLOAD, COST = 0, 1, 2
"""Columns of the reward components."""
MARGIN_SCORE, OVERLOAD_SCORE, TOPOLOGY_SCORE = 0, 1, 2
"""Columns of the scores of the paper's Section 5."""
(
    LOSSES_COST,
    REDISPATCH_COST,
    CURTAILMENT_COST,
    STORAGE_COST,
    STORAGE_ENERGY,
    RENEWABLE_USED,
    RENEWABLE_AVAILABLE,
) = range(7)
"""Columns of what operation costs, see :mod:`rl2grid.mdp.operation`: four costs, then three energies in MWh."""


class GridState(NamedTuple):
    """Structure of arrays: ``n`` environments of one grid.

    Names and meanings are Grid2Op's where Grid2Op has the attribute. What is observed is blank after a game over.
    """

    # Constants of the grid.
    thermal_limit: Annotated[F32, constant("line", "largest current", "A")]
    gen_pmin: Annotated[F32, constant("gen", "lowest production", "MW")]
    gen_pmax: Annotated[F32, constant("gen", "highest production", "MW")]
    gen_max_ramp_up: Annotated[F32, constant("gen", "largest increase", "MW per step")]
    gen_max_ramp_down: Annotated[F32, constant("gen", "largest decrease", "MW per step")]
    gen_redispatchable: Annotated[Flags, constant("gen", "may be dispatched")]
    gen_renewable: Annotated[Flags, constant("gen", "may be curtailed")]
    gen_cost_per_mw: Annotated[F32, constant("gen", "price", "cost per MWh")]
    line_or_to_subid: Annotated[I32, constant("line", "substation of the origin")]
    line_ex_to_subid: Annotated[I32, constant("line", "substation of the extremity")]
    line_or_pos_topo_vect: Annotated[I32, constant("line", "entry of the origin in topo_vect")]
    line_ex_pos_topo_vect: Annotated[I32, constant("line", "entry of the extremity in topo_vect")]
    gen_pos_topo_vect: Annotated[I32, constant("gen", "entry in topo_vect")]
    load_pos_topo_vect: Annotated[I32, constant("load", "entry in topo_vect")]
    storage_pos_topo_vect: Annotated[I32, constant("storage", "entry in topo_vect")]
    element_to_subid: Annotated[I32, constant("topo", "substation of each element")]
    sub_first_element: Annotated[I32, constant("sub", "entry of its first element in topo_vect")]
    sub_info: Annotated[I32, constant("sub", "number of its elements")]
    slack_gen: Annotated[I32, constant("1", "generator that balances the flow")]
    sub_area: Annotated[I32, constant("sub", "area within which changes are limited; a line is of its origin's")]
    max_changes: Annotated[I32, constant("2", "lines and substations of an area that one action may change")]
    reconnection: Annotated[I32, constant("1", "cooldown of a line that a protection opened", "steps")]

    # What Grid2Op observes after a step (its observation's attributes).
    gen_p: Annotated[F32, row("gen", "production", "MW", blank=0)]
    gen_theta: Annotated[F32, row("gen", "voltage angle", "degrees", blank=0)]
    load_p: Annotated[F32, row("load", "demand", "MW", blank=0)]
    load_theta: Annotated[F32, row("load", "voltage angle", "degrees", blank=0)]
    p_or: Annotated[F32, row("line", "power at the origin", "MW", blank=0)]
    a_or: Annotated[F32, row("line", "current at the origin", "A", blank=0)]
    rho: Annotated[F32, row("line", "a_or / thermal_limit", blank=0)]
    line_status: Annotated[Flags, row("line", "in service", blank=0)]
    topo_vect: Annotated[I32, row("topo", "busbar of each element, -1 when disconnected", blank=-1)]
    timestep_overflow: Annotated[I32, row("line", "overloaded so far", "steps", blank=0)]
    time_before_cooldown_line: Annotated[I32, row("line", "before it may be switched", "steps", blank=0)]
    time_before_cooldown_sub: Annotated[I32, row("sub", "before it may be changed", "steps", blank=0)]
    time_next_maintenance: Annotated[I32, row("line", "0 during, -1 when none is planned", "steps", blank=-1)]
    duration_next_maintenance: Annotated[I32, row("line", "of the next maintenance", "steps", blank=0)]
    target_dispatch: Annotated[F32, row("gen", "dispatch asked for", "MW", blank=0)]
    actual_dispatch: Annotated[F32, row("gen", "dispatch carried out", "MW", blank=0)]
    gen_margin_up: Annotated[F32, row("gen", "possible increase", "MW", blank=0)]
    gen_margin_down: Annotated[F32, row("gen", "possible decrease", "MW", blank=0)]
    gen_p_before_curtail: Annotated[F32, row("gen", "production without curtailment", "MW", blank=0)]
    curtailment: Annotated[F32, row("gen", "share of pmax curtailed", blank=0)]
    curtailment_limit: Annotated[F32, row("gen", "share of pmax allowed", blank=1)]
    storage_charge: Annotated[F32, row("storage", "energy stored", "MWh", blank=0)]
    storage_power_target: Annotated[F32, row("storage", "asked for, positive charges", "MW", blank=0)]
    storage_power: Annotated[F32, row("storage", "positive charges", "MW", blank=0)]
    storage_theta: Annotated[F32, row("storage", "voltage angle", "degrees", blank=0)]

    # The episode.
    step: Annotated[I32, row("", "played since the reset", "steps", grid2op="nb_time_step")]
    episode_length: Annotated[I32, row("", "of a completed episode, T", "steps")]
    terminated: Annotated[Flags, row("", "game over")]
    truncated: Annotated[Flags, row("", "the episode was completed")]
    game_over: Annotated[I32, row("", "the reason, an `rl2grid.mdp.termination.GameOver`")]
    illegal: Annotated[Flags, row("", "the last action broke a rule")]
    ambiguous: Annotated[Flags, row("", "the last action had no single meaning")]
    attacked: Annotated[Flags, row("line", "out by the opponent in this step")]
    excused: Annotated[Flags, row("line", "left out of TLO, see `rl2grid.mdp.constraints`")]
    final_topo_vect: Annotated[I32, row("topo", "the topology with which a game over happened")]

    # What heuristics and observations remember; see `rl2grid.mdp.heuristics` and `rl2grid.mdp.operator_features`.
    open_since: Annotated[I32, row("line", "step at which it was lost, -1 while in service")]
    split_since: Annotated[I32, row("sub", "step at which it was last split, -1 while all is on busbar 1")]
    attacked_at: Annotated[I32, row("line", "last step at which it was out by the opponent, -1 before the first")]

    # Sums over the transition in progress (one agent step and the heuristic steps behind it).
    n_steps: Annotated[I32, row("", "grid steps of the transition")]
    transition_reward: Annotated[F64, row("", "sum over the transition")]
    transition_discounted: Annotated[F64, row("", "sum of gamma^k times the reward of its step k")]
    transition_discount: Annotated[F64, row("", "gamma^n_steps, the factor of the next step")]
    transition_components: Annotated[F64, row("component", "SURVIVE, OVERLOAD, COST")]
    transition_costs: Annotated[F64, row("cost", ", ".join(CONSTRAINTS))]

    # Sums over what the heuristic played before the first decision.
    reset_steps: Annotated[I32, row("", "grid steps of the reset")]
    reset_reward: Annotated[F64, row("", "sum over the reset")]
    reset_components: Annotated[F64, row("component", "SURVIVE, OVERLOAD, COST")]
    reset_costs: Annotated[F64, row("cost", ", ".join(CONSTRAINTS))]

    # Sums over the episode.
    episode_return: Annotated[F64, row("", "sum of the rewards")]
    episode_components: Annotated[F64, row("component", "SURVIVE, OVERLOAD, COST")]
    episode_costs: Annotated[F64, row("cost", ", ".join(CONSTRAINTS))]
    episode_scores: Annotated[F64, row("score", "margin, overload, topology: sums over steps")]
    episode_operation: Annotated[F64, row("operation", "costs and energies, see `rl2grid.mdp.operation`")]
    curtailed: Annotated[F64, row("", "curtailed in the step before, as operation counts it", "MW")]
    decisions: Annotated[I32, row("", "agent actions")]


_OBSERVED = tuple(name for name, field in fields_of(GridState, Role.KEPT).items() if field.blank is not None)
OBSERVED = tuple(name for name in _OBSERVED if not name.startswith("storage_"))
"""Attributes of Grid2Op's observation, those of storage excepted."""
OBSERVED_STORAGE = tuple(name for name in _OBSERVED if name.startswith("storage_"))
"""Attributes of Grid2Op's observation on grids with storage."""


def new_state(grid: Grid, n: int) -> GridState:
    """A blank state for ``n`` environments of ``grid``; the constants are shared, not copied."""
    own = {
        "slack_gen": np.array([grid.slack_gen], np.int32),
        "max_changes": np.array([grid.rules.max_line_changes, grid.rules.max_sub_changes], np.int32),
        "reconnection": np.array([grid.rules.reconnection], np.int32),
    }
    shared = {name: getattr(grid, name) for name in fields_of(GridState, Role.CONSTANT) if name not in own}
    sizes = axis_sizes(grid) | {"component": 3, "cost": len(CONSTRAINTS), "score": 3, "operation": 7}
    return allocate(GridState, sizes, n, **own, **shared)
