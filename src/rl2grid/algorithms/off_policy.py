"""What DQN, SAC and TD3 have in common: playing, remembering, and when to learn. What they learn is in their own files.

Transitions of varying length
    Between two decisions the grid makes n_k >= 1 steps (heuristics, or a reset, play the others): a
    semi-Markov decision process. With the discount gamma of one grid step, transition k is worth

        R_k = sum over j < n_k of gamma^j r_{k,j}                  info["discounted_reward"]

    and all three algorithms fit their action values to

        R_k + gamma^{n_k} V(s_{k+1})                               V as each of them defines it

    without the second term if the episode was terminated (game over). If it was truncated (month completed),
    s_{k+1} is its last observation, because the grid would have gone on; the first observation of the next
    episode never enters.

When it learns
    Budgets, schedules and frequencies count decisions over all environments. After ``learning_starts``
    decisions there is one update per ``train_frequency`` decisions: with 16 environments and a frequency of 4,
    four after every step. An iteration plays ``num_steps`` decisions per environment; metrics are written and
    checkpoints are possible between two iterations.

Observations
    The memory holds them as the environment gives them. They are scaled by running statistics shared by all
    environments when they are used, so that old ones are scaled like new ones.

Randomness
    Initial weights and actions come from one generator seeded by ``Args.seed`` and saved with the
    checkpoint, minibatches from counted streams; nothing reads a global random state. The generator is the
    processor's also when networks are on a GPU. On the CPU, results are reproducible bit by bit for a given
    number of threads. Environment i is seeded ``seed * num_envs + i``: runs of different seeds share no episode.
"""

from __future__ import annotations

import itertools
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from torch import Tensor, nn

from rl2grid.algorithms.devices import DEVICES, find_device
from rl2grid.algorithms.playing import Tally, check_environments, of_transition, reported, resume_environments
from rl2grid.algorithms.replay import ReplayMemory, Step, computer_memory
from rl2grid.envs.normalization import ObservationNormalizer
from rl2grid.errors import UsageError, one_of

# --- Hyperparameters ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class OffPolicyArgs:
    """Hyperparameters that the algorithms share."""

    algorithm: ClassVar[str]
    """What messages call the algorithm."""

    seed: int = 1
    """Of the initial weights, the exploration, the minibatches and the episodes."""
    total_timesteps: int = 200_000
    """Decisions to train for, over all environments; never exceeded."""
    num_envs: int = 16
    """Environments played side by side."""
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
    reward_scale: float | None = None
    """Factor on rewards; None: 1 - gamma, which turns returns into mean rewards, of order one for any gamma."""
    max_grad_norm: float = 10.0
    """Gradients of a network are scaled down to this norm when longer."""
    mask_actions: bool = True
    """Discrete actions only: whether illegal actions are excluded (the environment has ``action_masks()``)."""
    normalize_observations: bool = True
    """Whether observations are scaled by running statistics shared by all environments."""
    device: str = "cpu"
    """Where networks are: ``cpu``, ``cuda``, or ``auto``: a GPU if there is one. Others than the CPU need not be
    reproducible."""
    torch_threads: int = 1
    """Threads of PyTorch; results are reproducible bit by bit for a given number only."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work.

        Raises:
            UsageError: naming the first such value.
        """
        self._check_counts("num_envs", "num_steps", "train_frequency", "batch_size", "buffer_size", "torch_threads")
        self._check_positive("max_grad_norm")
        self._check_not_negative("learning_starts")
        self._check_shares("gamma", "buffer_memory_share")
        if self.device not in DEVICES:
            raise one_of("Device", self.device, DEVICES)
        if self.seed < 0:
            raise UsageError(f"{self.algorithm} needs a seed of at least 0, not {self.seed}.")
        if self.gamma == 1.0 and self.reward_scale is None:
            raise UsageError(f"{self.algorithm} with gamma 1 needs a reward_scale, because 1 - gamma would be zero.")
        if self.total_timesteps < self.num_envs * self.num_steps:
            raise UsageError(
                f"{self.algorithm} needs total_timesteps of at least num_envs * num_steps = "
                f"{self.num_envs * self.num_steps}, not {self.total_timesteps}."
            )

    def _check_counts(self, *names: str) -> None:
        for name in names:
            if getattr(self, name) < 1:
                raise UsageError(f"{self.algorithm} needs {name} of at least 1, not {getattr(self, name)}.")

    def _check_layers(self, *names: str) -> None:
        for name in names:
            if any(width < 1 for width in getattr(self, name)):
                raise UsageError(f"{self.algorithm} needs {name} of widths of at least 1, not {getattr(self, name)}.")

    def _check_positive(self, *names: str) -> None:
        for name in names:
            if not 0.0 < getattr(self, name) < math.inf:
                raise UsageError(f"{self.algorithm} needs a positive {name}, not {getattr(self, name)}.")

    def _check_not_negative(self, *names: str) -> None:
        for name in names:
            if not 0.0 <= getattr(self, name) < math.inf:
                raise UsageError(f"{self.algorithm} needs {name} of at least 0, not {getattr(self, name)}.")

    def _check_shares(self, *names: str) -> None:
        for name in names:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise UsageError(f"{self.algorithm} needs {name} between 0 and 1, not {getattr(self, name)}.")


# --- Networks -------------------------------------------------------------------------------------------------------

ILLEGAL = -1e8
"""Value or logit of an illegal action: never the largest, probability exactly zero in float32, and finite."""


def make_network(inputs: int, layers: Sequence[int], outputs: int, generator: torch.Generator | None) -> nn.Sequential:
    """A ReLU network; weights and biases are uniform within 1 / sqrt(inputs of the layer), PyTorch's own default."""
    widths = (inputs, *layers, outputs)
    modules: list[nn.Module] = []
    for k, (width, next_width) in enumerate(itertools.pairwise(widths)):
        # Linear's own initialisation would draw from the global random state.
        linear = nn.utils.skip_init(nn.Linear, width, next_width)  # type: ignore[no-untyped-call]
        for parameter in (linear.weight, linear.bias):
            nn.init.uniform_(parameter, -1.0 / math.sqrt(width), 1.0 / math.sqrt(width), generator=generator)
        modules += [linear] if k == len(widths) - 2 else [linear, nn.ReLU()]
    return nn.Sequential(*modules)


class TwinCritics(nn.Module):
    """Two values of a continuous action, learned independently."""

    def __init__(
        self, observation_size: int, action_size: int, layers: Sequence[int], generator: torch.Generator | None = None
    ) -> None:
        super().__init__()
        inputs = observation_size + action_size
        self.networks = nn.ModuleList(make_network(inputs, layers, 1, generator) for _ in range(2))

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Both values of observations [batch, size] and actions [batch, dimensions] -> [2, batch]."""
        inputs = torch.cat([observations, actions], dim=-1)
        return torch.stack([network(inputs).squeeze(-1) for network in self.networks])

    def first(self, observations: Tensor, actions: Tensor) -> Tensor:
        """The first critic's values [batch]."""
        values: Tensor = self.networks[0](torch.cat([observations, actions], dim=-1))
        return values.squeeze(-1)


def follow(target: nn.Module, online: nn.Module, tau: float) -> None:
    """Move the weights of ``target`` by the share ``tau`` of the way to those of ``online``."""
    with torch.no_grad():
        for mine, theirs in zip(target.parameters(), online.parameters(), strict=True):
            mine.lerp_(theirs, tau)


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
    actions = torch.multinomial(weights, 1, generator=generator).squeeze(-1)
    if do_nothing is None:
        return actions
    return torch.where(torch.rand(count, generator=generator) < do_nothing, 0, actions)


def adam(network: nn.Module, learning_rate: float) -> torch.optim.Adam:
    """Adam for all weights of a network; fused, because networks are small and calls cost more than arithmetic."""
    return torch.optim.Adam(network.parameters(), lr=learning_rate, fused=True)


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


class OffPolicyTrainer(ABC):
    """One training run: ``iterate`` until ``finished``; ``state_dict`` between two iterations holds all of it."""

    args: OffPolicyArgs

    def __init__(self, args: OffPolicyArgs, envs: VectorEnv[Any, Any, Any]) -> None:
        """Everything but the networks; the environments are reset at the first iteration.

        Raises:
            UsageError: the environments cannot be learned with these hyperparameters.
        """
        torch.set_num_threads(args.torch_threads)
        self.args = args
        self.device = find_device(args.device)
        torch.use_deterministic_algorithms(self.device.type == "cpu")
        self.continuous = check_environments(
            args.algorithm, envs, num_envs=args.num_envs, mask_actions=args.mask_actions
        )
        self.envs = envs
        self.generator = torch.Generator().manual_seed(args.seed)
        observation_shape, action_space = envs.single_observation_space.shape, envs.single_action_space
        assert observation_shape is not None
        self.observation_size = int(observation_shape[0])
        self.action_size = int(action_space.shape[0] if isinstance(action_space, Box) else action_space.n)  # type: ignore[attr-defined]
        self.normalizer = ObservationNormalizer(self.observation_size) if args.normalize_observations else None
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
        self.reward_scale = 1.0 - args.gamma if args.reward_scale is None else args.reward_scale

        self.num_iterations = args.total_timesteps // (args.num_envs * args.num_steps)
        self.iteration = 0
        self.decisions = 0
        """Decisions made so far, over all environments."""
        self.grid_steps = 0
        """Grid steps behind them."""
        self.updates = 0
        """Minibatches learned from so far."""
        self._observations: NDArray[np.float32] | None = None
        self._over = np.zeros(args.num_envs, np.bool_)
        self._episode_return = np.zeros(args.num_envs, np.float64)
        self._episode_length = np.zeros(args.num_envs, np.int64)

    @abstractmethod
    def explore(self, observations: Tensor, masks: Tensor | None) -> Tensor:
        """Actions to play for normalised observations [num_envs, size]: int64 [num_envs], or float32 in [-1, 1]."""

    @abstractmethod
    def learn(self, batch: Batch) -> dict[str, Tensor]:
        """One update; returns scalars by the name of their metric."""

    @abstractmethod
    def schedule(self) -> dict[str, float]:
        """Metrics of what follows a schedule."""

    @abstractmethod
    def learned(self) -> Mapping[str, nn.Module | torch.optim.Optimizer]:
        """Networks and optimisers by name: all that updates change."""

    @abstractmethod
    def policy(self) -> tuple[nn.Module, dict[str, Any]]:
        """The network that acts, and what is needed to make it again."""

    @property
    def finished(self) -> bool:
        """Whether the budget of decisions is used up."""
        return self.iteration >= self.num_iterations

    @property
    def is_starting(self) -> bool:
        """Whether it is too early to learn."""
        return self.decisions < self.args.learning_starts

    def store_in(self, folder: Path) -> None:
        """Keep the replay memory's files there; ``state_dict`` is small then. Before the first iteration."""
        self.memory.store_in(folder)

    def iterate(self) -> dict[str, float]:
        """Play ``num_steps`` decisions in every environment, learning on the way, and return the metrics."""
        if self._observations is None:
            observations, infos = self.envs.reset(seed=self.args.seed * self.args.num_envs)
            self._over = reported(infos, "over", np.zeros(self.args.num_envs, np.bool_))
            self._see(observations)
        tally, history = Tally(), _History()
        for _ in range(self.args.num_steps):
            self._play(tally)
            self._improve(history)
        self.iteration += 1
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
        drawn = self.memory.draw(self.args.batch_size)
        actions = torch.as_tensor(drawn.actions)
        return Batch(
            self._tensor(self._normalized(drawn.observations)),
            None if drawn.masks is None else self._tensor(drawn.masks),
            (actions if self.continuous else actions.to(torch.int64)).to(self.device),
            self._tensor(drawn.rewards),
            self._tensor(drawn.discounts),
            self._tensor(self._normalized(drawn.next_observations)),
            None if drawn.next_masks is None else self._tensor(drawn.next_masks),
        )

    def policy_state(self) -> dict[str, Any]:
        """All that is needed to act; ``normalizer`` is None without normalisation."""
        network, sizes = self.policy()
        return {
            "network": network.state_dict(),
            "normalizer": None if self.normalizer is None else self.normalizer.state_dict(),
            "observation_size": self.observation_size,
            "action_size": self.action_size,
            "continuous": self.continuous,
            "mask_actions": self.args.mask_actions,
            **sizes,
        }

    def state_dict(self) -> dict[str, Any]:
        """All that is needed to go on, after an iteration; of a finished run, the memory is not."""
        return {
            **{name: part.state_dict() for name, part in self.learned().items()},
            "generator": self.generator.get_state(),
            "normalizer": None if self.normalizer is None else self.normalizer.state_dict(),
            "memory": None if self.finished else self.memory.state_dict(),
            "iteration": self.iteration,
            "decisions": self.decisions,
            "grid_steps": self.grid_steps,
            "updates": self.updates,
            "observations": np.array(self._observations),
            "over": self._over,
            "episode_return": self._episode_return,
            "episode_length": self._episode_length,
            "envs": self.envs.state_dict(),  # type: ignore[attr-defined]
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where ``state_dict`` was called, bit for bit.

        Raises:
            UsageError: the environments, played again, are not where they were, or the memory's files are gone.
        """
        for name, part in self.learned().items():
            part.load_state_dict(state[name])
        self.generator.set_state(state["generator"])
        if self.normalizer is not None:
            self.normalizer.load_state_dict(state["normalizer"])
        if state["memory"] is not None:
            self.memory.load_state_dict(state["memory"])
        self.iteration, self.decisions = state["iteration"], state["decisions"]
        self.grid_steps, self.updates = state["grid_steps"], state["updates"]
        self._observations = np.array(state["observations"])
        self._over = np.array(state["over"])
        self._episode_return = np.array(state["episode_return"])
        self._episode_length = np.array(state["episode_length"])
        resume_environments(self.envs, state["envs"], self._observations)

    def _see(self, observations: NDArray[np.float32]) -> None:
        """Take over what the environments show: each observation enters the statistics once."""
        # A copy, because environments may reuse their buffers.
        self._observations = np.array(observations, np.float32)
        if self.normalizer is not None:
            self.normalizer.update(self._observations)

    def _play(self, tally: Tally) -> None:
        """One decision in every environment, remembered."""
        args, observations = self.args, self._observations
        assert observations is not None
        masks = self.envs.action_masks() if args.mask_actions else None  # type: ignore[attr-defined]
        with torch.no_grad():
            actions = self.explore(
                self._tensor(self._normalized(observations)), None if masks is None else torch.as_tensor(masks)
            ).cpu()
        decided = ~self._over

        begin = time.perf_counter()
        shown, rewards, terminated, truncated, infos = self.envs.step(actions.numpy())
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
        self.memory.add(
            Step(
                observations,
                masks,
                actions.numpy(),
                rewards=discounted * self.reward_scale,
                discounts=np.where(terminated, 0.0, args.gamma**n_steps),
                ended=ended,
                decided=decided,
                last_observations={i: infos["final_obs"][i] for i in np.flatnonzero(truncated & ~terminated).tolist()},
            )
        )
        self._see(shown)
        self.decisions += args.num_envs
        self.grid_steps += int(n_steps.sum())
        self._episode_return += rewards
        self._episode_length += 1
        tally.note(n_steps, seconds, infos, ended, self._episode_return, self._episode_length)
        self._episode_return[ended] = 0.0
        self._episode_length[ended] = 0

    def _improve(self, history: _History) -> None:
        """Learn as often as is due."""
        due = (self.decisions - self.args.learning_starts) // self.args.train_frequency
        while self.updates < due and len(self.memory):
            self.updates += 1
            history.note(self.learn(self.minibatch()))

    def _normalized(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        return observations if self.normalizer is None else self.normalizer.normalize(observations)

    def _tensor(self, values: NDArray[Any]) -> Tensor:
        return torch.tensor(values).to(self.device)

    def _descend(self, optimizer: torch.optim.Optimizer, loss: Tensor, network: nn.Module) -> None:
        """One step down the gradient of a network's loss."""
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(network.parameters(), self.args.max_grad_norm)
        optimizer.step()


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
