"""Proximal policy optimisation (Schulman et al., 2017) for topology and redispatching tasks, in one file.

Transitions of varying length
    Between two decisions the grid makes n_k >= 1 steps (heuristics, or a reset, play the others): a
    semi-Markov decision process. With the discount gamma of one grid step, transition k is worth

        R_k = sum over j < n_k of gamma^j r_{k,j}                  info["discounted_reward"]

    and generalised advantage estimation (Schulman et al., 2016) reads

        delta_k = R_k + gamma^{n_k} V_{k+1} - V(s_k)
        A_k     = delta_k + gamma^{n_k} lambda A_{k+1}             (lambda decays per decision)

    The critic is fitted to A_k + V(s_k). Where an episode ends, A_{k+1} = 0. V_{k+1} = 0 if it was
    terminated (game over); if it was truncated (month completed) V_{k+1} is the value of its last
    observation, because the grid would have gone on. The next episode's first observation never enters.

Policies
    Discrete: a categorical distribution; with masks, illegal actions have probability zero, and the
    entropy is that of the legal ones. Continuous: a diagonal Gaussian whose log standard deviations are
    trained, one per dimension, the same in all states. The environment is given the sample clipped into
    [-1, 1]; log-probabilities are those of the sample before clipping, so clipping belongs to the
    environment and the ratio of probabilities is exact. The deterministic action is the most probable
    one, or the clipped mean.

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
    actor_learning_rate: float = 3e-4
    """Adam's step size for the policy."""
    critic_learning_rate: float = 3e-4
    """Adam's step size for the value function."""
    anneal_learning_rate: bool = True
    """Whether both step sizes fall linearly to zero over the run."""
    num_minibatches: int = 4
    """Parts into which the transitions of an update are split at random, in every epoch anew."""
    update_epochs: int = 10
    """Passes over the transitions of an update."""
    clip_coefficient: float = 0.2
    """The surrogate objective gains nothing from ratios outside 1 +- this."""
    clip_value_loss: bool = False
    """Whether the critic's change per update is clipped by the same coefficient."""
    normalize_advantages: bool = True
    """Whether the advantages of a minibatch are shifted and scaled to mean 0 and deviation 1."""
    entropy_coefficient: float = 0.01
    """Weight of the policy's entropy in the objective."""
    value_coefficient: float = 0.5
    """Weight of the critic's loss."""
    max_grad_norm: float = 0.5
    """Gradients of the actor, and those of the critic, are scaled down to this norm when longer."""
    target_kl: float | None = 0.03
    """An update ends after the epoch in which the approximate KL divergence passes this; None: never early."""
    mask_actions: bool = True
    """Discrete actions only: whether illegal actions are excluded (the environment has ``action_masks()``)."""
    normalize_observations: bool = True
    """Whether observations are scaled by running statistics shared by all environments."""
    actor_layers: tuple[int, ...] = (128, 128)
    """Widths of the policy's hidden layers (tanh)."""
    critic_layers: tuple[int, ...] = (128, 128)
    """Widths of the value function's hidden layers (tanh)."""
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
                raise UsageError(f"PPO needs {name} of at least 1, not {getattr(self, name)}.")
        for name in ("gamma", "gae_lambda"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise UsageError(f"PPO needs {name} between 0 and 1, not {getattr(self, name)}.")
        for name in ("actor_learning_rate", "critic_learning_rate", "clip_coefficient", "max_grad_norm"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise UsageError(f"PPO needs a positive {name}, not {getattr(self, name)}.")
        for name in ("actor_layers", "critic_layers"):
            if any(width < 1 for width in getattr(self, name)):
                raise UsageError(f"PPO needs {name} of widths of at least 1, not {getattr(self, name)}.")
        if self.initial_do_nothing is not None and not 0.0 < self.initial_do_nothing < 1.0:
            raise UsageError(f"PPO needs initial_do_nothing above 0 and below 1, not {self.initial_do_nothing}.")
        if self.device not in DEVICES:
            raise one_of("Device", self.device, DEVICES)
        if self.seed < 0:
            raise UsageError(f"PPO needs a seed of at least 0, not {self.seed}.")
        if self.gamma == 1.0 and self.reward_scale is None:
            raise UsageError("PPO with gamma 1 needs a reward_scale, because 1 - gamma would be zero.")
        if self.total_timesteps < self.num_envs * self.num_steps:
            raise UsageError(
                f"PPO needs total_timesteps of at least num_envs * num_steps = {self.num_envs * self.num_steps}, "
                f"not {self.total_timesteps}."
            )


def default(*, continuous: bool) -> Args:
    """Our own values: few environments, small updates, for tasks with a heuristic on a small machine.

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
    norm 10, learning rates 3e-4 (topology) or 3e-5 (redispatching). Where the table is silent: the layers, the value
    clipping and the annealing of the authors' published configuration, and CleanRL's entropy coefficients.
    """
    learning_rate = 3e-5 if continuous else 3e-4
    return Args(
        total_timesteps=80_000_000,
        num_envs=50,
        num_steps=400,
        gamma=0.9,
        reward_scale=1.0,
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
The weights of the reward, which it searched as well, belong to the environment."""


def preset(name: str, *, continuous: bool, **changes: Any) -> Args:
    """A preset for tasks with continuous or discrete actions, some values changed.

    Raises:
        UsageError: no such preset, or values that cannot work.
    """
    if name not in PRESETS:
        raise one_of("PPO's preset", name, tuple(PRESETS))
    return replace(PRESETS[name](continuous=continuous), **changes)


# --- Networks -------------------------------------------------------------------------------------------------------

_ILLEGAL_LOGIT = -1e8
"""Probability exactly zero in float32, and yet finite, so that zero times its logarithm is zero."""


class ActorCritic(nn.Module):
    """The policy and the value function: two separate tanh networks."""

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        *,
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
    ended: Tensor
    """bool, the episode ended with this transition"""
    decided: Tensor
    """bool, the action had an effect; False where the episode had ended before the agent's first decision"""


def generalized_advantages(rollout: Rollout, gae_lambda: float) -> Tensor:
    """A_k of all transitions [num_steps, num_envs] (equations above)."""
    deltas = rollout.rewards + rollout.discounts * rollout.next_values - rollout.values
    decays = rollout.discounts * gae_lambda * (~rollout.ended)
    advantages = torch.empty_like(deltas)
    following = torch.zeros_like(deltas[0])
    for k in reversed(range(len(deltas))):
        following = deltas[k] + decays[k] * following
        advantages[k] = following
    return advantages


class Minibatch(NamedTuple):
    """Some transitions of a rollout; every array is [batch, ...]."""

    observations: Tensor
    masks: Tensor | None
    actions: Tensor
    log_probabilities: Tensor
    values: Tensor
    advantages: Tensor
    returns: Tensor

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
        )


class Losses(NamedTuple):
    """The loss, its parts, and how far the policy has moved; all scalars."""

    total: Tensor
    policy: Tensor
    value: Tensor
    entropy: Tensor
    approximate_kl: Tensor
    """mean of (ratio - 1) - log ratio, an unbiased estimate of KL(old || new) (Schulman, 2020)"""
    clip_fraction: Tensor
    """share of ratios outside 1 +- clip_coefficient"""


def losses(network: ActorCritic, batch: Minibatch, args: Args) -> Losses:
    """PPO's clipped surrogate, the critic's squared error and the entropy, to be minimised."""
    log_probabilities, entropies = network.log_probability_and_entropy(batch.observations, batch.actions, batch.masks)
    log_ratios = log_probabilities - batch.log_probabilities
    ratios = log_ratios.exp()

    advantages = batch.advantages
    if args.normalize_advantages:
        advantages = (advantages - advantages.mean()) / (advantages.std(correction=0) + 1e-8)
    clipped_ratios = ratios.clamp(1.0 - args.clip_coefficient, 1.0 + args.clip_coefficient)
    policy = -torch.minimum(advantages * ratios, advantages * clipped_ratios).mean()

    values = network.value(batch.observations)
    squared_errors = (values - batch.returns).square()
    if args.clip_value_loss:
        changes = (values - batch.values).clamp(-args.clip_coefficient, args.clip_coefficient)
        squared_errors = torch.maximum(squared_errors, (batch.values + changes - batch.returns).square())
    value = 0.5 * squared_errors.mean()

    entropy = entropies.mean()
    total = policy - args.entropy_coefficient * entropy + args.value_coefficient * value
    with torch.no_grad():
        approximate_kl = (ratios - 1.0 - log_ratios).mean()
        clip_fraction = ((ratios - 1.0).abs() > args.clip_coefficient).float().mean()
    return Losses(total, policy.detach(), value.detach(), entropy.detach(), approximate_kl, clip_fraction)


# --- Training -------------------------------------------------------------------------------------------------------


class PPO:
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
        self.continuous = check_environments("PPO", envs, num_envs=args.num_envs, mask_actions=args.mask_actions)
        self.envs = NormalizeObservation(envs) if args.normalize_observations else envs
        self.generator = torch.Generator().manual_seed(args.seed)
        observation_shape, action_space = envs.single_observation_space.shape, envs.single_action_space
        assert observation_shape is not None
        self.network = ActorCritic(
            observation_shape[0],
            action_space.shape[0] if isinstance(action_space, Box) else int(action_space.n),  # type: ignore[attr-defined]
            continuous=self.continuous,
            actor_layers=args.actor_layers,
            critic_layers=args.critic_layers,
            initial_log_std=args.initial_log_std,
            generator=self.generator,
        )
        if args.initial_do_nothing is not None and not self.continuous:
            self.network.prefer_first_action(args.initial_do_nothing)
        self.network.to(self.device)
        self._groups = (self.network.actor_parameters(), list(self.network.critic.parameters()))
        self.optimizer = torch.optim.Adam([{"params": parameters} for parameters in self._groups], eps=1e-5)
        self.reward_scale = 1.0 - args.gamma if args.reward_scale is None else args.reward_scale

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

    @property
    def finished(self) -> bool:
        """Whether the budget of decisions is used up."""
        return self.iteration >= self.num_iterations

    def iterate(self) -> dict[str, float]:
        """Play ``num_steps`` decisions in every environment, learn from them, and return the metrics."""
        if self._observations is None:
            self._observations, infos = self.envs.reset(seed=self.args.seed * self.args.num_envs)
            self._over = reported(infos, "over", np.zeros(self.args.num_envs, np.bool_))
        rollout, playing_metrics = self.collect()
        learning_metrics = self.update(rollout)
        self.iteration += 1
        return {**playing_metrics, **learning_metrics}

    def collect(self) -> tuple[Rollout, dict[str, float]]:
        """Play one rollout."""
        tally = Tally()
        steps = [self._play(tally) for _ in range(self.args.num_steps)]
        columns = [None if column[0] is None else torch.stack(column) for column in zip(*steps, strict=True)]
        rollout = Rollout(*columns)  # type: ignore[arg-type]
        with torch.no_grad():
            last_values = self.network.value(self._tensor(self._observations, torch.float32))
        following = torch.cat([rollout.values[1:], last_values.unsqueeze(0)])
        rollout = rollout._replace(next_values=torch.where(rollout.ended, rollout.next_values, following))
        return rollout, {**tally.metrics(), "charts/grid_steps": float(self.grid_steps)}

    def _play(self, tally: Tally) -> Rollout:
        """One decision in every environment: a slice of a rollout, its ``next_values`` known where episodes ended."""
        args, network = self.args, self.network
        observations = self._tensor(self._observations, torch.float32)
        masks = self._tensor(self.envs.action_masks()) if args.mask_actions else None  # type: ignore[attr-defined]
        with torch.no_grad():
            actions = network.act(observations, masks, self.generator)
            log_probabilities, _ = network.log_probability_and_entropy(observations, actions, masks)
            values = network.value(observations)
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
        self.decisions += args.num_envs
        self.grid_steps += int(n_steps.sum())
        self._episode_return += rewards
        self._episode_length += 1
        tally.note(n_steps, seconds, infos, ended, self._episode_return, self._episode_length)
        self._episode_return[ended] = 0.0
        self._episode_length[ended] = 0
        return Rollout(
            observations,
            masks,
            actions,
            log_probabilities,
            rewards=self._tensor(discounted * self.reward_scale, torch.float32),
            discounts=self._tensor(args.gamma**n_steps, torch.float32),
            values=values,
            next_values=self._values_at_truncation(infos, truncated & ~terminated),
            ended=self._tensor(ended),
            decided=self._tensor(decided),
        )

    def update(self, rollout: Rollout) -> dict[str, float]:
        """Improve the networks on a rollout; transitions that no decision began are left out."""
        args = self.args
        learning_rates = self._set_learning_rates()
        advantages = generalized_advantages(rollout, args.gae_lambda)
        returns = advantages + rollout.values
        data = Minibatch(
            rollout.observations.flatten(0, 1),
            None if rollout.masks is None else rollout.masks.flatten(0, 1),
            rollout.actions.flatten(0, 1),
            rollout.log_probabilities.flatten(),
            rollout.values.flatten(),
            advantages.flatten(),
            returns.flatten(),
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
            "mask_actions": self.args.mask_actions,
            "actor_layers": list(self.args.actor_layers),
            "critic_layers": list(self.args.critic_layers),
        }

    def state_dict(self) -> dict[str, Any]:
        """All that is needed to go on, after an iteration."""
        return {
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "generator": self.generator.get_state(),
            "iteration": self.iteration,
            "decisions": self.decisions,
            "grid_steps": self.grid_steps,
            "observations": np.array(self._observations),
            "over": self._over,
            "episode_return": self._episode_return,
            "episode_length": self._episode_length,
            "envs": self.envs.state_dict(),  # type: ignore[attr-defined]
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where ``state_dict`` was called, bit for bit.

        Raises:
            UsageError: the environments, played again, are not where they were.
        """
        self.network.load_state_dict(state["network"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["generator"])
        self.iteration, self.decisions = state["iteration"], state["decisions"]
        self.grid_steps = state["grid_steps"]
        self._observations = np.array(state["observations"])
        self._over = np.array(state["over"])
        self._episode_return = np.array(state["episode_return"])
        self._episode_length = np.array(state["episode_length"])
        resume_environments(self.envs, state["envs"], self._observations)

    def _playable(self, actions: Tensor) -> NDArray[Any]:
        """What the environments are given: ids, or the actions clipped into their box."""
        actions = actions.cpu()
        return actions.clamp(-1.0, 1.0).numpy() if self.continuous else actions.numpy()

    def _tensor(self, array: Any, dtype: torch.dtype | None = None) -> Tensor:
        """A copy of an array on the networks' device."""
        return torch.tensor(array, dtype=dtype, device=self.device)

    def _values_at_truncation(self, infos: Mapping[str, Any], truncated: NDArray[np.bool_]) -> Tensor:
        """V of the last observations of truncated episodes, 0 elsewhere [num_envs]."""
        values = torch.zeros(len(truncated), device=self.device)
        if truncated.any():
            last = np.stack([infos["final_obs"][i] for i in np.flatnonzero(truncated)])
            with torch.no_grad():
                values[self._tensor(truncated)] = self.network.value(self._tensor(last, torch.float32))
        return values

    def _set_learning_rates(self) -> tuple[float, float]:
        remaining = 1.0 - self.iteration / self.num_iterations if self.args.anneal_learning_rate else 1.0
        rates = (remaining * self.args.actor_learning_rate, remaining * self.args.critic_learning_rate)
        for group, rate in zip(self.optimizer.param_groups, rates, strict=True):
            group["lr"] = rate
        return rates

    def _descend(self, batch: Minibatch) -> Losses:
        loss = losses(self.network, batch, self.args)
        self.optimizer.zero_grad()
        loss.total.backward()  # type: ignore[no-untyped-call]
        for parameters in self._groups:
            nn.utils.clip_grad_norm_(parameters, self.args.max_grad_norm)
        self.optimizer.step()
        return loss._replace(total=loss.total.detach())
