"""What ``info`` holds: one documented table, and the function that fills it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rl2grid.mdp.constraint_table import CONSTRAINTS
from rl2grid.mdp.scores import SCORES
from rl2grid.mdp.state import GridState
from rl2grid.mdp.termination import GAME_OVER_TEXT, GameOver

COMPONENTS: tuple[str, ...] = ("survive", "overload", "cost")
"""Names of the reward components."""
COSTS: tuple[str, ...] = tuple(CONSTRAINTS)
"""Names of the costs."""


@dataclass(frozen=True)
class InfoKey:
    """One row of the table of ``info``."""

    name: str
    dtype: str
    unit: str
    when: str
    meaning: str


_ALWAYS = "always"
INFO_KEYS: tuple[InfoKey, ...] = (
    InfoKey("scenario", "str", "", _ALWAYS, "id of the scenario being played"),
    InfoKey("start", "int", "row", _ALWAYS, "row of the scenario at which the episode began"),
    InfoKey("start_redraws", "int", "", _ALWAYS, "rows drawn as start before, in which doing nothing overloads a line"),
    InfoKey("step", "int", "grid steps", _ALWAYS, "grid steps of the episode so far"),
    InfoKey("episode_length", "int", "grid steps", _ALWAYS, "grid steps of a completed episode, T"),
    InfoKey("survival", "float", "share of T", _ALWAYS, "grid steps survived / T; 1 when the episode is completed"),
    InfoKey("decisions", "int", "", _ALWAYS, "actions of the agent in the episode so far"),
    InfoKey("n_steps", "int", "grid steps", _ALWAYS, "grid steps of this transition, 0 in `reset`"),
    InfoKey("grid_steps", "int", "grid steps", _ALWAYS, "grid steps since the last seeded `reset`, over all episodes"),
    InfoKey("reward_components", "dict", "", _ALWAYS, "survive, overload, cost: sums over the transition"),
    InfoKey(
        "cost",
        "float",
        "",
        _ALWAYS,
        f"cost of the task's constraint (without one: {' + '.join(COSTS)}), transition sum",
    ),
    InfoKey("costs", "dict", "", _ALWAYS, f"{', '.join(COSTS)}: sums over the transition"),
    InfoKey("reset_steps", "int", "grid steps", _ALWAYS, "grid steps that `reset` played before the first decision"),
    InfoKey("reset_reward", "float", "", _ALWAYS, "their rewards, which are in no transition"),
    InfoKey("reset_components", "dict", "", _ALWAYS, "survive, overload, cost: their sums"),
    InfoKey("reset_costs", "dict", "", _ALWAYS, f"{', '.join(COSTS)}: their sums"),
    InfoKey("episode_return", "float", "", _ALWAYS, "rewards of the episode so far"),
    InfoKey("episode_components", "dict", "", _ALWAYS, "survive, overload, cost: sums over the episode so far"),
    InfoKey("episode_costs", "dict", "", _ALWAYS, f"{', '.join(COSTS)}: sums over the episode so far"),
    InfoKey("scores", "dict", "", _ALWAYS, "margin, overload, topology (paper, Section 5): means per grid step"),
    InfoKey("illegal", "bool", "", _ALWAYS, "the agent's action broke a rule and became do nothing"),
    InfoKey("ambiguous", "bool", "", _ALWAYS, "the agent's action had no single meaning and became do nothing"),
    InfoKey("action_effect", "str", "", _ALWAYS, "what was refused or clipped of the agent's action, and why"),
    InfoKey("attacked_lines", "bool [line]", "", _ALWAYS, "lines out by the opponent in the last grid step"),
    InfoKey("game_over", "int", "", _ALWAYS, "a GameOver, 0 while the grid is alive"),
    InfoKey("game_over_text", "str", "", _ALWAYS, "the game over in words, empty while the grid is alive"),
    InfoKey("over", "bool", "", _ALWAYS, "the episode ended inside `reset`; the next `step` returns the ending"),
    InfoKey("discounted_reward", "float", "", "with gamma=", "sum over the transition of gamma^k times reward k"),
    InfoKey("action_set_hash", "str", "", "tasks T and H", "hash of the topology actions and of their order"),
)


GAME_OVER_WORDS = np.array(
    [f"{reason.name}: {GAME_OVER_TEXT[reason]}" if reason else "" for reason in GameOver], dtype=object
)
"""object [GameOver], the game over in words; empty while the grid is alive."""


def episode_info(state: GridState, i: int, constraint: str | None) -> dict[str, Any]:
    """What the state alone tells about environment ``i``; see :data:`INFO_KEYS`."""
    costs = _named(COSTS, state.transition_costs[i])
    step, length = int(state.step[i]), int(state.episode_length[i])
    reason = GameOver(int(state.game_over[i]))
    scored = max(step - int(state.terminated[i]), 1)  # the step of a game over has no flow to score
    return {
        "step": step,
        "episode_length": length,
        "survival": survival(state, i),
        "decisions": int(state.decisions[i]),
        "n_steps": int(state.n_steps[i]),
        "reward_components": _named(COMPONENTS, state.transition_components[i]),
        "cost": costs[constraint] if constraint else sum(costs.values()),
        "costs": costs,
        "reset_steps": int(state.reset_steps[i]),
        "reset_reward": float(state.reset_reward[i]),
        "reset_components": _named(COMPONENTS, state.reset_components[i]),
        "reset_costs": _named(COSTS, state.reset_costs[i]),
        "episode_return": float(state.episode_return[i]),
        "episode_components": _named(COMPONENTS, state.episode_components[i]),
        "episode_costs": _named(COSTS, state.episode_costs[i]),
        "scores": {name: value / scored for name, value in _named(SCORES, state.episode_scores[i]).items()},
        "illegal": bool(state.illegal[i]),
        "ambiguous": bool(state.ambiguous[i]),
        "attacked_lines": state.attacked[i].copy(),
        "game_over": int(reason),
        "game_over_text": GAME_OVER_WORDS[reason],
    }


def survival(state: GridState, i: int) -> float:
    """Grid steps survived / T: the step of a game over was not survived."""
    survived = int(state.step[i]) - int(state.terminated[i])
    return max(survived, 0) / int(state.episode_length[i])


def _named(names: tuple[str, ...], values: Any) -> dict[str, float]:
    return {name: float(value) for name, value in zip(names, values, strict=True)}
