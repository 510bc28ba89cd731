"""Layers that read the whole observation, and actions scored by an embedding of what they change.

With c(s) the output of the hidden layers, action a is worth

    score(s, a) = (P relu(W c(s)) + b) . k_a,          k_a = relu(U [kind of a] + p[place of a] + sum of e[moved by a])

where p is learned for every substation, line, generator and storage unit, and e for every element that can be moved to
another busbar. The weights are those of the grid: a task with 66,978 actions has as many as one with 50, and what is
learned of an action is learned of those like it.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rl2grid.algorithms.networks import Network, Output, Request
from rl2grid.algorithms.networks.action_table import KINDS, Places, action_table, first_table, with_first
from rl2grid.algorithms.networks.constants import keep
from rl2grid.algorithms.networks.mlp import Layers

WIDTH = 64
"""Entries of an embedding."""


class ActionEmbedding(nn.Module):
    """What every action, or dimension of a continuous action, changes: [action, :data:`WIDTH`]."""

    def __init__(self, request: Request, width: int = WIDTH) -> None:
        super().__init__()
        spec = request.spec
        assert spec.grid is not None
        names = ("kinds", "places", "elements", "offsets")
        keep(self, **dict(zip(names, action_table(spec).tensors(), strict=True)))
        self.of_kind = request.style.linear(len(KINDS), width, last=False, generator=request.generator)
        self.of_place = nn.Parameter(first_table(len(Places.of(spec.grid)), width, request))
        if len(self.elements):
            self.of_element = nn.Parameter(first_table(spec.grid.dim_topo, width, request))

    kinds: Tensor
    places: Tensor
    elements: Tensor
    offsets: Tensor

    def forward(self) -> Tensor:
        """The embeddings, which depend on nothing but the weights."""
        embedded: Tensor = self.of_kind(self.kinds).add(self.of_place[self.places])
        if len(self.elements):
            moved = nn.functional.embedding_bag(self.elements, self.of_element, self.offsets, mode="sum")
            embedded = embedded.add(moved)
        return embedded.relu()


class _Scores(nn.Module):
    """The numbers asked for, of an observation and of what actions change."""

    def __init__(self, request: Request) -> None:
        super().__init__()
        self.output, self.n_actions = request.output, request.spec.action_size
        self.read = request.spec.observation_size
        style, generator = request.style, request.generator
        inputs = self.read + (WIDTH if request.output.reads_action else 0)
        modules: list[nn.Module] = []
        for width in request.layers:
            modules += [style.linear(inputs, width, last=False, generator=generator), style.activation()]
            inputs = width
        self.context = Layers(*modules)
        self.embedding = ActionEmbedding(request) if _needs_actions(request.output) else None
        if request.output.per_state:
            self.of_state = style.linear(inputs, request.output.per_state, last=True, generator=generator)
        if request.output.per_action:
            self.query = style.linear(inputs, WIDTH, last=False, generator=generator)
            self.of_action = style.linear(WIDTH, request.output.per_action, last=True, generator=generator)
            self.of_pair = nn.ModuleList(
                style.linear(WIDTH, WIDTH, last=True, generator=generator) for _ in range(request.output.per_action)
            )
            self.do_nothing = nn.Parameter(torch.tensor(request.first_action or 0.0))

    def forward(self, inputs: Tensor) -> Tensor:
        """Numbers [batch, inputs] -> [batch, width]."""
        embedded = None if self.embedding is None else self.embedding()
        if self.output.reads_action:
            assert embedded is not None
            inputs = torch.cat([inputs[:, : self.read], inputs[:, self.read :] @ embedded], dim=-1)
        context = self.context(inputs)
        numbers = [self.of_state(context)] if self.output.per_state else []
        if self.output.per_action:
            assert embedded is not None
            query = self.query(context).relu()
            of_action = self.of_action(embedded)  # [action, number]
            for number, pair in enumerate(self.of_pair):
                scores = pair(query) @ embedded.T + of_action[:, number]
                numbers.append(with_first(scores, self.do_nothing) if number == 0 else scores)
        return torch.cat(numbers, dim=-1)


def _needs_actions(output: Output) -> bool:
    return bool(output.per_action) or output.reads_action


NETWORK = Network("action-embedding", _Scores, needs_grid=True)
