"""What the evaluation asks of an agent, trained or not."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rl2grid.mdp.actions import INJECTION, TOPOLOGY

Observation = NDArray[np.float32]
Action = Any
"""``int`` on topology tasks (Discrete), float32 [continuous] in [-1, 1] on redispatching tasks (Box), a dict of both,
``topology`` and ``injection``, on joint tasks (Dict)."""
Actions = Any
"""Of many environments: integers [k], float32 [k, continuous], or a dict of both."""
Info = Mapping[str, Any]


@runtime_checkable
class Agent(Protocol):
    """An agent that plays one environment."""

    name: str
    """What tables and figures call the agent."""

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Look at the environment to be played (its spaces, its grid); called once, before anything else.

        Raises:
            UsageError: the agent cannot play this task.
        """

    def reset(self, i: int) -> None:
        """Forget everything about environment ``i``: a new episode of it begins."""

    def act(self, observation: Observation, info: Info) -> Action:
        """The action for an observation (float32, one axis) and the ``info`` that came with it."""


@runtime_checkable
class SideBySideAgent(Protocol):
    """An agent that can decide for many environments of its task at once, as :meth:`Agent.act` does for each."""

    decides_side_by_side: bool
    """Whether it does, to the bit: an agent may be of a kind that can, and not be able to."""

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """See :meth:`Agent.bind`."""

    def act_side_by_side(self, observations: NDArray[np.float32], masks: Callable[[], NDArray[np.bool_]]) -> Actions:
        """The actions for observations.

        Args:
            observations: float32 [k, feature].
            masks: which topology actions are legal, bool [k, action]; called where they matter.
        """


@runtime_checkable
class RandomizedAgent(Protocol):
    """An agent that draws random numbers, from a stream that the evaluation names per episode.

    That makes an episode's actions a function of the seed and the scenario alone, whichever
    worker plays it and whatever was played before.
    """

    def seed_episode(self, seed: int, episode: int) -> None:
        """Draw from the stream (``seed``, ``episode``) from the next ``reset`` on."""


@runtime_checkable
class SpecialisedAgent(Protocol):
    """An agent that cannot play all kinds of task; those without ``kinds`` can."""

    kinds: tuple[str, ...]
    """``"T"``: topology tasks, ``"R"``: redispatching tasks, ``"H"``: joint tasks; ``bind`` refuses the others."""


@runtime_checkable
class RevisedAgent(Protocol):
    """An agent that plays otherwise than it did in its first results, which a ledger keeps apart."""

    rules: Mapping[str, int]
    """Version of its rules by kind of task, as in ``kinds``, where it is not the first."""


class Considered(NamedTuple):
    """What an agent thought of actions when it acted."""

    meaning: str
    """What the values are, for example ``probability``."""
    actions: Sequence[Action]
    """Best first; a few are enough."""
    values: Sequence[float]
    """Of each of them."""
    why: str = ""
    """By what rule it chose among them, in words."""


@runtime_checkable
class ExplainingAgent(Protocol):
    """An agent that says between which actions it chose; ``rl2grid watch`` shows it."""

    def explain(self) -> Considered | None:
        """What the last ``act`` thought of; None: there was nothing to choose."""


@runtime_checkable
class AimingAgent(Protocol):
    """An agent that knows where it wants the injections to be; who learns from it is told, beside what it asks for."""

    def aim(self) -> NDArray[np.float32]:
        """The continuous action that would bring them there at once, float32 [continuous].

        Asked after ``act`` and before the next step; beyond [-1, 1] where that takes more than a step.
        """


@runtime_checkable
class ProposingAgent(Protocol):
    """An agent that says which other continuous actions it would try, of which there are no best few to name."""

    def proposals(self, observation: Observation, info: Info) -> list[Action]:
        """What it would play without looking, and others around it."""


@runtime_checkable
class RankingAgent(Protocol):
    """An agent that compares single topology actions; who learns from it is told what it thought of them."""

    def ranking(self, most: int) -> Considered | None:
        """The topology actions, by id, that the last ``act`` found best; None: it compared none.

        Args:
            most: how many of them are asked for.
        """


@runtime_checkable
class OverruledAgent(Protocol):
    """An agent that remembers what it plays, and can be told that another action was played in its place."""

    def overruled(self, played: Action) -> None:
        """Not the last ``act`` was played but this; the next one is asked for what follows from there."""


def seed_together(agents: Iterable[Agent | None], seed: int, episode: int) -> None:
    """Let agents that play the same episode draw from streams of their own; those that draw nothing are passed over."""
    for place, agent in enumerate(agents):
        if isinstance(agent, RandomizedAgent):
            agent.seed_episode(seed, episode ^ place)


def nearest_of(kind: type, *names: str) -> str | None:
    """Which of some methods a class or its nearest base defines, the first named where one defines several; None: none.

    Who inherits another way to do what it does in a way of its own is to be asked in the latter.
    """
    return next((name for base in kind.__mro__ for name in names if name in vars(base)), None)


def no_intervention(space: gymnasium.Space[Any]) -> Action:
    """The action that changes nothing: id 0 of a topology task, zeros of a redispatching task, both of a joint task."""
    if isinstance(space, gymnasium.spaces.Dict):
        return {name: no_intervention(part) for name, part in space.items()}
    if isinstance(space, gymnasium.spaces.Discrete):
        return 0
    assert isinstance(space, gymnasium.spaces.Box)
    return np.zeros(space.shape, space.dtype)


def repeated(action: Action, n: int) -> Actions:
    """The same action for ``n`` environments."""
    if isinstance(action, Mapping):
        return {name: repeated(part, n) for name, part in action.items()}
    return np.repeat(np.asarray(action)[np.newaxis], n, axis=0)


def intervenes(action: Action) -> bool:
    """Whether an action, or a part of it, changes something."""
    parts = action.values() if isinstance(action, Mapping) else (action,)
    return any(np.any(part) for part in parts)


def key_of(action: Action) -> bytes:
    """What equal actions of a task have in common, to look them up."""
    if isinstance(action, Mapping):
        return b"".join(np.asarray(action[name]).tobytes() for name in sorted(action))
    return np.asarray(action).tobytes()


def has_topology_actions(space: gymnasium.Space[Any]) -> bool:
    """Whether actions of ``space`` are topology actions, or have such a part."""
    return isinstance(space, gymnasium.spaces.Discrete | gymnasium.spaces.Dict)


def has_injections(space: gymnasium.Space[Any]) -> bool:
    """Whether actions of ``space`` are continuous, or have such a part."""
    return isinstance(space, gymnasium.spaces.Box | gymnasium.spaces.Dict)


def topology_part(action: Action) -> int:
    """The topology action in an action of a topology task or of a joint one."""
    return int(action[TOPOLOGY] if isinstance(action, Mapping) else action)


def injection_part(action: Action) -> NDArray[np.float32]:
    """The continuous action in an action of a redispatching task or of a joint one."""
    return np.asarray(action[INJECTION] if isinstance(action, Mapping) else action, np.float32)


def topology_action(space: gymnasium.Space[Any], chosen: int) -> Action:
    """The action of ``space`` that changes the topology and injects nothing."""
    if isinstance(space, gymnasium.spaces.Dict):
        return {**no_intervention(space), TOPOLOGY: chosen}
    return chosen


def injecting_action(space: gymnasium.Space[Any], values: NDArray[np.float32], chosen: int = 0) -> Action:
    """The action of ``space`` that injects, and on joint tasks plays the topology action ``chosen``."""
    if isinstance(space, gymnasium.spaces.Dict):
        return {TOPOLOGY: chosen, INJECTION: values}
    return values
