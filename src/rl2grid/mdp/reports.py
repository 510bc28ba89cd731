"""Reports: the numbers that the ``info`` of many environments shows, in a few blocks of one column per environment.

A block holds the values of one type, a line each; compiled code fills it line by line for all environments at once.
What each value means is told by :data:`rl2grid.envs.info.INFO_KEYS`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rl2grid.arrays import F64, I64, Flags
from rl2grid.compile import jit
from rl2grid.mdp.constraint_table import CONSTRAINTS
from rl2grid.mdp.scores import SCORES
from rl2grid.mdp.state import GridState
from rl2grid.mdp.state_handles import open_state

START, START_REDRAWS, EARLIER_STEPS = range(3)
"""Lines of the episodes: the row of the scenario at which each began, rows drawn as start before, and grid steps of
earlier episodes of its stream."""
GRID_STEPS, STEP, EPISODE_LENGTH, DECISIONS, N_STEPS, RESET_STEPS, GAME_OVER = range(2, 9)
"""Lines of the counts, behind START and START_REDRAWS."""
ILLEGAL, AMBIGUOUS, OVER = range(3)
"""Lines of the flags."""
SURVIVAL, COST, RESET_REWARD, EPISODE_RETURN, DISCOUNTED_REWARD = range(5)
"""Lines of the numbers; the components, costs and scores lie behind them."""
_N_COMPONENTS, _N_COSTS = 3, len(CONSTRAINTS)
REWARD_COMPONENTS = DISCOUNTED_REWARD + 1
TRANSITION_COSTS = REWARD_COMPONENTS + _N_COMPONENTS
RESET_COMPONENTS = TRANSITION_COSTS + _N_COSTS
RESET_COSTS = RESET_COMPONENTS + _N_COMPONENTS
EPISODE_COMPONENTS = RESET_COSTS + _N_COSTS
EPISODE_COSTS = EPISODE_COMPONENTS + _N_COMPONENTS
EPISODE_SCORES = EPISODE_COSTS + _N_COSTS
_END = EPISODE_SCORES + len(SCORES)


class Report(NamedTuple):
    """Numbers of ``n`` environments."""

    numbers: F64
    """float64 [line, n]"""
    counts: I64
    """int64 [line, n]"""
    flags: Flags
    """bool [line, n]"""
    attacked: Flags
    """bool [n, power line]"""


def blank_report(n: int, n_line: int) -> Report:
    """A report of ``n`` environments of a grid with ``n_line`` power lines that tells nothing yet: 0 and False."""
    return Report(
        np.zeros((_END, n)),
        np.zeros((GAME_OVER + 1, n), np.int64),
        np.zeros((OVER + 1, n), np.bool_),
        np.zeros((n, n_line), np.bool_),
    )


@jit
def write_outcomes(address: int, rewards: F64, terminated: Flags, truncated: Flags) -> int:
    """Write what the last transition of every environment came to, [n] each; how many episodes have ended.

    Args:
        address: of a handle to the state of ``n`` environments.
        rewards: sums of the transitions' rewards.
        terminated: games over.
        truncated: completed episodes.
    """
    state, ended = open_state(address), 0
    for i in range(rewards.shape[0]):
        rewards[i] = state.transition_reward[i]
        terminated[i] = state.terminated[i]
        truncated[i] = state.truncated[i]
        ended += terminated[i] or truncated[i]
    return ended


@jit
def write_report(
    address: int,
    rows: I64,
    constraint: int,
    episodes: I64,
    over: Flags,
    numbers: F64,
    counts: I64,
    flags: Flags,
    attacked: Flags,
) -> None:
    """Report of the environments ``rows``; the columns of others stay.

    Args:
        address: of a handle to the state of ``n`` environments.
        rows: int64 [k].
        constraint: column of the cost that is COST; -1: all of them, added.
        episodes: which episodes are played, int64 [EARLIER_STEPS + 1, n].
        over: whose episode ended inside ``reset``, bool [n].
        numbers: a field of the :class:`Report`, as those that follow.
        counts: written too.
        flags: written too.
        attacked: written too.
    """
    state = open_state(address)
    for i in rows:
        counts[START, i] = episodes[START, i]
        counts[START_REDRAWS, i] = episodes[START_REDRAWS, i]
        counts[GRID_STEPS, i] = episodes[EARLIER_STEPS, i] + state.step[i]
        counts[STEP, i] = state.step[i]
        counts[EPISODE_LENGTH, i] = state.episode_length[i]
        counts[DECISIONS, i] = state.decisions[i]
        counts[N_STEPS, i] = state.n_steps[i]
        counts[RESET_STEPS, i] = state.reset_steps[i]
        counts[GAME_OVER, i] = state.game_over[i]
    for i in rows:
        flags[ILLEGAL, i] = state.illegal[i]
        flags[AMBIGUOUS, i] = state.ambiguous[i]
        flags[OVER, i] = over[i]
        attacked[i] = state.attacked[i]
    for i in rows:
        survived = max(state.step[i] - state.terminated[i], 0)  # the step of a game over was not survived
        numbers[SURVIVAL, i] = survived / state.episode_length[i]
        numbers[COST, i] = state.transition_costs[i, constraint] if constraint >= 0 else _sum_of_costs(state, i)
        numbers[RESET_REWARD, i] = state.reset_reward[i]
        numbers[EPISODE_RETURN, i] = state.episode_return[i]
        numbers[DISCOUNTED_REWARD, i] = state.transition_discounted[i]
    _write_lines(state.transition_components, rows, numbers, REWARD_COMPONENTS)
    _write_lines(state.transition_costs, rows, numbers, TRANSITION_COSTS)
    _write_lines(state.reset_components, rows, numbers, RESET_COMPONENTS)
    _write_lines(state.reset_costs, rows, numbers, RESET_COSTS)
    _write_lines(state.episode_components, rows, numbers, EPISODE_COMPONENTS)
    _write_lines(state.episode_costs, rows, numbers, EPISODE_COSTS)
    _write_lines(state.episode_scores, rows, numbers, EPISODE_SCORES)
    for i in rows:
        scored = max(state.step[i] - state.terminated[i], 1)  # the step of a game over has no flow to score
        for line in range(EPISODE_SCORES, numbers.shape[0]):
            numbers[line, i] /= scored


@jit
def _sum_of_costs(state: GridState, i: int) -> float:
    total = 0.0
    for cost in range(state.transition_costs.shape[1]):
        total += state.transition_costs[i, cost]
    return total


@jit
def _write_lines(values: F64, rows: I64, numbers: F64, first: int) -> None:
    """Write ``values`` [n, column] of ``rows`` to the lines from ``first`` on, a line for each column."""
    for column in range(values.shape[1]):
        for i in rows:
            numbers[first + column, i] = values[i, column]
