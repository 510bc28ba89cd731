"""Twin delayed deep deterministic policy gradient (Fujimoto et al., 2018) for redispatching tasks.

What is played, remembered and when there is an update is in :mod:`rl2grid.algorithms.off_policy`.

Targets
    Slow copies of the policy mu and of the two critics, the former with noise, say what follows:

        a' = clip(mu_slow(s_{k+1}) + clip(e, -c, c), -1, 1)         e ~ N(0, policy_noise), c = noise_clip
        y  = R_k + gamma^{n_k} min over i of Q_i,slow(s_{k+1}, a')  y = R_k after a game over

    Both critics are fitted to y by squared errors. Every ``policy_frequency``-th update also improves the
    policy, on -Q_1(s_k, mu(s_k)), and moves all slow copies by the share tau of the way.

Actions
    Policies end in tanh. What is played is clip(mu(s) + N(0, exploration_noise), -1, 1), before
    ``learning_starts`` an action drawn uniformly. The deterministic policy is mu.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from gymnasium.vector import VectorEnv
from torch import Tensor, nn

from rl2grid.algorithms.hyperparameters import changed_preset
from rl2grid.algorithms.networks import PER_ACTION, NetworkFactory
from rl2grid.algorithms.off_policy import (
    Batch,
    OffPolicyArgs,
    OffPolicyTrainer,
    TwinCritics,
    adam,
    follow,
    held,
)
from rl2grid.algorithms.registry import Algorithm
from rl2grid.errors import UsageError

# --- Hyperparameters ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Args(OffPolicyArgs):
    """Hyperparameters; the presets below change some of the values here."""

    algorithm: ClassVar[str] = "TD3"

    mask_actions: bool = False
    """Must be False: continuous actions are all legal."""
    actor_learning_rate: float = 3e-4
    """Adam's step size for the policy."""
    critic_learning_rate: float = 1e-3
    """Adam's step size for the critics."""
    tau: float = 0.005
    """Share of the way that the slow copies move."""
    policy_frequency: int = 2
    """Updates of the critics per update of the policy and of the slow copies."""
    exploration_noise: float = 0.1
    """Standard deviation of the noise on the actions played."""
    policy_noise: float = 0.2
    """Standard deviation of the noise on the actions in targets."""
    noise_clip: float = 0.5
    """Bound of the latter noise."""
    actor_layers: tuple[int, ...] = (128, 128)
    """Widths of the policy's hidden layers (ReLU, in an ``mlp``)."""
    critic_layers: tuple[int, ...] = (128, 128)
    """Widths of each critic's hidden layers (ReLU, in an ``mlp``)."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work; see :class:`OffPolicyArgs`."""
        super().__post_init__()
        self._check_counts("policy_frequency")
        self._check_positive("actor_learning_rate", "critic_learning_rate", "tau", "noise_clip")
        self._check_not_negative("exploration_noise", "policy_noise")
        self._check_shares("tau")
        self._check_layers("actor_layers", "critic_layers")


def default(*, continuous: bool) -> Args:
    """Our own values, for tasks with a heuristic on a small machine: few steps down the gradient, and large ones (see
    SAC's).
    """
    _refuse_discrete(continuous)
    return Args(gamma=0.99, train_frequency=32, actor_learning_rate=1e-3, critic_learning_rate=3e-3, tau=0.03)


def paper(*, continuous: bool) -> Args:
    """The paper's values (its table of hyperparameters, column R).

    Where the table is silent: 80 million decisions as for PPO, and SAC's train frequency. It lists the noise clip
    among the values of SAC, which has no such noise.
    """
    _refuse_discrete(continuous)
    return Args(
        total_timesteps=80_000_000,
        num_envs=50,
        learning_starts=20_000,
        train_frequency=50,
        batch_size=128,
        buffer_size=1_000_000,
        buffer_bytes=32 * 1024**3,
        gamma=0.9,
        reward_scale=1.0,
        max_grad_norm=10.0,
        actor_learning_rate=3e-5,
        critic_learning_rate=3e-5,
        tau=0.005,
        policy_frequency=2,
        exploration_noise=0.1,
        policy_noise=0.2,
        noise_clip=0.5,
    )


PRESETS: dict[str, Callable[..., Args]] = {"default": default, "paper": paper}

SEARCH_SPACE: dict[str, tuple[Any, ...]] = {
    "num_envs": (10, 20, 50),
    "max_grad_norm": (10.0, 20.0, 50.0),
    "gamma": (0.9, 0.95, 0.99),
    "policy_frequency": (2, 4),
    "buffer_size": (100_000, 250_000, 500_000, 1_000_000),
    "batch_size": (64, 128, 256),
    "actor_learning_rate": (3e-3, 3e-4, 3e-5),
    "critic_learning_rate": (3e-3, 3e-4, 3e-5),
    "tau": (0.005, 0.0005),
}
"""The paper's grid search, by hyperparameter (those with one value left out)."""


def preset(name: str, *, continuous: bool, **changes: Any) -> Args:
    """A preset, some values changed.

    Raises:
        UsageError: no such preset, values that cannot work, or discrete actions.
    """
    return changed_preset(PRESETS, "TD3", name, continuous=continuous, **changes)


def _refuse_discrete(continuous: bool) -> None:
    if not continuous:
        raise UsageError("TD3 plays continuous actions and cannot choose among discrete ones: choose ppo, dqn or sac.")


# --- Networks -------------------------------------------------------------------------------------------------------


class Actor(nn.Module):
    """The policy mu."""

    continuous = True

    def __init__(self, networks: NetworkFactory, layers: Sequence[int]) -> None:
        super().__init__()
        self.observation_size, self.action_size = networks.spec.observation_size, networks.spec.action_size
        self.network = networks.make(PER_ACTION, layers)

    def forward(self, observations: Tensor) -> Tensor:
        """Actions for observations [batch, size], float32 [batch, dimensions] in [-1, 1]."""
        outputs: Tensor = self.network(observations)
        return outputs.tanh()

    def act(self, observations: Tensor, masks: Tensor | None, generator: torch.Generator | None) -> Tensor:
        """The same; nothing is masked, and ``generator`` has nothing to draw."""
        actions: Tensor = self(observations)
        return actions


def load_policy(state: Mapping[str, Any]) -> Actor:
    """The network of a checkpoint's section ``policy``."""
    actor = Actor(NetworkFactory.from_state(state["factory"]), state["actor_layers"])
    actor.load_state_dict(state["network"])
    return actor


# --- What is optimised ----------------------------------------------------------------------------------------------


def targets(actor: Actor, critics: TwinCritics, batch: Batch, noise: Tensor, noise_clip: float) -> Tensor:
    """The targets y of transitions [batch] (equations above); ``noise`` is e [batch, dimensions]."""
    with torch.no_grad():
        smoothing = noise.clamp(-noise_clip, noise_clip)
        actions = (actor(batch.next_observations) + smoothing).clamp(-1.0, 1.0)
        values: Tensor = critics(batch.next_observations, actions).amin(dim=0)
        return batch.rewards + batch.discounts * values


def critic_loss(values: Tensor, aims: Tensor) -> Tensor:
    """Mean squared error of each critic's values [2, batch], summed over both."""
    return (values - aims).square().mean(dim=1).sum()


# --- Training -------------------------------------------------------------------------------------------------------


class TD3(OffPolicyTrainer):
    """One training run; see :class:`OffPolicyTrainer`."""

    args: Args

    def __init__(self, args: Args, envs: VectorEnv[Any, Any, Any]) -> None:
        """Set up the networks and their optimisers.

        Raises:
            UsageError: the environments cannot be learned with these hyperparameters.
        """
        super().__init__(args, envs)
        _refuse_discrete(self.continuous)
        self.actor = Actor(self.networks, args.actor_layers).to(self.device)
        self.critics = TwinCritics(self.networks, args.critic_layers).to(self.device)
        self.slow_actor = copy.deepcopy(self.actor)
        self.slow_critics = copy.deepcopy(self.critics)
        self.actor_optimizer = adam(self.actor, args.actor_learning_rate)
        self.critic_optimizer = adam(self.critics, args.critic_learning_rate)

    def explore(self, observations: Tensor, masks: Tensor | None) -> Tensor:
        """The policy with noise; uniform actions before it learns."""
        shape = (len(observations), self.action_size)
        if self.is_starting:
            return torch.rand(shape, generator=self.generator) * 2.0 - 1.0
        noise = self.args.exploration_noise * torch.randn(shape, generator=self.generator)
        best: Tensor = self.actor(observations).cpu()
        return (best + noise).clamp(-1.0, 1.0)

    def learn(self, batch: Batch) -> dict[str, Tensor]:
        """Improve the critics; when due, the policy, and let the slow copies follow."""
        args = self.args
        noise = args.policy_noise * torch.randn(batch.actions.shape, generator=self.generator)
        aims = targets(self.slow_actor, self.slow_critics, batch, noise.to(self.device), args.noise_clip)
        values = self.critics(batch.observations, batch.actions)
        error = critic_loss(values, aims)
        self._descend(self.critic_optimizer, error)
        metrics = {"losses/qf_loss": error, "losses/qf_values": values.mean()}
        if self.updates % args.policy_frequency:
            return metrics
        with held(self.critics):
            actor_loss = -self.critics.first(batch.observations, self.actor(batch.observations)).mean()
        self._descend(self.actor_optimizer, actor_loss)
        follow(self.slow_actor, self.actor, args.tau)
        follow(self.slow_critics, self.critics, args.tau)
        return {**metrics, "losses/actor_loss": actor_loss}

    def schedule(self) -> dict[str, float]:
        """Nothing."""
        return {}

    def learned(self) -> Mapping[str, nn.Module | torch.optim.Optimizer]:
        """See :class:`OffPolicyTrainer`."""
        return {
            "actor": self.actor,
            "critics": self.critics,
            "slow_actor": self.slow_actor,
            "slow_critics": self.slow_critics,
            "actor_optimizer": self.actor_optimizer,
            "critic_optimizer": self.critic_optimizer,
        }

    def policy(self) -> tuple[nn.Module, dict[str, Any]]:
        """See :class:`OffPolicyTrainer`."""
        return self.actor, {"actor_layers": list(self.args.actor_layers)}


ALGORITHM = Algorithm("td3", Args, TD3, ("R",), preset, load_policy, SEARCH_SPACE)
