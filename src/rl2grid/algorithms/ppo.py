"""Proximal policy optimisation (Schulman et al., 2017) for topology and redispatching tasks.

What is played, how advantages A_k are estimated, and what policies are is in :mod:`rl2grid.algorithms.on_policy`.

The objective
    With the ratio r_k of the action's probability now to that when it was chosen, the policy maximises

        mean over k of min(r_k A_k, clip(r_k, 1 - c, 1 + c) A_k) + entropy_coefficient times its entropy,

    in several epochs of minibatches, whose advantages are shifted and scaled first. The critic is fitted to the
    returns A_k + V(s_k) by squared errors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from gymnasium.vector import VectorEnv
from torch import Tensor

from rl2grid.algorithms.compiled_steps import PolicySteps, ValueSteps, policy_steps, value_steps
from rl2grid.algorithms.diagnostics import explained_variance, mean
from rl2grid.algorithms.hyperparameters import changed_preset
from rl2grid.algorithms.on_policy import (
    ActorCritic,
    CriticLosses,
    History,
    Minibatch,
    OnPolicyArgs,
    OnPolicyTrainer,
    PolicyLosses,
    Rollout,
    advantages_of_rewards,
)
from rl2grid.algorithms.on_policy import load_policy as load_policy
from rl2grid.algorithms.registry import Algorithm
from rl2grid.errors import UsageError

# --- Hyperparameters ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Args(OnPolicyArgs):
    """Hyperparameters; the presets below change some of the values here."""

    algorithm: ClassVar[str] = "PPO"

    clip_coefficient: float = 0.2
    """The surrogate objective gains nothing from ratios outside 1 +- this."""
    clip_value_loss: bool = False
    """Whether a critic's change per update is clipped by the same coefficient."""
    normalize_advantages: bool = True
    """Whether the advantages of a minibatch are shifted and scaled to mean 0 and deviation 1."""
    entropy_coefficient: float = 0.01
    """Weight of the policy's entropy in the objective."""
    value_coefficient: float = 0.5
    """Weight of a critic's loss."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work; see :class:`OnPolicyArgs`."""
        super().__post_init__()
        self._check_positive("clip_coefficient")
        self._check_not_negative("entropy_coefficient", "value_coefficient")


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


def tuned(*, continuous: bool) -> Args:
    """What a search on bus36-M-R with the heuristic ``recovery`` found (``benchmarks/families.py``).

    First draws with a deviation of 1, all that can be asked for: five changes besides were no better.

    Raises:
        UsageError: discrete actions, for which nothing was found.
    """
    if not continuous:
        raise UsageError("PPO's preset 'tuned' was searched for with continuous actions: choose 'default' or 'paper'.")
    return replace(default(continuous=True), initial_log_std=0.0)


PRESETS: dict[str, Callable[..., Args]] = {"default": default, "paper": paper, "tuned": tuned}

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
    return changed_preset(PRESETS, "PPO", name, continuous=continuous, **changes)


# --- What is optimised ----------------------------------------------------------------------------------------------


def policy_losses(network: ActorCritic, batch: Minibatch, args: Args) -> PolicyLosses:
    """PPO's clipped surrogate and the entropy, to be minimised."""
    log_probabilities, entropies = network.log_probability_and_entropy(batch.observations, batch.actions, batch.masks)
    log_ratios = log_probabilities - batch.log_probabilities
    ratios = log_ratios.exp()

    advantages = batch.advantages
    if args.normalize_advantages:
        advantages = (advantages - advantages.mean()) / (advantages.std(correction=0) + 1e-8)
    clipped_ratios = ratios.clamp(1.0 - args.clip_coefficient, 1.0 + args.clip_coefficient)
    policy = -torch.minimum(advantages * ratios, advantages * clipped_ratios).mean()

    entropy = entropies.mean()
    total = policy - args.entropy_coefficient * entropy
    with torch.no_grad():
        approximate_kl = (ratios - 1.0 - log_ratios).mean()
        clip_fraction = ((ratios - 1.0).abs() > args.clip_coefficient).float().mean()
    return PolicyLosses(total, policy.detach(), entropy.detach(), approximate_kl, clip_fraction)


def critic_losses(network: ActorCritic, batch: Minibatch, args: Args) -> CriticLosses:
    """The critic's squared error."""
    value = value_loss(network.value(batch.observations), batch.values, batch.returns, args)
    return CriticLosses(args.value_coefficient * value, value.detach())


def value_loss(values: Tensor, old_values: Tensor, returns: Tensor, args: Args) -> Tensor:
    """Half the mean squared error over a batch [batch, ...] -> [...]."""
    squared_errors = (values - returns).square()
    if args.clip_value_loss:
        changes = (values - old_values).clamp(-args.clip_coefficient, args.clip_coefficient)
        squared_errors = torch.maximum(squared_errors, (old_values + changes - returns).square())
    return 0.5 * squared_errors.mean(dim=0)


# --- Training -------------------------------------------------------------------------------------------------------


class PPO(OnPolicyTrainer):
    """One training run; see :class:`OnPolicyTrainer`."""

    args: Args
    _policy_steps: PolicySteps | None = None
    _value_steps: list[ValueSteps] | None = None

    def __init__(self, args: Args, envs: VectorEnv[Any, Any, Any], *, n_costs: int = 0) -> None:
        """See :class:`OnPolicyTrainer`."""
        super().__init__(args, envs, n_costs=n_costs)
        # Compiled steps minimise what is defined beside them, and not what a subclass makes of it.
        if _have_one_home(type(self), "policy_losses", "improve_policy"):
            self._policy_steps = policy_steps(self.network, self.actor_optimizer, args)
        if _have_one_home(type(self), "critic_losses", "improve_critics"):
            self._value_steps = value_steps(self.network, self.critic_optimizer, args)

    def update(self, rollout: Rollout) -> dict[str, float]:
        """Improve the networks on a rollout; transitions that no decision began are left out."""
        actor_learning_rate, _ = self.set_learning_rates()
        data = self.transitions(rollout)
        history, epochs = self.improve(data, rollout.decided.flatten())
        metrics = {
            "losses/policy_loss": mean(loss.policy for loss in history.policy),
            "losses/value_loss": mean(loss.value for loss in history.critics),
            "losses/entropy": mean(loss.entropy for loss in history.policy),
            "losses/approx_kl": mean(loss.approximate_kl for loss in history.policy),
            "losses/clipfrac": mean(loss.clip_fraction for loss in history.policy),
            "losses/explained_variance": explained_variance(data.values, data.returns),
            "charts/learning_rate": actor_learning_rate,
            "charts/update_epochs": float(epochs),
        }
        return metrics | self.further_metrics(data, history)

    def further_metrics(self, data: Minibatch, history: History) -> dict[str, float]:
        """What else there is to tell of an update: ``history`` has the losses of every minibatch of ``data``."""
        return {}

    def transitions(self, rollout: Rollout) -> Minibatch:
        """All transitions of a rollout, with what the policy and the critic learn from them."""
        advantages = advantages_of_rewards(rollout, self.args.gae_lambda)
        return Minibatch(
            rollout.observations.flatten(0, 1),
            None if rollout.masks is None else rollout.masks.flatten(0, 1),
            rollout.actions.flatten(0, 1),
            rollout.log_probabilities.flatten(),
            rollout.values.flatten(),
            advantages.flatten(),
            (advantages + rollout.values).flatten(),
        )

    def policy_losses(self, batch: Minibatch) -> PolicyLosses:
        """See :func:`policy_losses`."""
        return policy_losses(self.network, batch, self.args)

    def improve_policy(self, data: Minibatch, rows: Tensor) -> PolicyLosses:
        """One step down :func:`policy_losses`, in compiled code where there is such."""
        steps = self._policy_steps
        if steps is None or steps.policy.optimizer is not self.actor_optimizer or self.teacher_coefficient:
            return super().improve_policy(data, rows)
        policy, entropy, approximate_kl, clip_fraction = steps.step(data, rows)
        total = policy - self.args.entropy_coefficient * entropy
        return PolicyLosses(total, policy, entropy, approximate_kl, clip_fraction)

    def critic_losses(self, batch: Minibatch) -> CriticLosses:
        """See :func:`critic_losses`."""
        return critic_losses(self.network, batch, self.args)

    def improve_critics(self, data: Minibatch, rows: Tensor) -> CriticLosses:
        """One step down :func:`critic_losses`, in compiled code where there is such."""
        steps = self.compiled_critics()
        if steps is None:
            return super().improve_critics(data, rows)
        value = steps[0].step(rows, data.observations, data.values, data.returns)
        return CriticLosses(self.args.value_coefficient * value, value)

    def compiled_critics(self) -> list[ValueSteps] | None:
        """Steps of the critic and of the costs' critics in compiled code, where there are such for the optimiser."""
        steps = self._value_steps
        return None if steps is None or steps[0].critic.optimizer is not self.critic_optimizer else steps


def _have_one_home(kind: type, *names: str) -> bool:
    """Whether a class has these methods from one and the same of its bases."""
    return len({next(base for base in kind.__mro__ if name in vars(base)) for name in names}) == 1


ALGORITHM = Algorithm("ppo", Args, PPO, ("T", "R"), preset, load_policy, SEARCH_SPACE)
