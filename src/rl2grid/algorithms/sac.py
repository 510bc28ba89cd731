"""Soft actor-critic (Haarnoja et al., 2018; Christodoulou, 2019) for topology and redispatching tasks.

What is played, remembered and when there is an update is in :mod:`rl2grid.algorithms.off_policy`.

Soft values
    The policy pi earns its entropy on top of the rewards, once per decision, at the price alpha (the
    temperature). With slow copies of two critics, transitions are worth

        y = R_k + gamma^{n_k} V(s_{k+1})                            y = R_k after a game over
        V(s) = E over a ~ pi of [ min over i of Q_i,slow(s, a) - alpha log pi(a | s) ]

    Both critics are fitted to y by squared errors, the policy minimises E over a ~ pi of
    [alpha log pi(a | s_k) - min over i of Q_i(s_k, a)], and the slow copies move by the share tau of the way.

Discrete actions
    Critics have one output per action; both expectations are sums over the legal actions, without sampling.
    Illegal actions have probability zero.

Continuous actions
    a = tanh(u), u ~ N(mean(s), deviation(s)^2), both expectations by one reparametrised sample. Its density is

        log pi(a | s) = sum over dimensions of [log N(u) - log(1 - tanh(u)^2)]
        log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2 u))         exact also where 1 - tanh(u)^2 rounds to 0

Temperature
    alpha is fixed, or follows the entropy H(s) of the policy: it minimises alpha (H(s) - target), so that it
    rises while the entropy is below its target and falls while it is above. The target of discrete actions is
    a share of the largest entropy possible in the state, log(number of legal actions), and the share falls
    linearly over the run from ``first_entropy_share`` to ``last_entropy_share``: a policy that must act at random
    half of the time plays badly on a grid. The target of continuous actions is ``entropy_per_dimension`` for each.

The deterministic action is the most probable one, or tanh(mean).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import torch
from gymnasium.vector import VectorEnv
from torch import Tensor, nn

from rl2grid.algorithms.hyperparameters import changed_preset
from rl2grid.algorithms.networks import PER_ACTION, NetworkFactory, Output, outputs_of
from rl2grid.algorithms.off_policy import (
    Batch,
    OffPolicyArgs,
    OffPolicyTrainer,
    TwinCritics,
    adam,
    follow,
    held,
    random_legal_actions,
)
from rl2grid.algorithms.registry import Algorithm
from rl2grid.algorithms.sampling import drawn, legal_log_softmax, log_probabilities_of
from rl2grid.algorithms.starting import StartingPolicy
from rl2grid.algorithms.teacher import TeacherArgs, divergences
from rl2grid.arrays import F32, Flags
from rl2grid.errors import UsageError

# --- Hyperparameters ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Args(OffPolicyArgs, TeacherArgs):
    """Hyperparameters; the presets below change some of the values here."""

    algorithm: ClassVar[str] = "SAC"

    actor_learning_rate: float = 3e-4
    """Adam's step size for the policy."""
    critic_learning_rate: float = 1e-3
    """Adam's step size for the critics."""
    temperature_learning_rate: float = 1e-3
    """Adam's step size for the logarithm of the temperature."""
    tau: float = 0.005
    """Share of the way that the slow critics move."""
    policy_frequency: int = 1
    """Updates of the critics per update of the policy and of the temperature."""
    initial_temperature: float = 0.1
    """Price of entropy at the beginning."""
    tune_temperature: bool = True
    """Whether the temperature follows the entropy's target; else it stays what it is."""
    first_entropy_share: float = 0.5
    """Discrete actions only: target entropy at the beginning, as a share of log(number of legal actions)."""
    last_entropy_share: float = 0.05
    """Discrete actions only: that share at the end; it changes linearly with the decisions."""
    entropy_per_dimension: float = -1.0
    """Continuous actions only: target entropy, per dimension; that of a uniform action is log 2 = 0.69."""
    random_start: bool = True
    """Whether actions before ``learning_starts`` are uniform instead of the untrained policy's."""
    initial_do_nothing: float | None = None
    """Discrete actions only: probability of action 0 before training; None: all actions are about alike."""
    actor_layers: tuple[int, ...] = (128, 128)
    """Widths of the policy's hidden layers (ReLU, in an ``mlp``)."""
    critic_layers: tuple[int, ...] = (128, 128)
    """Widths of each critic's hidden layers (ReLU, in an ``mlp``)."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work; see :class:`OffPolicyArgs`."""
        super().__post_init__()
        self._check_counts("policy_frequency")
        self._check_positive("actor_learning_rate", "critic_learning_rate", "temperature_learning_rate")
        self._check_positive("tau", "initial_temperature")
        self._check_shares("tau", "first_entropy_share", "last_entropy_share")
        self._check_layers("actor_layers", "critic_layers")
        self._check_probability("initial_do_nothing")
        if not -math.inf < self.entropy_per_dimension <= math.log(2.0):
            raise UsageError(
                f"SAC needs a finite entropy_per_dimension of at most log 2 = 0.69, not {self.entropy_per_dimension}."
            )


def default(*, continuous: bool) -> Args:
    """Our own values, for tasks with a heuristic on a small machine.

    On topology tasks the untrained policy mostly does nothing and plays from the beginning: at random, one of the
    first few actions would already cut the grid apart, and little would be seen of what comes later.

    There, few steps down the gradient, and large ones, learn as much from a decision as one in four with a third of the
    step sizes, in an eighth of the time; on redispatching tasks they learn less (``benchmarks/equal_learning.py``).
    """
    if continuous:
        return Args(gamma=0.99, mask_actions=False)
    return Args(
        random_start=False,
        initial_do_nothing=0.6,
        train_frequency=32,
        actor_learning_rate=1e-3,
        critic_learning_rate=3e-3,
        temperature_learning_rate=5e-3,
        tau=0.03,
    )


def paper(*, continuous: bool) -> Args:
    """The paper's values (its table of hyperparameters, redispatching where ``continuous``).

    The entropy regularisation of the table is a fixed temperature. Where it is silent: 80 million decisions as for
    PPO, and TD3's tau.
    """
    learning_rate = 3e-5 if continuous else 3e-4
    return Args(
        total_timesteps=80_000_000,
        num_envs=50,
        learning_starts=20_000,
        train_frequency=50,
        batch_size=128,
        buffer_size=500_000,
        buffer_bytes=16 * 1024**3,
        gamma=0.9,
        reward_scale=1.0,
        max_grad_norm=10.0,
        mask_actions=False,
        actor_learning_rate=learning_rate,
        critic_learning_rate=learning_rate,
        tau=0.005,
        policy_frequency=2,
        initial_temperature=0.2,
        tune_temperature=False,
    )


def tuned(*, continuous: bool) -> Args:
    """Values that were found for tasks with a heuristic, and are not those of the algorithm's papers.

    Discrete: a search on bus14-T0 with ``careful`` (``benchmarks/tuning.py``), fourteen configurations, 40,000
    decisions each, rates rounded: longer trainings and other grids may want other values.

    Continuous: trials on bus36-M-R with ``recovery``, compared with the default on other seeds and months
    (``benchmarks/families.py``). The temperature of 0.1 with which the default begins pays a decision as much for its
    entropy as all that follows it is worth.
    """
    if continuous:
        return replace(
            default(continuous=True),
            tune_temperature=False,
            initial_temperature=3e-4,
            train_frequency=32,
            batch_size=512,
            actor_learning_rate=1e-3,
            critic_learning_rate=3e-3,
            last_learning_rate_share=0.05,
            tau=0.03,
        )
    return replace(
        default(continuous=False),
        gamma=0.95,
        batch_size=512,
        actor_learning_rate=3.9e-3,
        critic_learning_rate=3.9e-3,
        last_learning_rate_share=0.05,
        tau=0.005,
        last_entropy_share=0.1,
        actor_layers=(256, 256),
    )


PRESETS: dict[str, Callable[..., Args]] = {"default": default, "paper": paper, "tuned": tuned}

SEARCH_SPACE: dict[str, tuple[Any, ...]] = {
    "num_envs": (10, 20, 50),
    "max_grad_norm": (10.0, 20.0, 50.0),
    "gamma": (0.9, 0.95, 0.99),
    "train_frequency": (50, 100, 1000),
    "policy_frequency": (2, 4),
    "buffer_size": (100_000, 250_000, 500_000, 1_000_000),
    "batch_size": (64, 128, 256),
    "actor_learning_rate": (3e-3, 3e-4, 3e-5),
    "critic_learning_rate": (3e-3, 3e-4),
    "initial_temperature": (0.02, 0.2, 0.4),
}
"""The paper's grid search, by hyperparameter (it prints 0.0003 twice among the critic's learning rates)."""


def preset(name: str, *, continuous: bool, **changes: Any) -> Args:
    """A preset for tasks with continuous or discrete actions, some values changed.

    Raises:
        UsageError: no such preset, or values that cannot work.
    """
    return changed_preset(PRESETS, "SAC", name, continuous=continuous, **changes)


# --- Networks -------------------------------------------------------------------------------------------------------

_LOG_STD_RANGE = (-5.0, 2.0)


class GaussianActor(nn.Module):
    """A squashed Gaussian: tanh(u), u ~ N(mean(s), deviation(s)^2)."""

    continuous = True

    def __init__(self, networks: NetworkFactory, layers: Sequence[int]) -> None:
        super().__init__()
        self.observation_size, self.action_size = networks.spec.observation_size, networks.spec.action_size
        self.network = networks.make(Output(per_action=2), layers)

    def forward(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Means and log deviations of u, each [batch, dimensions], the latter within fixed bounds."""
        means, outputs = self.network(observations).chunk(2, dim=-1)
        low, high = _LOG_STD_RANGE
        return means, low + 0.5 * (high - low) * (outputs.tanh() + 1.0)

    def distribution(self, observations: Tensor, masks: Tensor | None) -> tuple[Tensor, ...]:
        """Means and log deviations of u, each [batch, dimensions]; there is nothing to mask."""
        means, log_stds = self(observations)
        return means, log_stds

    def sample(self, observations: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions [batch, dimensions] in [-1, 1] and their log-densities [batch], from standard normal noise."""
        means, log_stds = self(observations)
        unsquashed = means + log_stds.exp() * noise
        return unsquashed.tanh(), squashed_log_densities(unsquashed, means, log_stds)

    def act(self, observations: Tensor, masks: Tensor | None, generator: torch.Generator | None) -> Tensor:
        """Actions for observations [batch, size], float32 [batch, dimensions]; tanh(mean) without a generator."""
        unsquashed, log_stds = self(observations)
        if generator is not None:
            noise = torch.randn(unsquashed.shape, generator=generator).to(unsquashed.device)
            unsquashed = unsquashed + log_stds.exp() * noise
        actions: Tensor = unsquashed.tanh()
        return actions


def squashed_log_densities(unsquashed: Tensor, means: Tensor, log_stds: Tensor) -> Tensor:
    """Log-densities [batch] of tanh(u), where u ~ N(mean, deviation^2); all arguments [batch, dimensions]."""
    deviations = (unsquashed - means) / log_stds.exp()
    normal = -0.5 * deviations.square() - log_stds - 0.5 * math.log(2.0 * math.pi)
    log_slopes = 2.0 * (math.log(2.0) - unsquashed - nn.functional.softplus(-2.0 * unsquashed))
    return (normal - log_slopes).sum(dim=-1)


class CategoricalActor(nn.Module):
    """Probabilities of discrete actions."""

    continuous = False
    preference = "probability"

    def __init__(
        self, networks: NetworkFactory, layers: Sequence[int], initial_do_nothing: float | None = None
    ) -> None:
        super().__init__()
        self.observation_size, self.action_size = networks.spec.observation_size, networks.spec.action_size
        self.network = networks.make(PER_ACTION, layers, do_nothing=initial_do_nothing)

    def forward(self, observations: Tensor, masks: Tensor | None) -> Tensor:
        """Log-probabilities [batch, actions], of illegal actions large and negative."""
        return legal_log_softmax(self.network(observations), masks)

    def act(self, observations: Tensor, masks: Tensor | None, generator: torch.Generator | None) -> Tensor:
        """Actions for observations [batch, size], int64 [batch]; the most probable ones without a generator."""
        log_probabilities = self(observations, masks)
        if generator is None:
            best: Tensor = log_probabilities.argmax(dim=-1)
            return best
        return drawn(log_probabilities.exp(), generator)

    def distribution(self, observations: Tensor, masks: Tensor | None) -> tuple[Tensor, ...]:
        """Log-probabilities [batch, actions]."""
        return (self(observations, masks),)

    def preferences(self, observations: Tensor, masks: Tensor | None) -> Tensor:
        """Probabilities of the actions, [batch, actions]."""
        log_probabilities: Tensor = self(observations, masks)
        return log_probabilities.exp()

    def scores(self, rows: F32, legal: Flags) -> F32:
        """Log-probabilities of the actions as of :meth:`distribution`, without tensors; all [batch, ...]."""
        return log_probabilities_of(outputs_of(self.network, rows), legal)


class TwinActionCritics(nn.Module):
    """Two values of every discrete action, learned independently."""

    def __init__(self, networks: NetworkFactory, layers: Sequence[int]) -> None:
        super().__init__()
        self.networks = nn.ModuleList(networks.make(PER_ACTION, layers) for _ in range(2))

    def forward(self, observations: Tensor) -> Tensor:
        """Both values of observations [batch, size] -> [2, batch, actions]."""
        return torch.stack([network(observations) for network in self.networks])


def load_policy(state: Mapping[str, Any]) -> GaussianActor | CategoricalActor:
    """The network of a checkpoint's section ``policy``."""
    networks = NetworkFactory.from_state(state["factory"])
    make = GaussianActor if networks.spec.continuous else CategoricalActor
    actor = make(networks, state["actor_layers"])
    actor.load_state_dict(state["network"])
    return actor


# --- What is optimised ----------------------------------------------------------------------------------------------


class PolicyLoss(NamedTuple):
    """What the policy minimises, and how random it is."""

    loss: Tensor
    entropies: Tensor
    """H(s_k) [batch]; of continuous actions estimated by the negative log-density of one sample"""


class ContinuousObjective:
    """Soft values and losses of squashed Gaussian policies."""

    def __init__(self, actor: GaussianActor, critics: TwinCritics, slow: TwinCritics) -> None:
        self.actor, self.critics, self.slow = actor, critics, slow

    def next_values(self, batch: Batch, alpha: Tensor, noise: Tensor) -> Tensor:
        """V(s_{k+1}) [batch]."""
        actions, log_densities = self.actor.sample(batch.next_observations, noise)
        values: Tensor = self.slow(batch.next_observations, actions).amin(dim=0)
        return values - alpha * log_densities

    def values(self, batch: Batch) -> Tensor:
        """Both critics' Q(s_k, a_k) [2, batch]."""
        values: Tensor = self.critics(batch.observations, batch.actions)
        return values

    def policy_loss(self, batch: Batch, alpha: Tensor, noise: Tensor) -> PolicyLoss:
        """The policy's loss at s_k."""
        actions, log_densities = self.actor.sample(batch.observations, noise)
        with held(self.critics):
            values = self.critics(batch.observations, actions).amin(dim=0)
        return PolicyLoss((alpha * log_densities - values).mean(), -log_densities.detach())


class DiscreteObjective:
    """Soft values and losses of categorical policies: exact expectations over the legal actions."""

    def __init__(self, actor: CategoricalActor, critics: TwinActionCritics, slow: TwinActionCritics) -> None:
        self.actor, self.critics, self.slow = actor, critics, slow

    def next_values(self, batch: Batch, alpha: Tensor, noise: Tensor) -> Tensor:
        """V(s_{k+1}) [batch]; ``noise`` is not needed."""
        log_probabilities = self.actor(batch.next_observations, batch.next_masks)
        values = self.slow(batch.next_observations).amin(dim=0)
        return _expectation(log_probabilities, values - alpha * log_probabilities)

    def values(self, batch: Batch) -> Tensor:
        """Both critics' Q(s_k, a_k) [2, batch]."""
        chosen = batch.actions.unsqueeze(-1).expand(2, -1, 1)
        values: Tensor = self.critics(batch.observations).gather(-1, chosen)
        return values.squeeze(-1)

    def policy_loss(self, batch: Batch, alpha: Tensor, noise: Tensor) -> PolicyLoss:
        """The policy's loss at s_k; ``noise`` is not needed."""
        log_probabilities = self.actor(batch.observations, batch.masks)
        with torch.no_grad():
            values = self.critics(batch.observations).amin(dim=0)
        loss = _expectation(log_probabilities, alpha * log_probabilities - values).mean()
        return PolicyLoss(loss, -_expectation(log_probabilities, log_probabilities).detach())


def _expectation(log_probabilities: Tensor, of: Tensor) -> Tensor:
    """Sum over actions of probability times value [batch], of [batch, actions]."""
    return (log_probabilities.exp() * of).sum(dim=-1)


def critic_loss(values: Tensor, aims: Tensor) -> Tensor:
    """Mean squared error of each critic's values [2, batch], summed over both."""
    return (values - aims).square().mean(dim=1).sum()


def temperature_loss(log_alpha: Tensor, entropies: Tensor, target_entropies: Tensor) -> Tensor:
    """The mean of alpha (H(s) - target): it falls as alpha rises where the entropy is too low."""
    return (log_alpha.exp() * (entropies - target_entropies).detach()).mean()


# --- Training -------------------------------------------------------------------------------------------------------


class Temperature(nn.Module):
    """The logarithm of alpha, trained or not."""

    def __init__(self, initial: float) -> None:
        super().__init__()
        self.logarithm = nn.Parameter(torch.tensor(math.log(initial)))

    @property
    def alpha(self) -> Tensor:
        """The temperature, a constant to whom it is given."""
        return self.logarithm.detach().exp()


class SAC(OffPolicyTrainer):
    """One training run; see :class:`OffPolicyTrainer`."""

    args: Args

    def __init__(self, args: Args, envs: VectorEnv[Any, Any, Any]) -> None:
        """Set up the networks and their optimisers.

        Raises:
            UsageError: the environments cannot be learned with these hyperparameters.
        """
        super().__init__(args, envs)
        self.objective = self._continuous() if self.continuous else self._discrete()
        self.actor, self.critics, self.slow = self.objective.actor, self.objective.critics, self.objective.slow
        self.temperature = Temperature(args.initial_temperature).to(self.device)
        self.actor_optimizer = adam(self.actor, args.actor_learning_rate)
        self.critic_optimizer = adam(self.critics, args.critic_learning_rate)
        self.temperature_optimizer = adam(self.temperature, args.temperature_learning_rate)
        self.teacher: GaussianActor | CategoricalActor | None = None
        """What the policy was at the beginning, if it is that of another run."""

    def take_over(self, start: StartingPolicy) -> None:
        """The policy's weights; critics begin anew.

        Raises:
            UsageError: it is no policy of SAC.
        """
        theirs = start.network()
        if not isinstance(theirs, GaussianActor | CategoricalActor):
            raise start.refusal("SAC goes on with those of sac, or imitation with policy sac")
        self.actor.load_state_dict(theirs.state_dict())
        self.teacher = theirs.requires_grad_(False).to(self.device)

    @property
    def teacher_coefficient(self) -> float:
        """Weight of what keeps the policy near its teacher (:mod:`rl2grid.algorithms.teacher`)."""
        return 0.0 if self.teacher is None else self.args.teacher_coefficient_at(self.decisions)

    @property
    def actor_starts(self) -> int:
        """Decisions before the policy is changed: critics begin anew, and would make it worse before they know it."""
        asked = self.args.actor_starts
        if asked is not None:
            return asked
        return 0 if self.teacher is None else self.args.total_timesteps // 10

    def _continuous(self) -> ContinuousObjective:
        actor = GaussianActor(self.networks, self.args.actor_layers).to(self.device)
        critics = TwinCritics(self.networks, self.args.critic_layers).to(self.device)
        return ContinuousObjective(actor, critics, copy.deepcopy(critics))

    def _discrete(self) -> DiscreteObjective:
        actor = CategoricalActor(self.networks, self.args.actor_layers, self.args.initial_do_nothing).to(self.device)
        critics = TwinActionCritics(self.networks, self.args.critic_layers).to(self.device)
        return DiscreteObjective(actor, critics, copy.deepcopy(critics))

    @property
    def entropy_share(self) -> float:
        """Discrete actions: target entropy at this moment, as a share of the largest possible one.

        With a teacher it is that of the end all along: what was imitated is not to be forgotten by chance.
        """
        args = self.args
        if self.teacher is not None:
            return args.last_entropy_share
        progress = min(1.0, self.decisions / args.total_timesteps)
        return args.first_entropy_share + progress * (args.last_entropy_share - args.first_entropy_share)

    def target_entropies(self, batch: Batch) -> Tensor:
        """Target entropy in every state of the batch [batch]."""
        count = len(batch.observations)
        if self.continuous:
            return torch.full((count,), self.args.entropy_per_dimension * self.action_size, device=self.device)
        if batch.masks is None:
            return torch.full((count,), self.entropy_share * math.log(self.action_size), device=self.device)
        return self.entropy_share * batch.masks.sum(dim=-1).to(torch.float32).log()

    def explore(self, observations: Tensor, masks: Tensor | None) -> Tensor:
        """Samples of the policy; uniform actions before it learns, if asked for."""
        count = len(observations)
        if self.is_starting and self.args.random_start and self.teacher is None:
            if self.continuous:
                return torch.rand(count, self.action_size, generator=self.generator) * 2.0 - 1.0
            return random_legal_actions(count, self.action_size, masks, self.generator)
        return self.actor.act(observations, None if masks is None else masks.to(self.device), self.generator)

    def learn(self, batch: Batch) -> dict[str, Tensor]:
        """Improve the critics; when due, the policy and the temperature; let the slow critics follow."""
        args, alpha = self.args, self.temperature.alpha
        with torch.no_grad():
            aims = batch.rewards + batch.discounts * self.objective.next_values(batch, alpha, self._noise(batch))
        values = self.objective.values(batch)
        error = critic_loss(values, aims)
        self._descend(self.critic_optimizer, error)
        metrics = {"losses/qf_loss": error, "losses/qf_values": values.mean(), "losses/alpha": alpha}
        if self.updates % args.policy_frequency == 0 and self.decisions >= self.actor_starts:
            metrics |= self._improve_policy(batch, alpha)
        follow(self.slow, self.critics, args.tau)
        return metrics

    def _improve_policy(self, batch: Batch, alpha: Tensor) -> dict[str, Tensor]:
        policy = self.objective.policy_loss(batch, alpha, self._noise(batch))
        metrics = {"losses/actor_loss": policy.loss, "losses/entropy": policy.entropies.mean()}
        loss, coefficient = policy.loss, self.teacher_coefficient
        if self.teacher is not None and coefficient:
            divergence = self._divergences(self.teacher, batch).mean()
            loss = loss + coefficient * divergence
            metrics["losses/teacher_kl"] = divergence
        self._descend(self.actor_optimizer, loss)
        if not self.args.tune_temperature:
            return metrics
        aims = self.target_entropies(batch)
        loss = temperature_loss(self.temperature.logarithm, policy.entropies, aims)
        self._descend(self.temperature_optimizer, loss)
        return {**metrics, "losses/alpha_loss": loss, "losses/target_entropy": aims.mean()}

    def _divergences(self, teacher: GaussianActor | CategoricalActor, batch: Batch) -> Tensor:
        """KL(teacher || policy) in every state of the batch [batch]."""
        with torch.no_grad():
            said = teacher.distribution(batch.observations, batch.masks)
        return divergences(said, self.actor.distribution(batch.observations, batch.masks))

    def _noise(self, batch: Batch) -> Tensor:
        """Standard normal numbers [batch, dimensions]; none for discrete actions."""
        shape = (len(batch.observations), self.action_size if self.continuous else 0)
        return torch.randn(shape, generator=self.generator).to(self.device)

    def schedule(self) -> dict[str, float]:
        """The share of the largest entropy that is aimed at, and the weight of what keeps it near its teacher."""
        metrics = {} if self.continuous else {"charts/entropy_share": self.entropy_share}
        return metrics if self.teacher is None else {**metrics, "charts/teacher_coefficient": self.teacher_coefficient}

    def learned(self) -> Mapping[str, nn.Module | torch.optim.Optimizer]:
        """See :class:`OffPolicyTrainer`."""
        return {
            "actor": self.actor,
            "critics": self.critics,
            "slow": self.slow,
            "temperature": self.temperature,
            "actor_optimizer": self.actor_optimizer,
            "critic_optimizer": self.critic_optimizer,
            "temperature_optimizer": self.temperature_optimizer,
        }

    def policy(self) -> tuple[nn.Module, dict[str, Any]]:
        """See :class:`OffPolicyTrainer`."""
        return self.actor, {"actor_layers": list(self.args.actor_layers)}


ALGORITHM = Algorithm("sac", Args, SAC, ("T", "R"), preset, load_policy, SEARCH_SPACE)
