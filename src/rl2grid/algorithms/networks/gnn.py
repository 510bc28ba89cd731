"""Messages over the grid: lines tell each other what they are through the busbars that they share, and an action is
scored by the state of what it changes.

Every line l, generator, load and storage unit u is read by a layer of its kind into `width` numbers, r_l and r_u; what
is learned of each line is added. With B the busbars of a line's two ends, in every round

    h_b = (sum over lines k at busbar b of e_k + sum over units u at b of r_u) / sqrt(lines at the substation)
    e_l <- relu(W e_l + V sum over b in B of h_b + r_l)

begins with e_l = relu(r_l). A line that is out of service hears nobody
and is not heard. The state c is a layer over the mean and the largest of all lines and the mean of all units. Action a,
which changes a place p and moves elements i to the other busbar, is worth

    score(s, a) = w . relu(z_p + sum over i of m_i (1 - 2 [i on busbar 2]) + D c + k_kind),

z_p and m_i layers of the states of places and elements (of a substation: what its two busbars hold): moving back is the
opposite of moving there. The dimensions of a continuous action are scored in the same way by the states of their
generators and storage units. The weights are as many for 66,978 actions as for 50, and grow with a grid only by what is
learned of its substations and lines.

All arrays are [element, width, batch]: what leads along lines then moves whole rows. The steps that do have derivatives
written by hand, in :mod:`rl2grid.algorithms.networks.graph_functions`.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from rl2grid.algorithms.networks import Network, Request
from rl2grid.algorithms.networks.action_table import (
    CONTROLS,
    KINDS,
    ActionTable,
    Places,
    action_table,
    first_table,
)
from rl2grid.algorithms.networks.constants import URGENT_STEPS, keep, urgency
from rl2grid.algorithms.networks.graph_functions import (
    Busbars,
    Incidence,
    Injected,
    Layers,
    OnBusbars,
    Pooled,
    Read,
    Rounds,
    RowSums,
    Scores,
    applied,
)
from rl2grid.arrays import I32
from rl2grid.envs.spec import Spec
from rl2grid.envs.tasks import find_task
from rl2grid.mdp.features import operator_line_features, physical_scale

_STRESSED = 0.9
"""Loading from which a line's loading counts once more, five times as much."""
_SHARE, _LEAST_WIDTH = 16, 8
"""A hidden layer of n numbers stands for a round of messages of n / 16 numbers."""


class _Elements(NamedTuple):
    """What is known of the grid's elements, each [element, feature, batch], and where they are."""

    line: Tensor
    gen: Tensor
    load: Tensor
    storage: Tensor
    cooldown: Tensor
    """[substation, 1, batch]"""
    second: Tensor
    """[element, batch] 1 where on busbar 2; in the order of :mod:`rl2grid.algorithms.networks.action_table`"""
    in_service: Tensor
    """[line, 1, batch]"""
    time: Tensor
    """[entry, batch] the share of the episode that is over, and the calendar where it is observed"""


class Features(nn.Module):
    """Takes the flat observation apart, and the continuous action that may follow it."""

    def __init__(self, spec: Spec, *, reads_action: bool) -> None:
        super().__init__()
        assert spec.grid is not None
        assert spec.task is not None
        grid = self.grid = spec.grid
        self.slices = {feature.name: slice(feature.begin, feature.end) for feature in spec.features}
        self.lengths = [feature.end - feature.begin for feature in spec.features]
        self.observed = spec.observation_size
        self.is_physical = spec.normalize == "physical"
        self.has_topology = "topo_vect" in self.slices
        of_gens = [feature.name for feature in spec.features if feature.of == "gen"]
        self.dispatch = [name for name in of_gens if name not in ("gen_p", "gen_theta")]
        self.of_lines = operator_line_features(spec.operator_features)
        self.times = [feature.name for feature in spec.features if feature.of == "time"]
        self.of_storage = [feature.name for feature in spec.features if feature.of == "storage"]
        self.reads_action = reads_action
        shift, scale = physical_scale(grid, find_task(spec.task).kind, spec.operator_features)
        ends = (grid.line_or_pos_topo_vect, grid.line_ex_pos_topo_vect)
        others = (grid.gen_pos_topo_vect, grid.load_pos_topo_vect, grid.storage_pos_topo_vect)
        largest = float(grid.gen_pmax.max())
        kept = {
            "shift": torch.tensor(shift),
            "scale": torch.tensor(scale),
            "order": torch.cat([ids(each) for each in (*ends, *others)]),
            "gen_size": torch.tensor(grid.gen_pmax / largest, dtype=torch.float32).unsqueeze(-1),
            "load_size": torch.tensor(scale[self.slices["load_p"]] / largest).unsqueeze(-1),
            "renewable": torch.tensor(grid.gen_renewable, dtype=torch.float32).unsqueeze(-1),
        }
        keep(self, **kept)
        controls = _controls(spec) if reads_action else ()
        for kind, (entries, units) in enumerate(controls):
            self.register_buffer(f"entries_{kind}", entries, persistent=False)
            self.register_buffer(f"units_{kind}", units, persistent=False)
        self.n_topology = min((int(entries[0]) for entries, _ in controls if len(entries)), default=0)
        """Topology entries of the action that is read, which come first."""

    shift: Tensor
    scale: Tensor
    order: Tensor
    gen_size: Tensor
    load_size: Tensor
    renewable: Tensor

    def sizes(self) -> tuple[int, int, int, int]:
        """Features of a line, a generator, a load and a storage unit."""
        gen = 4 + len(self.dispatch) + (2 if self.reads_action else 0)
        return 9 + len(self.of_lines), gen, 3, len(self.of_storage) + int(self.reads_action)

    def forward(self, inputs: Tensor) -> _Elements:
        """Observations [batch, observation_size], each followed by its action where one is read."""
        observations = inputs[:, : self.observed]
        if not self.is_physical:
            observations = (observations - self.shift) / self.scale
        rows = observations.T.contiguous()
        part = dict(zip(self.slices, torch.split(rows, self.lengths), strict=True))
        second, in_service = self._topology(part)
        cooldown = part.get("time_before_cooldown_sub", rows.new_zeros(self.grid.n_sub, rows.shape[1]))
        return _Elements(
            line=self._lines(part, in_service, second),
            gen=self._gens(part, inputs),
            load=torch.stack([part["load_p"], part["load_p"] * self.load_size, part["load_theta"]], dim=1),
            storage=self._storages(part, inputs) if self.grid.n_storage else rows.new_zeros(0, 0, 0),
            cooldown=cooldown.unsqueeze(1),
            second=second,
            in_service=in_service.unsqueeze(1),
            time=torch.cat([part[name] for name in self.times]) if len(self.times) > 1 else part["t"],
        )

    def _topology(self, part: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Which elements are on busbar 2, and which lines in service; each [element, batch], 0 or 1."""
        rho, n_line = part["rho"], self.grid.n_line
        if not self.has_topology:
            return rho.new_zeros(len(self.order), rho.shape[1]), (rho > 0).to(rho.dtype)
        topology = part["topo_vect"].index_select(0, self.order)
        in_service = torch.minimum(topology[:n_line], topology[n_line : 2 * n_line]).gt_(-0.5)
        return topology.clone().gt_(0.5), in_service

    def _lines(self, part: dict[str, Tensor], in_service: Tensor, second: Tensor) -> Tensor:
        rho, n_line = part["rho"], self.grid.n_line
        steps = part["time_next_maintenance"] * self.scale[self.slices["time_next_maintenance"]].unsqueeze(-1)
        announced = urgency(steps / URGENT_STEPS)
        columns = [
            rho,
            (rho - _STRESSED).clamp(min=0.0) * 5.0,
            in_service,
            part.get("timestep_overflow", torch.zeros_like(rho)),
            part["time_before_cooldown_line"],
            announced,
            announced * part["duration_next_maintenance"],
            second[:n_line],
            second[n_line : 2 * n_line],
            *(part[name] for name in self.of_lines),
        ]
        return torch.stack(columns, dim=1)

    def _gens(self, part: dict[str, Tensor], inputs: Tensor) -> Tensor:
        gen_p = part["gen_p"]
        columns = [gen_p, gen_p * self.gen_size, part["gen_theta"], self.renewable.expand_as(gen_p)]
        columns += [part[name] for name in self.dispatch]
        columns += [self._entries(inputs, kind, gen_p) for kind in (0, 1)] if self.reads_action else []
        return torch.stack(columns, dim=1)

    def _storages(self, part: dict[str, Tensor], inputs: Tensor) -> Tensor:
        columns = [part[name] for name in self.of_storage]
        columns += [self._entries(inputs, 2, columns[0])] if self.reads_action else []
        return torch.stack(columns, dim=1)

    def _entries(self, inputs: Tensor, kind: int, like: Tensor) -> Tensor:
        """What the action that is read asks of every generator or storage unit [unit, batch]."""
        asked = inputs[:, self.observed :].T.index_select(0, self.get_buffer(f"entries_{kind}"))
        return torch.zeros_like(like).index_copy(0, self.get_buffer(f"units_{kind}"), asked)


class Messages(nn.Module):
    """The states of lines and busbars after some rounds of messages."""

    def __init__(self, request: Request, features: Features, width: int, rounds: int) -> None:
        super().__init__()
        grid, sizes = features.grid, features.sizes()
        ends = torch.cat([ids(grid.line_or_to_subid), ids(grid.line_ex_to_subid)])
        units = torch.cat([ids(each) for each in (grid.gen_to_subid, grid.load_to_subid, grid.storage_to_subid)])
        degree = torch.bincount(ends, minlength=grid.n_sub).clamp(min=1).to(torch.float32)
        self.register_buffer("subs", torch.cat([ends, units]), persistent=False)
        self.of_ends = Incidence(ends, torch.arange(grid.n_line).repeat(2), grid.n_sub, degree.rsqrt())
        self.of_units = Incidence(units, torch.arange(len(units)), grid.n_sub, torch.ones(grid.n_sub))
        self.read_line, self.read_gen, self.read_load = (_Layer(request, size, width) for size in sizes[:3])
        self.read_storage = _Layer(request, sizes[3], width) if grid.n_storage else None
        self.of_line = nn.Parameter(first_table(grid.n_line, width, request))
        self.to_self = nn.ModuleList(_Layer(request, width, width) for _ in range(rounds))
        self.to_others = nn.ModuleList(_Layer(request, width, width) for _ in range(rounds))

    subs: Tensor

    def forward(self, elements: _Elements) -> _States:
        """The states of everything."""
        kinds = [(self.read_line, elements.line), (self.read_gen, elements.gen), (self.read_load, elements.load)]
        if self.read_storage is not None:
            kinds.append((self.read_storage, elements.storage))
        read, units = applied(
            Read, self.of_line, *itertools.chain(*((features, layer.weight, layer.bias) for layer, features in kinds))
        )
        of_ends, of_units = self._on_busbars(elements.second)
        injected = applied(Injected, units, of_units)
        rounds = list(itertools.chain(*zip(self.to_self, self.to_others, strict=True)))
        lines = applied(
            Rounds,
            read,
            *injected,
            elements.in_service,
            of_ends,
            *(layer.weight for layer in rounds),
            *(layer.bias for layer in rounds),
        )
        return _States(lines, units, injected, of_ends, elements)

    def _on_busbars(self, second: Tensor) -> tuple[OnBusbars, OnBusbars]:
        """Where lines' ends and where units are."""
        moved = second.sum(dim=1).nonzero().squeeze(-1)
        divided, beside = torch.unique(self.subs.index_select(0, moved), return_inverse=True)
        n_ends, shown = len(self.of_ends.subs), second.index_select(0, moved).unsqueeze(1)
        n = int((moved < n_ends).sum())
        return (
            OnBusbars(self.of_ends, moved[:n], beside[:n], shown[:n], divided),
            OnBusbars(self.of_units, moved[n:] - n_ends, beside[n:], shown[n:], divided),
        )

    def busbars(self, states: _States) -> Tensor:
        """Busbars 1 and 2 of every substation, and its cooldown: [substation, 2 width + 1, batch]."""
        elements = states.elements
        busbars: Tensor = applied(
            Busbars, states.lines, *states.injected, elements.in_service, elements.cooldown, states.ends
        )
        return busbars


class _States(NamedTuple):
    """The states after all rounds, each [element, width, batch]."""

    lines: Tensor
    units: Tensor
    """generators, loads and storage units"""
    injected: tuple[Tensor, Tensor]
    """what the units at each busbar hold together"""
    ends: OnBusbars
    elements: _Elements


class GraphNetwork(nn.Module):
    """The numbers asked for of observations; see the equations of the module."""

    def __init__(self, request: Request) -> None:
        super().__init__()
        spec, output = request.spec, request.output
        width = max(min(request.layers, default=0) // _SHARE, _LEAST_WIDTH)
        self.output = output
        self.features = Features(spec, reads_action=output.reads_action)
        self.messages = Messages(request, self.features, width, max(len(request.layers), 1))
        self.state = _Layer(request, 3 * width + len(self.features.times), 4 * width)
        self.of_state = _Layer(request, 4 * width, output.per_state, last=True) if output.per_state else None
        self.chosen = _Chosen(request, width, self.features.n_topology) if self.features.n_topology else None
        self.scores = _Scores(request, width) if output.per_action else None

    def forward(self, inputs: Tensor) -> Tensor:
        """Numbers [batch, inputs] -> [batch, width]."""
        elements = self.features(inputs)
        states = self.messages(elements)
        hidden = self.state(torch.cat([applied(Pooled, states.lines, states.units), elements.time]))
        if self.chosen is not None:
            first = self.features.observed
            entries = inputs[:, first : first + self.features.n_topology]
            hidden = hidden + self.chosen(entries, self.messages.busbars(states), states.lines)
        context = hidden.relu()
        numbers = [] if self.of_state is None else [self.of_state(context).T]
        if self.scores is not None:
            numbers.append(self.scores(context, self.messages.busbars(states), states))
        return numbers[0] if len(numbers) == 1 else torch.cat(numbers, dim=-1)


class _Scores(nn.Module):
    """The numbers of every action."""

    def __init__(self, request: Request, width: int) -> None:
        super().__init__()
        assert request.spec.grid is not None
        grid, table = request.spec.grid, action_table(request.spec)
        self.n_sub = grid.n_sub
        counts = (grid.n_line, grid.n_line, grid.n_gen, grid.n_load, grid.n_storage)
        self._keep(table, Places.of(grid), counts)

        def layer(inputs: int, outputs: int, *, last: bool = False) -> _Layer:
            return _Layer(request, inputs, outputs, last=last)

        self.of_kind, self.of_context = layer(len(KINDS), width), layer(4 * width, width)
        topology = request.spec.task is not None and find_task(request.spec.task).changes_topology
        if topology:
            self.of_sub, self.of_line = layer(2 * width, width), layer(width, width)
            self.of_cooldown = layer(1, width)
            self.of_place = nn.Parameter(first_table(grid.n_sub + grid.n_line, width, request))
        # Of every kind of element that the grid has, whatever this task's actions move.
        self.moves = nn.ModuleDict({str(k): layer(width, width) for k, n in enumerate(counts) if topology and n})
        if "of_unit" in self.layers:
            self.of_unit = layer(width, width)
        self.of_action = layer(width, request.output.per_action, last=True)
        self.do_nothing = nn.Parameter(torch.tensor(request.first_action or 0.0))

    def _keep(self, table: ActionTable, places: Places, counts: tuple[int, ...]) -> None:
        """What of the table is needed: of places, kinds and elements only those that some action is about."""
        kinds, where, elements, offsets = table.tensors()
        n_gen, n_load = counts[2:4]
        at, place_of_action = torch.unique(where, return_inverse=True)
        moved, moved_of_action = torch.unique(elements, return_inverse=True)
        some_kinds, kind_of_action = torch.unique(kinds, dim=0, return_inverse=True)
        n_kinds, n_places, n_ends = len(some_kinds), int((at < places.nowhere).sum()), 2 * counts[0]
        subs, lines = at[at < places.lines], at[(at >= places.lines) & (at < places.gens)] - places.lines
        units = at[(at >= places.gens) & (at < places.nowhere)] - places.gens
        ends, others = moved[moved < n_ends], moved[moved >= n_ends]
        # Rows of lines, then of units: those that actions change, and those that they move.
        elements_of_rows = torch.cat([lines.new_full(lines.shape, -1), ends, units.new_full(units.shape, -1), others])
        of_elements = torch.bucketize(elements_of_rows, torch.tensor(counts).cumsum(0), right=True)
        groups = of_elements.masked_fill(elements_of_rows < 0, len(counts))
        groups[len(lines) + len(ends) :][: len(units)] = len(counts) + 1
        used, group = torch.unique(groups, return_inverse=True)
        self.layers = [(*(f"moves.{k}" for k in range(len(counts))), "of_line", "of_unit")[k] for k in used.tolist()]
        """Of the groups of rows."""
        # What an action adds up: its kind, its place, unless that is nowhere, and the elements that it moves.
        somewhere, every = where < places.nowhere, torch.arange(len(table))
        lengths = torch.diff(offsets, append=torch.tensor([len(elements)]))
        actions = torch.cat([every, every[somewhere], every.repeat_interleave(lengths)])
        n_lines = len(subs) + len(lines)
        place_of_action = place_of_action + torch.where(place_of_action >= n_lines, len(ends), 0)
        moved_of_action = moved_of_action + torch.where(moved_of_action >= len(ends), n_places, n_lines)
        rows = torch.cat([kind_of_action, place_of_action[somewhere] + n_kinds, moved_of_action + n_kinds])
        self.sums = RowSums(actions, rows, len(table))
        self.back = RowSums(rows, actions, n_kinds + len(subs) + len(group))
        kept = {
            "kinds": some_kinds,
            "at_subs": subs,
            "at_lines": lines,
            "of_lines": torch.cat([lines, ends % counts[0]]),
            "of_units": torch.cat([torch.where(units < n_gen, units, units + n_load), others - n_ends]),
            "group": group,
            "elements": elements_of_rows.clamp(min=0),
            "is_moved": (elements_of_rows >= 0).to(torch.float32).unsqueeze(-1),
        }
        keep(self, **kept)

    kinds: Tensor
    at_subs: Tensor
    at_lines: Tensor
    of_lines: Tensor
    of_units: Tensor
    group: Tensor
    elements: Tensor
    is_moved: Tensor

    def forward(self, context: Tensor, busbars: Tensor, states: _States) -> Tensor:
        """Of states [.., batch], [batch, number times action]."""
        kinds = nn.functional.linear(self.kinds, self.of_kind.weight, self.of_kind.bias)
        rows = [kinds.unsqueeze(-1) + self.of_context(context)]
        if len(self.at_subs):
            rows.append(self._subs(busbars))
        if len(self.group):
            rows.append(self._others(states))
        last = self.of_action
        scores = applied(Scores, torch.cat(rows), last.weight, last.bias, self.do_nothing, self.sums, self.back)
        numbers: Tensor = scores.transpose(0, 1).flatten(0, 1).T
        return numbers

    def _subs(self, busbars: Tensor) -> Tensor:
        """What substations are worth that actions change, [substation, width, batch]."""
        weight = torch.cat([self.of_sub.weight, self.of_cooldown.weight], dim=1)
        constant = self.of_place.index_select(0, self.at_subs) + (self.of_sub.bias + self.of_cooldown.bias)
        at = busbars.index_select(0, self.at_subs)
        return torch.baddbmm(constant.unsqueeze(-1), weight.expand(len(at), -1, -1), at)

    def _others(self, states: _States) -> Tensor:
        """What lines and units are worth that actions change, and elements that they move: [row, width, batch]."""
        layers: Any = [self.get_submodule(name) for name in self.layers]
        weight = torch.stack([layer.weight for layer in layers])
        learned = weight.new_zeros(0, weight.shape[1])
        if len(self.at_lines):
            learned = self.of_place.index_select(0, self.at_lines + self.n_sub)
        second = states.elements.second.index_select(0, self.elements)
        rows: Tensor = applied(
            Layers,
            states.lines,
            states.units,
            weight,
            torch.stack([layer.bias for layer in layers]),
            learned,
            (1.0 - 2.0 * self.is_moved * second).unsqueeze(1),
            self.of_lines,
            self.of_units,
            self.group,
        )
        return rows


class _Chosen(nn.Module):
    """What the topology entries of a joint action that is read mean for the state."""

    def __init__(self, request: Request, width: int, n_topology: int) -> None:
        super().__init__()
        assert request.spec.grid is not None
        kinds, where, *_ = action_table(request.spec).tensors()
        nowhere = Places.of(request.spec.grid).gens
        self.register_buffer("kinds", kinds[:n_topology].T.contiguous(), persistent=False)
        self.register_buffer("where", where[:n_topology].clamp(max=nowhere), persistent=False)
        self.layer = _Layer(request, len(KINDS) + width, 4 * width)

    kinds: Tensor
    where: Tensor

    def forward(self, entries: Tensor, busbars: Tensor, lines: Tensor) -> Tensor:
        """Of entries [batch, topology action], [4 width, batch]."""
        nowhere, width = torch.zeros_like(lines[:1]), lines.shape[1]
        places = torch.cat([busbars[:, :width] + busbars[:, width:-1], lines, nowhere])
        weighted = (places.index_select(0, self.where) * entries.T.unsqueeze(1)).sum(dim=0)
        chosen: Tensor = self.layer(torch.cat([self.kinds @ entries.T, weighted]))
        return chosen


class _Layer(nn.Module):
    """A layer over the first axis of [inputs, batch]."""

    def __init__(self, request: Request, inputs: int, outputs: int, *, last: bool = False) -> None:
        super().__init__()
        layer = request.style.linear(inputs, outputs, last=last, generator=request.generator)
        self.weight, self.bias = layer.weight, layer.bias

    def forward(self, inputs: Tensor) -> Tensor:
        """[inputs, batch] -> [outputs, batch]."""
        return torch.addmm(self.bias.unsqueeze(-1), self.weight, inputs)


def _controls(spec: Spec) -> tuple[tuple[Tensor, Tensor], ...]:
    """Of redispatch, curtailment and storage: entries of the action, and the units that they control."""
    assert spec.grid is not None
    table, places = action_table(spec), Places.of(spec.grid)
    parts = []
    for name in CONTROLS:
        rows = torch.from_numpy(table.kinds[:, KINDS.index(name)]).nonzero().squeeze(-1)
        first = places.storages if name == "storage" else places.gens
        parts.append((rows, torch.from_numpy(table.places)[rows] - first))
    return tuple(parts)


def ids(numbers: I32) -> Tensor:
    """Numbers as indices."""
    return torch.tensor(numbers, dtype=torch.int64)


NETWORK = Network("gnn", GraphNetwork, reads_normalized=False, needs_grid=True)
