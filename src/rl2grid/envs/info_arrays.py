"""``info`` of many environments at once: one array per key, as Gymnasium's vector environments have it.

The values of all keys of one kind lie in one block, a line each. Blocks are filled, and blanked where no episode
ended, by a handful of NumPy calls for all environments; what is handed out are their lines.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import F64, I64, Flags
from rl2grid.envs.info import COMPONENTS, COSTS, GAME_OVER_WORDS
from rl2grid.mdp.scores import SCORES
from rl2grid.mdp.state import GridState

Words = NDArray[np.object_]

_NO_WORDS = np.array(None, object)


@dataclass(frozen=True)
class Underway:
    """What a vector knows of the episodes that its ``n`` environments play, beside their state."""

    scenarios: Words
    """object [n], ids."""
    starts: I64
    """int64 [n], the row of the scenario at which each began."""
    redraws: I64
    """int64 [n], rows drawn as start before."""
    earlier_steps: I64
    """int64 [n], grid steps of earlier episodes of the seed's stream."""
    over: Flags
    """bool [n], the episode ended inside ``reset``."""
    effects: Words
    """object [n], what became of the agent's last action, put into words by ``str``."""


@dataclass(frozen=True)
class InfoArrays:
    """The infos of ``n`` environments at one moment, which later steps leave alone."""

    words: Words
    """object [key, n]"""
    counts: I64
    """int64 [key, n]"""
    flags: Flags
    """bool [key, n]"""
    numbers: F64
    """float64 [key, n], the entries of a dict one after the other."""
    attacked: Flags
    """bool [n, line]"""
    tells_discounted: bool
    """Whether there is a discounted reward."""
    tells_hash: bool
    """Whether there is an action-set hash."""

    def only(self, chosen: Flags) -> InfoArrays:
        """Those of the environments ``chosen``, bool [n]; elsewhere what Gymnasium leaves blank: 0, False, None."""
        return InfoArrays(
            np.where(chosen, self.words, _NO_WORDS),
            np.where(chosen, self.counts, 0),
            chosen & self.flags,
            np.where(chosen, self.numbers, 0.0),
            chosen[:, np.newaxis] & self.attacked,
            self.tells_discounted,
            self.tells_hash,
        )

    def named(self) -> dict[str, Any]:
        """By key of :data:`rl2grid.envs.info.INFO_KEYS`: arrays [n], or dicts of such."""
        scenario, game_over_text, action_effect, action_set_hash = self.words
        start, redraws, step, length, decisions, n_steps, reset_steps, game_over, grid_steps = self.counts
        illegal, ambiguous, over = self.flags
        numbers = iter(self.numbers)  # taken in the order in which `info_arrays` stacks them
        infos = {
            "scenario": scenario,
            "start": start,
            "start_redraws": redraws,
            "step": step,
            "episode_length": length,
            "survival": next(numbers),
            "decisions": decisions,
            "n_steps": n_steps,
            "reward_components": _named(COMPONENTS, numbers),
            "cost": next(numbers),
            "costs": _named(COSTS, numbers),
            "reset_steps": reset_steps,
            "reset_reward": next(numbers),
            "reset_components": _named(COMPONENTS, numbers),
            "reset_costs": _named(COSTS, numbers),
            "episode_return": next(numbers),
            "episode_components": _named(COMPONENTS, numbers),
            "episode_costs": _named(COSTS, numbers),
            "scores": _named(SCORES, numbers),
            "illegal": illegal,
            "ambiguous": ambiguous,
            "attacked_lines": self.attacked,
            "game_over": game_over,
            "game_over_text": game_over_text,
            "action_effect": action_effect,
            "grid_steps": grid_steps,
            "over": over,
        }
        if self.tells_discounted:
            infos["discounted_reward"] = next(numbers)
        if self.tells_hash:
            infos["action_set_hash"] = action_set_hash
        return infos


def info_arrays(
    state: GridState, underway: Underway, constraint: str | None, tells_discounted: bool, action_set_hash: str | None
) -> InfoArrays:
    """:meth:`rl2grid.envs.task_environments.TaskEnvironments.info` of all environments.

    Args:
        state: the state of ``n`` environments.
        underway: which episodes they play.
        constraint: the one that ``cost`` tells; None: both, added.
        tells_discounted: whether there is a discounted reward.
        action_set_hash: of the task's actions, None without.
    """
    step = state.step.astype(np.int64)
    alive = step - state.terminated  # the step of a game over was not survived, and has no flow to score
    costs = state.transition_costs
    return InfoArrays(
        np.array(
            (
                underway.scenarios,
                GAME_OVER_WORDS[state.game_over],
                underway.effects,
                np.full(len(step), action_set_hash, object),
            ),
            object,
        ),
        np.array(
            (
                underway.starts,
                underway.redraws,
                step,
                state.episode_length,
                state.decisions,
                state.n_steps,
                state.reset_steps,
                state.game_over,
                underway.earlier_steps + step,
            ),
            np.int64,
        ),
        np.array((state.illegal, state.ambiguous, underway.over), np.bool_),
        _stacked(
            np.maximum(alive, 0) / state.episode_length,
            state.transition_components,
            costs[:, COSTS.index(constraint)] if constraint else costs.sum(axis=1),
            costs,
            state.reset_reward,
            state.reset_components,
            state.reset_costs,
            state.episode_return,
            state.episode_components,
            state.episode_costs,
            state.episode_scores / np.maximum(alive, 1)[:, np.newaxis],
            state.transition_discounted,
        ),
        state.attacked.copy(),
        tells_discounted,
        action_set_hash is not None,
    )


def _stacked(*parts: F64) -> F64:
    """float64 [line, n]: each of ``parts``, [n] or [n, line], behind the other (``numpy.vstack``, in a third of it)."""
    heights = [1 if part.ndim == 1 else part.shape[1] for part in parts]
    block = np.empty((sum(heights), len(parts[0])))
    first = 0
    for part, height in zip(parts, heights, strict=True):
        block[first : first + height] = part.T
        first += height
    return block


def _named(names: Sequence[str], lines: Iterator[F64]) -> dict[str, F64]:
    """The next lines by name."""
    return {name: next(lines) for name in names}
