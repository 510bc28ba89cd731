"""The transitions of the native engine's environments, many per call."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import F32, I64
from rl2grid.engines.action_effects import clipping, refusal
from rl2grid.engines.native.action_notes import ActionNotes, copy_notes
from rl2grid.engines.native.advance import (
    ALONE,
    DEFAULT,
    IDLE,
    PAPER,
    RECONNECT,
    RECOVERY,
    RELEASED,
    RESET,
    advance,
    write_observations,
)
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.transition import Transitions
from rl2grid.grids import Grid
from rl2grid.mdp.actions import ActionKind, StepAction
from rl2grid.mdp.rewards import default_components, paper_components, released_components
from rl2grid.scenarios.episodes import EpisodePlan

_COMPILED_IN: dict[Callable[..., Any], int] = {
    default_components: DEFAULT,
    paper_components: PAPER,
    released_components: RELEASED,
}
_ROWS_PER_THREAD = 8
"""A thread with fewer rows than this costs more than it saves."""


@dataclass(frozen=True)
class Commands:
    """What the agents of several environments do, one entry each."""

    kinds: I64
    """int64 [k], an :class:`~rl2grid.mdp.actions.ActionKind`."""
    targets: I64
    """int64 [k], lines or substations."""
    masks: I64
    """int64 [k], moved elements."""
    values: F32
    """float32 [k, continuous]; no columns on topology tasks."""

    def __getitem__(self, part: slice) -> Commands:
        return Commands(self.kinds[part], self.targets[part], self.masks[part], self.values[part])

    def take(self, rows: I64) -> Commands:
        """The entries ``rows``."""
        if len(rows) == len(self.kinds):
            return self
        return Commands(self.kinds[rows], self.targets[rows], self.masks[rows], self.values[rows])

    def action(self, k: int) -> StepAction:
        """One entry as an action."""
        values = self.values[k] if self.kinds[k] == ActionKind.INJECTION else None
        return StepAction(int(self.kinds[k]), int(self.targets[k]), int(self.masks[k]), values)


class ActionEffect:
    """What became of one agent's action; put into words when somebody reads it."""

    __slots__ = ("_commands", "_grid", "_notes", "_row")

    def __init__(self, grid: Grid, notes: ActionNotes, commands: Commands, row: int) -> None:
        self._grid, self._notes, self._commands, self._row = grid, notes, commands, row

    def __str__(self) -> str:
        action = self._commands.action(self._row)
        refused = refusal(action, int(self._notes.cooldown_left[self._row]))
        return refused or clipping(self._grid, self._notes, self._row, action)

    __repr__ = __str__

    def __eq__(self, other: object) -> bool:
        return str(self) == str(other)

    def __hash__(self) -> int:
        return hash(str(self))


@dataclass
class NativeTransitions(Transitions):
    """:class:`~rl2grid.engines.transition.Transitions` in one compiled call for all environments.

    Listeners, a reward function of the user and SciPy's dispatch need Python at every grid step: with these the
    steps are played one by one.
    """

    engine: NativeEngine  # type: ignore[assignment]

    def __post_init__(self) -> None:
        n = len(self.engine.state.step)
        self._reward_code = _COMPILED_IN.get(self.reward.components)
        self._threads = ThreadPoolExecutor(os.cpu_count() or 1, "rl2grid")
        self._rows = np.arange(n)
        self._resets = Commands(
            np.full(n, RESET, np.int64), np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros((n, 0), np.float32)
        )

    @property
    def is_compiled(self) -> bool:
        """Whether transitions are played in compiled code from end to end."""
        exact = self.engine.dispatch == "exact" or self.topology_task
        return not self.listeners and self._reward_code is not None and exact

    def reset(self, i: int, plan: EpisodePlan) -> None:
        """Begin an episode and play to its first decision."""
        if not self.is_compiled:
            super().reset(i, plan)
            return
        self.engine.prepare(i, plan)
        self.action_effects[i] = ""
        self.begin_rows(self._rows[i : i + 1], 1)

    def play(self, i: int, action: StepAction) -> None:
        """Play the agent's action and all heuristic steps to the next decision."""
        if not self.is_compiled:
            super().play(i, action)
            return
        self._advance_part(self.engine.address, self._rows[i : i + 1], _one(action))
        notes = self.engine.environments.notes
        refused = refusal(action, int(notes.cooldown_left[i]))
        self.action_effects[i] = refused or clipping(self.engine.grid, notes, i, action)

    def play_rows(self, rows: I64, commands: Commands, num_threads: int) -> None:
        """Play one transition in each of ``rows``, entry k of ``commands`` in row ``rows[k]``."""
        if not self.is_compiled:
            for k, i in enumerate(rows.tolist()):
                self.play(i, commands.action(k))
            return
        self._advance(rows, commands, num_threads)

    def begin_rows(self, rows: I64, num_threads: int) -> None:
        """Play to the first decision in ``rows``, whose episodes the engine has been handed."""
        self._advance(rows, self._resets[: len(rows)], num_threads)

    def write_observations(self, rows: I64, shift: F32, scale: F32, out: F32) -> None:
        """Write the observations of ``rows``, shifted and scaled, to the same rows of ``out``, float32 [n, feature]."""
        write_observations(self.engine.address, rows, self.topology_task, shift, scale, out)

    def action_effects_of(self, commands: Commands) -> NDArray[np.object_]:
        """What became of the actions of all environments, object [n]."""
        if not self.is_compiled:
            return np.array([self.action_effects[i] for i in range(len(commands.kinds))], object)
        grid, notes = self.engine.grid, copy_notes(self.engine.environments.notes)
        effects = np.empty(len(commands.kinds), object)
        effects[:] = [ActionEffect(grid, notes, commands, i) for i in range(len(effects))]
        return effects

    def _advance(self, rows: I64, commands: Commands, num_threads: int) -> None:
        parts = max(1, min(num_threads, len(rows) // _ROWS_PER_THREAD))
        if parts == 1:
            self._advance_part(self.engine.address, rows, commands)
            return
        bounds = [len(rows) * part // parts for part in range(parts + 1)]
        slices = [slice(first, last) for first, last in itertools.pairwise(bounds)]
        addresses = [self.engine.address_for(thread) for thread in range(parts)]

        def advance_slice(address: int, part: slice) -> None:
            self._advance_part(address, rows[part], commands[part])

        list(self._threads.map(advance_slice, addresses, slices))

    def _advance_part(self, address: int, rows: I64, commands: Commands) -> None:
        weights = self.reward.weights
        advance(
            address,
            rows,
            commands.kinds,
            commands.targets,
            commands.masks,
            commands.values,
            self._heuristic_code(),
            self._reward_code or DEFAULT,
            (float(weights[0]), float(weights[1]), float(weights[2])),
            float(self.gamma),
        )

    def _heuristic_code(self) -> int:
        if self.heuristic is None:
            return ALONE
        if self.heuristic == "idle":
            return IDLE
        return RECOVERY if self.topology_task else RECONNECT


def _one(action: StepAction) -> Commands:
    values = np.zeros(0, np.float32) if action.values is None else action.values
    return Commands(
        np.array([action.kind], np.int64), np.array([action.target], np.int64), np.array([action.mask], np.int64),
        values[np.newaxis],
    )  # fmt: skip
