"""Networks by name: what maps observations to the numbers that an algorithm learns.

An algorithm asks for a network by a :class:`Request`: which task it is of, which numbers are wanted, how wide its
layers are. Whoever answers is chosen by name, the hyperparameter ``network``; a network of one's own is a function from
the request to a ``torch.nn.Module`` and a call of :func:`register_network`, or an entry point of a package, which every
process finds::

    [project.entry-points."rl2grid.networks"]
    graph = "my_package.graph:NETWORK"
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
import torch
from torch import Tensor, nn

from rl2grid.arrays import F32, F64, I64
from rl2grid.dense.choices import NEVER
from rl2grid.envs.spec import JointActions, Spec, spec_from_state
from rl2grid.errors import UsageError, one_of
from rl2grid.grids.rankings import ranking
from rl2grid.mdp.actions import ActionCatalogue, full_size


@dataclass(frozen=True)
class Output:
    """The numbers that a network gives for every observation: first those of the state, then those of the actions."""

    per_state: int = 0
    """Numbers for the state as a whole: 1 for a value."""
    per_action: int = 0
    """Numbers for every discrete action, or every dimension of a continuous one: the first number of all actions, then
    the second of all."""
    reads_action: bool = False
    """Whether what it reads is an observation followed by a continuous action."""

    def inputs(self, spec: Spec) -> int:
        """Numbers that the network reads."""
        return spec.observation_size + (spec.action_size if self.reads_action else 0)

    def width(self, spec: Spec) -> int:
        """Numbers that it gives."""
        return self.per_state + self.per_action * spec.action_size


VALUE = Output(per_state=1)
"""V(s)."""
PER_ACTION = Output(per_action=1)
"""Logits, means or values of actions."""
VALUE_OF_ACTION = Output(per_state=1, reads_action=True)
"""Q(s, a) of a continuous action."""


@dataclass(frozen=True)
class Style:
    """How the layers of an algorithm's networks are activated and begin."""

    activation: Callable[[], nn.Module]
    """Makes what follows every layer but the last."""
    begin: Callable[[nn.Linear, bool, torch.Generator | None], None]
    """``begin(layer, is_last, generator)`` draws its first weights."""

    def linear(self, inputs: int, outputs: int, *, last: bool, generator: torch.Generator | None) -> nn.Linear:
        """A layer with its first weights; the global random state is left alone."""
        # Linear's own initialisation would draw from it.
        layer: nn.Linear = nn.utils.skip_init(nn.Linear, inputs, outputs)  # type: ignore[no-untyped-call]
        self.begin(layer, last, generator)
        return layer


def orthogonal(output_gain: float) -> Style:
    """Tanh and orthogonal weights; a small ``output_gain`` makes a first policy nearly indifferent."""

    def begin(layer: nn.Linear, last: bool, generator: torch.Generator | None) -> None:
        # In float64, whose last digits, which depend on the processor, are rounded away.
        weight = torch.empty_like(layer.weight).normal_(generator=generator).double()
        with torch.no_grad():
            layer.weight.copy_(_orthogonal(weight) * (output_gain if last else math.sqrt(2.0)))
        nn.init.zeros_(layer.bias)

    return Style(nn.Tanh, begin)


def _orthogonal(numbers: Tensor) -> Tensor:
    """Rows or columns, the fewer of both, made orthonormal: uniformly distributed if the numbers are normally."""
    rows, columns = numbers.shape
    axes, remainder = torch.linalg.qr(numbers if rows >= columns else numbers.T)
    axes *= remainder.diagonal().sign()
    orthonormal: Tensor = axes if rows >= columns else axes.T
    return orthonormal


def _uniform(layer: nn.Linear, last: bool, generator: torch.Generator | None) -> None:
    bound = 1.0 / math.sqrt(layer.in_features)
    for parameter in (layer.weight, layer.bias):
        nn.init.uniform_(parameter, -bound, bound, generator=generator)


UNIFORM = Style(nn.ReLU, _uniform)
"""ReLU and weights within 1 / sqrt(inputs of the layer), PyTorch's own default."""


@dataclass(frozen=True)
class Request:
    """What an algorithm asks a network for."""

    spec: Spec
    """What is observed and what can be done."""
    output: Output
    """Which numbers are wanted."""
    layers: tuple[int, ...] = ()
    """Widths of hidden layers, first to last, as far as the network has such."""
    style: Style = UNIFORM
    """Activation and first weights, as far as the network has no better ones of its own."""
    first_action: float | None = None
    """Where the first number of action 0 begins, in every state: the logit by which a policy prefers to do nothing.
    None: like those of the others."""
    generator: torch.Generator | None = None
    """The source of all random weights."""


@dataclass(frozen=True)
class Network:
    """A kind of network."""

    name: str
    build: Callable[[Request], nn.Module]
    """Makes a module from float32 [batch, inputs] to float32 [batch, width]; see :class:`Output`."""
    reads_normalized: bool = True
    """Whether it may be given observations scaled by running statistics. A network that reads busbars or line states
    from them may not."""
    needs_grid: bool = False
    """Whether it is for tasks of rl2grid alone, whose ``Spec`` has a grid."""
    row_by_row: bool = False
    """Whether what it gives for a row is the same to the bit, whatever rows are beside it: its policies then play the
    episodes of an evaluation side by side."""


@runtime_checkable
class Aiming(Protocol):
    """A module whose means are the way to where injections should be: what a pupil is told of that is learned."""

    def aims_and_means(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """The action that would bring them there at once, and as much of that as a step can do, each
        [batch, action_size]; the latter are its means.
        """

    def reads(self, observations: Tensor) -> Tensor:
        """What it reads of observations, [batch, ...]."""

    def standardise(self, means: F64, deviations: F64) -> None:
        """Take off the means of what it reads, [...], and divide by its deviations."""


_IN_PACKAGE = {
    "mlp": "rl2grid.algorithms.networks.mlp",
    "action-embedding": "rl2grid.algorithms.networks.action_embedding",
    "gnn": "rl2grid.algorithms.networks.gnn",
    "set-point": "rl2grid.algorithms.networks.set_point",
}
"""The file of each, whose ``NETWORK`` describes it."""
_ADDED: dict[str, Network] = {}
GROUP = "rl2grid.networks"
"""Of entry points."""


@functools.cache
def _installed() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP) if point.name not in _IN_PACKAGE}


def register_network(network: Network) -> None:
    """Let algorithms use a network by its name, in this process.

    Raises:
        UsageError: the name is taken by another network.
    """
    if network.name in (*_IN_PACKAGE, *_installed()) or _ADDED.get(network.name, network) != network:
        raise UsageError(f"Network {network.name!r} exists already: choose another name.")
    _ADDED[network.name] = network


def network_names() -> tuple[str, ...]:
    """All names, those of the package first."""
    return (*_IN_PACKAGE, *_installed(), *_ADDED)


def find_network(name: str) -> Network:
    """The network called ``name``.

    Raises:
        UsageError: there is none.
    """
    if name in _ADDED:
        return _ADDED[name]
    if name in _IN_PACKAGE:
        network = import_module(_IN_PACKAGE[name]).NETWORK
    elif name in _installed():
        network = _installed()[name].load()
    else:
        raise one_of("Network", name, network_names())
    if not isinstance(network, Network):
        raise UsageError(f"Network {name!r} is offered by an entry point that is no Network, but {network!r}.")
    return network


def shortlist(spec: Spec, size: int) -> I64:
    """The actions among which a policy with a shortlist chooses, ascending int64 [action].

    Do nothing and the best-ranked topology actions, ``size`` together, and, of a flattened joint task, all moves of
    controls.

    Raises:
        UsageError: actions are continuous or of no grid, or there are not as many.
    """
    actions = spec.actions.topology if isinstance(spec.actions, JointActions) else spec.actions
    if spec.continuous or not isinstance(actions, ActionCatalogue) or spec.grid is None:
        raise UsageError("Only the discrete actions of tasks of rl2grid have a shortlist: leave it out.")
    if not 1 <= size <= len(actions):
        raise UsageError(
            f"shortlist={size} is not allowed: choose from 1 to {len(actions):,}, the actions of the task."
        )
    best = np.arange(size)
    if len(actions) == full_size(spec.grid.sub_info.tolist(), spec.grid.n_line):  # in the order of the catalogue
        best = np.sort(np.concatenate(([0], ranking(spec.grid.id).ids[: size - 1])))
    return np.concatenate((best, np.arange(len(actions), spec.action_size))).astype(np.int64)


class _Shortlisted(nn.Module):
    """A network of the actions on the shortlist, which never plays another one."""

    def __init__(self, request: Request, chosen: I64, build: Callable[[Request], nn.Module]) -> None:
        super().__init__()
        spec = request.spec
        actions: Any = spec.actions
        if isinstance(actions, JointActions):
            topology = chosen[chosen < len(actions.topology)].astype(np.int32)
            actions = JointActions(actions.topology.take(topology), actions.injection)
        else:
            actions = actions.take(chosen.astype(np.int32))
        self.network = build(replace(request, spec=replace(spec, action_size=len(chosen), actions=actions)))
        self.output, self.n_actions = request.output, spec.action_size
        self.register_buffer("chosen", torch.from_numpy(chosen), persistent=False)

    chosen: Tensor

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """Weights of a network of the same actions that had no shortlist fit as well."""
        inner = f"{prefix}network."
        mine = [name for name in state_dict if name.startswith(prefix)]
        if not any(name.startswith(inner) for name in mine):
            for name in mine:
                state_dict[inner + name.removeprefix(prefix)] = state_dict.pop(name)
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def forward(self, inputs: Tensor) -> Tensor:
        """Numbers [batch, inputs] -> [batch, width]."""
        numbers = self.network(inputs)
        first, per_action = self.output.per_state, self.output.per_action
        of_actions = numbers[:, first:].unflatten(1, (per_action, len(self.chosen)))
        every = numbers.new_full((len(inputs), per_action, self.n_actions), NEVER)
        return torch.cat([numbers[:, :first], every.index_copy(2, self.chosen, of_actions).flatten(1)], dim=1)

    def outputs_of(self, rows: F32) -> F32:
        """See :func:`outputs_of`."""
        numbers = outputs_of(self.network, rows)
        first, per_action = self.output.per_state, self.output.per_action
        every = np.full((len(rows), per_action, self.n_actions), NEVER, np.float32)
        every[:, :, self.chosen.numpy()] = numbers[:, first:].reshape(len(rows), per_action, -1)
        return np.concatenate((numbers[:, :first], every.reshape(len(rows), -1)), axis=1)


def outputs_of(network: nn.Module, rows: F32) -> F32:
    """What a network that learns no more gives for observations, float32 [batch, size] -> [batch, width].

    Of a single one tensors take longer than all products: networks that can, do without, by a method of this name.
    """
    own: Callable[[F32], F32] | None = getattr(network, "outputs_of", None)
    return outputs_by_tensors(network, rows) if own is None else own(rows)


def outputs_by_tensors(network: nn.Module, rows: F32) -> F32:
    """The same, of any network."""
    with torch.no_grad():
        outputs: F32 = network(torch.from_numpy(rows)).numpy()
    return outputs


@dataclass(frozen=True)
class NetworkFactory:
    """Makes networks of one kind for one task."""

    spec: Spec
    name: str = "mlp"
    """Of the kind; see :func:`network_names`."""
    generator: torch.Generator | None = None
    """The source of all random weights; None: they will be loaded."""
    shortlist: int | None = None
    """Actions among which is chosen, see :func:`shortlist`; None: all."""

    def __post_init__(self) -> None:
        """Refuse what cannot be made.

        Raises:
            UsageError: there is no such network, it needs a grid where there is none, or the shortlist is impossible.
        """
        self.shortlisted()
        if find_network(self.name).needs_grid and self.spec.grid is None:
            raise UsageError(f"Network {self.name!r} is for tasks of rl2grid: this environment has no grid.")

    def make(
        self, output: Output, layers: Sequence[int], style: Style = UNIFORM, do_nothing: float | None = None
    ) -> nn.Module:
        """A network that gives these numbers.

        Args:
            output: Which numbers.
            layers: Widths of hidden layers.
            style: Activation and first weights.
            do_nothing: Probability of action 0 in every state, if the numbers are logits and the others about alike.
        """
        first, chosen = None, self.shortlisted()
        if do_nothing is not None:
            others = (self.spec.action_size if chosen is None else len(chosen)) - 1
            first = math.log(do_nothing / (1.0 - do_nothing) * max(others, 1))
        request = Request(self.spec, output, tuple(layers), style, first, self.generator)
        build = find_network(self.name).build
        return build(request) if chosen is None or not output.per_action else _Shortlisted(request, chosen, build)

    def shortlisted(self) -> I64 | None:
        """The actions among which is chosen; None: all."""
        return None if self.shortlist is None else shortlist(self.spec, self.shortlist)

    def state_dict(self) -> dict[str, Any]:
        """Plain values from which :meth:`from_state` makes it again."""
        chosen = {} if self.shortlist is None else {"shortlist": self.shortlist}
        return {"name": self.name, "spec": self.spec.state_dict(), **chosen}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Self:
        """The factory whose ``state_dict`` this was; what it makes has no weights yet.

        Raises:
            UsageError: there is no such network or task any more.
        """
        return cls(spec_from_state(state["spec"]), state["name"], shortlist=state.get("shortlist"))
