"""Double deep Q-learning (Mnih et al., 2015; van Hasselt et al., 2016) for topology tasks.

Targets
    What is played, remembered and when there is an update is in :mod:`rl2grid.algorithms.off_policy`. One
    network chooses the next action, an older copy of it says what it is worth:

        a* = argmax over legal a of Q(s_{k+1}, a)
        y  = R_k + gamma^{n_k} Q_old(s_{k+1}, a*)                   y = R_k after a game over

    Q(s_k, a_k) is fitted to y by squared errors, or by Huber's loss. The copy is renewed whenever the
    decisions pass a multiple of ``target_frequency``. The environment tells no legal actions for the last
    observation of a completed month; there they are taken to be those of the last decision.

    With several networks, each fits the same y, and Q is the least of their values wherever an action is chosen
    or judged (clipped double Q-learning; Fujimoto et al., 2018).

    With the dueling head (Wang et al., 2016) the last layer gives V and A, one number per action, and
    Q(s, a) = V(s) + A(s, a) - mean over all a' of A(s, a'): what every action shows of a state is learned at
    once, and what remains to be told apart is small.

Exploration
    With probability epsilon, which falls linearly over the first decisions of the run, an action is drawn
    among the legal ones; else the legal action of the highest value is played. The deterministic policy is
    the latter.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor, nn

from rl2grid.algorithms.hyperparameters import changed_preset
from rl2grid.algorithms.networks import NetworkFactory, Output, outputs_of
from rl2grid.algorithms.off_policy import (
    Batch,
    OffPolicyArgs,
    OffPolicyTrainer,
    adam,
    random_legal_actions,
)
from rl2grid.algorithms.registry import Algorithm
from rl2grid.algorithms.starting import StartingPolicy
from rl2grid.arrays import F32, Flags
from rl2grid.dense.choices import NEVER
from rl2grid.errors import UsageError, one_of

SINGLE, DUELING = "single", "dueling"
HEADS = (SINGLE, DUELING)

# --- Hyperparameters ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Args(OffPolicyArgs):
    """Hyperparameters; the presets below change some of the values here."""

    algorithm: ClassVar[str] = "DQN"

    learning_rate: float = 5e-4
    """Adam's step size."""
    target_frequency: int = 2_000
    """Decisions, over all environments, between two renewals of the target network."""
    first_epsilon: float = 1.0
    """Probability of a random action at the first decision."""
    last_epsilon: float = 0.05
    """Probability of a random action from the end of the decay on."""
    epsilon_decay_fraction: float = 0.3
    """Share of the decisions of the run during which the probability falls, linearly."""
    exploration_do_nothing: float | None = None
    """Share of the random actions that do nothing; None: that is one action like the others."""
    huber_delta: float | None = None
    """Errors beyond this count linearly instead of squared (Huber's loss); None: all are squared."""
    layers: tuple[int, ...] = (128, 128)
    """Widths of the network's hidden layers (ReLU, in an ``mlp``)."""
    head: str = SINGLE
    """How values come out of a network: ``single``, one per action, or ``dueling`` (equation above)."""
    networks: int = 1
    """Networks that learn independently, the least of whose values counts (clipped double Q-learning)."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work; see :class:`OffPolicyArgs`."""
        super().__post_init__()
        self._check_counts("target_frequency", "networks")
        self._check_positive("learning_rate")
        self._check_layers("layers")
        self._check_shares("first_epsilon", "last_epsilon", "epsilon_decay_fraction")
        if self.exploration_do_nothing is not None:
            self._check_shares("exploration_do_nothing")
        if self.huber_delta is not None:
            self._check_positive("huber_delta")
        if self.head == DUELING and self.shortlist is not None:
            raise UsageError("DQN's dueling head has no shortlist: choose head 'single', or leave the shortlist out.")
        if self.head not in HEADS:
            raise one_of("DQN's head", self.head, HEADS)


def default(*, continuous: bool) -> Args:
    """Our own values, for tasks with a heuristic on a small machine.

    Many random actions do nothing: at random, one of the first few actions would already cut the grid apart, and
    little would be seen of what comes later. With one network the values grow beyond any return that is possible, as
    the best of many values is easily one that is too high and the next target is built on it; the least value of
    four does not, and what is tried is then worth trying, so that few random actions are needed. Few steps down the
    gradient, and large ones (see SAC's).
    """
    _refuse_continuous(continuous)
    return Args(
        num_envs=32,
        train_frequency=32,
        learning_rate=3e-3,
        target_frequency=1_000,
        first_epsilon=0.2,
        last_epsilon=0.02,
        exploration_do_nothing=0.5,
        huber_delta=1.0,
        head=DUELING,
        networks=4,
    )


def paper(*, continuous: bool) -> Args:
    """The paper's values (its table of hyperparameters, column T).

    Where the table is silent: 80 million decisions as for PPO, CleanRL's last epsilon, and squared errors. The table
    counts transitions; the memory is given bytes enough for a million of them on the largest grid.
    """
    _refuse_continuous(continuous)
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
        mask_actions=False,
        learning_rate=3e-4,
        target_frequency=5_000,
        epsilon_decay_fraction=0.5,
    )


PRESETS: dict[str, Callable[..., Args]] = {"default": default, "paper": paper}

SEARCH_SPACE: dict[str, tuple[Any, ...]] = {
    "num_envs": (10, 20, 50),
    "max_grad_norm": (10.0, 20.0, 50.0),
    "gamma": (0.9, 0.95, 0.99),
    "train_frequency": (50, 100, 1000),
    "target_frequency": (1000, 5000, 10_000),
    "buffer_size": (100_000, 250_000, 500_000, 1_000_000),
    "batch_size": (64, 128, 256),
    "learning_rate": (3e-3, 3e-4, 3e-5),
    "epsilon_decay_fraction": (0.3, 0.5, 0.7),
}
"""The paper's grid search, by hyperparameter."""


def preset(name: str, *, continuous: bool, **changes: Any) -> Args:
    """A preset, some values changed.

    Raises:
        UsageError: no such preset, values that cannot work, or continuous actions.
    """
    return changed_preset(PRESETS, "DQN", name, continuous=continuous, **changes)


def _refuse_continuous(continuous: bool) -> None:
    if continuous:
        raise UsageError("DQN chooses among discrete actions and cannot learn continuous ones: choose ppo, sac or td3.")


# --- Network --------------------------------------------------------------------------------------------------------


class QNetwork(nn.Module):
    """The value of every action."""

    continuous = False
    preference = "value"

    def __init__(self, networks: NetworkFactory, layers: Sequence[int], head: str = SINGLE, count: int = 1) -> None:
        super().__init__()
        self.observation_size, self.action_size = networks.spec.observation_size, networks.spec.action_size
        self.dueling = head == DUELING
        output = Output(per_state=int(self.dueling), per_action=1)
        self.networks = nn.ModuleList(networks.make(output, layers) for _ in range(count))

    def forward(self, observations: Tensor) -> Tensor:
        """Q of observations [batch, size] -> [batch, actions]: the least of what the networks say."""
        return self.each(observations).amin(dim=0)

    def each(self, observations: Tensor) -> Tensor:
        """What every network says of observations [batch, size] -> [networks, batch, actions]."""
        outputs = torch.stack([network(observations) for network in self.networks])
        if not self.dueling:
            return outputs
        value, advantages = outputs[..., :1], outputs[..., 1:]
        return value + advantages - advantages.mean(dim=-1, keepdim=True)

    def act(self, observations: Tensor, masks: Tensor | None, generator: torch.Generator | None) -> Tensor:
        """The best legal actions for observations [batch, size], int64 [batch]; ``generator`` has nothing to draw."""
        return best_actions(self(observations), masks)

    def preferences(self, observations: Tensor, masks: Tensor | None) -> Tensor:
        """Values of the actions, [batch, actions]; of illegal ones large and negative."""
        values: Tensor = self(observations)
        return values if masks is None else values.masked_fill(~masks, NEVER)

    def scores(self, rows: F32, legal: Flags) -> F32:
        """The same of rows [batch, size] and legal actions [batch, actions], of a single network without tensors."""
        if self.dueling or len(self.networks) > 1:
            with torch.no_grad():
                values: F32 = self.preferences(torch.from_numpy(rows), torch.from_numpy(legal)).numpy()
            return values
        return np.where(legal, outputs_of(self.networks[0], rows), np.float32(NEVER))


def best_actions(values: Tensor, masks: Tensor | None) -> Tensor:
    """The legal action of the highest value, int64 [batch], of values and masks [batch, actions]."""
    if masks is not None:
        values = values.masked_fill(~masks, NEVER)
    return values.argmax(dim=-1)


def load_policy(state: Mapping[str, Any]) -> QNetwork:
    """The network of a checkpoint's section ``policy``."""
    networks = NetworkFactory.from_state(state["factory"])
    network = QNetwork(networks, state["layers"], state["head"], state["networks"])
    network.load_state_dict(state["network"])
    return network


# --- What is optimised ----------------------------------------------------------------------------------------------


def targets(online: QNetwork, target: QNetwork, batch: Batch) -> Tensor:
    """The targets y of transitions [batch] (equations above)."""
    with torch.no_grad():
        following = best_actions(online(batch.next_observations), batch.next_masks)
        values: Tensor = target(batch.next_observations).gather(-1, following.unsqueeze(-1)).squeeze(-1)
        return batch.rewards + batch.discounts * values


def loss(values: Tensor, aims: Tensor, huber_delta: float | None) -> Tensor:
    """Mean squared error; with ``huber_delta`` d, of errors e beyond it d (2 |e| - d) instead of e squared."""
    if huber_delta is None:
        return nn.functional.mse_loss(values, aims)
    return 2.0 * nn.functional.huber_loss(values, aims, delta=huber_delta)


# --- Training -------------------------------------------------------------------------------------------------------


class DQN(OffPolicyTrainer):
    """One training run; see :class:`OffPolicyTrainer`."""

    args: Args

    def __init__(self, args: Args, envs: VectorEnv[Any, Any, Any]) -> None:
        """Set up the networks and the optimiser.

        Raises:
            UsageError: the environments cannot be learned with these hyperparameters.
        """
        super().__init__(args, envs)
        _refuse_continuous(self.continuous)
        self.network = QNetwork(self.networks, args.layers, args.head, args.networks).to(self.device)
        self.target = copy.deepcopy(self.network)
        self.optimizer = adam(self.network, args.learning_rate)
        self._renewals = 0

    def take_over(self, start: StartingPolicy) -> None:
        """The weights of the values, which are those of the policy.

        Raises:
            UsageError: they are no values of DQN, or others.
        """
        theirs = start.network()
        if not isinstance(theirs, QNetwork):
            raise start.refusal("DQN has values and no policy, and goes on with those of dqn alone")
        if (theirs.dueling, len(theirs.networks)) != (self.network.dueling, len(self.network.networks)):
            raise start.refusal("it has another head, or another number of networks: set both to the same")
        if not start.judges_like(self.args, getattr(self.options, "reward", None)):
            raise start.refusal("its values are of other rewards or of another discount: train with the same")
        self.network.load_state_dict(theirs.state_dict())
        self.target.load_state_dict(theirs.state_dict())

    @property
    def epsilon(self) -> float:
        """Probability of a random action at the next decision."""
        args = self.args
        decay = args.epsilon_decay_fraction * args.total_timesteps
        share = min(1.0, self.decisions / decay) if decay else 1.0
        return args.first_epsilon + share * (args.last_epsilon - args.first_epsilon)

    def explore(self, observations: Tensor, masks: Tensor | None) -> Tensor:
        """Random actions with probability epsilon, else the best."""
        count = len(observations)
        device_masks = None if masks is None else masks.to(self.device)
        best = self.network.act(observations, device_masks, None).cpu()
        drawn = random_legal_actions(
            count, self.action_size, masks, self.generator, do_nothing=self.args.exploration_do_nothing
        )
        return torch.where(torch.rand(count, generator=self.generator) < self.epsilon, drawn, best)

    def learn(self, batch: Batch) -> dict[str, Tensor]:
        """Fit the values of the actions played to their targets; renew the target network when due."""
        aims = targets(self.network, self.target, batch)
        played = batch.actions.expand(self.args.networks, -1).unsqueeze(-1)
        values = self.network.each(batch.observations).gather(-1, played).squeeze(-1)
        error = torch.stack([loss(each, aims, self.args.huber_delta) for each in values]).sum()
        self._descend(self.optimizer, error)
        renewals = self.decisions // self.args.target_frequency
        if renewals > self._renewals:
            self._renewals = renewals
            self.target.load_state_dict(self.network.state_dict())
        return {"losses/qf_loss": error, "losses/qf_values": values.mean()}

    def schedule(self) -> dict[str, float]:
        """Epsilon."""
        return {"charts/epsilon": self.epsilon}

    def learned(self) -> Mapping[str, nn.Module | torch.optim.Optimizer]:
        """See :class:`OffPolicyTrainer`."""
        return {"network": self.network, "target": self.target, "optimizer": self.optimizer}

    def policy(self) -> tuple[nn.Module, dict[str, Any]]:
        """See :class:`OffPolicyTrainer`."""
        return self.network, {"layers": list(self.args.layers), "head": self.args.head, "networks": self.args.networks}

    def state_dict(self) -> dict[str, Any]:
        """See :class:`OffPolicyTrainer`."""
        return {**super().state_dict(), "renewals": self._renewals}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """See :class:`OffPolicyTrainer`."""
        super().load_state_dict(state)
        self._renewals = state["renewals"]


ALGORITHM = Algorithm("dqn", Args, DQN, ("T",), preset, load_policy, SEARCH_SPACE)
