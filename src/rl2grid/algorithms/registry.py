"""The algorithms that can be trained, by name: those of the package, those of other installed packages, and whatever
:func:`register_algorithm` adds in this process.

This module needs no PyTorch: the file of an algorithm is imported when it is first asked for, and ends in the
:class:`Algorithm` that describes it. A package offers its own by entry points, which every process finds, those of the
command line and of workers too::

    [project.entry-points."rl2grid.algorithms"]
    reinforce = "my_package.reinforce:ALGORITHM"
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, get_type_hints

import gymnasium

from rl2grid.errors import UsageError, one_of

if TYPE_CHECKING:
    from rl2grid.algorithms.trainer import Learner

VectorEnvironment = gymnasium.vector.VectorEnv[Any, Any, Any]


class Hyperparameters(Protocol):
    """What a run reads of the hyperparameters of any algorithm, a dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def seed(self) -> int:
        """Of everything random."""

    @property
    def total_timesteps(self) -> int:
        """Decisions to train for, over all environments."""

    @property
    def num_envs(self) -> int:
        """Environments played side by side."""

    @property
    def num_steps(self) -> int:
        """Decisions per environment and iteration."""

    @property
    def gamma(self) -> float:
        """Discount of one grid step."""


@dataclass(frozen=True)
class Algorithm:
    """What training, evaluation and tuning need to know of an algorithm."""

    name: str
    """What the command line, run folders and checkpoints call it."""
    args: type[Any]
    """Its :class:`Hyperparameters`, a frozen dataclass, such as
    :class:`~rl2grid.algorithms.hyperparameters.SharedArgs` and what is made of it."""
    trainer: Callable[[Any, VectorEnvironment], Learner]
    """Made of hyperparameters and environments."""
    kinds: tuple[str, ...]
    """Kinds of task that it can learn: ``"T"`` (discrete actions), ``"R"`` (continuous actions). Joint tasks it learns
    flattened, see :meth:`plays_continuous`."""
    preset: Callable[..., Any]
    """``preset(name, continuous=..., **changes)``: hyperparameters."""
    load_policy: Callable[[Mapping[str, Any]], Any]
    """The network of a checkpoint's section ``policy``, which acts."""
    search_space: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    """Values that a search tries by default, by hyperparameter."""
    find_limits: Callable[[Any, str | None], dict[str, float]] | None = None
    """Of algorithms with constraints of their own: ``find_limits(args, constraint of the task)`` tells what the costs
    of a safe episode may reach, by constraint; None: the task's constraint is all there is."""
    joint_as_box: bool = False
    """Whether joint tasks are learned with continuous actions although discrete ones could be learned, too."""
    plays_months: bool = True
    """Whether it learns from months that it plays, which need room on the disk, and not from labels alone."""

    def learns(self, kind: str) -> bool:
        """Whether it can learn tasks of a kind, of :data:`rl2grid.mdp.features.KINDS`."""
        return kind == "H" or kind in self.kinds

    def plays_continuous(self, kind: str, joint_actions: str | None = None) -> bool:
        """Whether it learns tasks of a kind with continuous actions.

        Joint tasks are learned as :class:`~rl2grid.envs.joint.JointAsDiscrete` by whom discrete actions are learned at
        all, unless :attr:`joint_as_box` says otherwise, else as :class:`~rl2grid.envs.joint.JointAsBox`.

        Args:
            kind: Of the task.
            joint_actions: Of joint tasks, ``"discrete"`` or ``"box"``: how they are to be learned; None: as above.

        Raises:
            UsageError: it cannot learn joint tasks like that.
        """
        if kind != "H":
            return kind == "R"
        able = {"discrete": "T" in self.kinds and not self.joint_as_box, "box": "R" in self.kinds}
        if joint_actions is None:
            return not able["discrete"]
        if not able.get(joint_actions):
            raise one_of(f"joint_actions of {self.name}", joint_actions, [way for way in able if able[way]])
        return joint_actions == "box"

    def type_hints(self) -> dict[str, Any]:
        """Type hint of every hyperparameter."""
        hints = get_type_hints(self.args)
        return {parameter.name: hints[parameter.name] for parameter in fields(self.args)}


_IN_PACKAGE = {
    "ppo": "rl2grid.algorithms.ppo",
    "lagrangian-ppo": "rl2grid.algorithms.lagrangian_ppo",
    "dqn": "rl2grid.algorithms.dqn",
    "sac": "rl2grid.algorithms.sac",
    "td3": "rl2grid.algorithms.td3",
    "imitation": "rl2grid.algorithms.imitation",
}
"""The file of each, whose ``ALGORITHM`` describes it."""
_ADDED: dict[str, Algorithm] = {}
GROUP = "rl2grid.algorithms"
"""Of entry points."""


@functools.cache
def _installed() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP) if point.name not in _IN_PACKAGE}


def register_algorithm(algorithm: Algorithm) -> None:
    """Let an algorithm be trained, evaluated, studied and tuned by its name, in this process.

    Raises:
        UsageError: the name is taken by another algorithm.
    """
    if algorithm.name in (*_IN_PACKAGE, *_installed()) or _ADDED.get(algorithm.name, algorithm) != algorithm:
        raise UsageError(f"Algorithm {algorithm.name!r} exists already: choose another name.")
    _ADDED[algorithm.name] = algorithm


def algorithm_names() -> tuple[str, ...]:
    """All names, those of the package first."""
    return (*_IN_PACKAGE, *_installed(), *_ADDED)


def find_algorithm(name: str) -> Algorithm:
    """The algorithm called ``name``.

    Raises:
        UsageError: there is none.
        ImportError: PyTorch or the package that offers it is not installed.
    """
    if name in _ADDED:
        return _ADDED[name]
    if name in _IN_PACKAGE:
        algorithm = import_module(_IN_PACKAGE[name]).ALGORITHM
    elif name in _installed():
        algorithm = _installed()[name].load()
    else:
        raise one_of("Algorithm", name, algorithm_names())
    if not isinstance(algorithm, Algorithm):
        raise UsageError(f"Algorithm {name!r} is offered by an entry point that is no Algorithm, but {algorithm!r}.")
    return algorithm


def algorithms_for(kind: str) -> tuple[str, ...]:
    """Names of the algorithms that can learn tasks of a kind, of :data:`rl2grid.mdp.features.KINDS`."""
    return tuple(name for name in algorithm_names() if find_algorithm(name).learns(kind))
