"""Sums over the transition in progress and over the episode.

A transition is one step of the agent and all steps of the heuristic to the next decision. The order of calls is

1. ``begin_episode`` at a reset, before the heuristic plays to the first decision;
2. ``accrue`` after every grid step, whoever played it;
3. ``end_reset`` at the end of a reset: what accrued before the first decision is put aside, since no action of the
   agent had a part in it;
4. ``begin_transition`` before the agent's step of every decision.

The sums of the reset and of all transitions of an episode add up to those of all its steps.
"""

from __future__ import annotations

from rl2grid.compile import jit
from rl2grid.mdp.constraints import step_costs, update_excused
from rl2grid.mdp.operation import accrue_operation
from rl2grid.mdp.operator_features import note_attacks
from rl2grid.mdp.scores import margin_score, overload_score, topology_score
from rl2grid.mdp.state import (
    COST,
    MARGIN_SCORE,
    OVERLOAD,
    OVERLOAD_SCORE,
    SURVIVE,
    TOPOLOGY_SCORE,
    GridState,
)


@jit
def begin_episode(state: GridState, i: int) -> None:
    """Zero all sums of row ``i``, and its number of decisions. Flags, ``excused`` included, are the engine's."""
    begin_transition(state, i)
    end_reset(state, i)  # of which nothing was played yet
    state.episode_return[i] = 0.0
    state.episode_components[i] = 0.0
    state.episode_costs[i] = 0.0
    state.episode_scores[i] = 0.0
    state.episode_operation[i] = 0.0
    state.curtailed[i] = 0.0
    state.decisions[i] = 0


@jit
def begin_transition(state: GridState, i: int) -> None:
    """Zero the sums of the transition of row ``i``; see the module for when to call it."""
    state.n_steps[i] = 0
    state.transition_reward[i] = 0.0
    state.transition_discounted[i] = 0.0
    state.transition_discount[i] = 1.0
    state.transition_components[i] = 0.0
    state.transition_costs[i] = 0.0


@jit
def end_reset(state: GridState, i: int) -> None:
    """Put the sums of row ``i`` aside as those of its reset, and zero those of the transition."""
    state.reset_steps[i] = state.n_steps[i]
    state.reset_reward[i] = state.transition_reward[i]
    state.reset_components[i] = state.transition_components[i]
    state.reset_costs[i] = state.transition_costs[i]
    begin_transition(state, i)


@jit
def accrue(
    state: GridState,
    i: int,
    survive: float,
    overload: float,
    cost: float,
    weights: tuple[float, float, float],
    gamma: float,
) -> None:
    """Add the grid step that row ``i`` has just made to the sums of its transition and its episode.

    Args:
        state: the state after the step; which lines are excused is updated first.
        i: the row.
        survive: first component of the step's reward.
        overload: second component.
        cost: third component.
        weights: of the three components in the reward.
        gamma: discount from one grid step of a transition to the next.
    """
    reward = weights[SURVIVE] * survive + weights[OVERLOAD] * overload + weights[COST] * cost
    state.transition_reward[i] += reward
    state.transition_discounted[i] += state.transition_discount[i] * reward
    state.transition_discount[i] *= gamma
    state.episode_return[i] += reward
    state.n_steps[i] += 1
    _add(state.transition_components[i], state.episode_components[i], SURVIVE, survive)
    _add(state.transition_components[i], state.episode_components[i], OVERLOAD, overload)
    _add(state.transition_components[i], state.episode_components[i], COST, cost)
    update_excused(state, i)
    note_attacks(state, i)
    costs = step_costs(state, i)
    for column in range(len(costs)):
        _add(state.transition_costs[i], state.episode_costs[i], column, costs[column])
    state.episode_scores[i, MARGIN_SCORE] += margin_score(state, i)
    state.episode_scores[i, OVERLOAD_SCORE] += overload_score(state, i)
    state.episode_scores[i, TOPOLOGY_SCORE] += topology_score(state, i)
    accrue_operation(state, i)


@jit
def _add(transition, episode, column, value) -> None:  # type: ignore[no-untyped-def]
    transition[column] += value
    episode[column] += value
