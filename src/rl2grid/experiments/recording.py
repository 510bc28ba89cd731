"""Plays one episode and keeps what every grid step showed, heuristic steps included."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rl2grid.agents.agent import Action, Agent, Info
from rl2grid.analysis.recordings import Recording
from rl2grid.experiments.episode import play_episode
from rl2grid.mdp.state import GridState
from rl2grid.mdp.termination import GAME_OVER_TEXT, GameOver


class _Recorder:
    """Listens to the grid steps and the decisions of one environment."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self.columns: dict[str, list[NDArray[Any]]] = {
            name: [] for name in ("rho", "line_status", "attacked", "maintained")
        }
        self.decision_steps: list[int] = []
        self.actions: list[str] = []

    def hear(self, state: GridState, row: int) -> None:
        """Keep a grid step; that of a game over has no flows to show, and is kept only if nothing else was played."""
        if state.terminated[row] and self.columns["rho"]:
            return
        self.columns["rho"].append(state.rho[row].copy())
        self.columns["line_status"].append(state.line_status[row].copy())
        self.columns["attacked"].append(state.attacked[row].copy())
        self.columns["maintained"].append(state.time_next_maintenance[row] == 0)

    def note(self, action: Action, info: Info) -> None:
        """Keep a decision, in words unless it does nothing."""
        self.decision_steps.append(int(info["step"]))
        self.actions.append(self._env.describe_action(action) if np.any(action) else "")


def record_episode(
    agent: Agent, env: gymnasium.Env[Any, Any], *, scenario: str, seed: int = 0, start: int = 0
) -> Recording:
    """Play one episode with an agent that is bound to ``env``.

    Args:
        agent: bound to ``env``.
        env: made by ``gymnasium.make``.
        scenario: id of the scenario.
        seed: of maintenance, opponent and agent.
        start: row at which the episode begins.

    Raises:
        UsageError: the scenario is not in the split of ``env``, or leaves nothing to play after ``start``.
    """
    base: Any = env.unwrapped
    recorder = _Recorder(base)
    base.step_listeners.append(recorder.hear)
    try:
        episode = play_episode(agent, env, scenario=scenario, seed=seed, start=start, on_decision=recorder.note)
    finally:
        base.step_listeners.remove(recorder.hear)
    reason = GameOver[episode.game_over]
    n_line = base.grid.n_line
    return Recording(
        task=base.task.id,
        agent=agent.name,
        heuristic=base.options.heuristic or "none",
        scenario=scenario,
        seed=seed,
        start=start,
        episode_length=episode.episode_length,
        game_over="" if reason == GameOver.NONE else GAME_OVER_TEXT[reason],
        line_names=base.grid.name_line,
        decision_steps=tuple(recorder.decision_steps),
        actions=tuple(recorder.actions),
        **{name: np.array(rows).reshape(len(rows), n_line) for name, rows in recorder.columns.items()},
    )
