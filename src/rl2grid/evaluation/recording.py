"""Plays one episode and keeps what every grid step showed, heuristic steps included."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rl2grid.agents.agent import Action, Agent, Info, intervenes
from rl2grid.evaluation.collapse import lost_elements
from rl2grid.evaluation.episode import play_episode
from rl2grid.evaluation.reasons import Reasons
from rl2grid.mdp.actions import describe
from rl2grid.mdp.state import GridState
from rl2grid.mdp.termination import GAME_OVER_TEXT, GameOver
from rl2grid.records.recordings import Cascade, Ending, Reason, Recording

if TYPE_CHECKING:
    from rl2grid.evaluation.cascades import CascadeListener

_OBSERVED = ("rho", "line_status", "attacked", "gen_p", "load_p", "storage_power", "p_or", "gen_p_before_curtail")

OnStep = Callable[[int, int], None]
"""Called after every grid step with the steps played and the length of the episode."""


class _Stop(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Ends the episode at the first decision after a number of grid steps."""

    def __init__(self, env: gymnasium.Env[Any, Any], steps: int) -> None:
        super().__init__(env)
        self._steps = steps

    def step(self, action: Action) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated or info["step"] >= self._steps, info


class _Recorder:
    """Listens to the grid steps and the decisions of one environment."""

    def __init__(self, agent: Agent, env: Any, on_step: OnStep | None) -> None:
        self._env, self._on_step = env, on_step
        self._reasons = Reasons(agent, env)
        self._listener = _cascade_listener(env)
        self._agent_moves = False
        self.columns: dict[str, list[NDArray[Any]]] = {name: [] for name in (*_OBSERVED, "topo_vect", "maintained")}
        self.decision_steps: list[int] = []
        self.actions: list[str] = []
        self.reasons: list[Reason] = []
        self.heuristic_acts: list[tuple[int, str]] = []
        self.ending: Ending | None = None

    @property
    def cascades(self) -> list[Cascade]:
        """Those of the native engine."""
        return [] if self._listener is None else self._listener.cascades

    def hear(self, state: GridState, row: int) -> None:
        """Keep a grid step; that of a game over has no flows to show, and is kept only if nothing else was played."""
        if self._env.imagined:  # what an agent thinks of is not what happens
            return
        self._note_heuristic(state, row)
        if self._listener is not None:
            self._listener.hear(state, row)
        if state.terminated[row]:
            topology = state.final_topo_vect[row].astype(np.int8)
            self.ending = Ending(topology, lost_elements(state, row), state.attacked[row].copy())
        if state.terminated[row] and self.columns["rho"]:
            return
        for name in _OBSERVED:
            self.columns[name].append(getattr(state, name)[row].copy())
        self.columns["topo_vect"].append(state.topo_vect[row].astype(np.int8))
        self.columns["maintained"].append(state.time_next_maintenance[row] == 0)
        if self._on_step is not None:
            self._on_step(int(state.step[row]), int(state.episode_length[row]))

    def note(self, action: Action, info: Info) -> None:
        """Keep a decision, in words unless it does nothing."""
        step = int(info["step"])
        self.decision_steps.append(step)
        self.actions.append(self._env.describe_action(action) if intervenes(action) else "")
        reason = self._reasons.of(action, step)
        if reason is not None:
            self.reasons.append(reason)
        self._agent_moves = True

    def _note_heuristic(self, state: GridState, row: int) -> None:
        """Keep what was changed in a step that the agent was not asked about."""
        if self._agent_moves or self._listener is None or state.step[row] == 0:
            self._agent_moves = False
            return
        action = self._listener.last_action(row)
        if action.changes:
            self.heuristic_acts.append((int(state.step[row]), describe(self._env.grid, action)))


def _cascade_listener(env: Any) -> CascadeListener | None:
    if env.options.engine != "native":
        return None
    # Imported here: nobody else needs the compiled engine for that.
    from rl2grid.evaluation.cascades import CascadeListener

    return CascadeListener(env, env.options.opponent)


def record_episode(
    agent: Agent,
    env: gymnasium.Env[Any, Any],
    *,
    scenario: str,
    seed: int = 0,
    start: int = 0,
    steps: int | None = None,
    on_step: OnStep | None = None,
) -> Recording:
    """Play one episode with an agent that is bound to ``env``.

    Args:
        agent: bound to ``env``.
        env: made by ``gymnasium.make``.
        scenario: id of the scenario.
        seed: of maintenance, opponent and agent.
        start: row at which the episode begins.
        steps: record no more grid steps than these; None: all of the episode.
        on_step: called after every grid step.

    Raises:
        UsageError: the scenario is not in the split of ``env``, or leaves nothing to play after ``start``.
    """
    base: Any = env.unwrapped
    recorder = _Recorder(agent, base, on_step)
    played = env if steps is None else _Stop(env, steps)
    base.step_listeners.append(recorder.hear)
    try:
        episode = play_episode(agent, played, scenario=scenario, seed=seed, start=start, on_decision=recorder.note)
    finally:
        base.step_listeners.remove(recorder.hear)
    reason = GameOver[episode.game_over]
    # What the heuristic played beyond the last step asked for is cut off, and with it the ending.
    stop = len(recorder.columns["rho"]) if steps is None else steps + 1
    cut = stop < len(recorder.columns["rho"])
    n_decisions = sum(step < stop for step in recorder.decision_steps)
    return Recording(
        task=base.task.id,
        agent=agent.name,
        heuristic=base.options.heuristic or "none",
        scenario=scenario,
        seed=seed,
        start=start,
        episode_length=episode.episode_length,
        began=base.clock_at(0).isoformat(),
        game_over="" if cut or reason == GameOver.NONE else GAME_OVER_TEXT[reason],
        line_names=base.grid.name_line,
        decision_steps=tuple(recorder.decision_steps[:n_decisions]),
        actions=tuple(recorder.actions[:n_decisions]),
        reasons=tuple(reason for reason in recorder.reasons if reason.step < stop),
        heuristic_acts=tuple((step, words) for step, words in recorder.heuristic_acts if step < stop),
        cascades=tuple(cascade for cascade in recorder.cascades if not cut or cascade.step < stop),
        ending=None if cut else recorder.ending,
        **{name: np.array(rows[:stop]) for name, rows in recorder.columns.items()},
    )
