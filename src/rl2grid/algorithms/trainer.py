"""What all trainers have in common: budget and checkpoints (:class:`Learner`), and of those that play, a step of every
environment and the account of it (:class:`Trainer`).

Transitions of varying length
    Between two decisions the grid makes n_k >= 1 steps (a heuristic plays the others): a semi-Markov decision
    process. What a reset plays before the first decision is in no transition. With the discount gamma of one grid
    step, transition k is worth

        R_k = sum over j < n_k of gamma^j r_{k,j}                  info["discounted_reward"]

    and what follows it is discounted by gamma^{n_k}.

Randomness
    Initial weights and actions come from one generator seeded by ``Args.seed`` and saved with the
    checkpoint; nothing reads a global random state. The generator is the processor's also when networks are on
    a GPU. Environment i is seeded ``seed * num_envs + i``: runs of different seeds share no episode.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from torch import Tensor, nn

from rl2grid.algorithms.devices import find_device
from rl2grid.algorithms.hyperparameters import SharedArgs
from rl2grid.algorithms.networks import NetworkFactory, find_network
from rl2grid.algorithms.playing import (
    Tally,
    check_discount,
    check_environments,
    of_transition,
    reported,
    resume_environments,
)
from rl2grid.algorithms.starting import StartingPolicy, read_starting_policy
from rl2grid.envs.normalization import CLIP, ObservationNormalizer
from rl2grid.envs.spec import Spec, spec_of
from rl2grid.errors import UsageError


class Played(NamedTuple):
    """What a decision in every environment led to; every array is [num_envs, ...]."""

    observations: NDArray[np.float32]
    """shown now; where an episode ended, the next one's first"""
    rewards: NDArray[np.float64]
    """R_k, not scaled"""
    n_steps: NDArray[np.int64]
    """n_k"""
    ended: NDArray[np.bool_]
    """the episode ended with this transition"""
    terminated: NDArray[np.bool_]
    """... by a game over"""
    completed: NDArray[np.bool_]
    """... otherwise; its last observation is in ``infos["final_obs"]``"""
    decided: NDArray[np.bool_]
    """the action had an effect; False where the episode had ended before the agent's first decision"""
    infos: Mapping[str, Any]

    def last_observations(self) -> list[NDArray[np.float32]]:
        """The last observations of completed episodes, in the order of their environments."""
        return [self.infos["final_obs"][i] for i in np.flatnonzero(self.completed)]


class Answer(NamedTuple):
    """What ``VectorEnv.step`` returned."""

    observations: NDArray[np.float32]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    infos: Mapping[str, Any]
    seconds: float
    """that it took"""


class Learner(ABC):
    """What learns: ``iterate`` until ``finished``; ``state_dict`` between two iterations holds all of it."""

    deterministic_on: ClassVar[tuple[str, ...]] = ("cpu", "cuda")
    """Types of device on which only PyTorch's deterministic algorithms are used."""

    def __init__(self, args: SharedArgs, spec: Spec, options: Any = None) -> None:
        """Everything but the networks.

        Args:
            args: Hyperparameters.
            spec: What is observed and what can be done.
            options: Keywords of the environments, :class:`~rl2grid.envs.options.TaskOptions`; None: not known.

        Raises:
            UsageError: the network cannot read what these hyperparameters give it.
        """
        torch.set_num_threads(args.torch_threads)
        self.args = args
        self.device = find_device(args.device)
        # The same as use_deterministic_algorithms, which loads PyTorch's compilers too: 1.3 s, 6 s without byte code.
        torch.set_deterministic_debug_mode("error" if self.device.type in self.deterministic_on else "default")
        self.generator = torch.Generator().manual_seed(args.seed)
        self.spec = spec
        self.continuous = spec.continuous
        self.observation_size, self.action_size = spec.observation_size, spec.action_size
        if args.normalize_observations and not find_network(args.network).reads_normalized:
            raise UsageError(
                f"Network {args.network!r} reads observations as the environment gives them: set "
                "normalize_observations to False."
            )
        self.networks = NetworkFactory(self.spec, args.network, self.generator, args.shortlist)
        self.shortlisted = self._on_shortlist()
        """Actions that may be chosen at all, bool [action]; None: all."""
        self.normalizer = ObservationNormalizer(self.observation_size) if args.normalize_observations else None
        self._scale_of = -1
        self.reward_scale = 1.0 - args.gamma if args.reward_scale is None else args.reward_scale
        self.options: Any = options
        self.start: StartingPolicy | None = None
        """The policy of another run that this one began with."""

        self.num_iterations = args.total_timesteps // (args.num_envs * args.num_steps)
        self.iteration = 0
        self.decisions = 0
        """Decisions learned from so far, over all environments."""
        self.grid_steps = 0
        """Grid steps behind them, as far as they were played here."""

    def _on_shortlist(self) -> NDArray[np.bool_] | None:
        """Which actions are on the shortlist, bool [action]; None: there is none.

        Raises:
            UsageError: illegal actions are not excluded, so that others could not be either.
        """
        chosen = self.networks.shortlisted()
        if chosen is None:
            return None
        if not self.args.mask_actions:
            raise UsageError("A shortlist excludes all other actions: set mask_actions to True, or leave it out.")
        on_it = np.zeros(self.action_size, np.bool_)
        on_it[chosen] = True
        return on_it

    @property
    def finished(self) -> bool:
        """Whether the budget of decisions is used up."""
        return self.iteration >= self.num_iterations

    def store_in(self, folder: Path) -> None:
        """Where files may be kept that ``state_dict`` only refers to, before the first iteration; most need none."""
        return

    def identity(self) -> dict[str, Any]:
        """What results must name beside versions and hashes of the task: what it learns from and began with."""
        return {} if self.start is None else {"start": self.start.identity()}

    def begin_as_asked(self) -> None:
        """Begin with the policy of ``Args.start_from``, if there is one and nothing was begun yet.

        Raises:
            UsageError: there is no policy there, or none that this learner can begin with.
        """
        if self.args.start_from is not None and self.start is None:
            self.begin_with(read_starting_policy(self.args.with_seed(self.args.start_from)))

    def begin_with(self, start: StartingPolicy) -> None:
        """Take over the weights of a policy, and for good the statistics by which it reads observations.

        Raises:
            UsageError: this learner cannot begin with it.
        """
        start.check(self.args, self.spec, self.options)
        start = start.moved_to(self.spec)
        self.take_over(start)
        self.start = start
        if self.normalizer is not None:
            self.normalizer.load_state_dict(start.policy["normalizer"])
            self.normalizer.freeze()
            self._scale_of = -1

    def take_over(self, start: StartingPolicy) -> None:
        """Take over the weights of a policy; most algorithms do not.

        Raises:
            UsageError: they are of another kind.
        """
        raise UsageError(
            f"{self.args.algorithm} cannot begin with the policy of another run: leave start_from out (--from); ppo, "
            "lagrangian-ppo, sac and dqn can."
        )

    @abstractmethod
    def iterate(self) -> dict[str, float]:
        """Learn from ``num_steps`` decisions per environment, and return the metrics."""

    @abstractmethod
    def learned(self) -> Mapping[str, nn.Module | torch.optim.Optimizer]:
        """Networks and optimisers by name: all that updates change."""

    @abstractmethod
    def policy(self) -> tuple[nn.Module, dict[str, Any]]:
        """The network that acts, and what is needed to make it again."""

    def normalizer_state(self) -> dict[str, Any] | None:
        """The statistics that scale observations; None without normalisation."""
        return None if self.normalizer is None else self.normalizer.state_dict()

    def policy_state(self) -> dict[str, Any]:
        """All that is needed to act: see ``load_policy``; ``normalizer`` is None without normalisation."""
        network, sizes = self.policy()
        return {
            "network": network.state_dict(),
            "normalizer": self.normalizer_state(),
            "factory": self.networks.state_dict(),
            "mask_actions": self.args.mask_actions,
            **sizes,
        }

    def state_dict(self) -> dict[str, Any]:
        """All that is needed to go on, after an iteration."""
        return {
            **{name: part.state_dict() for name, part in self.learned().items()},
            "normalizer": self.normalizer_state(),
            "generator": self.generator.get_state(),
            "iteration": self.iteration,
            "decisions": self.decisions,
            "grid_steps": self.grid_steps,
            **({} if self.start is None else {"start": self.start.state_dict()}),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where ``state_dict`` was called, bit for bit.

        Raises:
            UsageError: what it learns from is not where it was, or an earlier version kept other things.
        """
        if "start" in state:
            self.begin_with(StartingPolicy(**state["start"]))
        learned = self.learned()
        missing = [name for name in learned if name not in state]
        if missing:
            raise UsageError(
                f"The checkpoint holds no {missing[0]}: an earlier version of {self.args.algorithm} wrote it, and can "
                "resume the run. Here its policy can be evaluated, and a new run can go on from it."
            )
        for name, part in learned.items():
            part.load_state_dict(state[name])
        if self.normalizer is not None:
            self.normalizer.load_state_dict(state["normalizer"])
            self._scale_of = -1
        self.generator.set_state(state["generator"])
        self.iteration, self.decisions = state["iteration"], state["decisions"]
        self.grid_steps = state["grid_steps"]

    def tensor(self, values: Any, dtype: torch.dtype | None = None) -> Tensor:
        """A copy of an array on the networks' device."""
        return torch.tensor(values, dtype=dtype, device=self.device)

    def moved(self, values: NDArray[Any]) -> Tensor:
        """An array on the networks' device, the same memory if that is the processor's."""
        return torch.from_numpy(np.ascontiguousarray(values)).to(self.device)

    def normalized(self, observations: NDArray[np.float32]) -> Tensor:
        """Observations [..., size] as networks read them, by the statistics of this moment.

        In float32, and therefore rounded otherwise than by :meth:`ObservationNormalizer.normalize`; a tensor of its own
        unless observations are not scaled.
        """
        given = self.moved(observations)
        if self.normalizer is None:
            return given
        if self._scale_of != self.normalizer.count:
            self._scale_of = self.normalizer.count
            self._mean = self.tensor(self.normalizer.mean, torch.float32)
            self._factor = self.tensor(1.0 / self.normalizer.deviation, torch.float32)
        return ((given - self._mean) * self._factor).clamp_(-CLIP, CLIP)


class Trainer(Learner):
    """What learns from what it plays."""

    def __init__(self, args: SharedArgs, envs: VectorEnv[Any, Any, Any]) -> None:
        """Everything but the networks; the environments are reset at the first iteration.

        Raises:
            UsageError: the environments cannot be learned with these hyperparameters.
        """
        check_environments(args.algorithm, envs, num_envs=args.num_envs, mask_actions=args.mask_actions)
        check_discount(args.algorithm, envs, args.gamma)
        super().__init__(args, spec_of(envs), getattr(envs.unwrapped, "options", None))
        self.envs = envs
        self.num_threads: int = getattr(envs.unwrapped, "num_threads", 1)
        """Of the environments; where there are several, learning may use a second one."""
        self.observations: NDArray[np.float32] | None = None
        """What the environments show, as they give it."""
        self._over = np.zeros(args.num_envs, np.bool_)
        self._episode_return = np.zeros(args.num_envs, np.float64)
        self._episode_length = np.zeros(args.num_envs, np.int64)

    @abstractmethod
    def iterate(self) -> dict[str, float]:
        """Play ``num_steps`` decisions in every environment, learn, and return the metrics."""

    def state_dict(self) -> dict[str, Any]:
        """All that is needed to go on, after an iteration."""
        return {
            **super().state_dict(),
            "observations": np.array(self.observations),
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
        super().load_state_dict(state)
        self.observations = np.array(state["observations"])
        self._over = np.array(state["over"])
        self._episode_return = np.array(state["episode_return"])
        self._episode_length = np.array(state["episode_length"])
        resume_environments(self.envs, state["envs"], self.observations)

    def reset(self) -> NDArray[np.float32]:
        """Begin the first episodes, with the policy that was asked for; what they show."""
        self.begin_as_asked()
        observations: NDArray[np.float32]
        observations, infos = self.envs.reset(seed=self.args.seed * self.args.num_envs)
        everywhere = np.ones(self.args.num_envs, np.bool_)
        self._over = reported(infos, "over", ~everywhere)
        self.begin_episodes(infos, everywhere)
        return observations

    def masks(self) -> NDArray[np.bool_] | None:
        """The actions that may be chosen now, bool [num_envs, action]; None: all.

        They are legal, and on the shortlist where there is one.
        """
        if not self.args.mask_actions:
            return None
        masks: NDArray[np.bool_] = self.envs.action_masks()  # type: ignore[attr-defined]
        return masks if self.shortlisted is None else masks & self.shortlisted

    def step(self, actions: NDArray[Any], tally: Tally) -> Played:
        """Play a decision in every environment and count it.

        Raises:
            UsageError: the environments play several grid steps per decision and do not tell what they are worth.
        """
        return self.counted(self.answers(actions), tally)

    def answers(self, actions: NDArray[Any]) -> Answer:
        """What the environments answer to a decision in each, and how long that took; nothing else is touched."""
        begin = time.perf_counter()
        return Answer(*self.envs.step(actions), seconds=time.perf_counter() - begin)

    def counted(self, answer: Answer, tally: Tally) -> Played:
        """Count what the environments answered.

        Raises:
            UsageError: the environments play several grid steps per decision and do not tell what they are worth.
        """
        observations, rewards, terminated, truncated, infos, seconds = answer
        decided = ~self._over
        ended = terminated | truncated
        self._over = reported(infos, "over", np.zeros_like(ended)) & ended
        n_steps = of_transition(infos, "n_steps", ended, np.ones(self.args.num_envs, np.int64))
        discounted = of_transition(infos, "discounted_reward", ended, np.where(n_steps == 1, rewards, np.nan))
        if np.isnan(discounted).any():
            raise UsageError(
                "The environment plays several grid steps per decision without info['discounted_reward']: "
                f"make it with gamma={self.args.gamma}."
            )
        self.decisions += self.args.num_envs
        self.grid_steps += int(n_steps.sum())
        self._episode_return += rewards
        self._episode_length += 1
        tally.note(n_steps, seconds, infos, ended, self._episode_return, self._episode_length)
        self.begin_episodes(infos, ended)
        return Played(observations, discounted, n_steps, ended, terminated, truncated & ~terminated, decided, infos)

    def begin_episodes(self, infos: Mapping[str, Any], begun: NDArray[np.bool_]) -> None:
        """Count what resets have played in the environments ``begun``, bool [num_envs]."""
        nothing = np.zeros(self.args.num_envs, np.float64)
        self.grid_steps += int(reported(infos, "reset_steps", nothing)[begun].sum())
        self._episode_return[begun] = reported(infos, "reset_reward", nothing)[begun]
        self._episode_length[begun] = 0

    def see(self, observations: NDArray[np.float32]) -> None:
        """Take over what the environments show: each observation enters the statistics once."""
        # A copy, because environments may reuse their buffers.
        self.observations = np.array(observations, np.float32)
        if self.normalizer is not None:
            self.normalizer.update(self.observations)
