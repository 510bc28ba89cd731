"""Where generators should be, in place of how they should move: means of continuous actions.

What a teacher asks of a generator in a step depends on how far it has moved it before, and an error of the pupil stays
in that for good. Where it wants the generator to be does not: that follows from schedules, demand and outages. So what
sees nothing of what dispatch has moved says where every redispatchable generator should be, x_g MW beside its schedule,
and the mean of its entry is what is missing of that,

    a_g = (x_g - target_g) / ramp_g                              ramp_g upwards or downwards, as the sign asks

which the environment clips to the ramp of a step. What the layers say of curtailment and storage are the means of those
entries. The topology entries of a joint task, and values, have layers of their own, over the whole observation.

What dispatch has moved are flows, angles, margins, and the generators' power, of which the schedule is left when the
dispatch is taken off. Inputs are observations as the environment gives them, in units of
:mod:`rl2grid.mdp.features`, from which a half is taken before they are multiplied by four.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from rl2grid.algorithms.networks import PER_ACTION, Network, Request
from rl2grid.algorithms.networks.constants import URGENT_STEPS, keep, urgency
from rl2grid.algorithms.networks.mlp import Layers, build, stacked
from rl2grid.arrays import I64
from rl2grid.envs.spec import JointActions, Spec
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError
from rl2grid.mdp.actions import ContinuousLayout
from rl2grid.mdp.features import OPERATOR_FEATURES, physical_scale

NAME = "set-point"
GIVEN = (
    "t", "load_p", "time_before_cooldown_line", "topo_vect", "line_status",
    "time_before_cooldown_sub", "gen_p_before_curtail", "duration_next_maintenance", "storage_charge",
    *OPERATOR_FEATURES["calendar"], *OPERATOR_FEATURES["attacks"],
)  # fmt: skip
"""Features that are read as they are."""


class Given(nn.Module):
    """What of an observation no dispatch has moved."""

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


class SetPoints(nn.Module):
    """Means of injections (module docstring), after those of topology entries if there are such."""

    def __init__(self, request: Request, layout: ContinuousLayout, n_topology: int) -> None:
        super().__init__()
        spec, draws = request.spec, (request.style, request.generator)
        grid, gens = spec.grid, layout.redispatch
        assert grid is not None
        assert spec.shift is not None
        assert spec.scale is not None
        self.given = Given(spec)
        self.layers = stacked((self.given.size, *request.layers, layout.size), *draws)
        self.topology: Layers | None = None
        if n_topology:
            self.topology = stacked((spec.observation_size, *request.layers, n_topology), *draws)
        target = spec.feature("target_dispatch").begin + gens
        keep(
            self,
            targets=torch.from_numpy(target.astype(np.int64)),
            shift=torch.tensor(spec.shift[target]),
            scale=torch.tensor(spec.scale[target]),
            largest=torch.tensor(grid.gen_pmax[gens]),
            ramp_up=torch.tensor(grid.gen_max_ramp_up[gens]),
            ramp_down=torch.tensor(grid.gen_max_ramp_down[gens]),
        )

    targets: Tensor
    shift: Tensor
    scale: Tensor
    largest: Tensor
    ramp_up: Tensor
    ramp_down: Tensor

    def forward(self, observations: Tensor) -> Tensor:
        """Observations [batch, observation_size] -> means [batch, action_size], not clipped."""
        said = self.layers((self.given(observations) - 0.5) * 4.0)
        n = len(self.targets)
        missing = said[:, :n] * self.largest - (observations[:, self.targets] * self.scale + self.shift)
        moves = missing / torch.where(missing > 0.0, self.ramp_up, self.ramp_down)
        topology = [] if self.topology is None else [self.topology(observations)]
        return torch.cat([*topology, moves, said[:, n:]], dim=1)


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


NETWORK = Network(NAME, make, reads_normalized=False, needs_grid=True)
