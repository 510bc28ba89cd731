"""What PPO and Lagrangian PPO have in common: playing a rollout and learning from it in minibatches. What they learn is
in their own files.

Advantages
    Of transitions of varying length (:mod:`rl2grid.algorithms.trainer`), generalised advantage estimation
    (Schulman et al., 2016) reads

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

Randomness and devices
    Minibatches are drawn from the generator of :mod:`rl2grid.algorithms.trainer` as well. The networks and a
    rollout live on ``Args.device``; environments, normalisation and all random draws stay on the CPU, so that a
    checkpoint made on one device can be resumed on another. Results are the same bit by bit on one kind of
    device, not across kinds.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from torch import Tensor, nn

from rl2grid.algorithms.descent import Adam, descend
from rl2grid.algorithms.diagnostics import mean
from rl2grid.algorithms.networks import PER_ACTION, VALUE, NetworkFactory, orthogonal, outputs_of
from rl2grid.algorithms.pair import Pair
from rl2grid.algorithms.playing import Tally
from rl2grid.algorithms.sampling import (
    drawn,
    legal_log_softmax,
    log_probabilities_and_entropies,
    log_probabilities_of,
)
from rl2grid.algorithms.starting import StartingPolicy
from rl2grid.algorithms.teacher import TeacherArgs, divergences
from rl2grid.algorithms.trainer import Played, Trainer
from rl2grid.arrays import F32, Flags

# --- Hyperparameters ------------------------------------------------------------------------------------------------

LOG_STD_LIMITS = (-20, 2)
"""Between which log standard deviations may start: from draws that are all alike to such as seldom fit the bounds."""


@dataclass(frozen=True)
class OnPolicyArgs(TeacherArgs):
    """Hyperparameters that the algorithms share."""

    num_steps: int = 64
    """Decisions per environment between two updates."""
    gae_lambda: float = 0.95
    """Decay of advantage estimates per decision; 0 trusts the critic alone, 1 the returns alone."""
    actor_learning_rate: float = 3e-4
    """Adam's step size for the policy."""
    critic_learning_rate: float = 3e-4
    """Adam's step size for every value function."""
    anneal_learning_rate: bool = True
    """Whether both step sizes fall linearly to zero over the run."""
    num_minibatches: int = 4
    """Parts into which the transitions of an update are split at random, in every epoch anew."""
    update_epochs: int = 10
    """Passes over the transitions of an update."""
    max_grad_norm: float = 0.5
    """Gradients of the actor, and those of each critic, are scaled down to this norm when longer."""
    target_kl: float | None = 0.03
    """An update ends after the epoch in which the approximate KL divergence passes this; None: never early."""
    actor_layers: tuple[int, ...] = (128, 128)
    """Widths of the policy's hidden layers (tanh, in an ``mlp``)."""
    critic_layers: tuple[int, ...] = (128, 128)
    """Widths of every value function's hidden layers (tanh, in an ``mlp``)."""
    initial_do_nothing: float | None = None
    """Discrete actions only: probability of action 0 before training; None: all actions are about alike."""
    initial_log_std: float = -1.0
    """Continuous actions only: where the trained log standard deviations start. Actions are from -1 to 1."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work; see :class:`SharedArgs`."""
        super().__post_init__()
        self._check_counts("num_minibatches", "update_epochs")
        self._check_shares("gae_lambda")
        self._check_positive("actor_learning_rate", "critic_learning_rate")
        self._check_layers("actor_layers", "critic_layers")
        self._check_probability("initial_do_nothing")
        self._check_between(*LOG_STD_LIMITS, "initial_log_std")
        if self.target_kl is not None:
            self._check_positive("target_kl")


# --- Networks -------------------------------------------------------------------------------------------------------


class ActorCritic(nn.Module):
    """The policy, the value function, and a value function of every cost: separate networks."""

    preference = "probability"

    def __init__(
        self,
        networks: NetworkFactory,
        *,
        actor_layers: Sequence[int],
        critic_layers: Sequence[int],
        initial_log_std: float = 0.0,
        initial_do_nothing: float | None = None,
        n_costs: int = 0,
    ) -> None:
        """The arguments are those of :class:`OnPolicyArgs`; ``n_costs``: costs with critics of their own."""
        super().__init__()
        self.observation_size, self.action_size = networks.spec.observation_size, networks.spec.action_size
        self.continuous = networks.spec.continuous
        do_nothing = None if self.continuous else initial_do_nothing
        self.actor = networks.make(PER_ACTION, actor_layers, orthogonal(0.01), do_nothing)
        self.critic = networks.make(VALUE, critic_layers, orthogonal(1.0))
        self.cost_critics = nn.ModuleList(networks.make(VALUE, critic_layers, orthogonal(1.0)) for _ in range(n_costs))
        if self.continuous:
            self.log_std = nn.Parameter(torch.full((self.action_size,), initial_log_std))

    def actor_parameters(self) -> list[nn.Parameter]:
        """Everything that the policy depends on, the log standard deviations included."""
        return list(self.actor.parameters()) + ([self.log_std] if self.continuous else [])

    def value(self, observations: Tensor) -> Tensor:
        """V of observations [batch, size] -> [batch]."""
        values: Tensor = self.critic(observations)
        return values.squeeze(-1)

    def cost_values(self, observations: Tensor) -> Tensor:
        """The values of the costs of observations [batch, size] -> [batch, cost]."""
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
        log_probabilities = legal_log_softmax(output, masks)
        if generator is None:
            return log_probabilities.argmax(dim=-1)
        return drawn(log_probabilities.exp(), generator).to(output.device)

    def sample(self, observations: Tensor, masks: Tensor | None, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """What ``act`` returns, and the log-probabilities of it [batch]."""
        output = self.actor(observations)
        if self.continuous:
            noise = torch.randn(output.shape, generator=generator).to(output.device)
            actions = output + self.log_std.exp() * noise
            return actions, self._log_densities(output, actions)
        log_probabilities = legal_log_softmax(output, masks)
        actions = drawn(log_probabilities.exp(), generator).to(output.device)
        return actions, log_probabilities.gather(-1, actions.unsqueeze(-1)).squeeze(-1)

    def distribution(self, observations: Tensor, masks: Tensor | None) -> tuple[Tensor, ...]:
        """Log-probabilities [batch, actions]; or means [batch, dimensions] and log standard deviations [dimensions]."""
        output = self.actor(observations)
        return (output, self.log_std) if self.continuous else (legal_log_softmax(output, masks),)

    def preferences(self, observations: Tensor, masks: Tensor | None) -> Tensor:
        """Probabilities of discrete actions, [batch, actions]."""
        return legal_log_softmax(self.actor(observations), masks).exp()

    def scores(self, rows: F32, legal: Flags) -> F32:
        """Log-probabilities of discrete actions as of :meth:`distribution`, without tensors; all [batch, ...]."""
        return log_probabilities_of(outputs_of(self.actor, rows), legal)

    def means(self, rows: F32) -> F32:
        """The most probable continuous actions before clipping, without tensors; both [batch, ...]."""
        return outputs_of(self.actor, rows)

    def log_probability_and_entropy(
        self, observations: Tensor, actions: Tensor, masks: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Of the actions (as ``act`` returned them), and of the policy, each [batch]."""
        output = self.actor(observations)
        if self.continuous:
            entropy = (self.log_std + 0.5 * math.log(2 * math.pi * math.e)).sum()
            return self._log_densities(output, actions), entropy.expand(len(actions))
        return log_probabilities_and_entropies(output, masks, actions)

    def _log_densities(self, means: Tensor, actions: Tensor) -> Tensor:
        """Of continuous actions [batch, dimensions], [batch]."""
        deviations = (actions - means) / self.log_std.exp()
        log_densities = -0.5 * deviations.square() - self.log_std - 0.5 * math.log(2 * math.pi)
        return log_densities.sum(dim=-1)


def load_policy(state: Mapping[str, Any]) -> ActorCritic:
    """The networks of a checkpoint's section ``policy``."""
    network = ActorCritic(
        NetworkFactory.from_state(state["factory"]),
        actor_layers=state["actor_layers"],
        critic_layers=state["critic_layers"],
        n_costs=state["n_costs"],
    )
    network.load_state_dict(state["network"])
    return network


# --- Rollouts -------------------------------------------------------------------------------------------------------


class Step(NamedTuple):
    """One decision in every environment; every array is [num_envs, ...]."""

    observations: Tensor
    masks: Tensor | None
    actions: Tensor
    log_probabilities: Tensor
    rewards: NDArray[np.float64]
    n_steps: NDArray[np.int64]
    ended: NDArray[np.bool_]
    completed: NDArray[np.bool_]
    decided: NDArray[np.bool_]
    last: Tensor | None
    """float32 [completed, size], normalised: the last observations of episodes that were completed"""


@dataclass(frozen=True)
class Record:
    """The steps of a rollout; every array is [num_steps, num_envs, ...]."""

    observations: Tensor
    """float32 [num_steps + 1, num_envs, size], normalised with the statistics of their moment; the last ones were not
    acted on yet"""
    masks: Tensor | None
    actions: Tensor
    log_probabilities: Tensor
    rewards: NDArray[np.float64]
    """R_k, not scaled"""
    n_steps: NDArray[np.int64]
    ended: Tensor
    completed: Tensor
    decided: Tensor
    last: Tensor | None
    """float32 [completed, size], normalised: the last observations of completed episodes, in order of steps"""

    def values(self, value: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        """V(s_k) and V_{k+1}, each [num_steps, num_envs, ...], of a function [batch, size] -> [batch, ...]."""
        flat = value(self.observations.flatten(0, 1))
        values = flat.view(*self.observations.shape[:2], *flat.shape[1:])
        at_ends = torch.zeros_like(values[1:])
        if self.last is not None:
            at_ends[self.completed] = value(self.last)
        return values[:-1], values_that_follow(values, at_ends, self.ended)


@dataclass(frozen=True)
class Rollout:
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


def advantages_of_rewards(rollout: Rollout, gae_lambda: float) -> Tensor:
    """A_k of all transitions [num_steps, num_envs] (equations above)."""
    return generalized_advantages(
        rollout.rewards, rollout.discounts, rollout.values, rollout.next_values, rollout.ended, gae_lambda
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


def values_that_follow(values: Tensor, at_ends: Tensor, ended: Tensor) -> Tensor:
    """V_{k+1} [num_steps, num_envs, ...] of V(s_k), one step more: those of the next step, else ``at_ends``.

    The latter where episodes ended, bool [num_steps, num_envs].
    """
    shape = (*ended.shape, *(1 for _ in values.shape[2:]))
    return torch.where(ended.view(shape), at_ends, values[1:])


# --- Training -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Minibatch:
    """Some transitions of a rollout; every array is [batch, ...]."""

    observations: Tensor
    masks: Tensor | None
    actions: Tensor
    log_probabilities: Tensor
    values: Tensor
    advantages: Tensor
    returns: Tensor

    def rows(self, chosen: Tensor) -> Self:
        """The transitions with these indices, int64 [batch]."""
        columns: dict[str, Any] = {
            name: None if array is None else array.index_select(0, chosen) for name, array in vars(self).items()
        }
        return type(self)(**columns)


@dataclass(frozen=True)
class PolicyLosses:
    """What the policy minimises, its parts, and how far the policy has moved; all scalars."""

    total: Tensor
    policy: Tensor
    entropy: Tensor
    approximate_kl: Tensor
    """mean of (ratio - 1) - log ratio, an unbiased estimate of KL(old || new) (Schulman, 2020)"""
    clip_fraction: Tensor
    """share of ratios outside 1 +- clip_coefficient"""


@dataclass(frozen=True)
class CriticLosses:
    """What the critics minimise, and its parts; all scalars."""

    total: Tensor
    value: Tensor


Loss = TypeVar("Loss")


class History(NamedTuple):
    """The losses of every minibatch of an update."""

    policy: list[PolicyLosses]
    critics: list[Any]


def _each(improve: Callable[[Any, Tensor], Loss], data: Minibatch, batches: Sequence[Tensor]) -> list[Loss]:
    return [improve(data, rows) for rows in batches]


class OnPolicyTrainer(Trainer):
    """One training run; a subclass says what is learned from a rollout."""

    args: OnPolicyArgs

    def __init__(self, args: OnPolicyArgs, envs: VectorEnv[Any, Any, Any], *, n_costs: int = 0) -> None:
        """Set up networks and optimiser.

        Args:
            args: Hyperparameters.
            envs: The environments.
            n_costs: Costs that have critics of their own.

        Raises:
            UsageError: the environments cannot be learned with these hyperparameters.
        """
        super().__init__(args, envs)
        self.network = ActorCritic(
            self.networks,
            actor_layers=args.actor_layers,
            critic_layers=args.critic_layers,
            initial_log_std=args.initial_log_std,
            initial_do_nothing=args.initial_do_nothing,
            n_costs=n_costs,
        )
        self.network.to(self.device)
        critics = (self.network.critic, *self.network.cost_critics)
        groups = [{"params": list(critic.parameters())} for critic in critics]
        self.actor_optimizer = Adam(self.network.actor_parameters(), lr=args.actor_learning_rate, eps=1e-5)
        self.critic_optimizer = Adam(groups, lr=args.critic_learning_rate, eps=1e-5)
        self._pair = Pair(self.num_threads > 1 and self.device.type == "cpu")
        self.teacher: ActorCritic | None = None
        """What the policy was at the beginning, if it is that of another run."""
        self._divergences: list[Tensor] = []

    def take_over(self, start: StartingPolicy) -> None:
        """The policy's weights, and those of the critic if rewards and their discount are the same.

        Raises:
            UsageError: it is no policy of these algorithms.
        """
        theirs = start.network()
        if not isinstance(theirs, ActorCritic):
            raise start.refusal(
                f"{self.args.algorithm} goes on with those of ppo, lagrangian-ppo, or imitation with policy ppo"
            )
        self.network.actor.load_state_dict(theirs.actor.state_dict())
        if self.continuous:
            self.network.log_std.data.copy_(theirs.log_std.data)
        if start.judges_like(self.args, getattr(self.options, "reward", None)):
            self.network.critic.load_state_dict(theirs.critic.state_dict())
        self.teacher = theirs.requires_grad_(False).to(self.device)

    @property
    def teacher_coefficient(self) -> float:
        """Weight of what keeps the policy near its teacher (:mod:`rl2grid.algorithms.teacher`)."""
        return 0.0 if self.teacher is None else self.args.teacher_coefficient_at(self.decisions)

    @abstractmethod
    def update(self, rollout: Any) -> dict[str, float]:
        """Improve the networks on a rollout; transitions that no decision began are left out."""

    @abstractmethod
    def policy_losses(self, batch: Any) -> PolicyLosses:
        """What the policy minimises on a minibatch."""

    @abstractmethod
    def critic_losses(self, batch: Any) -> CriticLosses:
        """What the critics minimise on a minibatch."""

    def before_update(self) -> dict[str, float]:
        """What is to be done between a rollout and the update on it, and its metrics."""
        return {}

    def iterate(self) -> dict[str, float]:
        """Play ``num_steps`` decisions in every environment, learn from them, and return the metrics."""
        if self.observations is None:
            self.see(self.reset())
        rollout, metrics = self.collect()
        metrics["charts/grid_steps"] = float(self.grid_steps)
        metrics |= self.before_update()
        self._divergences = []
        metrics |= self.update(rollout)
        if self.teacher is not None:
            metrics["charts/teacher_coefficient"] = self.teacher_coefficient
            if self._divergences:
                metrics["losses/teacher_kl"] = mean(self._divergences)
        if self.continuous:
            metrics["charts/action_std"] = float(self.network.log_std.detach().exp().mean())
        self.iteration += 1
        return metrics

    def collect(self) -> tuple[Rollout, dict[str, float]]:
        """Play one rollout."""
        tally = Tally()
        steps = [self._play(tally) for _ in range(self.args.num_steps)]
        with torch.no_grad():
            return self.rollout(self._recorded(steps)), tally.metrics()

    def note(self, played: Played) -> None:
        """What is to be kept of a step beside what all algorithms need, before the environments go on."""
        return

    def rollout(self, record: Record) -> Rollout:
        """What an update needs to know of the steps of a rollout."""
        values, next_values = record.values(self.network.value)
        return Rollout(
            record.observations[:-1],
            record.masks,
            record.actions,
            record.log_probabilities,
            rewards=self.tensor(record.rewards * self.reward_scale, torch.float32),
            discounts=self.tensor(self.args.gamma**record.n_steps, torch.float32),
            values=values,
            next_values=next_values,
            ended=record.ended,
            decided=record.decided,
        )

    def _play(self, tally: Tally) -> Step:
        """One decision in every environment."""
        assert self.observations is not None
        observations = self.normalized(self.observations)
        legal = self.masks()
        masks = None if legal is None else self.tensor(legal)
        with torch.no_grad():
            actions, log_probabilities = self.network.sample(observations, masks, self.generator)
        played = self.step(self._playable(actions), tally)
        self.see(played.observations)
        self.note(played)
        last = None
        if played.completed.any():
            last = self.normalized(np.stack(played.last_observations()).astype(np.float32))
        return Step(
            observations,
            masks,
            actions,
            log_probabilities,
            played.rewards,
            played.n_steps,
            played.ended,
            played.completed,
            played.decided,
            last,
        )

    def _recorded(self, steps: Sequence[Step]) -> Record:
        """The steps of a rollout, and what the last one showed."""
        assert self.observations is not None
        masks = [step.masks for step in steps if step.masks is not None]
        last = [step.last for step in steps if step.last is not None]
        return Record(
            torch.stack([*(step.observations for step in steps), self.normalized(self.observations)]),
            torch.stack(masks) if masks else None,
            torch.stack([step.actions for step in steps]),
            torch.stack([step.log_probabilities for step in steps]),
            np.stack([step.rewards for step in steps]),
            np.stack([step.n_steps for step in steps]),
            self.moved(np.stack([step.ended for step in steps])),
            self.moved(np.stack([step.completed for step in steps])),
            self.moved(np.stack([step.decided for step in steps])),
            torch.cat(last) if last else None,
        )

    def improve(self, data: Minibatch, decided: Tensor) -> tuple[History, int]:
        """Descend on minibatches of the transitions that a decision began, epoch after epoch.

        The policy and the critics have no weights in common: each goes through the minibatches of an epoch on its own.

        Args:
            data: All transitions [num_steps * num_envs, ...].
            decided: bool, of the same length.

        Returns:
            The losses of every minibatch, and the number of epochs.
        """
        args, rows = self.args, decided.nonzero().squeeze(-1)
        history = History([], [])
        epochs = 0
        for _ in range(args.update_epochs if len(rows) else 0):
            order = rows[torch.randperm(len(rows), generator=self.generator).to(self.device)]
            batches = order.tensor_split(min(args.num_minibatches, len(rows)))
            policy, critics = self._pair.run(
                partial(_each, self.improve_policy, data, batches), partial(_each, self.improve_critics, data, batches)
            )
            history.policy.extend(policy)
            history.critics.extend(critics)
            epochs += 1
            if args.target_kl is not None and mean(loss.approximate_kl for loss in policy) > args.target_kl:
                break
        return history, epochs

    def set_learning_rates(self) -> tuple[float, float]:
        """Let the step sizes follow their schedule; those of the actor and of the critics."""
        remaining = 1.0 - self.iteration / self.num_iterations if self.args.anneal_learning_rate else 1.0
        rates = (remaining * self.args.actor_learning_rate, remaining * self.args.critic_learning_rate)
        if 0 < self.decisions <= (self.args.actor_starts or 0):
            rates = (0.0, rates[1])
        for optimizer, rate in zip((self.actor_optimizer, self.critic_optimizer), rates, strict=True):
            for group in optimizer.param_groups:
                group["lr"] = rate
        return rates

    def learned(self) -> Mapping[str, nn.Module | torch.optim.Optimizer]:
        """See :class:`Trainer`."""
        return {
            "network": self.network,
            "actor_optimizer": self.actor_optimizer,
            "critic_optimizer": self.critic_optimizer,
        }

    def policy(self) -> tuple[nn.Module, dict[str, Any]]:
        """See :class:`Trainer`."""
        layers = {"actor_layers": list(self.args.actor_layers), "critic_layers": list(self.args.critic_layers)}
        return self.network, {**layers, "n_costs": len(self.network.cost_critics)}

    def _playable(self, actions: Tensor) -> NDArray[Any]:
        """What the environments are given: ids, or the actions clipped into their box."""
        actions = actions.cpu()
        return actions.clamp(-1.0, 1.0).numpy() if self.continuous else actions.numpy()

    def improve_policy(self, data: Any, rows: Tensor) -> PolicyLosses:
        """One step of the policy on the transitions ``rows``; called in a thread beside :meth:`improve_critics`."""
        batch = data.rows(rows)
        loss = self.policy_losses(batch)
        descend(self.actor_optimizer, self._near_teacher(loss.total, batch), self.args.max_grad_norm)
        return replace(loss, total=loss.total.detach())

    def improve_critics(self, data: Any, rows: Tensor) -> CriticLosses:
        """One step of the critics on the transitions ``rows``."""
        loss = self.critic_losses(data.rows(rows))
        descend(self.critic_optimizer, loss.total, self.args.max_grad_norm)
        return replace(loss, total=loss.total.detach())

    def _near_teacher(self, loss: Tensor, batch: Minibatch) -> Tensor:
        """The loss, and what keeps the policy near its teacher."""
        coefficient = self.teacher_coefficient
        if self.teacher is None or not coefficient:
            return loss
        with torch.no_grad():
            said = self.teacher.distribution(batch.observations, batch.masks)
        divergence = divergences(said, self.network.distribution(batch.observations, batch.masks)).mean()
        self._divergences.append(divergence.detach())
        return loss + coefficient * divergence
