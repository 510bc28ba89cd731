"""From one decision of the agent to the next: its step and the heuristic steps behind it.

A transition adds up rewards, costs and scores of all its grid steps (paper, Section 3.2). A reset plays
the heuristic to the first decision; what accrues there is kept apart, as no decision led to it.
"""

from __future__ import annotations

import functools
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
    is_at_rest,
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
from rl2grid.mdp.security import Security, is_expected, is_secure, loading_after_loss, new_security
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
    """Of task, one of :data:`rl2grid.mdp.features.KINDS`: where agents have no topology actions, heuristics
    only reconnect lines."""
    reward: RewardFunction
    gamma: float
    """Discount between the grid steps of a transition."""
    listeners: list[Listener] = field(default_factory=list)
    action_effects: dict[int, str] = field(default_factory=dict)
    """By row: what was refused or clipped of the agent's last action."""
    _opened: AsOpened[GridState] = field(default_factory=AsOpened)
    _opened_result: AsOpened[GridState] = field(default_factory=AsOpened)
    _opened_security: AsOpened[Security] = field(default_factory=AsOpened)

    @property
    def opened_state(self) -> GridState:
        """The engine's state, for compiled functions."""
        return self._opened(self.engine.state)

    def opened_result(self, result: GridState) -> GridState:
        """What :meth:`simulate` returned, for compiled functions."""
        return self._opened_result(result)

    @property
    def looks_ahead(self) -> bool:
        """Whether the heuristic tries things on forecasts."""
        return self.heuristic in ("careful", "secure")

    @functools.cached_property
    def security(self) -> Security:
        """What may be lost on the grid, for the heuristic that looks at it."""
        return new_security(self.engine.grid, self.engine.network, self.engine.attacks)

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
            action = self._heuristic_action(i)
            if not action.changes and self._asks(i):
                break
            self._step(i, action)

    def _asks(self, i: int) -> bool:
        """Whether the agent decides although the grid is safe, where the heuristic has nothing to do."""
        if self.heuristic != "secure":
            return False
        return not (is_at_rest(self.opened_state, i) and self._is_secure(i, self.opened_state, i))

    def expects_loss(self, i: int, k: int) -> bool:
        """Whether the line of contingency ``k`` of :attr:`security` may be lost soon in row ``i``."""
        return bool(is_expected(self._opened_security(self.security), self.opened_state, i, k))

    def loading_after_loss(self, i: int, k: int) -> float:
        """Largest loading in row ``i`` after the loss of the line of contingency ``k``, which is in service."""
        return float(loading_after_loss(self._opened_security(self.security), self.opened_state, i, k))

    def _is_secure(self, i: int, flows: GridState, j: int) -> bool:
        return bool(is_secure(self._opened_security(self.security), self.opened_state, i, flows, j))

    def _heuristic_action(self, i: int) -> StepAction:
        if self.heuristic == "idle":
            return DO_NOTHING
        if self.looks_ahead:
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
            forecast = self.opened_result(self.engine.simulate(i, action, 1))
            if is_careful_enough(forecast, 0) and self._keeps_secure(i, action, forecast):
                return action
            candidate = careful_candidate(opened, i, candidate + 1)
        return DO_NOTHING

    def _keeps_secure(self, i: int, action: StepAction, forecast: GridState) -> bool:
        """Whether the heuristic may play this as far as losses are concerned."""
        restores = action.changes[0].kind == ActionKind.RESTORE
        return self.heuristic != "secure" or not restores or self._is_secure(i, forecast, 0)

    def _remember(self, i: int) -> None:
        if self.looks_ahead:
            remember_topology(self.opened_state, i)

    def _remember_moves(self, i: int, action: StepAction) -> None:
        """Note the substations that the agent has changed."""
        state = self.engine.state
        if not self.looks_ahead or state.illegal[i] or state.ambiguous[i]:
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
