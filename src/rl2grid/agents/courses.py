"""Playing on from a saved world, and taking back what ends badly: for agents that look at more than one step."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from numbers import Integral
from typing import Any, NamedTuple

import numpy as np

from rl2grid.agents.agent import (
    Action,
    Agent,
    Info,
    Observation,
    ProposingAgent,
    key_of,
    no_intervention,
)
from rl2grid.agents.dispatch import worst_loading_if_legal
from rl2grid.agents.planner import Planner
from rl2grid.engines.worlds import World
from rl2grid.errors import UsageError
from rl2grid.handles import AsOpened
from rl2grid.mdp.actions import TOPOLOGY
from rl2grid.mdp.heuristics import is_safe
from rl2grid.mdp.state import GridState

EARLIER = (1, 3, 6, 12, 24, 48)
"""Decisions before the grid became unsafe at which something else is tried as well."""
PAST = 24
"""Grid steps after the moment of a death that an attempt must survive to have averted it."""


@dataclass(frozen=True)
class Reach:
    """How far is looked, and how much is tried.

    Raises:
        UsageError: one of the three is no whole number of at least 1.
    """

    ahead: int
    candidates: int
    """Other actions that are tried per decision: the best ones by the worst loading in the next step."""
    attempts: int

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not isinstance(value, Integral) or isinstance(value, bool) or value < 1:
                raise UsageError(f"{name}={value!r} is not allowed: give a whole number, at least 1.")


class Guided:
    """An agent that lets another one play on.

    Args:
        guide: who that is; None: the planner.
        reach: how far is looked.
        usual: how far by default; the name says where it is otherwise, and who guides if somebody was given.

    Raises:
        UsageError: the guide is no agent.
    """

    name: str

    def __init__(self, guide: Agent | None, reach: Reach, usual: Reach) -> None:
        if not (guide is None or isinstance(guide, Agent)):
            raise UsageError(f"guide={guide!r} is not allowed: give an agent, such as Planner(), or None.")
        usually = asdict(usual)
        details = [f"guided by {guide.name}"] if guide is not None else []
        details += [f"{each} {value}" for each, value in asdict(reach).items() if value != usually[each]]
        if details:
            self.name = f"{self.name} ({', '.join(details)})"
        self._guide: Agent = Planner() if guide is None else guide
        self._reach = reach


class Decision(NamedTuple):
    """A decision in a course."""

    world: World  # before it
    step: int
    safe: bool
    action: Action


class Course(NamedTuple):
    """What follows from a moment."""

    decisions: list[Decision]
    end: World | None  # after the last decision; None: the episode is over
    lost: bool
    step: int
    """The last grid step that was survived."""


@dataclass(frozen=True)
class Attempt:
    """Decisions up to one at which something else is tried."""

    decisions: Sequence[Decision]
    action: Action | None = None
    """What is played there; None: what the guide chooses."""


class Averted(NamedTuple):
    """What was found against a death."""

    course: Course
    attempts: int
    """That were made."""
    attempt: Attempt | None = None
    """The one that averted it; None: none did."""


class Courses:
    """What comes of decisions in a copy of an environment, where a guide plays on.

    Args:
        env: the environment that is copied.
        guide: who plays on, from any state and whatever was played before; it is bound to the copy. In a redispatching
            task it proposes what else is tried.
        candidates: other actions that are tried per decision: the best ones by the worst loading in the next step.
    """

    def __init__(self, env: Any, guide: Agent, candidates: int) -> None:
        self._guide, self._candidates = guide, candidates
        self._env: Any = copy.deepcopy(env)
        self._opened: AsOpened[GridState] = AsOpened()
        guide.bind(self._env)

    def reset(self) -> None:
        """A new episode begins."""
        self._guide.reset(0)

    def play(
        self, world: World, first: Sequence[Action] = (), most: int | None = None, until: int | None = None
    ) -> Course:
        """Let the guide play on, after actions of one's own.

        Args:
            world: where it begins.
            first: the actions that are played first, one after the other.
            most: decisions at most.
            until: the grid step at which it ends.
        """
        env = self._env
        observation, info = env.restore(world)
        state, decisions, over = env.state, list[Decision](), False
        lost = False
        while not over and (most is None or len(decisions) < most) and (until is None or int(state.step[0]) < until):
            before = env.save() if decisions else world
            step, safe = int(state.step[0]), is_safe(self._opened(state), 0)
            played = len(decisions)
            action = first[played] if played < len(first) else self._guide.act(observation, info)
            observation, _, lost, completed, info = env.step(action)
            decisions.append(Decision(before, step, safe, action))
            over = lost or completed
        return Course(decisions, None if over else env.save(), bool(lost), int(info["step"]))

    def averted(self, course: Course, attempts: int) -> Averted:
        """A course that outlives the end of the given one by far enough; if none is found, the one that lives longest.

        What delays a death without averting it is where the next attempts begin.

        Args:
            course: one that ends with a game over.
            attempts: that are made at most.
        """
        left = attempts
        while left > 0:
            until, longest = course.step + PAST, course
            for attempt in itertools.islice(self.attempts_at(course.decisions), left):
                left -= 1
                *before, last = attempt.decisions
                played = self.tried(attempt, last.world, until)
                played = played._replace(decisions=[*before, *played.decisions])
                if not played.lost:
                    return Averted(played, attempts - left, attempt)
                if played.step > longest.step:
                    longest = played
            if longest is course:
                break
            course = longest
        return Averted(course, attempts - left)

    def tried(self, attempt: Attempt, world: World, until: int) -> Course:
        """What comes of an attempt, until a grid step."""
        return self.play(world, () if attempt.action is None else (attempt.action,), until=until)

    def attempts_at(self, decisions: Sequence[Decision]) -> Iterator[Attempt]:
        """What is tried: other topology actions, in a redispatching task injections, the last decisions first."""
        crisis = begin_of_crisis(decisions)
        remedies = self._best_at(decisions[crisis].world)
        for at in range(len(decisions) - 1, crisis - 1, -1):
            yield from _others(decisions[: at + 1], self._best_at(decisions[at].world))
        for at in (crisis - earlier for earlier in EARLIER if earlier <= crisis):
            yield from _others(decisions[: at + 1], remedies)

    def _best_at(self, world: World) -> list[Action]:
        """Nothing, and the actions with the least worst loading in the next step; of topology all are compared."""
        observation, info = self._env.restore(world)
        if not self._env.task.changes_topology:
            return self._best_proposed(observation, info)
        outcomes = self._env.what_if()
        loading = np.where(outcomes.legal, outcomes.worst_loading, np.inf)
        best = np.argsort(loading, kind="stable")[: self._candidates]
        return [int(action) for action in dict.fromkeys([*best[np.isfinite(loading[best])].tolist(), 0])]

    def _best_proposed(self, observation: Observation, info: Info) -> list[Action]:
        assert isinstance(self._guide, ProposingAgent)
        proposed = self._guide.proposals(observation, info)
        loading = np.array([worst_loading_if_legal(self._env, action) for action in proposed])
        best = np.argsort(loading, kind="stable")[: self._candidates]
        return [*(proposed[k] for k in best if np.isfinite(loading[k])), no_intervention(self._env.action_space)]


def begin_of_crisis(decisions: Sequence[Decision]) -> int:
    """Which is the first of the last decisions, none of which was taken in a safe grid; at most the last."""
    crisis = len(decisions) - 1
    while crisis > 0 and not decisions[crisis - 1].safe:
        crisis -= 1
    return crisis


def _others(decisions: Sequence[Decision], actions: Iterable[Action]) -> Iterator[Attempt]:
    """The last decision with other actions; what it injects in a joint task stays."""
    played = decisions[-1].action
    others = (_in_place_of(played, action) for action in actions)
    return (Attempt(decisions, other) for other in others if key_of(other) != key_of(played))


def _in_place_of(played: Action, action: Action) -> Action:
    return {**played, TOPOLOGY: action} if isinstance(played, Mapping) else action
