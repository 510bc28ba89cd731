"""PPO's steps on a minibatch, made by compiled code as a whole (:mod:`rl2grid.dense.surrogate`).

They are those of :mod:`rl2grid.algorithms.ppo`, up to rounding: PyTorch spends most of the time of a small network on
everything but its arithmetic.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from rl2grid.algorithms.descent import Adam
from rl2grid.algorithms.networks.mlp import shape_of
from rl2grid.arrays import I64
from rl2grid.dense.surrogate import shift_and_scale, write_policy_gradients, write_value_gradients


@dataclass(frozen=True)
class Perceptron:
    """A network that is a group of an optimiser."""

    widths: I64
    activations: I64
    optimizer: Adam
    group: int

    def descend(self, max_norm: float) -> None:
        """One step down the gradients."""
        self.optimizer.flat(self.group).descend(self.optimizer.param_groups[self.group], max_norm)


def _perceptron(network: nn.Module, optimizer: Adam, group: int) -> Perceptron | None:
    shape = shape_of(network)
    return None if shape is None else Perceptron(*shape, optimizer, group)


@dataclass(frozen=True)
class PolicySteps:
    """Steps of a categorical policy."""

    policy: Perceptron
    args: Any
    """Of PPO."""

    def step(self, data: Any, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """One step on the transitions ``rows``: surrogate, entropy, approximate divergence, share that is clipped."""
        args, flat = self.args, self.policy.optimizer.flat(self.policy.group)
        advantages, losses = data.advantages[rows].numpy(), torch.empty(4, dtype=torch.float64)
        if args.normalize_advantages:
            shift_and_scale(advantages)
        legal = data.masks
        if legal is None:
            legal = torch.ones(len(data.actions), int(self.policy.widths[-1]), dtype=torch.bool)
        write_policy_gradients(
            rows.numpy(),
            data.observations.numpy(),
            legal.numpy(),
            data.actions.numpy(),
            data.log_probabilities.numpy(),
            advantages,
            self.policy.widths,
            self.policy.activations,
            flat.weights.numpy(),
            args.clip_coefficient,
            args.entropy_coefficient,
            flat.gradients.numpy(),
            losses.numpy(),
        )
        self.policy.descend(args.max_grad_norm)
        surrogate, entropy, divergence, clipped = losses.float().unbind()
        return surrogate, entropy, divergence, clipped


@dataclass(frozen=True)
class ValueSteps:
    """Steps of a critic."""

    critic: Perceptron
    args: Any
    """Of PPO."""

    def step(self, rows: Tensor, observations: Tensor, old_values: Tensor, returns: Tensor) -> Tensor:
        """One step on some transitions; half the mean squared error.

        Args:
            rows: int64 [batch], which ones.
            observations: [transition, size], normalised as in training.
            old_values: [transition], what the critic said when the actions were chosen.
            returns: [transition], what it should say.
        """
        args, flat = self.args, self.critic.optimizer.flat(self.critic.group)
        error = write_value_gradients(
            rows.numpy(),
            observations.numpy(),
            old_values.numpy(),
            returns.numpy(),
            self.critic.widths,
            self.critic.activations,
            flat.weights.numpy(),
            args.clip_coefficient if args.clip_value_loss else math.inf,
            args.value_coefficient,
            flat.gradients.numpy(),
        )
        self.critic.descend(args.max_grad_norm)
        return torch.tensor(error, dtype=torch.float32)


def policy_steps(network: Any, optimizer: Adam, args: Any) -> PolicySteps | None:
    """Those of the policy of an :class:`~rl2grid.algorithms.on_policy.ActorCritic`; None where PyTorch makes them."""
    policy = None if network.continuous else _perceptron(network.actor, optimizer, 0)
    return None if policy is None else PolicySteps(policy, args)


def value_steps(network: Any, optimizer: Adam, args: Any) -> list[ValueSteps] | None:
    """Those of the critic and of the costs' critics, each a group of the optimiser; None where PyTorch makes them."""
    critics = [
        _perceptron(critic, optimizer, group) for group, critic in enumerate((network.critic, *network.cost_critics))
    ]
    known = [critic for critic in critics if critic is not None]
    return [ValueSteps(critic, args) for critic in known] if len(known) == len(critics) else None
