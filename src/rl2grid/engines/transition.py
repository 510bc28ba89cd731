"""From one decision of the agent to the next: its step and the heuristic steps behind it.

A transition adds up rewards, costs and scores of all its grid steps (paper, Section 3.2). A reset plays
the heuristic to the first decision; what accrues there is kept apart, as no decision led to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from rl2grid.engines.action_effects import clipping, refusal
from rl2grid.engines.base import Engine
from rl2grid.handles import AsOpened
from rl2grid.mdp.accumulate import accrue, begin_episode, begin_transition, end_reset
from rl2grid.mdp.actions import DO_NOTHING, ActionKind, StepAction, one_change
from rl2grid.mdp.features import changes_topology
from rl2grid.mdp.heuristics import (
    candidate_action,
    careful_candidate,
    is_careful_enough,
    is_safe,
    reconnect_action,
    recovery_action,
    remember_move,
    remember_nothing,
    remember_topology,
)
from rl2grid.mdp.legality import verdict_on
from rl2grid.mdp.rewards import RewardFunction
from rl2grid.mdp.state import GridState
from rl2grid.scenarios.episodes import EpisodePlan

Listener = Callable[[GridState, int], None]
"""Called after every grid step with the state and the environment's row."""


@dataclass
class Transitions:
    """Plays the transitions of the environments of one engine."""

    engine: Engine
    heuristic: str | None
    """One of :data:`rl2grid.engines.HEURISTICS`; None: the agent decides every step."""
    kind: str
    """Of task, one of :data:`rl2grid.mdp.features.KINDS`: where agents have no topology actions, the heuristics
    recovery and careful only reconnect lines."""
    reward: RewardFunction
    gamma: float
    """Discount between the grid steps of a transition."""
    listeners: list[Listener] = field(default_factory=list)
    action_effects: dict[int, str] = field(default_factory=dict)
    """By row: what was refused or clipped of the agent's last action."""
    _opened: AsOpened[GridState] = field(default_factory=AsOpened)
    _opened_result: AsOpened[GridState] = field(default_factory=AsOpened)

    @property
    def opened_state(self) -> GridState:
        """The engine's state, for compiled functions."""
        return self._opened(self.engine.state)

    def opened_result(self, result: GridState) -> GridState:
        """What :meth:`simulate` returned, for compiled functions."""
        return self._opened_result(result)

    def reset(self, i: int, plan: EpisodePlan) -> None:
        """Begin an episode and play to its first decision."""
        self.engine.reset(i, plan)
        state = self.opened_state
        self.action_effects[i] = ""
        begin_episode(state, i)
        remember_nothing(state, i)
        self._remember(i)
        self._announce(i)
        self._play_heuristic(i)
        end_reset(state, i)

    def play(self, i: int, action: StepAction) -> None:
        """Play the agent's action and all heuristic steps to the next decision.

        The flags ``illegal`` and ``ambiguous`` keep what happened to the agent's own action.
        """
        state = self.engine.state
        begin_transition(self.opened_state, i)
        state.decisions[i] += 1
        refused = refusal(self.engine.grid, verdict_on(state, i, action))
        self._step(i, action)
        self.action_effects[i] = refused or clipping(self.engine.grid, state, i, action)
        self._remember_moves(i, action)
        illegal, ambiguous = state.illegal[i], state.ambiguous[i]
        self._play_heuristic(i)
        state.illegal[i], state.ambiguous[i] = illegal, ambiguous

    def simulate(self, i: int, action: StepAction, horizon: int) -> GridState:
        """``action`` played on the forecast, without heuristic: row 0 holds what one step would bring."""
        result = self.engine.simulate(i, action, horizon)
        opened = self.opened_result(result)
        begin_episode(opened, 0)
        self._accrue(result, opened, 0)
        return result

    def _play_heuristic(self, i: int) -> None:
        state = self.engine.state
        if self.heuristic is None:
            return
        while not (state.terminated[i] or state.truncated[i]) and is_safe(self.opened_state, i):
            self._step(i, self._heuristic_action(i))

    def _heuristic_action(self, i: int) -> StepAction:
        if self.heuristic == "idle":
            return DO_NOTHING
        if self.heuristic == "careful":
            return self._careful_action(i)
        decide = recovery_action if changes_topology(self.kind) else reconnect_action
        kind, target = decide(self.opened_state, i)
        return one_change(kind, target)

    def _careful_action(self, i: int) -> StepAction:
        """The first candidate that the forecast allows; else nothing."""
        state, opened = self.engine.state, self.opened_state
        end = state.line_status.shape[1] + (len(state.sub_info) if changes_topology(self.kind) else 0)
        candidate = careful_candidate(opened, i, 0)
        while 0 <= candidate < end:
            action = one_change(*candidate_action(opened, candidate))
            if is_careful_enough(self.opened_result(self.engine.simulate(i, action, 1)), 0):
                return action
            candidate = careful_candidate(opened, i, candidate + 1)
        return DO_NOTHING

    def _remember(self, i: int) -> None:
        if self.heuristic == "careful":
            remember_topology(self.opened_state, i)

    def _remember_moves(self, i: int, action: StepAction) -> None:
        """Note the substations that the agent has changed."""
        state = self.engine.state
        if self.heuristic != "careful" or state.illegal[i] or state.ambiguous[i]:
            return
        for change in action.changes:
            if change.kind == ActionKind.MOVE:
                remember_move(self.opened_state, i, change.target)

    def _step(self, i: int, action: StepAction) -> None:
        self.engine.step(i, action)
        self._accrue(self.engine.state, self.opened_state, i)
        self._remember(i)
        self._announce(i)

    def _accrue(self, state: GridState, opened: GridState, i: int) -> None:
        """Add up a grid step; a reward of the user is given the state itself."""
        survive, overload, cost = self.reward.components(opened if self.reward.is_preset else state, i)
        accrue(opened, i, survive, overload, cost, self.reward.weights, self.gamma)

    def _announce(self, i: int) -> None:
        for listener in self.listeners:
            listener(self.engine.state, i)
