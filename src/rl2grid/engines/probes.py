"""Policies that look for trouble: what the engines are compared on.

A probe reads the state of the engine that is believed and chooses what both engines play. Its choices
are a function of that state and of the random generator that it is given for the episode.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import one_of
from rl2grid.grids import Grid
from rl2grid.mdp.actions import (
    DO_NOTHING,
    ActionKind,
    Change,
    StepAction,
    continuous_layout,
    full_catalogue,
    inject,
    is_legal,
    move,
    one_change,
    reconnect,
    restore,
    switch,
)
from rl2grid.mdp.heuristics import is_safe, reconnect_action, recovery_action
from rl2grid.mdp.state import GridState

KINDS = ("topology", "continuous", "mixed", "joint")
"""What a probe plays: topology actions of one change, continuous actions, now one and now the other, or actions of
several changes and an injection."""

_MOVE = int(ActionKind.MOVE)
_SOON = 3
"""Steps before planned maintenance in which its line is worth touching."""
_LONGEST_BURST = 40
_CROSSING = 4
"""Line ends of a substation of which two may go to another busbar without cutting it off."""
_DISTURBANCE = 0.02


class Probe(Protocol):
    """Chooses the actions of one episode at a time."""

    def begin(self, random: np.random.Generator) -> None:
        """Begin an episode, all of whose choices are drawn from ``random``."""

    def choose(self, state: GridState, i: int) -> StepAction:
        """The next action in row ``i`` of ``state``."""


class RandomTopology:
    """Legal topology actions, as often in small substations as in large ones; some episodes busy, some calm."""

    def __init__(self, grid: Grid) -> None:
        self._grid = grid
        catalogue = full_catalogue(grid)
        moves = catalogue.kind == _MOVE
        self._subs = np.unique(catalogue.target[moves])
        self._first = np.searchsorted(catalogue.target[moves], self._subs) + 1  # do nothing comes first
        self._past = np.searchsorted(catalogue.target[moves], self._subs, side="right") + 1
        self._catalogue = catalogue

    def begin(self, random: np.random.Generator) -> None:
        """Decide how busy the episode is."""
        self._random, self._share = random, float(random.choice([0.03, 0.3, 1.0]))

    def choose(self, state: GridState, i: int) -> StepAction:
        """A legal action, or nothing."""
        if self._random.random() >= self._share:
            return DO_NOTHING
        action = self._any_action()
        return action if _is_legal(state, i, action) else DO_NOTHING

    def _any_action(self) -> StepAction:
        if self._random.random() < 0.3:
            return switch(int(self._random.integers(self._grid.n_line)))
        k = int(self._random.integers(len(self._subs)))
        return self._catalogue[int(self._random.integers(self._first[k], self._past[k]))]


class AdversarialTopology:
    """Whatever the rules, the protections and the opponent make difficult, until the grid collapses."""

    def __init__(self, grid: Grid) -> None:
        self._grid = grid
        self._ends = np.stack((grid.line_or_to_subid, grid.line_ex_to_subid))
        self._positions = np.stack((grid.line_or_pos_topo_vect, grid.line_ex_pos_topo_vect))
        self._tricks: tuple[Callable[[GridState, int], StepAction], ...] = (
            self._switch_any_line,
            self._split_any_substation,
            self._break_a_line_cooldown,
            self._break_a_substation_cooldown,
            self._touch_a_line_before_maintenance,
            self._close_an_open_line,
            self._close_a_closed_line,
            self._move_an_open_end,
            self._restore_any_substation,
            self._restore_a_split_substation,
        )

    def begin(self, random: np.random.Generator) -> None:
        """Decide how much of the episode is left in peace."""
        self._random, self._peace = random, float(random.choice([0.0, 0.5, 0.9, 0.97]))

    def choose(self, state: GridState, i: int) -> StepAction:
        """One of the tricks that the state allows, or nothing."""
        if self._random.random() < self._peace:
            return DO_NOTHING
        for k in self._random.permutation(len(self._tricks)).tolist():
            action: StepAction = self._tricks[k](state, i)
            if action is not DO_NOTHING:
                return action
        return DO_NOTHING

    def _switch_any_line(self, state: GridState, i: int) -> StepAction:
        return switch(int(self._random.integers(self._grid.n_line)))

    def _split_any_substation(self, state: GridState, i: int) -> StepAction:
        return self._split(int(self._random.integers(self._grid.n_sub)), 0)

    def _split(self, sub: int, at_least: int) -> StepAction:
        """Move any elements of a substation, those of the mask ``at_least`` among them."""
        mask = int(self._random.integers(1, 1 << int(self._grid.sub_info[sub])))
        return move(sub, mask | at_least)

    def _break_a_line_cooldown(self, state: GridState, i: int) -> StepAction:
        line = self._one_of(state.time_before_cooldown_line[i] > 0)
        return DO_NOTHING if line < 0 else self._switch_or_reconnect(line)

    def _break_a_substation_cooldown(self, state: GridState, i: int) -> StepAction:
        sub = self._one_of(state.time_before_cooldown_sub[i] > 0)
        if sub < 0:
            return DO_NOTHING
        return restore(sub) if self._random.random() < 0.5 else self._split(sub, 0)

    def _touch_a_line_before_maintenance(self, state: GridState, i: int) -> StepAction:
        soon = state.time_next_maintenance[i]
        line = self._one_of((soon >= 0) & (soon <= _SOON))
        return DO_NOTHING if line < 0 else self._switch_or_reconnect(line)

    def _close_an_open_line(self, state: GridState, i: int) -> StepAction:
        line = self._one_of(~state.line_status[i])
        return DO_NOTHING if line < 0 else self._switch_or_reconnect(line)

    def _close_a_closed_line(self, state: GridState, i: int) -> StepAction:
        line = self._one_of(state.line_status[i])
        return DO_NOTHING if line < 0 else reconnect(line)

    def _move_an_open_end(self, state: GridState, i: int) -> StepAction:
        line = self._one_of(~state.line_status[i])
        if line < 0:
            return DO_NOTHING
        end = int(self._random.integers(2))
        sub = int(self._ends[end, line])
        element = int(self._positions[end, line] - self._grid.sub_first_element[sub])
        return self._split(sub, 1 << element)

    def _restore_any_substation(self, state: GridState, i: int) -> StepAction:
        return restore(int(self._random.integers(self._grid.n_sub)))

    def _restore_a_split_substation(self, state: GridState, i: int) -> StepAction:
        element = self._one_of(state.topo_vect[i] == 2)
        return DO_NOTHING if element < 0 else restore(int(state.element_to_subid[element]))

    def _switch_or_reconnect(self, line: int) -> StepAction:
        return switch(line) if self._random.random() < 0.5 else reconnect(line)

    def _one_of(self, candidates: NDArray[np.bool_]) -> int:
        """A random position at which ``candidates`` holds; -1 if there is none."""
        positions = np.flatnonzero(candidates)
        return int(positions[self._random.integers(len(positions))]) if len(positions) else -1


class MovedLines:
    """Two lines of a substation are moved, one of them is opened, closed, and moved back: busbars must be remembered.

    The busbar that they are moved to carries nothing else, which the grid mostly survives.
    """

    def __init__(self, grid: Grid) -> None:
        self._ends = np.stack((grid.line_or_to_subid, grid.line_ex_to_subid))
        self._positions = np.stack((grid.line_or_pos_topo_vect, grid.line_ex_pos_topo_vect))
        self._first = grid.sub_first_element
        line_ends = np.bincount(self._ends.ravel(), minlength=grid.n_sub)
        self._crossings = np.flatnonzero(line_ends >= _CROSSING)

    def begin(self, random: np.random.Generator) -> None:
        """Begin with the first move."""
        self._random, self._plan = random, list[StepAction]()

    def choose(self, state: GridState, i: int) -> StepAction:
        """The next action of the plan as soon as it is legal; nothing until then."""
        if not self._plan:
            self._plan = self._moves_and_back()
        if not _is_legal(state, i, self._plan[0]):
            return DO_NOTHING
        return self._plan.pop(0)

    def _moves_and_back(self) -> list[StepAction]:
        random = self._random
        sub = int(random.choice(self._crossings))
        end, line = np.nonzero(self._ends == sub)
        two = random.choice(len(line), 2, replace=False)
        mask = sum(1 << int(element - self._first[sub]) for element in self._positions[end[two], line[two]])
        opened, close = int(line[two[0]]), (switch, reconnect)[int(random.integers(2))]
        return [move(sub, mask), switch(opened), close(opened), restore(sub)]


class RandomContinuous:
    """Continuous actions of moderate size in random entries; some episodes busy, some calm."""

    def __init__(self, grid: Grid) -> None:
        self._size = continuous_layout(grid).size

    def begin(self, random: np.random.Generator) -> None:
        """Decide how busy the episode is, and how large its actions are."""
        self._random = random
        self._share, self._scale = float(random.choice([0.1, 0.5, 1.0])), float(random.choice([0.02, 0.1, 0.4]))

    def choose(self, state: GridState, i: int) -> StepAction:
        """A random continuous action, or nothing."""
        if self._random.random() >= self._share:
            return DO_NOTHING
        values = self._scale * self._random.uniform(-1.0, 1.0, self._size)
        values[self._random.random(self._size) < self._random.random()] = 0.0
        return inject(values.astype(np.float32))


class AdversarialContinuous:
    """Bursts of extreme continuous actions, until targets or balance are out of reach."""

    def __init__(self, grid: Grid) -> None:
        layout = continuous_layout(grid)
        self._size = layout.size
        parts = np.split(np.arange(layout.size), np.cumsum([len(layout.redispatch), len(layout.curtail)]))
        self._redispatch, self._curtail, self._storage = parts

    def begin(self, random: np.random.Generator) -> None:
        """Begin with a burst."""
        self._random, self._left = random, 0
        self._peace = float(random.choice([0.0, 0.5, 0.9]))

    def choose(self, state: GridState, i: int) -> StepAction:
        """The burst's action; nothing in some of its steps."""
        if self._left == 0:
            self._left = int(self._random.integers(1, _LONGEST_BURST))
            self._values = self._burst()
        self._left -= 1
        if self._random.random() < self._peace:
            return DO_NOTHING
        if self._random.random() < 0.1:
            self._values = -self._values
        return inject(self._values)

    def _burst(self) -> NDArray[np.float32]:
        random, values = self._random, np.zeros(self._size, np.float32)
        pattern = int(random.integers(8))
        if pattern == 0:  # every limit is lifted again
            return values
        if pattern == 1:
            values[:] = random.choice([-1.0, 1.0])
        elif pattern == 2:
            values[:] = random.choice([-1.0, 1.0], self._size)
        elif pattern == 3:
            values[random.integers(self._size)] = random.choice([-1.0, 1.0])
        elif pattern == 4:
            values[self._curtail] = -1.0
        elif pattern == 5:
            values[self._storage] = random.choice([-1.0, 1.0])
        elif pattern == 6:
            values[self._redispatch] = random.choice([-1.0, 0.0, 1.0], len(self._redispatch))
        else:
            values[:] = random.uniform(-1.0, 1.0, self._size)
        return values


class Recovering:
    """The recovery heuristic while the grid is safe; another probe when it is not, and now and then."""

    def __init__(self, kind: str, disturbance: Probe) -> None:
        self._decide: Any = recovery_action if kind == "topology" else reconnect_action
        self._disturbance = disturbance

    def begin(self, random: np.random.Generator) -> None:
        """Begin the other probe's episode."""
        self._random = random
        self._disturbance.begin(random)

    def choose(self, state: GridState, i: int) -> StepAction:
        """The heuristic's or the other probe's action."""
        if not is_safe(state, i) or self._random.random() < _DISTURBANCE:
            return self._disturbance.choose(state, i)
        kind, target = self._decide(state, i)
        return one_change(int(kind), int(target))


class Seldom:
    """Another probe's actions, one in a hundred steps: long episodes, with all that happens in them."""

    def __init__(self, probe: Probe) -> None:
        self._probe = probe

    def begin(self, random: np.random.Generator) -> None:
        """Begin the other probe's episode."""
        self._random = random
        self._probe.begin(random)

    def choose(self, state: GridState, i: int) -> StepAction:
        """Nothing, nearly always."""
        return self._probe.choose(state, i) if self._random.random() < 0.01 else DO_NOTHING


class Mixed:
    """Topology actions and continuous ones in one episode, which no task has."""

    def __init__(self, topology: Probe, continuous: Probe) -> None:
        self._probes = (topology, continuous)

    def begin(self, random: np.random.Generator) -> None:
        """Begin an episode of both."""
        self._random = random
        for probe in self._probes:
            probe.begin(random)

    def choose(self, state: GridState, i: int) -> StepAction:
        """The action of one of the two."""
        return self._probes[int(self._random.integers(2))].choose(state, i)


class JointWithinLimits:
    """Several changes, as many as the rules allow and now and then one more, often with an injection."""

    def __init__(self, grid: Grid) -> None:
        self._grid, self._injections = grid, RandomContinuous(grid)
        self._line_area = grid.sub_area[grid.line_or_to_subid]
        self._areas = np.unique(grid.sub_area)

    def begin(self, random: np.random.Generator) -> None:
        """Decide how busy the episode is."""
        self._random, self._share = random, float(random.choice([0.05, 0.3, 1.0]))
        self._injections.begin(random)

    def choose(self, state: GridState, i: int) -> StepAction:
        """Changes of different lines and substations, most of them allowed, and perhaps an injection."""
        if self._random.random() >= self._share:
            return DO_NOTHING
        actions = [self._injections.choose(state, i)]
        for area in self._areas.tolist():
            if self._random.random() < 0.6:
                actions.append(self._change_of_line(state, i, area))
            if self._random.random() < 0.6:
                actions.append(self._change_of_substation(state, i, area))
        if self._random.random() < 0.1:
            area = int(self._random.choice(self._areas))
            actions.append(self._change_of_line(state, i, area))
            actions.append(self._change_of_substation(state, i, area))
        return _together(actions)

    def _change_of_line(self, state: GridState, i: int, area: int) -> StepAction:
        lines = np.flatnonzero(self._line_area == area)
        free = lines[state.time_before_cooldown_line[i, lines] == 0]
        closed = ~state.line_status[i, free]
        if closed.any():
            line = int(self._random.choice(free[closed]))
            return switch(line) if self._random.random() < 0.5 else reconnect(line)
        line = int(self._random.choice(free if len(free) and self._random.random() < 0.95 else lines))
        return switch(line)

    def _change_of_substation(self, state: GridState, i: int, area: int) -> StepAction:
        subs = np.flatnonzero(self._grid.sub_area == area)
        free = subs[state.time_before_cooldown_sub[i, subs] == 0]
        sub = int(self._random.choice(free if len(free) and self._random.random() < 0.95 else subs))
        first, n_elements = int(self._grid.sub_first_element[sub]), int(self._grid.sub_info[sub])
        divided = (state.topo_vect[i, first : first + n_elements] == 2).any()
        if divided and self._random.random() < 0.8:
            return restore(sub)
        moved = self._random.choice(n_elements, min(n_elements, int(self._random.integers(1, 4))), replace=False)
        return move(sub, sum(1 << int(k) for k in moved))


class AdversarialJoint:
    """Several tricks at once, and those that only an action of several changes can play."""

    def __init__(self, grid: Grid) -> None:
        self._grid, self._tricks, self._bursts = grid, AdversarialTopology(grid), AdversarialContinuous(grid)
        self._ends = np.stack((grid.line_or_to_subid, grid.line_ex_to_subid))
        self._positions = np.stack((grid.line_or_pos_topo_vect, grid.line_ex_pos_topo_vect))

    def begin(self, random: np.random.Generator) -> None:
        """Decide how much of the episode is left in peace."""
        self._random, self._peace = random, float(random.choice([0.0, 0.5, 0.9]))
        self._tricks.begin(random)
        self._bursts.begin(random)

    def choose(self, state: GridState, i: int) -> StepAction:
        """Up to five changes and an injection."""
        random = self._random
        if random.random() < self._peace:
            return DO_NOTHING
        actions = [self._line_with_its_ends(state, i)] if random.random() < 0.6 else []
        for _ in range(int(random.choice(5, p=[0.4, 0.3, 0.15, 0.1, 0.05]))):
            actions.append(self._tricks.choose(state, i))
        if random.random() < 0.4:
            actions.append(self._bursts.choose(state, i))
        return _together(actions)

    def _line_with_its_ends(self, state: GridState, i: int) -> StepAction:
        """A line switched or reconnected, and its ends moved or their substations restored in the same action."""
        random, line = self._random, int(self._random.integers(self._grid.n_line))
        wanted = np.flatnonzero(~state.line_status[i])
        on_second = np.flatnonzero((state.topo_vect[i, self._positions] == 2).any(axis=0))
        for lines in (wanted, on_second):
            if len(lines) and random.random() < 0.5:
                line = int(random.choice(lines))
        actions = [switch(line) if random.random() < 0.6 else reconnect(line)]
        for end in np.flatnonzero(random.random(2) < 0.6).tolist():
            sub = int(self._ends[end, line])
            own = 1 << int(self._positions[end, line] - self._grid.sub_first_element[sub])
            others = int(random.integers(1 << int(self._grid.sub_info[sub]))) if random.random() < 0.4 else 0
            actions.append(restore(sub) if random.random() < 0.4 else move(sub, own | others))
        return _together(actions)


def _together(actions: list[StepAction]) -> StepAction:
    """The actions as one; of changes of the same line or substation, and of injections, the first."""
    changes: dict[tuple[bool, int], Change] = {}
    for change in (change for action in actions for change in action.changes):
        changes.setdefault((change.is_of_line, change.target), change)
    values = next((action.values for action in actions if action.values is not None), None)
    return StepAction(tuple(changes.values()), values)


def _is_legal(state: GridState, i: int, action: StepAction) -> bool:
    """Whether the rules let environment ``i`` play each of the changes alone."""
    return all(is_legal(state, i, change.kind, change.target) for change in action.changes)


PROBES: dict[str, dict[str, Callable[[Grid], Probe]]] = {
    "topology": {
        "random": RandomTopology,
        "adversarial": AdversarialTopology,
        "moved lines": MovedLines,
        "recovery": lambda grid: Recovering("topology", RandomTopology(grid)),
        "idle": lambda grid: Seldom(RandomTopology(grid)),
    },
    "continuous": {
        "random": RandomContinuous,
        "adversarial": AdversarialContinuous,
        "recovery": lambda grid: Recovering("continuous", RandomContinuous(grid)),
        "idle": lambda grid: Seldom(AdversarialContinuous(grid)),
    },
    "mixed": {
        "moved lines": lambda grid: Mixed(MovedLines(grid), RandomContinuous(grid)),
        "random": lambda grid: Mixed(RandomTopology(grid), RandomContinuous(grid)),
        "adversarial": lambda grid: Mixed(AdversarialTopology(grid), AdversarialContinuous(grid)),
    },
    "joint": {
        "within limits": JointWithinLimits,
        "adversarial": AdversarialJoint,
    },
}
"""Probes by what they play and by name."""


def make_probe(grid: Grid, kind: str, name: str) -> Probe:
    """The probe ``name`` of :data:`PROBES`.

    Raises:
        UsageError: there is no such probe.
    """
    if kind not in PROBES:
        raise one_of("Kind of probe", kind, KINDS)
    if name not in PROBES[kind]:
        raise one_of(f"Probe of kind {kind}", name, tuple(PROBES[kind]))
    return PROBES[kind][name](grid)
