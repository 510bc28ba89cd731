"""Lagrangian PPO (Ray, Achiam and Amodei, 2019) for tasks with safety constraints.

What is played, how advantages A_k are estimated, and what policies are is in :mod:`rl2grid.algorithms.on_policy`; the
clipped surrogate and the losses of critics are those of :mod:`rl2grid.algorithms.ppo`.

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

Costs
    Every cost has a critic of its own, and advantages A^i_k by the equations of rewards with the transition's sum
    of costs (all its grid steps count fully, as in the constraint) and the discount ``cost_gamma``.

The objective
    PPO's clipped surrogate of the advantages of the Lagrangian,

        (A_k - sum_i lambda_i A^i_k) / (1 + sum_i lambda_i),

    which are shifted and scaled per minibatch after they were combined: scaling them one by one would
    change the price that the multipliers stand for. What costs more than expected becomes less probable.

    A constraint that binds is met exactly by a policy that mixes actions, so the deterministic one may be safer than
    the threshold, or less safe.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from torch import Tensor

from rl2grid.algorithms import on_policy, ppo
from rl2grid.algorithms.diagnostics import explained_variance, mean
from rl2grid.algorithms.hyperparameters import changed_preset
from rl2grid.algorithms.on_policy import ActorCritic, generalized_advantages
from rl2grid.algorithms.on_policy import load_policy as load_policy
from rl2grid.algorithms.playing import reported
from rl2grid.algorithms.registry import Algorithm
from rl2grid.algorithms.trainer import Played
from rl2grid.errors import UsageError, one_of
from rl2grid.mdp.constraint_table import THRESHOLDS

# --- Hyperparameters ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Args(ppo.Args):
    """Hyperparameters; the presets below change some of the values here."""

    algorithm: ClassVar[str] = "Lagrangian PPO"

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

    def __post_init__(self) -> None:
        """Refuse values that cannot work; see :class:`OnPolicyArgs`."""
        super().__post_init__()
        cost_gamma = self.gamma if self.cost_gamma is None else self.cost_gamma
        if not 0.0 <= cost_gamma <= 1.0:
            raise UsageError(f"Lagrangian PPO needs cost_gamma between 0 and 1, not {cost_gamma}.")
        if cost_gamma == 1.0 and self.cost_scale is None:
            raise UsageError(
                "Lagrangian PPO with cost_gamma 1 needs a cost_scale, because 1 - cost_gamma would be zero."
            )
        if self.cost_scale is not None:
            self._check_positive("cost_scale")
        self._check_not_negative("multiplier_learning_rate", "multiplier_damping")
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
    """Our own values: those of PPO, and multipliers that start at zero."""
    return Args(**vars(ppo.default(continuous=continuous)))


def paper(*, continuous: bool) -> Args:
    """The paper's values: those of PPO, and multipliers by plain gradient steps and without bound.

    The step size of the multipliers, of which its table is silent, is ours.
    """
    return Args(**vars(ppo.paper(continuous=continuous)), multiplier_damping=0.0, max_multiplier=None, cost_scale=1.0)


PRESETS: dict[str, Callable[..., Args]] = {"default": default, "paper": paper}

SEARCH_SPACE = ppo.SEARCH_SPACE
"""The values among which the paper searched (its table of hyperparameters). The thresholds 0 and 50 that it lists as
well are no choice but what a task asks for. The table gives 0 to TLO and 50 to LSI, the text the other way round: the
tasks follow the text."""


def preset(name: str, *, continuous: bool, **changes: Any) -> Args:
    """A preset for tasks with continuous or discrete actions, some values changed.

    Raises:
        UsageError: no such preset, or values that cannot work.
    """
    return changed_preset(PRESETS, "Lagrangian PPO", name, continuous=continuous, **changes)


# --- What is optimised ----------------------------------------------------------------------------------------------


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


@dataclass(frozen=True)
class Rollout(on_policy.Rollout):
    """What happened between two updates; every array is [num_steps, num_envs, ...]."""

    costs: Tensor
    """[..., constraint], sums over the transitions, scaled"""
    cost_discounts: Tensor
    """cost_gamma ** n_k"""
    cost_values: Tensor
    """[..., constraint]"""
    next_cost_values: Tensor
    """[..., constraint]: 0 after a termination, of the last observation at a truncation"""


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


@dataclass(frozen=True)
class Minibatch(on_policy.Minibatch):
    """Some transitions of a rollout, their advantages those of the Lagrangian; every array is [batch, ...]."""

    cost_values: Tensor
    """[batch, constraint]"""
    cost_returns: Tensor
    """[batch, constraint]"""


@dataclass(frozen=True)
class CriticLosses(on_policy.CriticLosses):
    """What the critics minimise, and its parts; scalars but for that of the costs."""

    cost_values: Tensor
    """[constraint]"""


def critic_losses(network: ActorCritic, batch: Minibatch, args: Args) -> CriticLosses:
    """The squared errors of the critic and of the costs' critics."""
    of_ppo = ppo.critic_losses(network, batch, args)
    cost_values = ppo.value_loss(network.cost_values(batch.observations), batch.cost_values, batch.cost_returns, args)
    total = of_ppo.total + args.value_coefficient * cost_values.sum()
    return CriticLosses(total, of_ppo.value, cost_values.detach())


# --- Training -------------------------------------------------------------------------------------------------------


class LagrangianPPO(ppo.PPO):
    """One training run; see :class:`OnPolicyTrainer`."""

    args: Args

    def __init__(self, args: Args, envs: VectorEnv[Any, Any, Any]) -> None:
        """Set up networks, optimiser and multipliers.

        Raises:
            UsageError: the environments cannot be learned with these hyperparameters.
        """
        limits = find_limits(args, getattr(getattr(envs.unwrapped, "options", None), "constraint", None))
        self.constraints, self.thresholds = tuple(limits), np.array(list(limits.values()), np.float64)
        super().__init__(args, envs, n_costs=len(limits))
        self.cost_gamma = args.gamma if args.cost_gamma is None else args.cost_gamma
        self.cost_scale = 1.0 - self.cost_gamma if args.cost_scale is None else args.cost_scale
        initial = np.full(len(self.constraints), args.initial_multiplier, np.float64)
        self.multipliers = Multipliers(initial, initial)
        self.account = CostAccount(args.num_envs, tuple(limits), self.thresholds)

    def before_update(self) -> dict[str, float]:
        """Let the multipliers follow the episodes that ended in the rollout."""
        return self.update_multipliers(self.account.costs)

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

    def collect(self) -> tuple[on_policy.Rollout, dict[str, float]]:
        """Play one rollout."""
        self.account.forget()
        self._costs: list[NDArray[np.float64]] = []
        rollout, metrics = super().collect()
        return rollout, {**metrics, **self.account.metrics()}

    def begin_episodes(self, infos: Mapping[str, Any], begun: NDArray[np.bool_]) -> None:
        """See :class:`Trainer`."""
        super().begin_episodes(infos, begun)
        if self.observations is None:  # later episodes begin when the costs of those before have been counted
            self.account.begin(infos, begun)

    def note(self, played: Played) -> None:
        """Count what the step has cost."""
        costs = costs_of_transition(played, self.constraints)
        self.account.note(played, costs)
        self._costs.append(costs)

    def rollout(self, record: on_policy.Record) -> Rollout:
        """What an update needs to know of the steps of a rollout, with what they cost."""
        cost_values, next_cost_values = record.values(self.network.cost_values)
        return Rollout(
            **vars(super().rollout(record)),
            costs=self.tensor(np.stack(self._costs) * self.cost_scale, torch.float32),
            cost_discounts=self.tensor(self.cost_gamma**record.n_steps, torch.float32),
            cost_values=cost_values,
            next_cost_values=next_cost_values,
        )

    def transitions(self, rollout: on_policy.Rollout) -> Minibatch:
        """All transitions of a rollout, with what the policy and the critics learn from them."""
        assert isinstance(rollout, Rollout)
        of_ppo = super().transitions(rollout)
        cost_advantages = advantages_of_costs(rollout, self.args.gae_lambda)
        multipliers = self.tensor(self.multipliers.current, torch.float32)
        advantages = lagrangian_advantages(of_ppo.advantages, cost_advantages.flatten(0, 1), multipliers)
        return Minibatch(
            **{**vars(of_ppo), "advantages": advantages},
            cost_values=rollout.cost_values.flatten(0, 1),
            cost_returns=(cost_advantages + rollout.cost_values).flatten(0, 1),
        )

    def further_metrics(self, data: on_policy.Minibatch, history: on_policy.History) -> dict[str, float]:
        """The losses of the costs' critics, and how well they predict."""
        assert isinstance(data, Minibatch)
        metrics = {}
        for i, name in enumerate(_metric_names("losses/cost_value_loss", self.constraints)):
            metrics[name] = mean(loss.cost_values[i] for loss in history.critics)
        for i, name in enumerate(_metric_names("losses/cost_explained_variance", self.constraints)):
            metrics[name] = explained_variance(data.cost_values[..., i], data.cost_returns[..., i])
        return metrics

    def critic_losses(self, batch: on_policy.Minibatch) -> CriticLosses:
        """See :func:`critic_losses`."""
        assert isinstance(batch, Minibatch)
        return critic_losses(self.network, batch, self.args)

    def improve_critics(self, data: on_policy.Minibatch, rows: Tensor) -> on_policy.CriticLosses:
        """One step down :func:`critic_losses`, in compiled code where there is such."""
        steps = self.compiled_critics()
        if steps is None:
            return super().improve_critics(data, rows)
        assert isinstance(data, Minibatch)
        of_rewards, *of_costs = steps
        value = of_rewards.step(rows, data.observations, data.values, data.returns)
        columns = zip(of_costs, data.cost_values.T.contiguous(), data.cost_returns.T.contiguous(), strict=True)
        cost_values = torch.stack([of_cost.step(rows, data.observations, *column) for of_cost, *column in columns])
        return CriticLosses(self.args.value_coefficient * (value + cost_values.sum()), value, cost_values)

    def state_dict(self) -> dict[str, Any]:
        """See :class:`Trainer`."""
        return {
            **super().state_dict(),
            "multipliers": self.multipliers._asdict(),
            "episode_costs": self.account.running,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """See :class:`Trainer`."""
        super().load_state_dict(state)
        self.multipliers = Multipliers(**{name: np.array(value) for name, value in state["multipliers"].items()})
        self.account.running = np.array(state["episode_costs"])


class CostAccount:
    """The costs of episodes, not scaled: of those that are played, and of those that ended in a rollout."""

    def __init__(self, num_envs: int, constraints: tuple[str, ...], thresholds: NDArray[np.float64]) -> None:
        self.running = np.zeros((num_envs, len(thresholds)), np.float64)
        """[num_envs, constraint], so far"""
        self._constraints, self._thresholds = constraints, thresholds
        self.forget()

    def forget(self) -> None:
        """Begin a rollout: no episode has ended in it."""
        self._ended: list[NDArray[np.float64]] = []
        self._safe: list[bool] = []

    def note(self, played: Played, costs: NDArray[np.float64]) -> None:
        """Count the costs [num_envs, constraint] of a transition, and whether the episodes that ended were safe."""
        self.running += costs
        self._ended.extend(self.running[played.ended].copy())
        safe = played.completed & (self.running <= self._thresholds).all(axis=1)
        self._safe.extend(safe[played.ended].tolist())
        self.begin(played.infos, played.ended)

    def begin(self, infos: Mapping[str, Any], begun: NDArray[np.bool_]) -> None:
        """Episodes begin with what their resets have cost: no decision led to it, but the constraint counts it."""
        nothing = np.zeros(len(begun), np.float64)
        costs = infos.get("reset_costs", {})
        for column, name in enumerate(self._constraints):
            self.running[begun, column] = reported(costs, name, nothing)[begun]

    @property
    def costs(self) -> NDArray[np.float64]:
        """Of the episodes that ended, [episode, constraint]."""
        return np.array(self._ended, np.float64).reshape(-1, len(self._thresholds))

    def metrics(self) -> dict[str, float]:
        """Means over the episodes that ended; nothing if none did."""
        if not self._ended:
            return {}
        names = _metric_names("charts/episodic_cost", self._constraints)
        means = dict(zip(names, self.costs.mean(axis=0).tolist(), strict=True))
        return {**means, "charts/safe_episodes": float(np.mean(self._safe))}


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


def costs_of_transition(played: Played, constraints: tuple[str, ...]) -> NDArray[np.float64]:
    """Sums of the costs over all grid steps of the transitions just played [num_envs, constraint], not scaled.

    Raises:
        UsageError: the environments do not report them.
    """
    missing = np.full(len(played.ended), np.nan)
    playing, last = played.infos.get("costs", {}), played.infos.get("final_info", {}).get("costs", {})
    columns = [
        np.where(played.ended, reported(last, name, missing), reported(playing, name, missing)) for name in constraints
    ]
    costs = np.stack(columns, axis=1)
    if np.isnan(costs).any():
        raise UsageError(f"The environment does not report info['costs'] of {', '.join(constraints)}.")
    return costs


ALGORITHM = Algorithm("lagrangian-ppo", Args, LagrangianPPO, ("T", "R"), preset, load_policy, SEARCH_SPACE, find_limits)
