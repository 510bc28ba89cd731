"""Where generators should be, in place of how they should move: means of continuous actions.

What a teacher asks of a generator in a step depends on how far it has moved it before, and an error of the pupil stays
in that for good. Where it wants the generator to be does not: that follows from schedules, demand, outages, and from
how lines are loaded. So what does not see the dispatch says where every redispatchable generator should be, x_g MW
beside its schedule, and the mean of its entry is what a step can do of that,

    change_g = clip(x_g - dispatch_g, - margin_g downwards, margin_g upwards)        then balanced, see below
    a_g      = (dispatch_g + change_g - asked_g) / ramp_g                            clipped into [-1, 1]

Margins are what ramps and limits leave; ramps are those upwards or downwards, as the sign asks. asked_g is what a
request is added to: the target, or the dispatch of who was never asked. Those that go up, or those that go down,
whichever would be more, wait for the others, so that all changes sum to zero: else what is asked for is often more
than the others can make up for, which the environment refuses.

What is learned by imitation is x_g, before it is clipped. What the layers say of curtailment and storage are the means
of those entries. The topology entries of a joint task, and values, have layers of their own, over the whole
observation.

Inputs are observations as the environment gives them, in units of :mod:`rl2grid.mdp.features`. Of what is read of them
a half is taken before it is multiplied by four; by imitation the mean of what is learned from, before it is divided by
the deviation of that, so that what is rare, a line that is out, counts as much as what is not. The checkpoint holds
both numbers.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from rl2grid.algorithms.networks import PER_ACTION, Network, Request
from rl2grid.algorithms.networks.constants import URGENT_STEPS, keep, urgency
from rl2grid.algorithms.networks.mlp import Layers, build, stacked
from rl2grid.arrays import F64, I32, I64
from rl2grid.envs.spec import JointActions, Spec
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError
from rl2grid.mdp.actions import ContinuousLayout
from rl2grid.mdp.features import OPERATOR_FEATURES, physical_scale

NAME = "set-point"
GIVEN = (
    "t", "load_p", "time_before_cooldown_line", "topo_vect", "line_status",
    "time_before_cooldown_sub", "gen_p_before_curtail", "duration_next_maintenance", "storage_charge", "rho",
    *OPERATOR_FEATURES["calendar"], *OPERATOR_FEATURES["attacks"], *OPERATOR_FEATURES["security"],
)  # fmt: skip
"""Features that are read as they are."""
USUAL, SPREAD = 0.5, 0.25
"""Mean and deviation of what is read, before anything was seen."""
LEAST_SPREAD = 0.01
"""What is added to deviations that were seen: what hardly changes is not magnified without bounds."""
_TRIFLE = 1e-6
"""MW that nobody waits for."""


class Given(nn.Module):
    """What of an observation tells where generators should be, but not where they are."""

    def __init__(self, spec: Spec) -> None:
        super().__init__()
        assert spec.grid is not None
        assert spec.task is not None
        assert spec.shift is not None
        assert spec.scale is not None
        self.slices = {feature.name: slice(feature.begin, feature.end) for feature in spec.features}
        shift, scale = physical_scale(spec.grid, find_task(spec.task).kind, spec.operator_features)
        keep(
            self,
            shift=torch.tensor((spec.shift - shift) / scale),
            scale=torch.tensor(spec.scale / scale),
            read=torch.from_numpy(_entries(self.slices)),
            steps=torch.tensor(scale[self.slices["time_next_maintenance"]] / URGENT_STEPS),
        )
        self.size = len(self.read) + spec.grid.n_gen + 2 * spec.grid.n_line

    shift: Tensor
    scale: Tensor
    read: Tensor
    steps: Tensor

    def forward(self, observations: Tensor) -> Tensor:
        """Observations [batch, observation_size] -> [batch, :attr:`size`]."""
        entries = observations * self.scale + self.shift
        schedule = entries[:, self.slices["gen_p"]] - entries[:, self.slices["actual_dispatch"]]
        is_out = (entries[:, self.slices["rho"]] == 0.0).to(entries.dtype)
        announced = urgency(entries[:, self.slices["time_next_maintenance"]] * self.steps)
        return torch.cat([entries[:, self.read], schedule, is_out, announced], dim=1)


def _entries(slices: dict[str, slice]) -> I64:
    """Indices of the entries that are read as they are."""
    return np.concatenate([np.arange(slices[name].start, slices[name].stop) for name in GIVEN if name in slices])


class Dispatched(nn.Module):
    """What an observation says of the redispatchable generators, in MW, each [batch, generator]."""

    def __init__(self, spec: Spec, gens: I32) -> None:
        super().__init__()
        assert spec.grid is not None
        assert spec.shift is not None
        assert spec.scale is not None
        names = ("target_dispatch", "actual_dispatch", "gen_margin_up", "gen_margin_down")
        entries = np.concatenate([spec.feature(name).begin + gens for name in names]).astype(np.int64)
        keep(
            self,
            entries=torch.from_numpy(entries),
            shift=torch.tensor(spec.shift[entries]),
            scale=torch.tensor(spec.scale[entries]),
            ramp_up=torch.tensor(spec.grid.gen_max_ramp_up[gens]),
            ramp_down=torch.tensor(spec.grid.gen_max_ramp_down[gens]),
        )

    entries: Tensor
    shift: Tensor
    scale: Tensor
    ramp_up: Tensor
    ramp_down: Tensor

    def forward(self, observations: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What requests are added to, the dispatch, and what it may change by upwards and downwards."""
        values = observations[:, self.entries] * self.scale + self.shift
        target, dispatch, up, down = values.chunk(4, dim=1)
        return torch.where(target == 0.0, dispatch, target), dispatch, up, down

    def requests(self, missing: Tensor) -> Tensor:
        """MW that are missing, in ramps."""
        return missing / torch.where(missing > 0.0, self.ramp_up, self.ramp_down)


def balanced(changes: Tensor) -> Tensor:
    """Changes [batch, generator], upwards or downwards shortened alike so that they sum to zero."""
    up, down = changes.clamp(min=0.0), changes.clamp(max=0.0)
    ups, downs = up.sum(dim=1, keepdim=True), -down.sum(dim=1, keepdim=True)
    both = torch.minimum(ups, downs)
    return up * (both / ups.clamp(min=_TRIFLE)) + down * (both / downs.clamp(min=_TRIFLE))


class SetPoints(nn.Module):
    """Means of injections (module docstring), after those of topology entries if there are such."""

    def __init__(self, request: Request, layout: ContinuousLayout, n_topology: int) -> None:
        super().__init__()
        spec, draws = request.spec, (request.style, request.generator)
        assert spec.grid is not None
        self.given, self.dispatched = Given(spec), Dispatched(spec, layout.redispatch)
        self.layers = stacked((self.given.size, *request.layers, layout.size), *draws)
        self.topology: Layers | None = None
        if n_topology:
            self.topology = stacked((spec.observation_size, *request.layers, n_topology), *draws)
        self.register_buffer("usual", torch.full((self.given.size,), USUAL))
        self.register_buffer("spread", torch.full((self.given.size,), SPREAD))
        keep(self, largest=torch.tensor(spec.grid.gen_pmax[layout.redispatch]))

    usual: Tensor
    spread: Tensor
    largest: Tensor

    def reads(self, observations: Tensor) -> Tensor:
        """What is read of observations [batch, observation_size], before it is standardised, [batch, ...]."""
        read: Tensor = self.given(observations)
        return read

    def standardise(self, means: F64, deviations: F64) -> None:
        """Read everything by how it differs from what is usual; both [...] as :meth:`reads` has it."""
        self.usual.copy_(torch.from_numpy(means))
        self.spread.copy_(torch.from_numpy(deviations + LEAST_SPREAD))

    def forward(self, observations: Tensor) -> Tensor:
        """Observations [batch, observation_size] -> means [batch, action_size]."""
        return self.aims_and_means(observations)[1]

    def aims_and_means(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """The action that would bring all generators there at once, and what a step can do, [batch, action_size]."""
        said = self.layers((self.given(observations) - self.usual) / self.spread)
        n = len(self.largest)
        wanted, others = said[:, :n] * self.largest, said[:, n:]
        asked, dispatch, up, down = self.dispatched(observations)
        changes = balanced(torch.minimum(torch.maximum(wanted - dispatch, -down), up))
        aims = self.dispatched.requests(wanted - asked)
        means = self.dispatched.requests(dispatch + changes - asked).clamp(-1.0, 1.0)
        topology = [] if self.topology is None else [self.topology(observations)]
        return torch.cat([*topology, aims, others], dim=1), torch.cat([*topology, means, others], dim=1)


def make(request: Request) -> nn.Module:
    """A network of set-points where means of continuous actions are asked for, else layers one after the other.

    Raises:
        UsageError: actions are discrete, or more than means is asked for.
    """
    spec, actions = request.spec, request.spec.actions
    if not spec.continuous:
        raise UsageError(
            f"Network {NAME!r} is for redispatching tasks, and for joint ones with joint_actions 'box': here actions "
            "are discrete."
        )
    if not request.output.per_action:
        return build(request)
    if request.output != PER_ACTION:
        raise UsageError(
            f"Network {NAME!r} gives means alone, which SAC's policy is not: choose ppo, td3, or imitation with policy "
            "ppo."
        )
    if isinstance(actions, JointActions):
        return SetPoints(request, actions.injection, len(actions.topology))
    assert isinstance(actions, ContinuousLayout)
    return SetPoints(request, actions, 0)


NETWORK = Network(NAME, make, reads_normalized=False, needs_grid=True, row_by_row=True)
