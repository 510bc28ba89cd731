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

All arrays are [width, element, batch]: what leads along lines then copies whole rows, and layers are one product.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

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
    with_first,
)
from rl2grid.arrays import I32
from rl2grid.envs.spec import Spec
from rl2grid.envs.tasks import find_task
from rl2grid.mdp.features import physical_scale

_URGENT_STEPS = 72.0
"""Steps after which planned maintenance counts e times less: six hours."""
_STRESSED = 0.9
"""Loading from which a line's loading counts once more, five times as much."""
_SHARE, _LEAST_WIDTH = 16, 8
"""A hidden layer of n numbers stands for a round of messages of n / 16 numbers."""


class _Elements(NamedTuple):
    """What is known of the grid's elements, each [feature, element, batch], and where they are."""

    line: Tensor
    gen: Tensor
    load: Tensor
    storage: Tensor
    cooldown: Tensor
    """[1, substation, batch]"""
    second: Tensor
    """[element, batch] 1 where on busbar 2; in the order of :mod:`rl2grid.algorithms.networks.action_table`"""
    in_service: Tensor
    """[line, batch]"""
    time: Tensor
    """[1, batch]"""


class Features(nn.Module):
    """Takes the flat observation apart, and the continuous action that may follow it."""

    def __init__(self, spec: Spec, *, reads_action: bool) -> None:
        super().__init__()
        assert spec.grid is not None
        assert spec.task is not None
        grid = self.grid = spec.grid
        self.slices = {feature.name: slice(feature.begin, feature.end) for feature in spec.features}
        self.observed = spec.observation_size
        self.is_physical = spec.normalize == "physical"
        self.has_topology = "topo_vect" in self.slices
        of_gens = [feature.name for feature in spec.features if feature.of == "gen"]
        self.dispatch = [name for name in of_gens if name not in ("gen_p", "gen_theta")]
        self.of_storage = [feature.name for feature in spec.features if feature.of == "storage"]
        self.reads_action = reads_action
        shift, scale = physical_scale(grid, find_task(spec.task).kind)
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
        for name, tensor in kept.items():
            self.register_buffer(name, tensor, persistent=False)
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
        return 9, gen, 3, len(self.of_storage) + int(self.reads_action)

    def forward(self, inputs: Tensor) -> _Elements:
        """Observations [batch, observation_size], each followed by its action where one is read."""
        observations = inputs[:, : self.observed]
        if not self.is_physical:
            observations = (observations - self.shift) / self.scale
        rows = observations.T.contiguous()
        part = {name: rows[where] for name, where in self.slices.items()}
        second, in_service = self._topology(part)
        cooldown = part.get("time_before_cooldown_sub", rows.new_zeros(self.grid.n_sub, rows.shape[1]))
        return _Elements(
            line=self._lines(part, in_service, second),
            gen=self._gens(part, inputs),
            load=torch.stack([part["load_p"], part["load_p"] * self.load_size, part["load_theta"]]),
            storage=self._storages(part, inputs) if self.grid.n_storage else rows.new_zeros(0, 0, 0),
            cooldown=cooldown.unsqueeze(0),
            second=second,
            in_service=in_service,
            time=part["t"],
        )

    def _topology(self, part: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Which elements are on busbar 2, and which lines in service; each [element, batch], 0 or 1."""
        rho, n_line = part["rho"], self.grid.n_line
        if not self.has_topology:
            return rho.new_zeros(len(self.order), rho.shape[1]), (rho > 0).to(rho.dtype)
        topology = part["topo_vect"].index_select(0, self.order)
        both = (topology[:n_line] > -0.5) & (topology[n_line : 2 * n_line] > -0.5)
        return (topology > 0.5).to(rho.dtype), both.to(rho.dtype)

    def _lines(self, part: dict[str, Tensor], in_service: Tensor, second: Tensor) -> Tensor:
        rho, n_line = part["rho"], self.grid.n_line
        steps = part["time_next_maintenance"] * self.scale[self.slices["time_next_maintenance"]].unsqueeze(-1)
        announced = torch.where(steps >= 0, (-steps.clamp(min=0.0) / _URGENT_STEPS).exp(), 0.0)
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
        ]
        return torch.stack(columns)

    def _gens(self, part: dict[str, Tensor], inputs: Tensor) -> Tensor:
        gen_p = part["gen_p"]
        columns = [gen_p, gen_p * self.gen_size, part["gen_theta"], self.renewable.expand_as(gen_p)]
        columns += [part[name] for name in self.dispatch]
        columns += [self._entries(inputs, kind, gen_p) for kind in (0, 1)] if self.reads_action else []
        return torch.stack(columns)

    def _storages(self, part: dict[str, Tensor], inputs: Tensor) -> Tensor:
        columns = [part[name] for name in self.of_storage]
        columns += [self._entries(inputs, 2, columns[0])] if self.reads_action else []
        return torch.stack(columns)

    def _entries(self, inputs: Tensor, kind: int, like: Tensor) -> Tensor:
        """What the action that is read asks of every generator or storage unit [unit, batch]."""
        asked = inputs[:, self.observed :].T.index_select(0, self.get_buffer(f"entries_{kind}"))
        return torch.zeros_like(like).index_copy(0, self.get_buffer(f"units_{kind}"), asked)


class Messages(nn.Module):
    """The states of lines and busbars after some rounds of messages."""

    def __init__(self, request: Request, features: Features, width: int, rounds: int) -> None:
        super().__init__()
        grid, sizes = features.grid, features.sizes()
        self.n_sub, self.n_line = grid.n_sub, grid.n_line
        ends = torch.cat([ids(grid.line_or_to_subid), ids(grid.line_ex_to_subid)])
        units = torch.cat([ids(each) for each in (grid.gen_to_subid, grid.load_to_subid, grid.storage_to_subid)])
        degree = torch.bincount(ends, minlength=grid.n_sub).clamp(min=1).to(torch.float32)
        for name, tensor in (("ends", ends), ("units", units), ("per_line", degree.rsqrt().repeat(2).unsqueeze(-1))):
            self.register_buffer(name, tensor, persistent=False)
        self.read_line, self.read_gen, self.read_load = (_Layer(request, size, width) for size in sizes[:3])
        self.read_storage = _Layer(request, sizes[3], width) if grid.n_storage else None
        self.of_line = nn.Parameter(first_table(grid.n_line, width, request))
        self.to_self = nn.ModuleList(_Layer(request, width, width) for _ in range(rounds))
        self.to_others = nn.ModuleList(_Layer(request, width, width) for _ in range(rounds))

    ends: Tensor
    units: Tensor
    per_line: Tensor

    def forward(self, elements: _Elements) -> _States:
        """The states of everything."""
        parts = [self.read_gen(elements.gen), self.read_load(elements.load)]
        if self.read_storage is not None:
            parts.append(self.read_storage(elements.storage))
        units = torch.cat(parts, dim=1)
        moved = elements.second.any(dim=1)
        n_busbars = self.n_sub * (1 + int(moved.any()))
        ends = _OnBusbars(self.ends, elements.second[: 2 * self.n_line], self.n_sub)
        injected = _OnBusbars(self.units, elements.second[2 * self.n_line :], self.n_sub).added(
            units, units.new_zeros(len(units), n_busbars, units.shape[2])
        )
        read = self.read_line(elements.line).add_(self.of_line.T.unsqueeze(-1))
        lines = read.relu()
        for to_self, to_others in zip(self.to_self, self.to_others, strict=True):
            busbars = ends.added(lines * elements.in_service, injected.clone())
            at_ends = ends.of(busbars.mul_(self.per_line[:n_busbars]))
            heard = (at_ends[:, : self.n_line] + at_ends[:, self.n_line :]).mul_(elements.in_service)
            lines = to_self(lines).add_(to_others(heard)).add_(read).relu_()
        return _States(lines, units, injected, ends, elements)

    def busbars(self, states: _States) -> Tensor:
        """The states of busbars, [width, 2 n_sub, batch]."""
        lines, injected = states.lines, states.injected
        if injected.shape[1] == self.n_sub:
            injected = torch.cat([injected, torch.zeros_like(injected)], dim=1)
        else:
            injected = injected.clone()
        return states.ends.added(lines * states.elements.in_service, injected).mul_(self.per_line)


class _States(NamedTuple):
    """The states after all rounds, each [width, element, batch]."""

    lines: Tensor
    units: Tensor
    """generators, loads and storage units"""
    injected: Tensor
    """what the units at each busbar hold together; of busbars 1 alone where the whole batch has no others"""
    ends: _OnBusbars
    elements: _Elements


class _OnBusbars:
    """Which busbars elements are on, in a batch: busbar 1 of their substation, but for a few."""

    def __init__(self, subs: Tensor, second: Tensor, n_sub: int) -> None:
        self.subs, self.n_sub = subs, n_sub
        self.moved = second.any(dim=1).nonzero().squeeze(-1)
        self.second = second.index_select(0, self.moved)
        self.moved_subs = subs.index_select(0, self.moved)

    def of(self, busbars: Tensor) -> Tensor:
        """What the busbar of each element holds, [width, element, batch]."""
        held = busbars.index_select(1, self.subs)
        if not len(self.moved):
            return held
        here = busbars.index_select(1, self.moved_subs)
        there = busbars.index_select(1, self.moved_subs + self.n_sub)
        return held.index_add_(1, self.moved, (there - here).mul_(self.second))

    def added(self, values: Tensor, sums: Tensor) -> Tensor:
        """Add to ``sums`` [width, busbar, batch] what the elements at each busbar hold.

        ``values`` are of elements, or of half as many, lines, each of which counts at both of its ends.
        """
        n = values.shape[1]
        for first in range(0, len(self.subs), n):
            sums.index_add_(1, self.subs[first : first + n], values)
        if not len(self.moved):
            return sums
        moved = values.index_select(1, self.moved % n).mul_(self.second)
        return sums.index_add_(1, self.moved_subs, moved, alpha=-1.0).index_add_(1, self.moved_subs + self.n_sub, moved)


class GraphNetwork(nn.Module):
    """The numbers asked for of observations; see the equations of the module."""

    def __init__(self, request: Request) -> None:
        super().__init__()
        spec, output = request.spec, request.output
        width = max(min(request.layers, default=0) // _SHARE, _LEAST_WIDTH)
        self.output = output
        self.features = Features(spec, reads_action=output.reads_action)
        self.messages = Messages(request, self.features, width, max(len(request.layers), 1))
        self.state = _Layer(request, 3 * width + 1, 4 * width)
        self.of_state = _Layer(request, 4 * width, output.per_state, last=True) if output.per_state else None
        self.chosen = _Chosen(request, width, self.features.n_topology) if self.features.n_topology else None
        self.scores = _Scores(request, width) if output.per_action else None

    def forward(self, inputs: Tensor) -> Tensor:
        """Numbers [batch, inputs] -> [batch, width]."""
        elements = self.features(inputs)
        states = self.messages(elements)
        lines = states.lines
        hidden = self.state(torch.cat([lines.mean(dim=1), lines.amax(dim=1), states.units.mean(dim=1), elements.time]))
        if self.chosen is not None:
            first = self.features.observed
            entries = inputs[:, first : first + self.features.n_topology]
            hidden = hidden + self.chosen(entries, self.messages.busbars(states), lines)
        context = hidden.relu()
        numbers = [] if self.of_state is None else [self.of_state(context).T]
        if self.scores is not None:
            numbers.append(self.scores(context, self.messages.busbars(states), states))
        return torch.cat(numbers, dim=-1)


class _Scores(nn.Module):
    """The numbers of every action."""

    def __init__(self, request: Request, width: int) -> None:
        super().__init__()
        assert request.spec.grid is not None
        grid, table = request.spec.grid, action_table(request.spec)
        self.n_sub, self.n_gen, self.loads = grid.n_sub, grid.n_gen, grid.n_gen + grid.n_load
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
        if len(self.at_units):
            self.of_unit = layer(width, width)
        self.of_action = layer(width, request.output.per_action, last=True)
        self.do_nothing = nn.Parameter(torch.tensor(request.first_action or 0.0))

    def _keep(self, table: ActionTable, places: Places, counts: tuple[int, ...]) -> None:
        """What of the table is needed: of places and elements only those that some action is about."""
        kinds, where, elements, offsets = table.tensors()
        at, place_of_action = torch.unique(where, return_inverse=True)
        moved, moved_of_action = torch.unique(elements, return_inverse=True)
        bounds = (0, places.lines, places.gens, places.nowhere, len(places))
        for name, (first, after) in zip(("subs", "lines", "units", "nowhere"), itertools.pairwise(bounds), strict=True):
            self.register_buffer(f"at_{name}", at[(at >= first) & (at < after)] - first, persistent=False)
        begins = torch.tensor([0, *counts]).cumsum(0).tolist()
        for k, (first, after) in enumerate(itertools.pairwise(begins)):
            self.register_buffer(f"part_{k}", moved[(moved >= first) & (moved < after)] - first, persistent=False)
        for name, tensor in (
            ("kinds", kinds.T.contiguous()),
            ("where", place_of_action),
            ("elements", moved_of_action),
            ("offsets", offsets),
            ("moved", moved),
        ):
            self.register_buffer(name, tensor, persistent=False)

    at_subs: Tensor
    at_lines: Tensor
    at_units: Tensor
    at_nowhere: Tensor
    kinds: Tensor
    where: Tensor
    elements: Tensor
    offsets: Tensor
    moved: Tensor

    def forward(self, context: Tensor, busbars: Tensor, states: _States) -> Tensor:
        """Of states [.., batch], [batch, number times action]."""
        hidden = self._places(busbars, states).index_select(1, self.where)
        hidden.add_(self.of_context(context).unsqueeze(1)).add_(self.of_kind(self.kinds).unsqueeze(-1))
        if len(self.elements):
            hidden.add_(self._moved(states.lines, states.units, states.elements.second))
        scores: Tensor = self.of_action(hidden.relu_()).flatten(0, 1).T
        return with_first(scores, self.do_nothing)

    def _places(self, busbars: Tensor, states: _States) -> Tensor:
        """States of what actions change, [width, place, batch]."""
        lines, units = states.lines, states.units
        width, _, batch = lines.shape
        parts = [lines.new_zeros(width, len(self.at_nowhere), batch)]
        if len(self.at_units):
            controlled = torch.cat([units[:, : self.n_gen], units[:, self.loads :]], dim=1)
            parts.insert(0, self.of_unit(controlled.index_select(1, self.at_units)))
        if len(self.at_lines):
            learned = self.of_place.index_select(0, self.at_lines + self.n_sub).T.unsqueeze(-1)
            parts.insert(0, self.of_line(lines.index_select(1, self.at_lines)) + learned)
        if len(self.at_subs):
            both = [busbars.index_select(1, self.at_subs + first) for first in (0, self.n_sub)]
            learned = self.of_place.index_select(0, self.at_subs).T.unsqueeze(-1)
            cooldown = self.of_cooldown(states.elements.cooldown.index_select(1, self.at_subs))
            parts.insert(0, self.of_sub(torch.cat(both)).add_(learned).add_(cooldown))
        return torch.cat(parts, dim=1)

    def _moved(self, lines: Tensor, units: Tensor, second: Tensor) -> Tensor:
        """What the elements that an action moves add to it, [width, action, batch]."""
        states = (lines, lines, units[:, : self.n_gen], units[:, self.n_gen : self.loads], units[:, self.loads :])
        moves = [
            self.moves[str(k)](state.index_select(1, chosen))
            for k, state in enumerate(states)
            if len(chosen := self.get_buffer(f"part_{k}"))
        ]
        signed = torch.cat(moves, dim=1) * (1.0 - 2.0 * second.index_select(0, self.moved))
        width, n, batch = signed.shape
        rows = signed.transpose(0, 1).reshape(n, width * batch)
        summed = nn.functional.embedding_bag(self.elements, rows, self.offsets, mode="sum")
        return summed.view(-1, width, batch).transpose(0, 1)


class _Chosen(nn.Module):
    """What the topology entries of a joint action that is read mean for the state."""

    def __init__(self, request: Request, width: int, n_topology: int) -> None:
        super().__init__()
        assert request.spec.grid is not None
        kinds, where, *_ = action_table(request.spec).tensors()
        self.n_sub = request.spec.grid.n_sub
        nowhere = Places.of(request.spec.grid).gens
        self.register_buffer("kinds", kinds[:n_topology].T.contiguous(), persistent=False)
        self.register_buffer("where", where[:n_topology].clamp(max=nowhere), persistent=False)
        self.layer = _Layer(request, len(KINDS) + width, 4 * width)

    kinds: Tensor
    where: Tensor

    def forward(self, entries: Tensor, busbars: Tensor, lines: Tensor) -> Tensor:
        """Of entries [batch, topology action], [4 width, batch]."""
        nowhere = lines.new_zeros(lines.shape[0], 1, lines.shape[2])
        places = torch.cat([busbars[:, : self.n_sub] + busbars[:, self.n_sub :], lines, nowhere], dim=1)
        weighted = (places.index_select(1, self.where) * entries.T).sum(dim=1)
        chosen: Tensor = self.layer(torch.cat([self.kinds @ entries.T, weighted]))
        return chosen


class _Layer(nn.Module):
    """A layer over the first axis of [inputs, ...]."""

    def __init__(self, request: Request, inputs: int, outputs: int, *, last: bool = False) -> None:
        super().__init__()
        layer = request.style.linear(inputs, outputs, last=last, generator=request.generator)
        self.weight, self.bias = layer.weight, layer.bias

    def forward(self, inputs: Tensor) -> Tensor:
        """[inputs, ...] -> [outputs, ...], a new array."""
        # Not addmm, which copies the bias to where the product goes first.
        outputs = torch.mm(self.weight, inputs.flatten(1)).add_(self.bias.unsqueeze(1))
        return outputs.view(-1, *inputs.shape[1:])


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
