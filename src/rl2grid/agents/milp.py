"""Topology optimisation by a mixed-integer linear programme on the DC approximation (``docs/algorithms/milp.md``)."""

from __future__ import annotations

import time
from collections.abc import Set as AbstractSet
from typing import Any

import gymnasium
import numpy as np

from rl2grid.agents.agent import Action, Info, Observation, has_topology_actions, topology_action
from rl2grid.agents.dc_flow import DcPoint, buses, dc_flow, dc_point, is_connected
from rl2grid.agents.linear_programme import Affine, Programme
from rl2grid.arrays import F64, I32, Flags
from rl2grid.envs.outages_after_action import busbars_after
from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.handles import AsOpened
from rl2grid.mdp.actions import ActionCatalogue, ActionKind, full_catalogue, moved_elements
from rl2grid.mdp.heuristics import is_safe
from rl2grid.mdp.state import GridState
from rl2grid.powerflow.model import load_network

_NOTHING = 0
_WORTHWHILE = 1e-3
"""Least decrease of the worst loading for which an action is played, as for the greedy agent."""
_MEGAWATT = 0.01
"""Powers are in units of 100 MW inside the programme, so that its numbers are of one size."""
_ROOM = 1.0 + 1e-6
"""Factor on bounds that hold with equality at do nothing."""


class Milp:
    """While the grid is not safe, plays the action with the least worst loading of a DC power flow.

    One mixed-integer linear programme per decision chooses among the legal actions of the task. The choice is checked
    by AC power flow on the forecast (:meth:`PowerGridEnv.what_if`); one that is no better than doing nothing is ruled
    out and the programme solved again. On joint tasks it never injects.

    Args:
        node_limit: nodes of the branch-and-bound tree that the solver may visit per programme; the best choice found by
            then counts, the same on every machine.
        time_limit: seconds that the solver may take per decision: a safety net, since what it cuts short depends
            on the machine.
        attempts: choices that are checked per decision.

    Raises:
        UsageError: an argument is not positive.
    """

    name = "milp"
    kinds = ("T", "H")

    def __init__(self, node_limit: int = 100, time_limit: float = 60.0, attempts: int = 3) -> None:
        if node_limit < 1:
            raise UsageError(f"node_limit={node_limit!r} is not allowed: give at least 1.")
        if not time_limit > 0:
            raise UsageError(f"time_limit={time_limit!r} is not allowed: give a positive number of seconds.")
        if attempts < 1:
            raise UsageError(f"attempts={attempts!r} is not allowed: give at least 1.")
        self._node_limit, self._time_limit, self._attempts = node_limit, time_limit, attempts

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Look up the actions of the task and the electrical model of its grid.

        Raises:
            UsageError: the task has no topology actions.
        """
        if not has_topology_actions(env.action_space):
            raise UsageError(
                "Agent 'milp' cannot play a redispatching task (-R-), which has no topology actions: "
                "choose a topology task (-T0-, -T1-, ...) or the agent 'dc-opf'."
            )
        base: Any = env.unwrapped
        self._env, self._space = base, env.action_space
        self._opened: AsOpened[GridState] = AsOpened()
        self._grid: Grid = base.grid
        self._network = load_network(self._grid)
        self._catalogue = full_catalogue(self._grid).take(base.action_catalogue_ids)
        self.reset(0)

    def reset(self, i: int) -> None:
        """Forget to which busbars open lines return."""
        self._last_busbar = np.ones(self._grid.dim_topo, np.int32)

    def act(self, observation: Observation, info: Info) -> Action:
        """The best action that the AC check confirms; the one that changes nothing where there is none."""
        return topology_action(self._space, self._choose())

    def _choose(self) -> int:
        state = self._env.state
        on = state.topo_vect[0] > 0
        self._last_busbar[on] = state.topo_vect[0][on]
        if is_safe(self._opened(state), 0):
            return _NOTHING
        point = dc_point(state, 0, self._grid, self._network)
        allowed: Flags = self._env.action_masks()
        ruled_out: set[int] = set()
        deadline = time.monotonic() + self._time_limit
        for _ in range(self._attempts):
            left = deadline - time.monotonic()
            if left <= 0:
                return _NOTHING
            action = best_action(
                self._grid, point, self._catalogue, allowed, self._last_busbar, left, ruled_out, self._node_limit
            )
            if action == _NOTHING or self._helps(action):
                return action
            ruled_out.add(action)
        return _NOTHING

    def _helps(self, action: int) -> bool:
        """Whether the AC flow on the forecast is better than that of doing nothing."""
        outcomes = self._env.what_if([_NOTHING, action])
        return bool(outcomes.legal[1] and outcomes.worst_loading[1] < outcomes.worst_loading[0] - _WORTHWHILE)


def best_action(
    grid: Grid,
    point: DcPoint,
    catalogue: ActionCatalogue,
    allowed: Flags,
    last_busbar: I32,
    time_limit: float,
    ruled_out: AbstractSet[int] = frozenset(),
    node_limit: int | None = None,
) -> int:
    """The action after which the largest DC loading is least; 0 if none is better than doing nothing.

    The DC flow of a line is corrected by what the observed (AC) flow differs from the DC flow now, while it is closed.

    Args:
        grid: the grid.
        point: operating point; its grid must be connected.
        catalogue: the actions, of kinds NOTHING, MOVE and SWITCH; entry 0 does nothing.
        allowed: which of them may be played, bool [action].
        last_busbar: to which busbar the end of an open line returns, int32 [topo].
        time_limit: seconds for the solver.
        ruled_out: actions that may not be chosen.
        node_limit: nodes of the branch-and-bound tree per programme; None: any number.
    """
    deadline = time.monotonic() + time_limit
    excluded = set(ruled_out)
    while (left := deadline - time.monotonic()) > 0:
        topology = _Topology(grid, point, catalogue, allowed, last_busbar, excluded)
        values = topology.programme.solve(left, node_limit)
        action = _NOTHING if values is None else topology.chosen(values)
        if action == _NOTHING or is_connected(grid, busbars_after(grid, point.busbar, last_busbar, catalogue[action])):
            return action
        # Flow balance excludes islands, but for those that need no power, such as a line with dead ends only.
        excluded.add(action)
    return _NOTHING


class _Topology:
    """The programme of one decision, and what its columns stand for."""

    def __init__(
        self,
        grid: Grid,
        point: DcPoint,
        catalogue: ActionCatalogue,
        allowed: Flags,
        last_busbar: I32,
        excluded: AbstractSet[int],
    ) -> None:
        self.programme = Programme()
        self._grid, self._point, self._catalogue = grid, point, catalogue
        self._limit, self._susceptance = point.limit * _MEGAWATT, point.susceptance * _MEGAWATT
        self._correction = (point.flow - dc_flow(grid, point)) * _MEGAWATT
        loading = float(np.max(np.abs(point.flow) / point.limit))
        self._present_loading = loading
        self._worst = self.programme.column(0.0, loading * _ROOM, cost=1.0)
        # Doing nothing is a choice, so no better one has more on any line.
        self._most = loading * _ROOM * self._limit + np.abs(self._correction)
        self._widest = _widest_angle(self._most / self._susceptance, len(np.unique(buses(grid, point.busbar))))
        self._busbar = np.where(point.busbar > 0, point.busbar, last_busbar)
        self._single: dict[int, int] = {}  # action -> its binary
        self._moved: dict[int, int] = {}  # element -> 1 where it changes its busbar
        self._free_subs: dict[int, int] = {}  # substation with every move in the catalogue -> 1 where it changes
        self._switched: dict[int, int] = {}  # line -> 1 where it is switched
        self._add_choices(allowed, excluded)
        self._add_flows()

    def chosen(self, values: F64) -> int:
        """The action that a solution stands for; 0 if it is no better than doing nothing."""
        if not values[self._worst] < self._present_loading * (2.0 - _ROOM):
            return _NOTHING
        for action, column in self._single.items():
            if values[column] > 0.5:
                return action
        for sub, column in self._free_subs.items():
            if values[column] > 0.5:
                return self._move_of(sub, values)
        return _NOTHING

    def _move_of(self, sub: int, values: F64) -> int:
        first = int(self._grid.sub_first_element[sub])
        ends = range(first, first + int(self._grid.sub_info[sub]))
        mask = sum(1 << (e - first) for e in ends if e in self._moved and values[self._moved[e]] > 0.5)
        return self._catalogue.find(ActionKind.MOVE, sub, mask)

    # Which actions there are: at most one of them, and what each element does then.

    def _add_choices(self, allowed: Flags, excluded: AbstractSet[int]) -> None:
        catalogue = self._catalogue
        for action in np.flatnonzero(allowed & (catalogue.kind == ActionKind.SWITCH)).tolist():
            if action not in excluded:
                self._single[action] = self._switched[int(catalogue.target[action])] = self.programme.binary()
        moves = np.flatnonzero(allowed & (catalogue.kind == ActionKind.MOVE))
        for sub in np.unique(catalogue.target[moves]).tolist():
            of_sub = moves[catalogue.target[moves] == sub].tolist()
            if len(of_sub) == (1 << (int(self._grid.sub_info[sub]) - 1)) - 1:
                self._add_free_moves(sub, [action for action in of_sub if action in excluded])
            else:
                self._add_listed_moves([action for action in of_sub if action not in excluded])
        choices = [*self._single.values(), *self._free_subs.values()]
        self.programme.row(0.0, ((column, 1.0) for column in choices), 1.0)

    def _add_listed_moves(self, actions: list[int]) -> None:
        """One binary per action; an element is moved where an action with it is chosen."""
        by_element: dict[int, list[int]] = {}
        for action in actions:
            self._single[action] = self.programme.binary()
            for element in self._closed_elements(action):
                by_element.setdefault(element, []).append(self._single[action])
        for element, columns in by_element.items():
            moved = self._moved[element] = self.programme.column(0.0, 1.0)
            self.programme.row(0.0, ((moved, 1.0), *((column, -1.0) for column in columns)), 0.0)

    def _add_free_moves(self, sub: int, excluded: list[int]) -> None:
        """One binary per element; the first stays, since moving all others instead is the same."""
        changed = self._free_subs[sub] = self.programme.binary()
        first = int(self._grid.sub_first_element[sub])
        movable = [e for e in range(first + 1, first + int(self._grid.sub_info[sub])) if self._point.busbar[e] > 0]
        for element in movable:
            self._moved[element] = self.programme.binary()
            self.programme.at_most([(self._moved[element], 1.0)], Affine(0.0, {changed: 1.0}))
        self.programme.at_most([(changed, 1.0)], Affine(0.0, {self._moved[element]: 1.0 for element in movable}))
        for action in excluded:
            inside = set(self._closed_elements(action))
            signs = [(self._moved[element], 1.0 if element in inside else -1.0) for element in movable]
            self.programme.row(-np.inf, signs, len(inside) - 1.0)

    def _closed_elements(self, action: int) -> list[int]:
        """The elements that a move changes: those that are off stay off."""
        (change,) = self._catalogue[action].changes
        elements = moved_elements(self._grid, change.target, change.mask)
        return [int(element) for element in elements if self._point.busbar[element] > 0]

    def _on_second(self, element: int) -> Affine:
        """1 where an element is on busbar 2, 0 where it is on busbar 1."""
        second = float(self._busbar[element] == 2)
        if element not in self._moved:
            return Affine(second)
        return Affine(second, {self._moved[element]: 1.0 - 2.0 * second})

    # The DC flow of whatever is chosen.

    def _add_flows(self) -> None:
        grid, programme = self._grid, self.programme
        reference = int(grid.gen_to_subid[grid.slack_gen])
        angles = [programme.column(-self._widest, self._widest) for _ in range(2 * grid.n_sub)]
        programme.row(0.0, [(angles[reference], 1.0)], 0.0)
        self._angles = angles
        self._balance: list[list[tuple[int, float]]] = [[] for _ in angles]  # flow out of each bus
        self._into = [Affine() for _ in angles]
        for line in range(grid.n_line):
            self._add_line(line)
        for positions in (grid.gen_pos_topo_vect, grid.load_pos_topo_vect, grid.storage_pos_topo_vect):
            for element in positions.tolist():
                self._inject(element)
        for terms, into in zip(self._balance, self._into, strict=True):
            if terms or into.terms:
                programme.row(into.constant, (*terms, *into.times(-1.0).terms.items()), into.constant)
        self._keep_fed()

    def _add_line(self, line: int) -> None:
        closed = bool(self._point.busbar[self._grid.line_or_pos_topo_vect[line]] > 0)
        if not closed and line not in self._switched:
            return
        programme, most, slope = self.programme, float(self._most[line]), float(self._susceptance[line])
        flow = programme.column(-most, most)
        loading = Affine(0.0, {self._worst: float(self._limit[line])})
        origin = self._add_end(int(self._grid.line_or_pos_topo_vect[line]), flow, most, 1.0)
        extremity = self._add_end(int(self._grid.line_ex_pos_topo_vect[line]), flow, most, -1.0)
        law = [(flow, 1.0), (origin, -slope), (extremity, slope)]
        correction = float(self._correction[line])
        if line not in self._switched:
            programme.within([(flow, 1.0)], loading, -correction)
            programme.row(0.0, law, 0.0)
            return
        switched = Affine(0.0, {self._switched[line]: 1.0})
        in_service = switched.complement() if closed else switched
        corrected = [(flow, 1.0), *in_service.times(correction).terms.items()]
        programme.within(corrected, loading, -correction * in_service.constant)
        programme.within([(flow, 1.0)], in_service.times(most))
        programme.within(law, in_service.complement().times(slope * self._widest))

    def _add_end(self, element: int, flow: int, most: float, sign: float) -> int:
        """Count the flow of a line at the busbars of one end; the column of the angle there."""
        sub, second = int(self._grid.element_to_subid[element]), self._on_second(element)
        buses_here = sub, sub + self._grid.n_sub
        if element not in self._moved:
            bus = buses_here[int(second.constant)]
            self._balance[bus].append((flow, sign))
            return self._angles[bus]
        programme = self.programme
        on_first = second.complement()
        through_second = programme.column(-most, most)
        programme.within([(through_second, 1.0)], second.times(most))
        programme.within([(flow, 1.0), (through_second, -1.0)], on_first.times(most))
        self._balance[buses_here[0]] += [(flow, sign), (through_second, -sign)]
        self._balance[buses_here[1]].append((through_second, sign))
        angle = programme.column(-self._widest, self._widest)
        programme.within([(angle, 1.0), (self._angles[buses_here[0]], -1.0)], second.times(self._widest))
        programme.within([(angle, 1.0), (self._angles[buses_here[1]], -1.0)], on_first.times(self._widest))
        return angle

    def _inject(self, element: int) -> None:
        if self._point.busbar[element] < 0:
            return
        sub, second = int(self._grid.element_to_subid[element]), self._on_second(element)
        power = float(self._point.injection[element]) * _MEGAWATT
        for bus, here in ((sub, second.complement()), (sub + self._grid.n_sub, second)):
            self._into[bus] = self._into[bus].plus(here.times(power))

    def _keep_fed(self) -> None:
        """A busbar with a load, generator or storage unit keeps a closed line, even where none of them needs power."""
        grid = self._grid
        is_end = np.zeros(grid.dim_topo, np.bool_)
        is_end[grid.line_or_pos_topo_vect] = is_end[grid.line_ex_pos_topo_vect] = True
        for sub in np.unique(grid.element_to_subid[list(self._moved)]).tolist():
            present = (grid.element_to_subid == sub) & (self._point.busbar > 0)
            second = {int(element): self._on_second(int(element)) for element in np.flatnonzero(present)}
            ends = [second[int(element)] for element in np.flatnonzero(present & is_end)]
            for element in np.flatnonzero(present & ~is_end).tolist():
                self._ask_for_one(ends, second[element])
                self._ask_for_one([end.complement() for end in ends], second[element].complement())

    def _ask_for_one(self, ends: list[Affine], element: Affine) -> None:
        """Where ``element`` is 1, one of ``ends`` is."""
        spare = element.times(-1.0)
        for end in ends:
            spare = spare.plus(end)
        self.programme.row(-spare.constant, spare.terms.items(), np.inf)


def _widest_angle(differences: F64, n_bus: int) -> float:
    """A bound on the angle between two buses: a path between them has fewer lines than the grid has buses."""
    return float(np.sort(differences)[::-1][:n_bus].sum())
