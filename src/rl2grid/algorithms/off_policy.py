"""What DQN, SAC and TD3 have in common: playing, remembering, and when to learn. What they learn is in their own files.

Targets
    All three algorithms fit their action values to

        R_k + gamma^{n_k} V(s_{k+1})                               V as each of them defines it

    without the second term if the episode was terminated (game over). If it was truncated (month completed),
    s_{k+1} is its last observation, because the grid would have gone on; the first observation of the next
    episode never enters.

When it learns
    Budgets, schedules and frequencies count decisions over all environments. After ``learning_starts``
    decisions there is one update per ``train_frequency`` decisions: with 16 environments and a frequency of 4,
    four after every step. An iteration plays ``num_steps`` decisions per environment; metrics are written and
    checkpoints are possible between two iterations.

    With a lag of 1 the updates that a step made due are made while the next one is played, on two cores at once: the
    policy that chose its actions does not know them yet. Which updates those are follows from the decisions alone, so
    that results depend on the lag, and never on who is faster. The run ends with all updates that are due.

Observations
    The memory holds them as the environment gives them. They are scaled by running statistics shared by all
    environments when they are used, so that old ones are scaled like new ones.

Randomness
    Minibatches come from counted streams, all else from the generator of :mod:`rl2grid.algorithms.trainer`. On the
    CPU, results are reproducible bit by bit for a given number of threads.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from torch import Tensor, nn

from rl2grid.algorithms.descent import Adam, descend
from rl2grid.algorithms.hyperparameters import SharedArgs, added_later
from rl2grid.algorithms.networks import VALUE_OF_ACTION, NetworkFactory
from rl2grid.algorithms.pair import Pair
from rl2grid.algorithms.playing import Tally
from rl2grid.algorithms.replay import ReplayMemory, Step, computer_memory
from rl2grid.algorithms.sampling import drawn
from rl2grid.algorithms.trainer import Answer, Trainer
from rl2grid.errors import UsageError

# --- Hyperparameters ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class OffPolicyArgs(SharedArgs):
    """Hyperparameters that the algorithms share."""

    num_steps: int = 64
    """Decisions per environment between two rows of metrics."""
    learning_starts: int = 4_000
    """Decisions before the first update."""
    train_frequency: int = 4
    """Decisions, over all environments, per update."""
    batch_size: int = 256
    """Transitions per update."""
    buffer_size: int = 1_000_000
    """Transitions that are remembered, memory permitting: see ``buffer_bytes``."""
    buffer_bytes: int = 4 * 1024**3
    """Bytes that they may take; fewer are remembered if need be."""
    buffer_memory_share: float = 0.25
    """Share of the computer's memory beyond which they are memory-mapped files in the run folder."""
    gamma: float = 0.9
    """Discount of one grid step (a transition of n grid steps is discounted by gamma ** n)."""
    max_grad_norm: float = 10.0
    """Gradients of a network are scaled down to this norm when longer."""
    last_learning_rate_share: float = 1.0
    """Share of the learning rates that is left at the end of the run, to which they fall linearly with the decisions;
    1: they stay."""
    lag: int = added_later(0)
    """Steps of the environments by which updates come later: 0, or 1, while the environments play the next one."""
    device: str = "cpu"
    """Where networks are: ``cpu``, ``cuda``, or ``auto``: a GPU if there is one. Others than the CPU need not be
    reproducible."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work; see :class:`SharedArgs`."""
        super().__post_init__()
        self._check_counts("train_frequency", "batch_size", "buffer_size")
        self._check_not_negative("learning_starts")
        self._check_shares("buffer_memory_share", "last_learning_rate_share")
        if self.lag not in (0, 1):
            raise UsageError(f"{self.algorithm} needs a lag of 0 or 1, not {self.lag}.")


# --- Networks -------------------------------------------------------------------------------------------------------


class TwinCritics(nn.Module):
    """Two values of a continuous action, learned independently."""

    def __init__(self, networks: NetworkFactory, layers: Sequence[int]) -> None:
        super().__init__()
        self.networks = nn.ModuleList(networks.make(VALUE_OF_ACTION, layers) for _ in range(2))

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Both values of observations [batch, size] and actions [batch, dimensions] -> [2, batch]."""
        inputs = torch.cat([observations, actions], dim=-1)
        return torch.stack([network(inputs).squeeze(-1) for network in self.networks])

    def first(self, observations: Tensor, actions: Tensor) -> Tensor:
        """The first critic's values [batch]."""
        values: Tensor = self.networks[0](torch.cat([observations, actions], dim=-1))
        return values.squeeze(-1)


@contextmanager
def held(network: nn.Module) -> Iterator[None]:
    """What is computed within it takes the network's weights as given: their gradients are not computed either."""
    weights = list(network.parameters())
    for weight in weights:
        weight.requires_grad_(False)
    try:
        yield
    finally:
        for weight in weights:
            weight.requires_grad_()


def follow(target: nn.Module, online: nn.Module, tau: float) -> None:
    """Move the weights of ``target`` by the share ``tau`` of the way to those of ``online``."""
    with torch.no_grad():
        torch._foreach_lerp_(list(target.parameters()), list(online.parameters()), tau)


def random_legal_actions(
    count: int, action_size: int, masks: Tensor | None, generator: torch.Generator, do_nothing: float | None = None
) -> Tensor:
    """Discrete actions drawn uniformly among the legal ones, int64 [count].

    Args:
        count: Number of environments.
        action_size: Number of actions.
        masks: Legal actions, bool [count, action_size]; None: all are.
        generator: Source of the draw.
        do_nothing: Probability of action 0, on top of its share of the rest; None: it is one like the others.
    """
    weights = torch.ones(count, action_size) if masks is None else masks.to(torch.float32)
    actions = drawn(weights, generator)
    if do_nothing is None:
        return actions
    return torch.where(torch.rand(count, generator=generator) < do_nothing, 0, actions)


def adam(network: nn.Module, learning_rate: float) -> Adam:
    """Adam for all weights of a network."""
    return Adam(network.parameters(), lr=learning_rate)


# --- Training -------------------------------------------------------------------------------------------------------


class Batch(NamedTuple):
    """Transitions to learn from, on the device of the networks; every array is [batch, ...]."""

    observations: Tensor
    """float32, normalised with the present statistics"""
    masks: Tensor | None
    """bool, legal discrete actions"""
    actions: Tensor
    """int64, or float32 [batch, dimensions]"""
    rewards: Tensor
    """R_k, scaled"""
    discounts: Tensor
    """gamma ** n_k, 0 after a termination"""
    next_observations: Tensor
    """s_{k+1}; where an episode was truncated, its last observation"""
    next_masks: Tensor | None
    """legal discrete actions there"""


class OffPolicyTrainer(Trainer):
    """One training run; a subclass says how it explores and what it learns from a minibatch."""

    args: OffPolicyArgs
    deterministic_on = ("cpu",)

    def __init__(self, args: OffPolicyArgs, envs: VectorEnv[Any, Any, Any]) -> None:
        """Everything but the networks.

        Raises:
            UsageError: the environments cannot be learned with these hyperparameters.
        """
        super().__init__(args, envs)
        self.memory = ReplayMemory(
            num_envs=args.num_envs,
            observation_size=self.observation_size,
            action_dimensions=self.action_size if self.continuous else None,
            masked_actions=self.action_size if args.mask_actions else None,
            max_transitions=min(args.buffer_size, args.total_timesteps + args.num_envs),
            max_bytes=args.buffer_bytes,
            memory_bytes=int(args.buffer_memory_share * computer_memory()),
            seed=args.seed,
        )
        self.updates = 0
        """Minibatches learned from so far."""
        self._pair = Pair(self.num_threads > 1)

    @abstractmethod
    def explore(self, observations: Tensor, masks: Tensor | None) -> Tensor:
        """Actions to play for normalised observations [num_envs, size]: int64 [num_envs], or float32 in [-1, 1]."""

    @abstractmethod
    def learn(self, batch: Batch) -> dict[str, Tensor]:
        """One update; returns scalars by the name of their metric."""

    @abstractmethod
    def schedule(self) -> dict[str, float]:
        """Metrics of what follows a schedule."""

    @property
    def is_starting(self) -> bool:
        """Whether it is too early to learn."""
        return self.decisions < self.args.learning_starts

    def store_in(self, folder: Path) -> None:
        """Keep the replay memory's files there; ``state_dict`` is small then. Before the first iteration."""
        self.memory.store_in(folder)

    def iterate(self) -> dict[str, float]:
        """Play ``num_steps`` decisions in every environment, learning on the way, and return the metrics."""
        if self.observations is None:
            self.see(self.reset())
        self._set_learning_rates()
        tally, history = Tally(), _History()
        for _ in range(self.args.num_steps):
            self._play(tally, history)
            if not self.args.lag:
                self._improve(history)
        self.iteration += 1
        if self.finished:
            self._improve(history)
        return {
            **tally.metrics(),
            "charts/grid_steps": float(self.grid_steps),
            "charts/updates": float(self.updates),
            "charts/replay_transitions": float(len(self.memory)),
            **self.schedule(),
            **history.means(),
        }

    def minibatch(self) -> Batch:
        """Transitions drawn from the memory."""
        batch = self.memory.draw(self.args.batch_size)
        actions = self.moved(batch.actions)
        return Batch(
            self.normalized(batch.observations),
            None if batch.masks is None else self.moved(batch.masks),
            actions if self.continuous else actions.to(torch.int64),
            self.moved(batch.rewards),
            self.moved(batch.discounts),
            self.normalized(batch.next_observations),
            None if batch.next_masks is None else self.moved(batch.next_masks),
        )

    def state_dict(self) -> dict[str, Any]:
        """All that is needed to go on, after an iteration; of a finished run, the memory is not."""
        return {
            **super().state_dict(),
            "memory": None if self.finished else self.memory.state_dict(),
            "updates": self.updates,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where ``state_dict`` was called, bit for bit.

        Raises:
            UsageError: the environments, played again, are not where they were, or the memory's files are gone.
        """
        if state["memory"] is not None:
            self.memory.load_state_dict(state["memory"])
        self.updates = state["updates"]
        super().load_state_dict(state)

    def _set_learning_rates(self) -> None:
        """Let the step sizes follow their schedule."""
        last = self.args.last_learning_rate_share
        if last == 1.0:
            return
        share = 1.0 - (1.0 - last) * self.decisions / self.args.total_timesteps
        for optimizer in self.learned().values():
            if isinstance(optimizer, torch.optim.Optimizer):
                for group in optimizer.param_groups:
                    group["lr"] = share * group.setdefault("initial_lr", group["lr"])

    def _play(self, tally: Tally, history: _History) -> None:
        """One decision in every environment, remembered; with a lag, what was due before is learned meanwhile."""
        args, observations = self.args, self.observations
        assert observations is not None
        masks = self.masks()
        with torch.no_grad():
            shown = self.normalized(observations)
            actions = self.explore(shown, None if masks is None else torch.as_tensor(masks)).cpu()
        answer = self._answers(actions.numpy(), history) if args.lag else self.answers(actions.numpy())
        played = self.counted(answer, tally)
        ended_well = np.flatnonzero(played.completed).tolist()
        self.memory.add(
            Step(
                observations,
                masks,
                actions.numpy(),
                rewards=played.rewards * self.reward_scale,
                discounts=np.where(played.terminated, 0.0, args.gamma**played.n_steps),
                ended=played.ended,
                decided=played.decided,
                last_observations=dict(zip(ended_well, played.last_observations(), strict=True)),
            )
        )
        self.see(played.observations)

    def _answers(self, actions: NDArray[Any], history: _History) -> Answer:
        """What the environments answer; the updates that are due are made meanwhile."""
        _, answer = self._pair.run(partial(self._improve, history), partial(self.answers, actions))
        return answer

    def _improve(self, history: _History) -> None:
        """Learn as often as is due."""
        due = (self.decisions - self.args.learning_starts) // self.args.train_frequency
        while self.updates < due and len(self.memory):
            self.updates += 1
            history.note(self.learn(self.minibatch()))

    def _descend(self, optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
        """One step down the gradient of a loss."""
        descend(optimizer, loss, self.args.max_grad_norm)


class _History:
    """Metrics of the updates of an iteration."""

    def __init__(self) -> None:
        self._values: dict[str, list[Tensor]] = {}

    def note(self, values: Mapping[str, Tensor]) -> None:
        """Metrics of one update."""
        for name, value in values.items():
            self._values.setdefault(name, []).append(value.detach())

    def means(self) -> dict[str, float]:
        """Means over the updates that had the metric; nothing if there were none."""
        return {name: float(torch.stack(values).to(torch.float64).mean()) for name, values in self._values.items()}
