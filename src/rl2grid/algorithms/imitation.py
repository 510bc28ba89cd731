"""Imitation: supervised learning of what a teacher decided, so that PPO or SAC can go on from there.

What is learned from are labels of ``rl2grid teach`` (:mod:`rl2grid.records.labels`): states s_k, the teacher's action
a_k there, what it thinks of the actions that it considered, how many decisions w_k the label stands for, and the
discounted return G_k that followed as the episode was played.

Topology actions
    The policy minimises the cross-entropy - sum over a of q_k(a) log pi(a | s_k) over the legal actions, where

        q_k = (1 - e) [(1 - m_k) 1(a = a_k) + m_k softmax(values_k / T)] + e / (number of legal actions)

    with the temperature T (``soft_temperature``), the share m_k of the values (``soft_share``; 0 where the teacher told
    none) and the share e of smoothing (``label_smoothing``).

Continuous actions
    Means are fitted to a_k by Huber's loss; those of a network that says where injections should be (``set-point``)
    before they are clipped to a step, to where the teacher wants them. The deviations, which exploration starts with,
    are those of the teacher's actions around the means: the log-likelihood of a Gaussian, whose means are not moved by
    it, within ``log_std_range``. Of SAC's policy that is the Gaussian before it is squashed.

Joint tasks
    are learned as :class:`~rl2grid.envs.joint.JointAsBox`, whose topology action is that of the largest of the first n
    entries x: cross-entropy with the logits ``joint_scale`` * x, over all actions, because nothing is masked when it is
    played, and what leaves [-1, 1] costs its square. Noise of deviation pi / (sqrt(6) ``joint_scale``) on the entries,
    as wide as Gumbel's, draws about as those logits say. The other entries are learned as continuous actions.

Weights
    A label counts w_k times, and ``acting_weight`` times that where the teacher acts (any action but 0, or any
    injection): where it rarely does, a policy that never acts would be nearly as good.

Critic
    V(s_k) of the policy ``ppo`` is fitted to (1 - gamma) G_k by squared errors, as PPO scales rewards.

Held-out months
    are not learned from; they tell when what is learned is the months and no longer the teacher. The best policy is
    picked by how long it survives on validation months, as of every training.

The budget counts labels, each as often as it is learned from. Their order is a pure function of the seed and the epoch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor, nn

from rl2grid.algorithms import on_policy, sac
from rl2grid.algorithms.descent import Adam, descend
from rl2grid.algorithms.diagnostics import explained_variance, mean
from rl2grid.algorithms.examples import (
    Batch,
    Examples,
    chosen_rows,
    factor_of_acting,
    held_out,
    shortlisted,
    teacher_acts,
    weighted_statistics,
)
from rl2grid.algorithms.hyperparameters import SharedArgs, changed_preset
from rl2grid.algorithms.networks import Aiming
from rl2grid.algorithms.on_policy import ActorCritic
from rl2grid.algorithms.playing import check_environments
from rl2grid.algorithms.registry import Algorithm
from rl2grid.algorithms.sac import CategoricalActor, GaussianActor
from rl2grid.algorithms.sampling import legal_log_softmax
from rl2grid.algorithms.trainer import Learner
from rl2grid.arrays import I64
from rl2grid.dense.choices import NEVER
from rl2grid.envs.options import DEFAULTS, OBSERVED_WITH
from rl2grid.envs.spec import Spec, spec_of
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError, one_of
from rl2grid.records.labels import NO_CANDIDATE, Labels, LabelsDescription, read_labels
from rl2grid.streams import Purpose, Stream

ON_POLICY, SOFT = "ppo", "sac"
POLICIES = (ON_POLICY, SOFT)
CLOSE = 0.1
"""Continuous actions agree if no entry differs by more."""

# --- Hyperparameters ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Args(SharedArgs):
    """Hyperparameters; the presets below change some of the values here."""

    algorithm: ClassVar[str] = "Imitation"

    labels: tuple[str, ...] = ()
    """Folders of labels that 'rl2grid teach' wrote, of one task; at least one. ``{seed}`` in them is the run's seed."""
    policy: str = ON_POLICY
    """Whose policy is learned: ``ppo``, with a critic, or ``sac``."""
    total_timesteps: int = 2_000_000
    """Labels to learn from, each as often as it is its turn; never exceeded."""
    num_envs: int = 1
    """No environment is played: 1."""
    num_steps: int = 20_000
    """Labels between two rows of metrics."""
    batch_size: int = 256
    """Labels per update."""
    actor_learning_rate: float = 1e-3
    """Adam's step size for the policy."""
    critic_learning_rate: float = 1e-3
    """Adam's step size for the critic."""
    anneal_learning_rate: bool = True
    """Whether both step sizes fall linearly to zero over the run."""
    soft_share: float = 0.25
    """Share of the teacher's values in what is imitated, where it tells any; the rest is its action."""
    soft_temperature: float = 0.02
    """Difference of two values, of loadings mostly, that makes one action e times as desirable as the other."""
    label_smoothing: float = 0.0
    """Share of the legal actions, all alike, in what is imitated."""
    acting_weight: float | None = None
    """How much more decisions count in which the teacher acts; None: as much as makes them a quarter of all weight."""
    holdout: float = 0.1
    """Share of the months that are not learned from, but tell how well the rest was generalised."""
    huber_delta: float = 0.1
    """Continuous actions only: errors beyond this count linearly."""
    log_std_range: tuple[float, float] = (-2.5, -0.5)
    """Continuous actions only: bounds of the policy's log standard deviations."""
    joint_scale: float = 10.0
    """Joint tasks only: logit of an entry of 1."""
    actor_layers: tuple[int, ...] = (128, 128)
    """Widths of the policy's hidden layers (in an ``mlp`` tanh, of SAC's policy ReLU)."""
    critic_layers: tuple[int, ...] = (128, 128)
    """Widths of the value function's hidden layers (tanh, in an ``mlp``)."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work; see :class:`SharedArgs`."""
        super().__post_init__()
        if self.num_envs != 1:
            raise UsageError(f"Imitation plays no environments: leave num_envs at 1 instead of {self.num_envs}.")
        if self.policy not in POLICIES:
            raise one_of("Imitation's policy", self.policy, POLICIES)
        self._check_counts("batch_size")
        self._check_positive("actor_learning_rate", "critic_learning_rate", "soft_temperature", "huber_delta")
        self._check_positive("joint_scale")
        self._check_shares("soft_share", "label_smoothing", "holdout")
        if self.acting_weight is not None:
            self._check_positive("acting_weight")
        if self.holdout == 1.0:
            raise UsageError("Imitation needs a holdout below 1: no month would be left to learn from.")
        low, high = self.log_std_range
        if not -10.0 <= low <= high <= 2.0:
            raise UsageError(f"Imitation needs a log_std_range within -10 and 2, not {self.log_std_range}.")
        self._check_layers("actor_layers", "critic_layers")


def default(*, continuous: bool) -> Args:
    """Our own values; sizes and discount are those of the default of PPO, which can go on from there."""
    if continuous:
        return Args(mask_actions=False, gamma=0.99)
    return Args(gamma=0.9)


PRESETS: dict[str, Callable[..., Args]] = {"default": default}

SEARCH_SPACE: dict[str, tuple[Any, ...]] = {
    "batch_size": (128, 256, 1024),
    "actor_learning_rate": (3e-3, 1e-3, 3e-4),
    "soft_share": (0.0, 0.25, 0.5),
    "label_smoothing": (0.0, 0.02),
}
"""Values among which a search tries by default; the paper imitates nothing."""


def preset(name: str, *, continuous: bool, **changes: Any) -> Args:
    """A preset for tasks with continuous or discrete actions, some values changed.

    Raises:
        UsageError: no such preset, or values that cannot work.
    """
    return changed_preset(PRESETS, "Imitation", name, continuous=continuous, **changes)


# --- What is optimised ----------------------------------------------------------------------------------------------


def aims(batch: Batch, masks: Tensor | None, actions: int, args: Args) -> Tensor:
    """The distribution q over topology actions that is imitated, [batch, actions] (equation above).

    Args:
        batch: Labels of topology actions.
        masks: Actions that may have a probability, bool [batch, actions]; None: all.
        actions: How many there are.
        args: Hyperparameters.
    """
    assert batch.topology is not None
    hard = nn.functional.one_hot(batch.topology, actions).to(torch.float32)
    aim = hard
    known = batch.candidates != NO_CANDIDATE
    if args.soft_share and known.shape[1]:
        values = (batch.values / args.soft_temperature).masked_fill(~known, NEVER)
        liked = values.softmax(dim=-1) * known
        soft = torch.zeros_like(hard).scatter_add_(-1, batch.candidates.clamp(min=0), liked)
        share = args.soft_share * known.any(dim=-1, keepdim=True)
        aim = (1.0 - share) * hard + share * soft
    if args.label_smoothing:
        legal = torch.ones_like(hard) if masks is None else masks.to(torch.float32)
        aim = (1.0 - args.label_smoothing) * aim + args.label_smoothing * legal / legal.sum(dim=-1, keepdim=True)
    return aim


def cross_entropies(logits: Tensor, aim: Tensor, masks: Tensor | None) -> Tensor:
    """- sum over actions of q log pi, [batch], of logits and q [batch, actions]."""
    return -(aim * legal_log_softmax(logits, masks)).sum(dim=-1)


def huber(errors: Tensor, delta: float) -> Tensor:
    """Half the square of errors up to ``delta``, beyond it delta (|e| - delta / 2); summed over dimensions, [batch]."""
    return nn.functional.huber_loss(errors, torch.zeros_like(errors), reduction="none", delta=delta).sum(dim=-1)


def deviation_losses(residuals: Tensor, log_stds: Tensor) -> Tensor:
    """Negative log-likelihood of residuals [batch, dimensions] of a Gaussian, but for a constant, [batch]."""
    return (0.5 * (residuals / log_stds.exp()).square() + log_stds).sum(dim=-1)


class Said(NamedTuple):
    """What a policy says of a batch."""

    outputs: Tensor
    """logits [batch, actions], or what is played of continuous actions [batch, dimensions]"""
    unsquashed: Tensor | None = None
    """continuous actions only: means of the Gaussian"""
    log_stds: Tensor | None = None
    """its log standard deviations, [dimensions] or [batch, dimensions]"""
    aim: Tensor | None = None
    """of networks that say where injections should be: the action that would bring them there at once"""


def said_by(network: nn.Module, observations: Tensor) -> Said:
    """What any of the policies that are imitated with says of observations [batch, size]."""
    if isinstance(network, ActorCritic):
        if isinstance(network.actor, Aiming):
            aim, means = network.actor.aims_and_means(observations)
            return Said(means, means, network.log_std, aim)
        outputs = network.actor(observations)
        return Said(outputs, outputs, network.log_std) if network.continuous else Said(outputs)
    if isinstance(network, GaussianActor):
        means, log_stds = network(observations)
        return Said(means.tanh(), means, log_stds)
    assert isinstance(network, CategoricalActor)
    return Said(network.network(observations))


class Errors(NamedTuple):
    """How far a policy is from its teacher, each [batch]."""

    policy: Tensor
    """what actions or means minimise"""
    agrees: Tensor
    """bool, the most probable action is the teacher's"""
    deviations: Tensor | None = None
    """what log standard deviations minimise"""


_ALMOST_ONE = 0.999
"""Where tanh is inverted: that of 1 would be infinite."""


def errors_of(network: nn.Module, batch: Batch, args: Args) -> Errors:
    """The losses of the policy (module docstring), and whether it agrees with the teacher."""
    said = said_by(network, batch.observations)
    if said.unsquashed is None:
        assert batch.topology is not None
        masks = batch.masks if args.mask_actions else None
        losses = cross_entropies(said.outputs, aims(batch, masks, said.outputs.shape[-1], args), masks)
        best = said.outputs if masks is None else said.outputs.masked_fill(~masks, NEVER)
        return Errors(losses, best.argmax(dim=-1) == batch.topology)
    return _continuous_errors(network, said, batch, args)


def _continuous_errors(network: nn.Module, said: Said, batch: Batch, args: Args) -> Errors:
    assert batch.injection is not None
    assert said.unsquashed is not None
    assert said.log_stds is not None
    n = said.outputs.shape[-1] - batch.injection.shape[-1]
    played = said.outputs.clamp(-1.0, 1.0)
    if said.aim is None:
        losses = huber(said.outputs[:, n:] - batch.injection, args.huber_delta)
    else:
        assert batch.aim is not None
        losses = huber(said.aim[:, n:] - batch.aim, args.huber_delta)
    agrees = ((played[:, n:].detach() - batch.injection).abs() <= CLOSE).all(dim=-1)
    aimed_at = batch.injection
    if isinstance(network, GaussianActor):
        aimed_at = aimed_at.clamp(-_ALMOST_ONE, _ALMOST_ONE).atanh()
    residuals = aimed_at - said.unsquashed[:, n:].detach()
    deviations = deviation_losses(residuals, said.log_stds[..., n:].clamp(*args.log_std_range))
    if n:
        assert batch.topology is not None
        losses = losses + cross_entropies(args.joint_scale * played[:, :n], aims(batch, None, n, args), None)
        losses = losses + (said.outputs[:, :n] - played[:, :n].detach()).square().sum(dim=-1)
        deviations = deviations + (said.log_stds[..., :n] - gumbel_log_std(args)).square().mean(dim=-1)
        agrees = agrees & (played[:, :n].argmax(dim=-1) == batch.topology)
    return Errors(losses, agrees, deviations)


def gumbel_log_std(args: Args) -> float:
    """Log standard deviation of noise on the entries of a joint action that draws about as their logits say."""
    return math.log(math.pi / (math.sqrt(6.0) * args.joint_scale))


# --- Training -------------------------------------------------------------------------------------------------------


class Imitation(Learner):
    """One training run; see :class:`Learner`. It plays nothing."""

    args: Args

    def __init__(self, args: Args, envs: VectorEnv[Any, Any, Any]) -> None:
        """Read the labels, set up the network and its optimiser.

        Args:
            args: Hyperparameters.
            envs: What the labels are to be of; they are not reset.

        Raises:
            UsageError: the labels are not of these environments or cannot be read, or cannot be learned from with these
                hyperparameters.
        """
        check_environments(args.algorithm, envs, num_envs=args.num_envs, mask_actions=args.mask_actions)
        super().__init__(args, spec_of(envs), getattr(envs.unwrapped, "options", None))
        description, labels = _labels_for(args, self.spec, self.options)
        self._identity = {**description.identity, "teacher": description.teacher, "rounds": description.rounds}
        self.network = self._policy().to(self.device)
        self.optimizer = Adam(self._groups(), lr=args.actor_learning_rate, eps=1e-5)
        self._take(labels, description)

    def _policy(self) -> ActorCritic | GaussianActor | CategoricalActor:
        args = self.args
        if args.policy == SOFT:
            return (GaussianActor if self.continuous else CategoricalActor)(self.networks, args.actor_layers)
        network = ActorCritic(
            self.networks,
            actor_layers=args.actor_layers,
            critic_layers=args.critic_layers,
            initial_log_std=min(max(-1.0, args.log_std_range[0]), args.log_std_range[1]),
        )
        if self.spec.task is not None and find_task(self.spec.task).kind == "H":
            with torch.no_grad():
                network.log_std[: find_task(self.spec.task).n_topology_actions] = gumbel_log_std(args)
        return network

    def _groups(self) -> list[dict[str, Any]]:
        """What is optimised: the policy, its deviations where they are no part of its layers, and the critic."""
        if not isinstance(self.network, ActorCritic):
            return [{"params": list(self.network.parameters())}]
        deviations = [self.network.log_std] if self.continuous else []
        parts = [list(self.network.actor.parameters()), deviations, list(self.network.critic.parameters())]
        return [{"params": part} for part in parts if part]

    def _take(self, labels: Labels, description: LabelsDescription) -> None:
        """Part what is learned from and what is held out, and look at what both have in common."""
        args = self.args
        scenarios = [row.scenario for row in description.rows for _ in range(row.labels)]
        out = held_out(scenarios, args.holdout)
        aside = np.array([scenario in out for scenario in scenarios])
        learned, kept = chosen_rows(labels, ~aside), chosen_rows(labels, aside)
        if not len(learned):
            raise UsageError("All labels are of months that are held out: set holdout to 0, or label more months.")
        if self.normalizer is not None:
            self.normalizer.load_state_dict(weighted_statistics(learned.observations, learned.weights))
            self.normalizer.freeze()
        acts = teacher_acts(learned)
        factor = factor_of_acting(learned.weights, acts, args.acting_weight)
        scale = float(np.mean(learned.weights * np.where(acts, factor, 1.0)))
        self.acting_weight = factor
        """How much more decisions count in which the teacher acts."""
        self.examples = self._examples(learned, factor, scale)
        """What is learned from."""
        self.aside = self._examples(kept, factor, scale)
        """What is held out."""
        self._order = -1, np.zeros(0, np.int64)
        if isinstance(self.network, ActorCritic) and isinstance(self.network.actor, Aiming):
            parts = [self.network.actor.reads(batch.observations).cpu() for batch in self.examples.batches(4096)]
            seen = weighted_statistics(torch.cat(parts).numpy(), learned.weights)
            self.network.actor.standardise(seen["mean"], np.sqrt(seen["squares"] / seen["count"]))

    def _examples(self, labels: Labels, factor: float, scale: float) -> Examples:
        acts = teacher_acts(labels)
        weights = (labels.weights * np.where(acts, factor, 1.0) / scale).astype(np.float32)
        if self.shortlisted is not None:
            labels, weights = shortlisted(labels, weights, self.shortlisted)
        return Examples(labels, self.normalized(labels.observations), weights, acts, self.reward_scale)

    def identity(self) -> dict[str, Any]:
        """The labels: who decided them, and their hashes."""
        return {**super().identity(), "labels": self._identity}

    def iterate(self) -> dict[str, float]:
        """Learn from ``num_steps`` labels, and return the metrics."""
        self.begin_as_asked()
        args = self.args
        rates = self._set_learning_rates()
        history: list[Seen] = []
        for first in range(0, args.num_steps, args.batch_size):
            batch = self.examples.rows(self._next(min(args.batch_size, args.num_steps - first)))
            history.append(self._descend(batch))
        self.iteration += 1
        metrics = _metrics(history, "losses/imitation_loss", "charts/")
        if isinstance(self.network, ActorCritic):
            metrics["losses/value_loss"] = mean(seen.value_loss for seen in history)
        metrics |= self._held_out_metrics()
        metrics["charts/epochs"] = self.decisions / len(self.examples)
        metrics["charts/learning_rate"] = rates[0]
        if isinstance(self.network, ActorCritic) and self.continuous:
            metrics["charts/action_std"] = float(self.network.log_std.detach().exp().mean())
        return metrics

    def _descend(self, batch: Batch) -> Seen:
        errors = errors_of(self.network, batch, self.args)
        losses = errors.policy if errors.deviations is None else errors.policy + errors.deviations
        loss = (batch.weights * losses).mean()
        value = torch.zeros_like(loss)
        if isinstance(self.network, ActorCritic):
            value = 0.5 * (batch.weights * (self.network.value(batch.observations) - batch.returns).square()).mean()
            loss = loss + value
        descend(self.optimizer, loss, self.args.max_grad_norm)
        if isinstance(self.network, ActorCritic) and self.continuous:
            with torch.no_grad():
                self.network.log_std[-batch.injection.shape[-1] :].clamp_(*self.args.log_std_range)  # type: ignore[union-attr]
        return seen_of(errors, batch, value)

    def _held_out_metrics(self) -> dict[str, float]:
        """How well the policy does on months that it does not learn from; nothing without such."""
        if not len(self.aside):
            return {}
        with torch.no_grad():
            batches = partial(self.aside.batches, self.args.batch_size)
            seen = [seen_of(errors_of(self.network, batch, self.args), batch) for batch in batches()]
            metrics = _metrics(seen, "losses/holdout_loss", "charts/holdout_")
            if isinstance(self.network, ActorCritic):
                values = torch.cat([self.network.value(batch.observations) for batch in batches()])
                returns = torch.cat([batch.returns for batch in batches()])
                metrics["losses/explained_variance"] = explained_variance(values, returns)
        return metrics

    def _set_learning_rates(self) -> tuple[float, float]:
        """Let the step sizes follow their schedule; those of the policy and of the critic."""
        remaining = 1.0 - self.iteration / self.num_iterations if self.args.anneal_learning_rate else 1.0
        rates = (remaining * self.args.actor_learning_rate, remaining * self.args.critic_learning_rate)
        groups = self.optimizer.param_groups
        for group in groups:
            group["lr"] = rates[0]
        if isinstance(self.network, ActorCritic):
            groups[-1]["lr"] = rates[1]
        return rates

    def _next(self, count: int) -> I64:
        """Indices of the labels whose turn it is: every epoch has all of them, in an order of its own."""
        parts: list[I64] = []
        while count:
            epoch, place = divmod(self.decisions, len(self.examples))
            if self._order[0] != epoch:
                drawn = Stream(self.args.seed, epoch, Purpose.AGENT).uniform(len(self.examples))
                self._order = epoch, np.argsort(drawn, kind="stable")
            part = self._order[1][place : place + count]
            parts.append(part)
            self.decisions += len(part)
            count -= len(part)
        return np.concatenate(parts)

    def learned(self) -> Mapping[str, nn.Module | torch.optim.Optimizer]:
        """See :class:`Learner`."""
        return {"network": self.network, "optimizer": self.optimizer}

    def policy(self) -> tuple[nn.Module, dict[str, Any]]:
        """See :class:`Learner`."""
        sizes: dict[str, Any] = {"policy": self.args.policy, "actor_layers": list(self.args.actor_layers)}
        if self.args.policy == ON_POLICY:
            sizes |= {"critic_layers": list(self.args.critic_layers), "n_costs": 0}
        return self.network, sizes


def _labels_for(args: Args, spec: Spec, options: Any) -> tuple[LabelsDescription, Labels]:
    """The labels that are to be learned from, of environments with these options."""
    if not args.labels:
        raise UsageError("Imitation needs labels: give a folder that 'rl2grid teach' wrote, with --labels.")
    if spec.task is None:
        raise UsageError("Imitation learns tasks of rl2grid, whose observations and actions labels can name.")
    description, labels = read_labels([Path(args.with_seed(folder)) for folder in args.labels], spec.task)
    for name in ("heuristic", *OBSERVED_WITH, "reward"):
        mine, theirs = getattr(options, name), description.env_keywords.get(name, DEFAULTS[name])
        if mine != theirs:
            raise UsageError(f"The labels are of environments with {name}={theirs}, not {mine}: train with the former.")
    if args.gamma != description.gamma:
        raise UsageError(
            f"The returns of the labels are discounted by gamma={description.gamma}, not {args.gamma}: set gamma to "
            "the former."
        )
    return description, labels


class Seen(NamedTuple):
    """What metrics need to know of a batch, each [batch] but the last; nothing that is as large as its masks."""

    losses: Tensor
    """weighted"""
    agrees: Tensor
    acts: Tensor
    stands_for: Tensor
    value_loss: Tensor


def seen_of(errors: Errors, batch: Batch, value_loss: Tensor | None = None) -> Seen:
    """What is kept of the errors of a batch."""
    losses = (batch.weights * errors.policy).detach()
    value = torch.zeros_like(losses[:1].sum()) if value_loss is None else value_loss.detach()
    return Seen(losses, errors.agrees, batch.acts, batch.stands_for, value)


def _metrics(seen: Sequence[Seen], loss: str, agreement: str) -> dict[str, float]:
    """Means over decisions: the loss as it is minimised, and how often the most probable action is the teacher's."""
    losses, agrees = torch.cat([each.losses for each in seen]), torch.cat([each.agrees for each in seen])
    acts, counts = torch.cat([each.acts for each in seen]), torch.cat([each.stands_for for each in seen])
    metrics = {loss: float(losses.mean()), f"{agreement}agreement": float((counts * agrees).sum() / counts.sum())}
    if acts.any():
        metrics[f"{agreement}agreement_acting"] = float((counts * agrees)[acts].sum() / counts[acts].sum())
    return metrics


def load_policy(state: Mapping[str, Any]) -> ActorCritic | GaussianActor | CategoricalActor:
    """The network of a checkpoint's section ``policy``."""
    return sac.load_policy(state) if state["policy"] == SOFT else on_policy.load_policy(state)


ALGORITHM = Algorithm(
    "imitation",
    Args,
    Imitation,
    ("T", "R"),
    preset,
    load_policy,
    SEARCH_SPACE,
    joint_as_box=True,
    plays_months=False,
)
