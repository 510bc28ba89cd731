"""Hyperparameters that all algorithms have, and the checks that refuse values which cannot work."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, ClassVar, TypeVar

from rl2grid.errors import UsageError, one_of

DEVICES = ("auto", "cpu", "cuda")

_ADDED_LATER = "added_later"
_PATHS = {"labels", "start_from"}


def added_later(default: Any) -> Any:
    """A field of hyperparameters that results were recorded without; they were all reached with its default.

    While it has that value it is left out of what identifies a training, see :func:`identifying`.
    """
    return field(default=default, metadata={_ADDED_LATER: True})


def identifying(args: Any) -> dict[str, Any]:
    """The hyperparameters by which a training is told from others: all but later ones that have their default.

    Paths are left out, too: what lies there is what counts, and is told apart.
    """
    later = [each for each in fields(args) if each.metadata.get(_ADDED_LATER)]
    left_out = {each.name for each in later if getattr(args, each.name) == each.default} | _PATHS
    return {name: value for name, value in asdict(args).items() if name not in left_out}


@dataclass(frozen=True)
class SharedArgs:
    """What every algorithm of the package can be told; its own are in the ``Args`` of its file."""

    algorithm: ClassVar[str]
    """What messages call the algorithm."""

    seed: int = 1
    """Of the initial weights, the exploration, the minibatches and the episodes."""
    total_timesteps: int = 200_000
    """Decisions to train for, over all environments; never exceeded."""
    num_envs: int = 16
    """Environments played side by side."""
    num_steps: int = 64
    """Decisions per environment and iteration."""
    gamma: float = 0.99
    """Discount of one grid step (a transition of n grid steps is discounted by gamma ** n)."""
    reward_scale: float | None = None
    """Factor on rewards; None: 1 - gamma, which turns returns into mean rewards, of order one for any gamma."""
    max_grad_norm: float = 0.5
    """Gradients of a network are scaled down to this norm when longer."""
    mask_actions: bool = True
    """Discrete actions only: whether illegal actions are excluded (the environment has ``action_masks()``)."""
    normalize_observations: bool = True
    """Whether observations are scaled by running statistics shared by all environments."""
    network: str = added_later("mlp")
    """Name of the kind of networks: ``mlp``, layers one after the other, ``action-embedding``, ``gnn``, for continuous
    actions ``set-point``, or one of your own."""
    shortlist: int | None = added_later(None)
    """Discrete actions only: among how many it chooses, do nothing and the best-ranked ones; None: all."""
    joint_actions: str | None = added_later(None)
    """Joint tasks only: ``discrete`` (a topology action, or one control moved fully) or ``box`` (both parts at once);
    None: discrete where the algorithm knows such."""
    start_from: str | None = added_later(None)
    """A run folder or checkpoint whose policy the run begins with, on the command line ``--from``; ``{seed}`` in it is
    the run's seed. None: a new policy."""
    torch_threads: int = 1
    """Threads of PyTorch; results are reproducible bit by bit for a given number only."""
    device: str = "cpu"
    """Where the networks are: ``cpu``, ``cuda``, or ``auto`` (``cuda`` if there is one)."""

    def with_seed(self, path: str) -> str:
        """A path in which ``{seed}`` stands for the seed of the run."""
        return path.replace("{seed}", str(self.seed))

    def __post_init__(self) -> None:
        """Refuse values that cannot work.

        Raises:
            UsageError: naming the first such value.
        """
        self._check_counts("num_envs", "num_steps", "torch_threads")
        self._check_shares("gamma")
        self._check_positive("max_grad_norm")
        if self.reward_scale is not None:
            self._check_positive("reward_scale")
        if self.device not in DEVICES:
            raise one_of("Device", self.device, DEVICES)
        if self.seed < 0:
            raise UsageError(f"{self.algorithm} needs a seed of at least 0, not {self.seed}.")
        if self.gamma == 1.0 and self.reward_scale is None:
            raise UsageError(f"{self.algorithm} with gamma 1 needs a reward_scale, because 1 - gamma would be zero.")
        if self.total_timesteps < self.num_envs * self.num_steps:
            raise UsageError(
                f"{self.algorithm} needs total_timesteps (--decisions) of at least num_envs * num_steps = "
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
        self._check_between(0, 1, *names)

    def _check_between(self, low: int, high: int, *names: str) -> None:
        for name in names:
            if not low <= getattr(self, name) <= high:
                raise UsageError(f"{self.algorithm} needs {name} between {low} and {high}, not {getattr(self, name)}.")

    def _check_probability(self, name: str) -> None:
        """None, or a probability that is neither 0 nor 1."""
        value = getattr(self, name)
        if value is not None and not 0.0 < value < 1.0:
            raise UsageError(f"{self.algorithm} needs {name} above 0 and below 1, not {value}.")


A = TypeVar("A", bound=SharedArgs)


def changed_preset(
    presets: Mapping[str, Callable[..., A]], algorithm: str, name: str, *, continuous: bool, **changes: Any
) -> A:
    """The preset called ``name`` for tasks with continuous or discrete actions, some values changed.

    Raises:
        UsageError: no such preset, or values that cannot work.
    """
    if name not in presets:
        raise one_of(f"{algorithm}'s preset", name, tuple(presets))
    return replace(presets[name](continuous=continuous), **changes)
