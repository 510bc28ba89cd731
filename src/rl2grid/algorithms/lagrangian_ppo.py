"""Lagrangian PPO (Ray, Achiam and Amodei, 2019) for tasks with safety constraints, in one file.

What is solved
    With the cost C_i of an episode (the sum of ``info["costs"]`` over all its grid steps, not discounted)
    and its threshold d_i (LSI 0, TLO 50):

        maximise the expected return subject to the expected C_i <= d_i for every constraint i.

    Every constraint has a multiplier lambda_i >= 0, the price of its cost. Its Lagrangian, return minus
    sum_i lambda_i (C_i - d_i), is maximised by PPO over the policy and minimised over the multipliers:

        e_i      =  (mean C_i - d_i) / max(d_i, 1)
        I_i      <- clip(I_i + eta e_i)              between 0 and the maximum
        lambda_i <- clip(I_i + kappa e_i)            likewise

    once per update, before the policy moves. The mean is over the episodes that ended since the last update,
    those that ended inside ``reset`` among them; without any, the multipliers stay. Dividing by the threshold
    makes one eta serve thresholds of 0 and of 50. With kappa = 0 this is the projected gradient step, around whose
    solution policy and multipliers circle; kappa > 0 damps that (Stooke, Achiam and Abbeel, 2020) and moves no
    fixed point. The maximum keeps a multiplier that rose while all episodes were far from safe from staying high
    for long afterwards.

Transitions of varying length
    Between two decisions the grid makes n_k >= 1 steps (heuristics, or a reset, play the others): a
    semi-Markov decision process. With the discount gamma of one grid step, transition k is worth

        R_k = sum over j < n_k of gamma^j r_{k,j}                  info["discounted_reward"]

    and generalised advantage estimation (Schulman et al., 2016) reads

        delta_k = R_k + gamma^{n_k} V_{k+1} - V(s_k)
        A_k     = delta_k + gamma^{n_k} lambda A_{k+1}             (this lambda decays per decision)

    The critic is fitted to A_k + V(s_k). Where an episode ends, A_{k+1} = 0. V_{k+1} = 0 if it was
    terminated (game over); if it was truncated (month completed) V_{k+1} is the value of its last
    observation, because the grid would have gone on. The next episode's first observation never enters.

    Every cost has a critic of its own, and advantages A^i_k by the same equations with the transition's sum
    of costs (all its grid steps count fully, as in the constraint) and the discount ``cost_gamma``.

The objective
    PPO's clipped surrogate of the advantages of the Lagrangian,

        (A_k - sum_i lambda_i A^i_k) / (1 + sum_i lambda_i),

    which are shifted and scaled per minibatch after they were combined: scaling them one by one would
    change the price that the multipliers stand for. What costs more than expected becomes less probable.

Policies
    Discrete: a categorical distribution; with masks, illegal actions have probability zero, and the
    entropy is that of the legal ones. Continuous: a diagonal Gaussian whose log standard deviations are
    trained, one per dimension, the same in all states. The environment is given the sample clipped into
    [-1, 1]; log-probabilities are those of the sample before clipping, so clipping belongs to the
    environment and the ratio of probabilities is exact. The deterministic action is the most probable
    one, or the clipped mean. A constraint that binds is met exactly by a policy that mixes actions, so the
    deterministic one may be safer than the threshold, or less safe.

Randomness
    Initial weights, actions and minibatches come from one generator seeded by ``Args.seed`` and saved
    with the checkpoint; nothing reads a global random state. Environment i is seeded
    ``seed * num_envs + i``: runs of different seeds share no episode.

Devices
    The networks and a rollout live on ``Args.device``; environments, normalisation and all random draws stay
    on the CPU, so that a checkpoint made on one device can be resumed on another. Results are the same bit by
    bit on one kind of device, not across kinds.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from torch import Tensor, nn

from rl2grid.algorithms.devices import DEVICES, find_device
from rl2grid.algorithms.diagnostics import explained_variance, mean
from rl2grid.algorithms.playing import Tally, check_environments, of_transition, reported, resume_environments
from rl2grid.envs.normalization import NormalizeObservation
from rl2grid.errors import UsageError, one_of
from rl2grid.mdp.constraints import THRESHOLDS

# --- Hyperparameters ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Args:
    """Hyperparameters; the presets below change some of the values here."""

    seed: int = 1
    """Of the initial weights, the exploration, the minibatches and the episodes."""
    total_timesteps: int = 200_000
    """Decisions to train for, over all environments; never exceeded."""
    num_envs: int = 16
    """Environments played side by side."""
    num_steps: int = 64
    """Decisions per environment between two updates."""
    gamma: float = 0.99
    """Discount of one grid step (a transition of n grid steps is discounted by gamma ** n)."""
    gae_lambda: float = 0.95
    """Decay of advantage estimates per decision; 0 trusts the critic alone, 1 the returns alone."""
    reward_scale: float | None = None
    """Factor on rewards; None: 1 - gamma, which turns returns into mean rewards, of order one for any gamma."""
    constraints: tuple[str, ...] = ()
    """Names of costs in ``info["costs"]`` (``LSI``, ``TLO``) that are constrained; empty: that of the task."""
    thresholds: tuple[float, ...] = ()
    """What the cost of an episode may be on average, one per constraint; empty: those of LSI and TLO, 0 and 50."""
    multiplier_learning_rate: float = 0.05
    """Rise of a multiplier per update in which costs exceed the threshold by itself (by 1, if it is below 1)."""
    multiplier_damping: float = 0.5
    """Further rise for such an update, which the next one takes back (kappa above); 0: plain gradient steps."""
    initial_multiplier: float = 0.0
    """Where the multipliers start."""
    max_multiplier: float | None = 10.0
    """What no multiplier exceeds; None: they are not bounded."""
    cost_gamma: float | None = None
    """Discount of a grid step for the critics of the costs; None: ``gamma``."""
    cost_scale: float | None = None
    """Factor on costs for critics and advantages (not for the multipliers' steps); None: 1 - cost_gamma."""
    actor_learning_rate: float = 3e-4
    """Adam's step size for the policy."""
    critic_learning_rate: float = 3e-4
    """Adam's step size for the value functions of reward and costs."""
    anneal_learning_rate: bool = True
    """Whether both step sizes fall linearly to zero over the run; the multipliers' does not."""
    num_minibatches: int = 4
    """Parts into which the transitions of an update are split at random, in every epoch anew."""
    update_epochs: int = 10
    """Passes over the transitions of an update."""
    clip_coefficient: float = 0.2
    """The surrogate objective gains nothing from ratios outside 1 +- this."""
    clip_value_loss: bool = False
    """Whether the critics' change per update is clipped by the same coefficient."""
    normalize_advantages: bool = True
    """Whether the combined advantages of a minibatch are shifted and scaled to mean 0 and deviation 1."""
    entropy_coefficient: float = 0.01
    """Weight of the policy's entropy in the objective."""
    value_coefficient: float = 0.5
    """Weight of the loss of every critic."""
    max_grad_norm: float = 0.5
    """Gradients of the actor, and those of each critic, are scaled down to this norm when longer."""
    target_kl: float | None = 0.03
    """An update ends after the epoch in which the approximate KL divergence passes this; None: never early."""
    mask_actions: bool = True
    """Discrete actions only: whether illegal actions are excluded (the environment has ``action_masks()``)."""
    normalize_observations: bool = True
    """Whether observations are scaled by running statistics shared by all environments."""
    actor_layers: tuple[int, ...] = (128, 128)
    """Widths of the policy's hidden layers (tanh)."""
    critic_layers: tuple[int, ...] = (128, 128)
    """Widths of the hidden layers of the value functions of reward and costs (tanh)."""
    initial_do_nothing: float | None = None
    """Discrete actions only: probability of action 0 before training; None: all actions are about alike."""
    initial_log_std: float = -1.0
    """Continuous actions only: where the trained log standard deviations start."""
    torch_threads: int = 1
    """Threads of PyTorch; results are reproducible bit by bit for a given number only."""
    device: str = "cpu"
    """Where the networks are: ``cpu``, ``cuda``, or ``auto`` (``cuda`` if there is one)."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work.

        Raises:
            UsageError: naming the first such value.
        """
        counts = ("num_envs", "num_steps", "num_minibatches", "update_epochs", "torch_threads")
        for name in counts:
            if getattr(self, name) < 1:
                raise UsageError(f"Lagrangian PPO needs {name} of at least 1, not {getattr(self, name)}.")
        for name in ("gamma", "gae_lambda"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise UsageError(f"Lagrangian PPO needs {name} between 0 and 1, not {getattr(self, name)}.")
        for name in ("actor_learning_rate", "critic_learning_rate", "clip_coefficient", "max_grad_norm"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise UsageError(f"Lagrangian PPO needs a positive {name}, not {getattr(self, name)}.")
        for name in ("actor_layers", "critic_layers"):
            if any(width < 1 for width in getattr(self, name)):
                raise UsageError(f"Lagrangian PPO needs {name} of widths of at least 1, not {getattr(self, name)}.")
        if self.initial_do_nothing is not None and not 0.0 < self.initial_do_nothing < 1.0:
            raise UsageError(
                f"Lagrangian PPO needs initial_do_nothing above 0 and below 1, not {self.initial_do_nothing}."
            )
        if self.device not in DEVICES:
            raise one_of("Device", self.device, DEVICES)
        if self.seed < 0:
            raise UsageError(f"Lagrangian PPO needs a seed of at least 0, not {self.seed}.")
        if self.gamma == 1.0 and self.reward_scale is None:
            raise UsageError("Lagrangian PPO with gamma 1 needs a reward_scale, because 1 - gamma would be zero.")
        self._check_constraints()
        if self.total_timesteps < self.num_envs * self.num_steps:
            raise UsageError(
                "Lagrangian PPO needs total_timesteps of at least num_envs * num_steps = "
                f"{self.num_envs * self.num_steps}, not {self.total_timesteps}."
            )

    def _check_constraints(self) -> None:
        cost_gamma = self.gamma if self.cost_gamma is None else self.cost_gamma
        if not 0.0 <= cost_gamma <= 1.0:
            raise UsageError(f"Lagrangian PPO needs cost_gamma between 0 and 1, not {cost_gamma}.")
        if cost_gamma == 1.0 and self.cost_scale is None:
            raise UsageError(
                "Lagrangian PPO with cost_gamma 1 needs a cost_scale, because 1 - cost_gamma would be zero."
            )
        if self.cost_scale is not None and not 0.0 < self.cost_scale < math.inf:
            raise UsageError(f"Lagrangian PPO needs a positive cost_scale, not {self.cost_scale}.")
        for name in ("multiplier_learning_rate", "multiplier_damping"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise UsageError(f"Lagrangian PPO needs {name} of at least 0, not {getattr(self, name)}.")
        maximum = math.inf if self.max_multiplier is None else self.max_multiplier
        if not 0.0 <= self.initial_multiplier <= maximum:
            raise UsageError(
                f"Lagrangian PPO needs initial_multiplier from 0 to max_multiplier, not {self.initial_multiplier}."
            )
        if len(set(self.constraints)) != len(self.constraints):
            raise UsageError(f"Lagrangian PPO needs different constraints, not {', '.join(self.constraints)}.")
        if not all(0.0 <= threshold < math.inf for threshold in self.thresholds):
            raise UsageError("Lagrangian PPO needs thresholds of at least 0.")


def default(*, continuous: bool) -> Args:
    """Our own values: those of PPO, and multipliers that start at zero.

    On topology tasks the untrained policy mostly does nothing: at random, one of the first few actions would
    already cut the grid apart, and most of the budget would be spent on learning that. The discount of 0.9 per
    grid step asks to survive the next quarter of an hour to hour, within which an overloaded line trips.
    """
    if continuous:
        return Args(mask_actions=False, entropy_coefficient=0.0)
    return Args(
        num_steps=16,
        gamma=0.9,
        actor_learning_rate=1e-3,
        critic_learning_rate=1e-3,
        initial_do_nothing=0.6,
    )


def paper(*, continuous: bool) -> Args:
    """The paper's values (its table of hyperparameters, redispatching where ``continuous``).

    20,000 transitions per update in 50 environments, 4 minibatches, 40 epochs, discount 0.9, clipping 0.2, gradient
    norm 10, learning rates 3e-4 (topology) or 3e-5 (redispatching), multipliers by plain gradient steps and without
    bound. Where the table is silent: the layers, the value clipping and the annealing of the authors' published
    configuration, CleanRL's entropy coefficients, and our step size of the multipliers.
    """
    learning_rate = 3e-5 if continuous else 3e-4
    return Args(
        total_timesteps=80_000_000,
        num_envs=50,
        num_steps=400,
        gamma=0.9,
        reward_scale=1.0,
        multiplier_damping=0.0,
        max_multiplier=None,
        cost_scale=1.0,
        actor_learning_rate=learning_rate,
        critic_learning_rate=learning_rate,
        num_minibatches=4,
        update_epochs=40,
        clip_coefficient=0.2,
        clip_value_loss=True,
        entropy_coefficient=0.0 if continuous else 0.01,
        max_grad_norm=10.0,
        target_kl=None,
        mask_actions=False,
        actor_layers=(256, 128, 64),
        critic_layers=(512, 256, 128),
        initial_log_std=0.0,
    )


PRESETS: dict[str, Callable[..., Args]] = {"default": default, "paper": paper}

SEARCH_SPACE: dict[str, tuple[float, ...]] = {
    "num_envs": (10, 20, 50),
    "num_envs * num_steps": (10_000, 20_000, 50_000),
    "gamma": (0.9, 0.95, 0.99),
    "max_grad_norm": (10.0, 20.0, 50.0),
    "num_minibatches": (4, 8, 12),
    "update_epochs": (20, 40, 80),
    "actor_learning_rate": (3e-3, 3e-4, 3e-5),
    "critic_learning_rate": (3e-3, 3e-4, 3e-5),
    "clip_coefficient": (0.1, 0.2, 0.3),
}
"""The values among which the paper searched (its table of hyperparameters); it tells transitions per update, not steps.
The thresholds 0 and 50 that the table lists as well are no choice but what a task asks for. The table gives 0 to TLO
and 50 to LSI, the text the other way round: the tasks follow the text.
The weights of the reward, which it searched as well, belong to the environment."""


def preset(name: str, *, continuous: bool, **changes: Any) -> Args:
    """A preset for tasks with continuous or discrete actions, some values changed.

    Raises:
        UsageError: no such preset, or values that cannot work.
    """
    if name not in PRESETS:
        raise one_of("Lagrangian PPO's preset", name, tuple(PRESETS))
    return replace(PRESETS[name](continuous=continuous), **changes)


# --- Networks -------------------------------------------------------------------------------------------------------

_ILLEGAL_LOGIT = -1e8
"""Probability exactly zero in float32, and yet finite, so that zero times its logarithm is zero."""


class ActorCritic(nn.Module):
    """The policy, the value function, and a value function of every cost: separate tanh networks."""

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        *,
        n_constraints: int,
        continuous: bool,
        actor_layers: Sequence[int],
        critic_layers: Sequence[int],
        initial_log_std: float,
        generator: torch.Generator | None = None,
    ) -> None:
        """``action_size``: number of discrete actions, or dimensions of the continuous action."""
        super().__init__()
        self.observation_size = observation_size
        self.action_size = action_size
        self.continuous = continuous
        self.actor = _network(observation_size, actor_layers, action_size, 0.01, generator)
        self.critic = _network(observation_size, critic_layers, 1, 1.0, generator)
        self.cost_critics = nn.ModuleList(
            _network(observation_size, critic_layers, 1, 1.0, generator) for _ in range(n_constraints)
        )
        if continuous:
            self.log_std = nn.Parameter(torch.full((action_size,), initial_log_std))

    def prefer_first_action(self, probability: float) -> None:
        """Shift the last layer so that action 0 has about this probability in every state."""
        last = self.actor[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            last.bias[0] = math.log(probability / (1.0 - probability) * (self.action_size - 1))

    def actor_parameters(self) -> list[nn.Parameter]:
        """Everything that the policy depends on, the log standard deviations included."""
        return list(self.actor.parameters()) + ([self.log_std] if self.continuous else [])

    def value(self, observations: Tensor) -> Tensor:
        """V of observations [batch, size] -> [batch]."""
        values: Tensor = self.critic(observations)
        return values.squeeze(-1)

    def cost_values(self, observations: Tensor) -> Tensor:
        """The values of the costs of observations [batch, size] -> [batch, constraint]."""
        return torch.cat([critic(observations) for critic in self.cost_critics], dim=-1)

    def act(self, observations: Tensor, masks: Tensor | None, generator: torch.Generator | None) -> Tensor:
        """Actions for observations [batch, size]: int64 [batch], or float32 [batch, dimensions] before clipping.

        Args:
            observations: Normalised as in training.
            masks: Legal discrete actions, bool [batch, actions]; None: all are.
            generator: Source of the sample, on the CPU; None: the most probable action.
        """
        output = self.actor(observations)
        if self.continuous:
            mean: Tensor = output
            if generator is None:
                return mean
            return mean + self.log_std.exp() * torch.randn(mean.shape, generator=generator).to(mean.device)
        log_probabilities = _log_probabilities(output, masks)
        if generator is None:
            return log_probabilities.argmax(dim=-1)
        actions = torch.multinomial(log_probabilities.exp().cpu(), 1, generator=generator)
        return actions.squeeze(-1).to(output.device)

    def log_probability_and_entropy(
        self, observations: Tensor, actions: Tensor, masks: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Of the actions (as ``act`` returned them), and of the policy, each [batch]."""
        output = self.actor(observations)
        if self.continuous:
            deviations = (actions - output) / self.log_std.exp()
            log_densities = -0.5 * deviations.square() - self.log_std - 0.5 * math.log(2 * math.pi)
            entropy = (self.log_std + 0.5 * math.log(2 * math.pi * math.e)).sum()
            return log_densities.sum(dim=-1), entropy.expand(len(actions))
        log_probabilities = _log_probabilities(output, masks)
        entropies = -(log_probabilities.exp() * log_probabilities).sum(dim=-1)
        return log_probabilities.gather(-1, actions.unsqueeze(-1)).squeeze(-1), entropies


def _log_probabilities(logits: Tensor, masks: Tensor | None) -> Tensor:
    if masks is not None:
        logits = logits.masked_fill(~masks, _ILLEGAL_LOGIT)
    return logits.log_softmax(dim=-1)


def _network(
    inputs: int, layers: Sequence[int], outputs: int, output_gain: float, generator: torch.Generator | None
) -> nn.Sequential:
    """A tanh network with orthogonal weights; a small ``output_gain`` makes the first policy nearly indifferent."""
    widths = (inputs, *layers, outputs)
    modules: list[nn.Module] = []
    for k, (width, next_width) in enumerate(itertools.pairwise(widths)):
        last = k == len(widths) - 2
        # Linear's own initialisation would draw from the global random state.
        linear = nn.utils.skip_init(nn.Linear, width, next_width)  # type: ignore[no-untyped-call]
        nn.init.orthogonal_(linear.weight, output_gain if last else math.sqrt(2.0), generator)
        nn.init.zeros_(linear.bias)
        modules += [linear] if last else [linear, nn.Tanh()]
    return nn.Sequential(*modules)


def load_policy(state: Mapping[str, Any]) -> ActorCritic:
    """The networks of a checkpoint's section ``policy``."""
    network = ActorCritic(
        state["observation_size"],
        state["action_size"],
        n_constraints=len(state["constraints"]),
        continuous=state["continuous"],
        actor_layers=state["actor_layers"],
        critic_layers=state["critic_layers"],
        initial_log_std=0.0,
    )
    network.load_state_dict(state["network"])
    return network


# --- What is optimised ----------------------------------------------------------------------------------------------


class Rollout(NamedTuple):
    """What happened between two updates; every array is [num_steps, num_envs, ...]."""

    observations: Tensor
    """float32, normalised with the statistics of their moment"""
    masks: Tensor | None
    """bool, legal discrete actions"""
    actions: Tensor
    """int64, or float32 before clipping"""
    log_probabilities: Tensor
    """of the actions, under the policy that chose them"""
    rewards: Tensor
    """R_k, scaled"""
    discounts: Tensor
    """gamma ** n_k"""
    values: Tensor
    """V(s_k)"""
    next_values: Tensor
    """V_{k+1}: 0 after a termination, of the last observation at a truncation"""
    costs: Tensor
    """[..., constraint], sums over the transitions, scaled"""
    cost_discounts: Tensor
    """cost_gamma ** n_k"""
    cost_values: Tensor
    """[..., constraint]"""
    next_cost_values: Tensor
    """[..., constraint]: 0 after a termination, of the last observation at a truncation"""
    ended: Tensor
    """bool, the episode ended with this transition"""
    decided: Tensor
    """bool, the action had an effect; False where the episode had ended before the agent's first decision"""


def advantages_of_rewards(rollout: Rollout, gae_lambda: float) -> Tensor:
    """A_k of all transitions [num_steps, num_envs] (equations above)."""
    return generalized_advantages(
        rollout.rewards, rollout.discounts, rollout.values, rollout.next_values, rollout.ended, gae_lambda
    )


def advantages_of_costs(rollout: Rollout, gae_lambda: float) -> Tensor:
    """A^i_k of all transitions [num_steps, num_envs, constraint]."""
    return generalized_advantages(
        rollout.costs,
        rollout.cost_discounts.unsqueeze(-1),
        rollout.cost_values,
        rollout.next_cost_values,
        rollout.ended.unsqueeze(-1),
        gae_lambda,
    )


def generalized_advantages(
    amounts: Tensor, discounts: Tensor, values: Tensor, next_values: Tensor, ended: Tensor, gae_lambda: float
) -> Tensor:
    """How much more than expected follows a transition, in rewards or in costs; all arrays are [num_steps, ...]."""
    deltas = amounts + discounts * next_values - values
    decays = discounts * gae_lambda * (~ended)
    advantages = torch.empty_like(deltas)
    following = torch.zeros_like(deltas[0])
    for k in reversed(range(len(deltas))):
        following = deltas[k] + decays[k] * following
        advantages[k] = following
    return advantages


def lagrangian_advantages(advantages: Tensor, cost_advantages: Tensor, multipliers: Tensor) -> Tensor:
    """Rewards [...] at the price of costs [..., constraint], multipliers [constraint], as a weighted mean [...]."""
    return (advantages - (cost_advantages * multipliers).sum(dim=-1)) / (1.0 + multipliers.sum())


class Multipliers(NamedTuple):
    """The prices of the costs; every array is float64 [constraint], in scaled reward per scaled cost."""

    current: NDArray[np.float64]
    """lambda_i"""
    integral: NDArray[np.float64]
    """I_i, which they would be without damping"""

    def step(self, mean_costs: NDArray[np.float64], thresholds: NDArray[np.float64], args: Args) -> Multipliers:
        """The multipliers after episodes of these mean costs, which are per episode and not scaled."""
        excess = (mean_costs - thresholds) / np.maximum(thresholds, 1.0)
        integral = np.clip(self.integral + args.multiplier_learning_rate * excess, 0.0, args.max_multiplier)
        return Multipliers(np.clip(integral + args.multiplier_damping * excess, 0.0, args.max_multiplier), integral)


class Minibatch(NamedTuple):
    """Some transitions of a rollout; every array is [batch, ...]."""

    observations: Tensor
    masks: Tensor | None
    actions: Tensor
    log_probabilities: Tensor
    values: Tensor
    advantages: Tensor
    """of the Lagrangian"""
    returns: Tensor
    cost_values: Tensor
    """[batch, constraint]"""
    cost_returns: Tensor
    """[batch, constraint]"""

    def rows(self, chosen: Tensor) -> Minibatch:
        """The transitions with these indices, int64 [batch]."""
        masks = None if self.masks is None else self.masks[chosen]
        return Minibatch(
            self.observations[chosen],
            masks,
            self.actions[chosen],
            self.log_probabilities[chosen],
            self.values[chosen],
            self.advantages[chosen],
            self.returns[chosen],
            self.cost_values[chosen],
            self.cost_returns[chosen],
        )


class Losses(NamedTuple):
    """The loss, its parts, and how far the policy has moved; scalars but for the costs' part."""

    total: Tensor
    policy: Tensor
    value: Tensor
    cost_values: Tensor
    """[constraint]"""
    entropy: Tensor
    approximate_kl: Tensor
    """mean of (ratio - 1) - log ratio, an unbiased estimate of KL(old || new) (Schulman, 2020)"""
    clip_fraction: Tensor
    """share of ratios outside 1 +- clip_coefficient"""


def losses(network: ActorCritic, batch: Minibatch, args: Args) -> Losses:
    """PPO's clipped surrogate, the critics' squared errors and the entropy, to be minimised."""
    log_probabilities, entropies = network.log_probability_and_entropy(batch.observations, batch.actions, batch.masks)
    log_ratios = log_probabilities - batch.log_probabilities
    ratios = log_ratios.exp()

    advantages = batch.advantages
    if args.normalize_advantages:
        advantages = (advantages - advantages.mean()) / (advantages.std(correction=0) + 1e-8)
    clipped_ratios = ratios.clamp(1.0 - args.clip_coefficient, 1.0 + args.clip_coefficient)
    policy = -torch.minimum(advantages * ratios, advantages * clipped_ratios).mean()

    value = _value_loss(network.value(batch.observations), batch.values, batch.returns, args)
    cost_values = _value_loss(network.cost_values(batch.observations), batch.cost_values, batch.cost_returns, args)

    entropy = entropies.mean()
    total = policy - args.entropy_coefficient * entropy + args.value_coefficient * (value + cost_values.sum())
    with torch.no_grad():
        approximate_kl = (ratios - 1.0 - log_ratios).mean()
        clip_fraction = ((ratios - 1.0).abs() > args.clip_coefficient).float().mean()
    return Losses(
        total,
        policy.detach(),
        value.detach(),
        cost_values.detach(),
        entropy.detach(),
        approximate_kl,
        clip_fraction,
    )


def _value_loss(values: Tensor, old_values: Tensor, returns: Tensor, args: Args) -> Tensor:
    """Half the mean squared error over a batch [batch, ...] -> [...]."""
    squared_errors = (values - returns).square()
    if args.clip_value_loss:
        changes = (values - old_values).clamp(-args.clip_coefficient, args.clip_coefficient)
        squared_errors = torch.maximum(squared_errors, (old_values + changes - returns).square())
    return 0.5 * squared_errors.mean(dim=0)


# --- Training -------------------------------------------------------------------------------------------------------


class LagrangianPPO:
    """One training run: ``iterate`` until ``finished``; ``state_dict`` between two iterations holds all of it."""

    def __init__(self, args: Args, envs: VectorEnv[Any, Any, Any]) -> None:
        """Set up networks and optimiser; the environments are reset at the first iteration.

        Raises:
            UsageError: the environments cannot be learned with these hyperparameters.
        """
        torch.set_num_threads(args.torch_threads)
        torch.use_deterministic_algorithms(True)
        self.args = args
        self.device = find_device(args.device)
        self.continuous = check_environments(
            "Lagrangian PPO", envs, num_envs=args.num_envs, mask_actions=args.mask_actions
        )
        limits = find_limits(args, getattr(getattr(envs.unwrapped, "options", None), "constraint", None))
        self.constraints, self.thresholds = tuple(limits), np.array(list(limits.values()), np.float64)
        self.envs = NormalizeObservation(envs) if args.normalize_observations else envs
        self.generator = torch.Generator().manual_seed(args.seed)
        observation_shape, action_space = envs.single_observation_space.shape, envs.single_action_space
        assert observation_shape is not None
        self.network = ActorCritic(
            observation_shape[0],
            action_space.shape[0] if isinstance(action_space, Box) else int(action_space.n),  # type: ignore[attr-defined]
            n_constraints=len(self.constraints),
            continuous=self.continuous,
            actor_layers=args.actor_layers,
            critic_layers=args.critic_layers,
            initial_log_std=args.initial_log_std,
            generator=self.generator,
        )
        if args.initial_do_nothing is not None and not self.continuous:
            self.network.prefer_first_action(args.initial_do_nothing)
        self.network.to(self.device)
        critics = (self.network.critic, *self.network.cost_critics)
        self._groups = (self.network.actor_parameters(), *(list(critic.parameters()) for critic in critics))
        self.optimizer = torch.optim.Adam([{"params": parameters} for parameters in self._groups], eps=1e-5)
        self.reward_scale = 1.0 - args.gamma if args.reward_scale is None else args.reward_scale
        self.cost_gamma = args.gamma if args.cost_gamma is None else args.cost_gamma
        self.cost_scale = 1.0 - self.cost_gamma if args.cost_scale is None else args.cost_scale
        initial = np.full(len(self.constraints), args.initial_multiplier, np.float64)
        self.multipliers = Multipliers(initial, initial)

        self.num_iterations = args.total_timesteps // (args.num_envs * args.num_steps)
        self.iteration = 0
        self.decisions = 0
        """Decisions made so far, over all environments."""
        self.grid_steps = 0
        """Grid steps behind them."""
        self._observations: NDArray[np.float32] | None = None
        self._over = np.zeros(args.num_envs, np.bool_)
        self._episode_return = np.zeros(args.num_envs, np.float64)
        self._episode_length = np.zeros(args.num_envs, np.int64)
        self._episode_costs = np.zeros((args.num_envs, len(self.constraints)), np.float64)

    @property
    def finished(self) -> bool:
        """Whether the budget of decisions is used up."""
        return self.iteration >= self.num_iterations

    def iterate(self) -> dict[str, float]:
        """Play ``num_steps`` decisions in every environment, learn from them, and return the metrics."""
        if self._observations is None:
            self._observations, infos = self.envs.reset(seed=self.args.seed * self.args.num_envs)
            self._over = reported(infos, "over", np.zeros(self.args.num_envs, np.bool_))
        rollout, episode_costs, playing_metrics = self.collect()
        multiplier_metrics = self.update_multipliers(episode_costs)
        learning_metrics = self.update(rollout)
        self.iteration += 1
        return {**playing_metrics, **multiplier_metrics, **learning_metrics}

    def collect(self) -> tuple[Rollout, NDArray[np.float64], dict[str, float]]:
        """Play one rollout; returns also the costs of the episodes that ended in it, [episode, constraint]."""
        tally = _CostTally(self.constraints, self.thresholds)
        steps = [self._play(tally) for _ in range(self.args.num_steps)]
        columns = [None if column[0] is None else torch.stack(column) for column in zip(*steps, strict=True)]
        rollout = Rollout(*columns)  # type: ignore[arg-type]
        with torch.no_grad():
            last = self._tensor(self._observations, torch.float32)
            last_values, last_cost_values = self.network.value(last), self.network.cost_values(last)
        following = torch.cat([rollout.values[1:], last_values.unsqueeze(0)])
        cost_following = torch.cat([rollout.cost_values[1:], last_cost_values.unsqueeze(0)])
        ended = rollout.ended
        rollout = rollout._replace(
            next_values=torch.where(ended, rollout.next_values, following),
            next_cost_values=torch.where(ended.unsqueeze(-1), rollout.next_cost_values, cost_following),
        )
        return rollout, tally.episode_costs(), {**tally.metrics(), "charts/grid_steps": float(self.grid_steps)}

    def _play(self, tally: _CostTally) -> Rollout:
        """One decision in every environment: a slice of a rollout, its ``next_values`` known where episodes ended."""
        args, network = self.args, self.network
        observations = self._tensor(self._observations, torch.float32)
        masks = self._tensor(self.envs.action_masks()) if args.mask_actions else None  # type: ignore[attr-defined]
        with torch.no_grad():
            actions = network.act(observations, masks, self.generator)
            log_probabilities, _ = network.log_probability_and_entropy(observations, actions, masks)
            values, cost_values = network.value(observations), network.cost_values(observations)
        decided = ~self._over

        begin = time.perf_counter()
        self._observations, rewards, terminated, truncated, infos = self.envs.step(self._playable(actions))
        seconds = time.perf_counter() - begin

        ended = terminated | truncated
        self._over = reported(infos, "over", np.zeros_like(ended)) & ended
        n_steps = of_transition(infos, "n_steps", ended, np.ones(args.num_envs, np.int64))
        discounted = of_transition(infos, "discounted_reward", ended, np.where(n_steps == 1, rewards, np.nan))
        if np.isnan(discounted).any():
            raise UsageError(
                "The environment plays several grid steps per decision without info['discounted_reward']: "
                f"make it with gamma={args.gamma}."
            )
        costs = _costs_of_transition(infos, self.constraints, ended)
        self.decisions += args.num_envs
        self.grid_steps += int(n_steps.sum())
        self._episode_return += rewards
        self._episode_length += 1
        self._episode_costs += costs
        tally.note(n_steps, seconds, infos, ended, self._episode_return, self._episode_length)
        tally.note_costs(ended, truncated & ~terminated, self._episode_costs)
        self._episode_return[ended] = 0.0
        self._episode_length[ended] = 0
        self._episode_costs[ended] = 0.0
        next_values, next_cost_values = self._values_at_truncation(infos, truncated & ~terminated)
        return Rollout(
            observations,
            masks,
            actions,
            log_probabilities,
            rewards=self._tensor(discounted * self.reward_scale, torch.float32),
            discounts=self._tensor(args.gamma**n_steps, torch.float32),
            values=values,
            next_values=next_values,
            costs=self._tensor(costs * self.cost_scale, torch.float32),
            cost_discounts=self._tensor(self.cost_gamma**n_steps, torch.float32),
            cost_values=cost_values,
            next_cost_values=next_cost_values,
            ended=self._tensor(ended),
            decided=self._tensor(decided),
        )

    def update_multipliers(self, episode_costs: NDArray[np.float64]) -> dict[str, float]:
        """Raise the prices of costs above their thresholds, lower the others.

        Args:
            episode_costs: Of the episodes that ended since the last call, not scaled, [episode, constraint].
        """
        metrics: dict[str, float] = {}
        if len(episode_costs):
            mean_costs = episode_costs.mean(axis=0)
            self.multipliers = self.multipliers.step(mean_costs, self.thresholds, self.args)
            names = _metric_names("lagrangian/violation", self.constraints)
            metrics |= zip(names, (mean_costs - self.thresholds).tolist(), strict=True)
        names = _metric_names("lagrangian/multiplier", self.constraints)
        return metrics | dict(zip(names, self.multipliers.current.tolist(), strict=True))

    def update(self, rollout: Rollout) -> dict[str, float]:
        """Improve the networks on a rollout; transitions that no decision began are left out."""
        args = self.args
        learning_rates = self._set_learning_rates()
        advantages = advantages_of_rewards(rollout, args.gae_lambda)
        cost_advantages = advantages_of_costs(rollout, args.gae_lambda)
        returns, cost_returns = advantages + rollout.values, cost_advantages + rollout.cost_values
        multipliers = self._tensor(self.multipliers.current, torch.float32)
        data = Minibatch(
            rollout.observations.flatten(0, 1),
            None if rollout.masks is None else rollout.masks.flatten(0, 1),
            rollout.actions.flatten(0, 1),
            rollout.log_probabilities.flatten(),
            rollout.values.flatten(),
            lagrangian_advantages(advantages, cost_advantages, multipliers).flatten(),
            returns.flatten(),
            rollout.cost_values.flatten(0, 1),
            cost_returns.flatten(0, 1),
        )
        rows = rollout.decided.flatten().nonzero().squeeze(-1)
        history: list[Losses] = []
        epochs = 0
        for _ in range(args.update_epochs if len(rows) else 0):
            order = rows[torch.randperm(len(rows), generator=self.generator).to(self.device)]
            first = len(history)
            for chosen in order.tensor_split(args.num_minibatches):
                if len(chosen):
                    history.append(self._descend(data.rows(chosen)))
            epochs += 1
            if args.target_kl is not None and mean(loss.approximate_kl for loss in history[first:]) > args.target_kl:
                break
        metrics = {
            "losses/policy_loss": mean(loss.policy for loss in history),
            "losses/value_loss": mean(loss.value for loss in history),
            "losses/entropy": mean(loss.entropy for loss in history),
            "losses/approx_kl": mean(loss.approximate_kl for loss in history),
            "losses/clipfrac": mean(loss.clip_fraction for loss in history),
            "losses/explained_variance": explained_variance(rollout.values, returns),
            "charts/learning_rate": learning_rates[0],
            "charts/update_epochs": float(epochs),
        }
        for i, name in enumerate(_metric_names("losses/cost_value_loss", self.constraints)):
            metrics[name] = mean(loss.cost_values[i] for loss in history)
        for i, name in enumerate(_metric_names("losses/cost_explained_variance", self.constraints)):
            metrics[name] = explained_variance(rollout.cost_values[..., i], cost_returns[..., i])
        if self.continuous:
            metrics["charts/action_std"] = float(self.network.log_std.detach().exp().mean())
        return metrics

    def policy_state(self) -> dict[str, Any]:
        """All that is needed to act: see ``load_policy``; ``normalizer`` is None without normalisation."""
        normalizer = self.envs.normalizer.state_dict() if isinstance(self.envs, NormalizeObservation) else None
        return {
            "network": self.network.state_dict(),
            "normalizer": normalizer,
            "observation_size": self.network.observation_size,
            "action_size": self.network.action_size,
            "continuous": self.continuous,
            "constraints": list(self.constraints),
            "mask_actions": self.args.mask_actions,
            "actor_layers": list(self.args.actor_layers),
            "critic_layers": list(self.args.critic_layers),
        }

    def state_dict(self) -> dict[str, Any]:
        """All that is needed to go on, after an iteration."""
        return {
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "multipliers": self.multipliers._asdict(),
            "generator": self.generator.get_state(),
            "iteration": self.iteration,
            "decisions": self.decisions,
            "grid_steps": self.grid_steps,
            "observations": np.array(self._observations),
            "over": self._over,
            "episode_return": self._episode_return,
            "episode_length": self._episode_length,
            "episode_costs": self._episode_costs,
            "envs": self.envs.state_dict(),  # type: ignore[attr-defined]
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where ``state_dict`` was called, bit for bit.

        Raises:
            UsageError: the environments, played again, are not where they were.
        """
        self.network.load_state_dict(state["network"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.multipliers = Multipliers(**{name: np.array(value) for name, value in state["multipliers"].items()})
        self.generator.set_state(state["generator"])
        self.iteration, self.decisions = state["iteration"], state["decisions"]
        self.grid_steps = state["grid_steps"]
        self._observations = np.array(state["observations"])
        self._over = np.array(state["over"])
        self._episode_return = np.array(state["episode_return"])
        self._episode_length = np.array(state["episode_length"])
        self._episode_costs = np.array(state["episode_costs"])
        resume_environments(self.envs, state["envs"], self._observations)

    def _playable(self, actions: Tensor) -> NDArray[Any]:
        """What the environments are given: ids, or the actions clipped into their box."""
        actions = actions.cpu()
        return actions.clamp(-1.0, 1.0).numpy() if self.continuous else actions.numpy()

    def _tensor(self, array: Any, dtype: torch.dtype | None = None) -> Tensor:
        """A copy of an array on the networks' device."""
        return torch.tensor(array, dtype=dtype, device=self.device)

    def _values_at_truncation(self, infos: Mapping[str, Any], truncated: NDArray[np.bool_]) -> tuple[Tensor, Tensor]:
        """Values of rewards [num_envs] and costs [num_envs, constraint] at truncations, 0 elsewhere."""
        values = torch.zeros(len(truncated), device=self.device)
        cost_values = torch.zeros(len(truncated), len(self.constraints), device=self.device)
        if truncated.any():
            last = self._tensor(np.stack([infos["final_obs"][i] for i in np.flatnonzero(truncated)]), torch.float32)
            rows = self._tensor(truncated)
            with torch.no_grad():
                values[rows], cost_values[rows] = self.network.value(last), self.network.cost_values(last)
        return values, cost_values

    def _set_learning_rates(self) -> tuple[float, float]:
        remaining = 1.0 - self.iteration / self.num_iterations if self.args.anneal_learning_rate else 1.0
        rates = (remaining * self.args.actor_learning_rate, remaining * self.args.critic_learning_rate)
        actor, *critics = self.optimizer.param_groups
        actor["lr"] = rates[0]
        for critic in critics:
            critic["lr"] = rates[1]
        return rates

    def _descend(self, batch: Minibatch) -> Losses:
        loss = losses(self.network, batch, self.args)
        self.optimizer.zero_grad()
        loss.total.backward()  # type: ignore[no-untyped-call]
        for parameters in self._groups:
            nn.utils.clip_grad_norm_(parameters, self.args.max_grad_norm)
        self.optimizer.step()
        return loss._replace(total=loss.total.detach())


class _CostTally(Tally):
    """What happened during a rollout, costs of the episodes that ended included."""

    def __init__(self, constraints: tuple[str, ...], thresholds: NDArray[np.float64]) -> None:
        super().__init__()
        self._constraints, self._thresholds = constraints, thresholds
        self._costs: list[NDArray[np.float64]] = []
        self._safe: list[bool] = []

    def note_costs(
        self, ended: NDArray[np.bool_], completed: NDArray[np.bool_], episode_costs: NDArray[np.float64]
    ) -> None:
        """Count the costs [num_envs, constraint] of the episodes that ended, and whether they were safe."""
        self._costs.extend(episode_costs[ended].copy())
        safe = completed & (episode_costs <= self._thresholds).all(axis=1)
        self._safe.extend(safe[ended].tolist())

    def episode_costs(self) -> NDArray[np.float64]:
        """Of the episodes that ended, [episode, constraint]."""
        return np.array(self._costs, np.float64).reshape(-1, len(self._constraints))

    def metrics(self) -> dict[str, float]:
        """Means over decisions and over the episodes that ended (none of the latter if none did)."""
        if not self._costs:
            return super().metrics()
        names = _metric_names("charts/episodic_cost", self._constraints)
        return {
            **super().metrics(),
            **dict(zip(names, self.episode_costs().mean(axis=0).tolist(), strict=True)),
            "charts/safe_episodes": float(np.mean(self._safe)),
        }


def find_limits(args: Args, of_task: str | None) -> dict[str, float]:
    """Threshold by constraint: of the constraints asked for, else of the task's own.

    Args:
        args: Hyperparameters.
        of_task: The constraint of the environments; None: they have none.

    Raises:
        UsageError: there is no constraint, or no threshold for one.
    """
    names = args.constraints or ((of_task,) if of_task else ())
    if not names:
        raise UsageError(
            "Lagrangian PPO needs a constraint: choose a task whose id names LSI or TLO, or set constraint to one of "
            "them."
        )
    if args.thresholds:
        if len(args.thresholds) != len(names):
            raise UsageError(
                f"Lagrangian PPO needs one threshold for each of {', '.join(names)}, not {len(args.thresholds)}."
            )
        return dict(zip(names, args.thresholds, strict=True))
    for name in names:
        if name not in THRESHOLDS:
            raise one_of("Constraint without a given threshold,", name, tuple(THRESHOLDS))
    return {name: THRESHOLDS[name] for name in names}


def _metric_names(name: str, constraints: tuple[str, ...]) -> list[str]:
    """The name itself for a single constraint; one with the constraint's name added for each of several."""
    return [name] if len(constraints) == 1 else [f"{name}_{constraint}" for constraint in constraints]


def _costs_of_transition(
    infos: Mapping[str, Any], constraints: tuple[str, ...], ended: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Sums of the costs over all grid steps of the transitions just played [num_envs, constraint], not scaled."""
    missing = np.full(len(ended), np.nan)
    playing, last = infos.get("costs", {}), infos.get("final_info", {}).get("costs", {})
    columns = [np.where(ended, reported(last, name, missing), reported(playing, name, missing)) for name in constraints]
    costs = np.stack(columns, axis=1)
    if np.isnan(costs).any():
        raise UsageError(f"The environment does not report info['costs'] of {', '.join(constraints)}.")
    return costs
