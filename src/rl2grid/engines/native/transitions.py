"""The transitions of the native engine's environments, many per call."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import F32, I64, U64, Flags
from rl2grid.engines.action_effects import clipping, refusal
from rl2grid.engines.native.action_notes import ActionNotes, notes_of, verdict_in
from rl2grid.engines.native.advance import (
    ALONE,
    CAREFUL,
    CAREFUL_RECONNECT,
    DEFAULT,
    IDLE,
    MOST_ABREAST,
    PAPER,
    RECONNECT,
    RECOVERY,
    RELEASED,
    SECURE,
    SECURE_RECONNECT,
    TRIPS,
    advance,
    write_observations,
    write_topology_keys,
)
from rl2grid.engines.native.beginning import Draws
from rl2grid.engines.native.compile_ahead import compile_ahead
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.entry import reset_rows
from rl2grid.engines.native.threads import Threads
from rl2grid.engines.native.training_library import training_library
from rl2grid.engines.transition import Transitions
from rl2grid.grids import Grid
from rl2grid.handles import Handle
from rl2grid.mdp.actions import (
    DO_NOTHING,
    ActionKind,
    Change,
    StepAction,
    check_changes,
    continuous_layout,
    mask_integer,
    mask_words,
    write_mask,
)
from rl2grid.mdp.features import changes_topology, injects
from rl2grid.mdp.rewards import default_components, paper_components, released_components, trips_components
from rl2grid.mdp.security import Security
from rl2grid.scenarios.episodes import MAX_STEPS, EpisodePlan, PlannedStarts
from rl2grid.structures import with_own_workspace

_COMPILED_IN: dict[Callable[..., Any], int] = {
    default_components: DEFAULT,
    paper_components: PAPER,
    released_components: RELEASED,
    trips_components: TRIPS,
}
_CODES = {
    ("idle", True): IDLE,
    ("idle", False): IDLE,
    ("recovery", True): RECOVERY,
    ("recovery", False): RECONNECT,
    ("careful", True): CAREFUL,
    ("careful", False): CAREFUL_RECONNECT,
    ("secure", True): SECURE,
    ("secure", False): SECURE_RECONNECT,
}
"""What a heuristic is where agents have topology actions, and where not."""
_ROWS_PER_THREAD = 8
"""A thread with fewer rows than this costs more than it saves."""
_ABREAST = 16
"""Rows that a thread plays at the same time between which heuristics play: twice as many as flows are solved side by
side, because the topologies of rows differ. More, and a thread still has many when the others are done."""


@dataclass(slots=True)  # not frozen, which takes a microsecond of every step
class Commands:
    """What the agents of several environments do, one entry each, some of the changes that all refer to."""

    first: I64
    """int64 [k], the first change of each entry."""
    end: I64
    """int64 [k], the change behind its last one."""
    kinds: I64
    """int64 [change], an :class:`~rl2grid.mdp.actions.ActionKind`."""
    targets: I64
    """int64 [change], lines or substations."""
    masks: U64
    """uint64 [change, word], moved elements."""
    injects: Flags
    """bool [k], which of them inject."""
    values: F32
    """float32 [k, continuous], their injections; no columns where nobody injects."""

    def __len__(self) -> int:
        return len(self.injects)

    def __getitem__(self, part: slice) -> Commands:
        start, stop, _ = part.indices(len(self))
        return self if stop - start == len(self) else self._only(part)

    def take(self, rows: I64) -> Commands:
        """The entries ``rows``, which ascend."""
        return self if len(rows) == len(self) else self._only(rows)

    def _only(self, entries: slice | I64) -> Commands:
        return replace(
            self,
            first=self.first[entries],
            end=self.end[entries],
            injects=self.injects[entries],
            values=self.values[entries],
        )

    def action(self, k: int) -> StepAction:
        """One entry as an action."""
        changes = tuple(
            Change(int(self.kinds[c]), int(self.targets[c]), mask_integer(self.masks[c]))
            for c in range(int(self.first[k]), int(self.end[k]))
            if self.kinds[c] != ActionKind.NOTHING
        )
        return StepAction(changes, self.values[k] if self.injects[k] else None)


def commands_of(grid: Grid, actions: Sequence[StepAction]) -> Commands:
    """Actions as one batch.

    Raises:
        UsageError: a line, substation or element that the grid does not have.
    """
    changes = [change for action in actions for change in action.changes]
    check_changes(grid, changes)
    masks = np.zeros((len(changes), mask_words(grid)), np.uint64)
    for change, row in zip(changes, masks, strict=True):
        write_mask(change.mask, row)
    injects = [action.values is not None for action in actions]
    size = continuous_layout(grid).size if any(injects) else 0
    values = np.zeros((len(actions), size), np.float32)
    for k, action in enumerate(actions):
        if action.values is not None:
            values[k] = action.values
    ends = np.cumsum([0, *(len(action.changes) for action in actions)], dtype=np.int64)
    return Commands(
        ends[:-1],
        ends[1:],
        np.array([change.kind for change in changes], np.int64),
        np.array([change.target for change in changes], np.int64),
        masks,
        np.array(injects, np.bool_),
        values,
    )


@dataclass(frozen=True)
class NotedActions:
    """Actions of a step of which something was refused or clipped."""

    grid: Grid
    commands: Commands
    rows: I64
    """int64 [k], their entries in ``commands``."""
    notes: ActionNotes
    """What became of them, ``k`` environments."""

    def in_words(self, k: int) -> str:
        """What was refused or clipped of one of them, and why."""
        return _in_words(self.grid, self.notes, k, self.commands.action(int(self.rows[k])))


def _in_words(grid: Grid, notes: ActionNotes, i: int, action: StepAction) -> str:
    return refusal(grid, verdict_in(notes, i)) or clipping(grid, notes, i, action)


class ActionEffect:
    """What was refused or clipped of one agent's action; put into words when somebody reads it."""

    __slots__ = ("_k", "_noted")

    def __init__(self, noted: NotedActions, k: int) -> None:
        self._noted, self._k = noted, k

    def __str__(self) -> str:
        return self._noted.in_words(self._k)

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
        survive, overload, cost = map(float, self.reward.weights)
        self._weights = survive, overload, cost
        self._heuristic_code = _CODES[self.heuristic, changes_topology(self.kind)] if self.heuristic else ALONE
        self._threads = Threads(os.cpu_count() or 1, "rl2grid")
        self._rows = np.arange(n)
        self._no_effects = np.full(n, "", object)
        self._nothing = commands_of(self.engine.grid, [DO_NOTHING] * n)
        self._securities: list[Handle[Security]] = []
        if self.is_compiled:
            compile_ahead()

    @property
    def is_compiled(self) -> bool:
        """Whether transitions are played in compiled code from end to end."""
        exact = self.engine.dispatch == "exact" or not injects(self.kind)
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
        self._advance(self._rows[i : i + 1], commands_of(self.engine.grid, [action]), 1, False)
        notes = self.engine.environments.notes
        self.action_effects[i] = _in_words(self.engine.grid, notes, i, action) if notes.worth_a_word[i] else ""

    def play_rows(self, rows: I64, commands: Commands, num_threads: int) -> None:
        """Play one transition in each of ``rows``, entry k of ``commands`` in row ``rows[k]``."""
        if not self.is_compiled:
            for k, i in enumerate(rows.tolist()):
                self.play(i, commands.action(k))
            return
        self._advance(rows, commands, num_threads, False)

    def begin_rows(self, rows: I64, num_threads: int) -> None:
        """Play to the first decision in ``rows``, whose episodes the engine has been handed.

        Raises:
            UsageError: the heuristic looks at forecasts, and a series has none.
        """
        if self.looks_ahead:
            for i in rows.tolist():
                self.engine.check_horizon(i, 1)

        def show(thread: int, part: slice) -> None:
            reset_rows(self.engine.address_for(thread), rows[part])

        self._in_threads(show, len(rows), num_threads)
        self._advance(rows, self._nothing[: len(rows)], num_threads, True)

    def begin_training(
        self,
        rows: I64,
        seeds: I64,
        numbers: I64,
        maintained: bool,
        num_threads: int,
        n_steps: int = MAX_STEPS,
    ) -> PlannedStarts:
        """Begin the training episodes ``numbers`` of ``seeds`` in ``rows`` and play to their first decisions.

        What is begun is what :func:`~rl2grid.scenarios.episodes.plan_episode` plans of the library of training years;
        it is completed after ``n_steps`` steps.

        Raises:
            UsageError: the data folder cannot be written, or has no room for the library; nothing has begun then.
        """
        library = training_library(self.engine.grid)
        draws = self.engine.draw_training(library, seeds, numbers)

        def show(thread: int, part: slice) -> None:
            own = Draws(*(column[part] for column in draws))
            self.engine.show_training(library, thread, rows[part], own, maintained, n_steps)

        self._in_threads(show, len(rows), num_threads)
        self._advance(rows, self._nothing[: len(rows)], num_threads, True)
        self.action_effects.update(dict.fromkeys(rows.tolist(), ""))
        return self.engine.take_training(library, rows, draws)

    def write_observations(self, rows: I64, shift: F32, scale: F32, out: F32) -> None:
        """Write the observations of ``rows``, shifted and scaled, to the same rows of ``out``, float32 [n, feature]."""
        topology, dispatch = changes_topology(self.kind), injects(self.kind)
        write_observations(self.engine.address, rows, topology, dispatch, shift, scale, out)

    def action_effects_of(self, commands: Commands) -> NDArray[np.object_]:
        """What became of the actions of all environments, object [n]: an empty text, or what ``str`` makes one of."""
        if not self.is_compiled:
            return np.array([self.action_effects[i] for i in range(len(commands))], object)
        effects = self._no_effects.copy()
        notes = self.engine.environments.notes
        (rows,) = notes.worth_a_word.nonzero()
        if len(rows):
            noted = NotedActions(self.engine.grid, commands, rows, notes_of(notes, rows))
            for k, i in enumerate(rows.tolist()):
                effects[i] = ActionEffect(noted, k)
        return effects

    def _advance(self, rows: I64, commands: Commands, num_threads: int, begins: bool) -> None:
        counter, order = np.zeros(1, np.int64), self._order(rows, commands)
        # Without a heuristic all are done after a step: a thread may take its share, whose topologies differ most.
        abreast = _ABREAST if self.heuristic else min(MOST_ABREAST, -(-len(rows) // _parts(len(rows), num_threads)))

        def advance_some(thread: int, _: slice) -> None:
            self._advance_some(thread, rows, order, counter, abreast, commands, begins)

        self._in_threads(advance_some, len(rows), num_threads)

    def _order(self, rows: I64, commands: Commands) -> I64:
        """In which to play ``rows``: those together that will have one topology."""
        keys = np.zeros(len(rows), np.int64)
        if len(rows) > 1:
            write_topology_keys(
                self.engine.address,
                rows,
                commands.first,
                commands.end,
                commands.kinds,
                commands.targets,
                commands.masks,
                keys,
            )
        return keys.argsort(kind="stable")

    def _in_threads(self, play: Callable[[int, slice], None], n_rows: int, num_threads: int) -> None:
        """Call ``play`` with the number of a thread and a part of ``n_rows`` rows, in as many threads as pay off."""
        parts = _parts(n_rows, num_threads)
        if parts == 1:
            play(0, slice(0, n_rows))
            return
        bounds = [n_rows * part // parts for part in range(parts + 1)]
        slices = [slice(first, last) for first, last in itertools.pairwise(bounds)]
        for thread in range(parts):  # made here: threads must not make room at the same time
            self._addresses(thread)
        self._threads.map(play, range(parts), slices)

    def _addresses(self, thread: int) -> tuple[int, int, int]:
        """The environments, where heuristics may try things, and what may be lost, for one thread."""
        address = self.engine.address_for(thread)
        # Where a heuristic does not look, any address will do.
        trial = self.engine.trial_address_for(thread) if self.looks_ahead else address
        return address, trial, self._security_address_for(thread) if self.heuristic == "secure" else address

    def _security_address_for(self, thread: int) -> int:
        while len(self._securities) <= thread:
            own = with_own_workspace(self.security)
            self._securities.append(Handle(own))
        return self._securities[thread].address

    def _advance_some(
        self, thread: int, rows: I64, order: I64, counter: I64, abreast: int, commands: Commands, begins: bool
    ) -> None:
        advance(
            *self._addresses(thread),
            rows,
            order,
            counter,
            abreast,
            begins,
            commands.first,
            commands.end,
            commands.kinds,
            commands.targets,
            commands.masks,
            commands.injects,
            commands.values,
            self._heuristic_code,
            self._reward_code or DEFAULT,
            self._weights,
            float(self.gamma),
        )


def _parts(n_rows: int, num_threads: int) -> int:
    """In how many threads rows are played."""
    return max(1, min(num_threads, n_rows // _ROWS_PER_THREAD))
