"""The rounds of a cascade: a step is played again with protections that wait until they are told to act.

The engine plays a step from end to end and tells which lines its protections opened, not in which order. From the
world before the step, a second engine plays the same action with the same draws and protections that open nothing: that
is the first power flow. What they would open follows from its currents by the rules of the engine; the step is played
again with these lines opened, and so on until nothing more opens or no flow is found.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.orders import Orders
from rl2grid.engines.worlds import World
from rl2grid.mdp.actions import ActionKind, Change, StepAction, mask_integer
from rl2grid.mdp.state import GridState
from rl2grid.mdp.termination import GameOver
from rl2grid.records.recordings import Cascade, Round, Trip

_AT_ONCE = np.float32(-1.0)
"""A hard limit that every current is above."""
_NEVER = np.iinfo(np.int32).max


class CascadeListener:
    """Hears the grid steps of an environment of the native engine, and keeps their cascades.

    Args:
        env: the environment, of which row 0 is heard.
        opponent: whether the opponent of the grid attacks there.
    """

    def __init__(self, env: Any, opponent: bool) -> None:
        self._engine: NativeEngine = env.engine
        self._opponent = opponent
        self._second: NativeEngine | None = None
        self._before: World | None = None
        self.cascades: list[Cascade] = []

    def hear(self, state: GridState, row: int) -> None:
        """Keep the cascade of the step just played, if there was one.

        One of the first row that an episode shows is not known: there is no world before it.
        """
        if self._before is not None and self._has_cascade(state, row):
            rounds = self._replayed(self._before, self.last_action(row))
            if self._is_what_happened(rounds, state, row):
                self.cascades.append(Cascade(int(state.step[row]), rounds))
        self._before = None if state.terminated[row] or state.truncated[row] else self._engine.save(row)

    def last_action(self, row: int) -> StepAction:
        """What the agent or the heuristic played in the last step."""
        return action_of(self._engine.environments.orders, row)

    def _has_cascade(self, state: GridState, row: int) -> bool:
        if state.game_over[row] == GameOver.DISPATCH:  # nothing was switched: there was no flow
            return False
        return bool(state.terminated[row] or self._engine.environments.hidden.tripped[row].any())

    def _is_what_happened(self, rounds: tuple[Round, ...], state: GridState, row: int) -> bool:
        """Whether the replay ends with the topology that the step ended with."""
        topology = (state.final_topo_vect if state.terminated[row] else state.topo_vect)[row]
        flow_was_lost = bool(np.isnan(rounds[-1].rho).all())
        return np.array_equal(rounds[-1].topo_vect, topology) and flow_was_lost == bool(state.terminated[row])

    def _replayed(self, world: World, action: StepAction) -> tuple[Round, ...]:
        if self._second is None:
            engine = self._engine
            self._second = NativeEngine(engine.grid, 1, engine.dispatch, self._opponent)
            self._rules = hard_limit_of(self._second).copy(), int(engine.environments.constants.overflow_allowed[0])
            self._second.environments.constants.overflow_allowed[0] = _NEVER
        return replay(self._second, world, action, *self._rules)


def replay(
    engine: NativeEngine, world: World, action: StepAction, hard_limit: NDArray[np.float32], overflow_allowed: int
) -> tuple[Round, ...]:
    """The rounds of the step that ``action`` makes of ``world``.

    Args:
        engine: one environment whose protections count no overloads; its hard limits are overwritten.
        world: before the step.
        action: what is played.
        hard_limit: A, above which a line opens at once, float32 [line].
        overflow_allowed: steps that a line may be overloaded.
    """
    state, rounds = engine.state, list[Round]()
    opened, counted = np.zeros((2, len(hard_limit)), np.bool_)
    while True:
        hard_limit_of(engine)[:] = np.where(opened, _AT_ONCE, np.float32(np.inf))
        engine.restore(0, world)
        overloaded_before = engine.environments.hidden.protection[0].copy()
        engine.step(0, action)
        if state.terminated[0]:
            return (*rounds, _lost_round(state))
        counted |= state.line_status[0] & (state.a_or[0] > state.thermal_limit)
        count = overloaded_before + counted
        at_once = state.a_or[0] > hard_limit
        trips = state.line_status[0] & (at_once | (count > overflow_allowed))
        rounds.append(_round(state, trips, np.where(at_once, 0, count)))
        if not trips.any():
            return tuple(rounds)
        opened |= trips


def hard_limit_of(engine: NativeEngine) -> NDArray[np.float32]:
    """A, above which each line of an engine opens at once; what is written there counts."""
    return engine.environments.constants.hard_limit


def action_of(orders: Orders, row: int) -> StepAction:
    """The action that a row played last."""
    changes = tuple(
        Change(kind, target, mask_integer(mask) if kind == ActionKind.MOVE else 0)
        for kind, target, mask in zip(
            orders.kind[row].tolist(), orders.target[row].tolist(), orders.mask[row], strict=True
        )
    )
    values = orders.injection[row].copy() if orders.injects[row] else None
    return StepAction(changes[: int(orders.n_changes[row])], values)


def _round(state: GridState, trips: NDArray[np.bool_], overloaded: NDArray[np.int32]) -> Round:
    return Round(
        state.topo_vect[0].astype(np.int8),
        state.rho[0].copy(),
        state.p_or[0].copy(),
        tuple(Trip(k, float(state.rho[0, k]), int(overloaded[k])) for k in np.flatnonzero(trips).tolist()),
    )


def _lost_round(state: GridState) -> Round:
    unknown = np.full(state.rho.shape[1], np.nan, np.float32)
    return Round(state.final_topo_vect[0].astype(np.int8), unknown, unknown, ())
