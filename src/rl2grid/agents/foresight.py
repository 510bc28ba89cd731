"""How long a grid can be kept alive by one who knows what comes (``docs/algorithms/foresight.md``)."""

from __future__ import annotations

import copy
import itertools
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from numbers import Integral
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from rl2grid.agents.agent import Action, Agent, Considered, Info, Observation, topology_part
from rl2grid.agents.planner import Foretold, Planner
from rl2grid.agents.trend import undispatched
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.worlds import World
from rl2grid.errors import UsageError
from rl2grid.handles import AsOpened
from rl2grid.mdp.actions import TOPOLOGY
from rl2grid.mdp.heuristics import is_safe
from rl2grid.mdp.state import GridState

_EARLIER = (1, 3, 6, 12, 24, 48)
"""Decisions before the grid became unsafe at which something else is tried as well."""
_AHEAD, _CANDIDATES, _ATTEMPTS = 96, 24, 300
"""Decisions played in advance, actions tried per decision and attempts per death, unless others are asked for."""
_PAST = 24
"""Grid steps after the moment of a death that an attempt must survive to have averted it."""


class _Decision(NamedTuple):
    """A decision in the episode that is to come."""

    world: World  # before it
    step: int
    safe: bool
    action: Action


class _Course(NamedTuple):
    """What follows from a moment."""

    decisions: list[_Decision]
    end: World | None  # after the last decision; None: the episode is over
    lost: bool
    step: int
    """The last grid step that was survived."""


class _Attempt(NamedTuple):
    """Decisions up to one at which something else is tried."""

    decisions: Sequence[_Decision]
    action: Action | None = None
    """What is played there; None: what the guide chooses."""
    foretold: Foretold | None = None
    """What the guide is told from there on."""


class Foresight:
    """Plays the true future in advance and takes back what ends badly: a bound, not a player.

    It lets a guide, the planner, play on from saved true worlds, some hours ahead of the episode. Where that ends in a
    game over, it goes back decision by decision, first through the crisis, then to moments before it began, plays
    another topology action there (in a joint task with the injection of the guide) and lets the guide go on; where
    power can be dispatched, it first tells the planner what comes, so that the grid is ready; what outlives the moment
    of the death by two hours is kept. So its survival can be reached by one who reacts like the planner and knows all
    attacks, outages and demand: a lower bound of the best possible. It is marked as an agent with foresight and never
    ranked with others. Its name says who guides it and how far it looks, where that is not as by default.

    Args:
        guide: who plays on, from any state and whatever was played before; None: the planner.
        ahead: decisions that are played in advance.
        candidates: other actions that are tried per decision: the best ones by the worst loading in the next step.
        attempts: that are made to avert one death.

    Raises:
        UsageError: the guide is no agent, or one of the others no whole number of at least 1.
    """

    name = "foresight"
    kinds = ("T", "R", "H")

    def __init__(
        self,
        guide: Agent | None = None,
        ahead: int = _AHEAD,
        candidates: int = _CANDIDATES,
        attempts: int = _ATTEMPTS,
    ) -> None:
        asked = {"ahead": ahead, "candidates": candidates, "attempts": attempts}
        for name, value in asked.items():
            if not isinstance(value, Integral) or isinstance(value, bool) or value < 1:
                raise UsageError(f"{name}={value!r} is not allowed: give a whole number, at least 1.")
        if not (guide is None or isinstance(guide, Agent)):
            raise UsageError(f"guide={guide!r} is not allowed: give an agent, such as Planner(), or None.")
        self._guide = Planner() if guide is None else guide
        usual = {"ahead": _AHEAD, "candidates": _CANDIDATES, "attempts": _ATTEMPTS}
        guided = [] if guide is None else [f"guided by {guide.name}"]
        details = guided + [f"{name} {value}" for name, value in asked.items() if value != usual[name]]
        self.name = f"foresight ({', '.join(details)})" if details else "foresight"
        self._ahead, self._candidates, self._attempts = ahead, candidates, attempts

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Make a copy of the environment, in which the future is played.

        Raises:
            UsageError: a redispatching task with another guide than the planner, or the reference engine, which answers
                no what-if.
        """
        base: Any = env.unwrapped
        if not base.task.changes_topology and not isinstance(self._guide, Planner):
            raise UsageError(
                f"Agent {self.name!r} cannot play {base.task.id}, which has no topology actions to try, and only the "
                "planner can be told what to dispatch against: leave out the guide, or choose a task with topology."
            )
        if not isinstance(base.engine, NativeEngine):
            raise UsageError(f'Agent {self.name!r} asks what-ifs of the native engine: choose engine="native".')
        self._present = base
        self._future: Any = copy.deepcopy(base)
        self._opened: AsOpened[GridState] = AsOpened()
        self._guide.bind(self._future)

    def reset(self, i: int) -> None:
        """Forget what was foreseen."""
        self._guide.reset(0)
        self._course: deque[_Decision] = deque()
        self._end: World | None = None
        self._ends = False  # the end of the episode is in the course, good or bad
        self._why = ""

    def act(self, observation: Observation, info: Info) -> Action:
        """The next action of the course that was found."""
        self._why = ""
        if not self._course:
            self._end = self._present.save()
        while not self._ends and len(self._course) < self._ahead:
            self._go_on()
        return self._course.popleft().action

    def overruled(self, played: Action) -> None:
        """Another action than the foreseen one was played: what follows is not what was foreseen."""
        self._course.clear()
        self._ends = False

    def explain(self) -> Considered | None:
        """Whether a death was averted, or could not be."""
        return Considered("", (), (), self._why) if self._why else None

    def _go_on(self) -> None:
        """Extend the course, by what averts a death where there is one."""
        assert self._end is not None
        course = self._play(self._end, None, self._ahead - len(self._course))
        decisions = [*self._course, *course.decisions]
        if course.lost:
            course = self._averted(course._replace(decisions=decisions))
            decisions = course.decisions
        self._course, self._end, self._ends = deque(decisions), course.end, course.end is None

    def _averted(self, course: _Course) -> _Course:
        """A course that outlives the end of the given one by far enough; if none is found, the one that lives longest.

        What delays a death without averting it is where the next attempts begin.
        """
        death, left = course.step, self._attempts
        while left > 0:
            until, longest = course.step + _PAST, course
            for attempt in itertools.islice(self._attempts_at(course.decisions), left):
                left -= 1
                *before, last = attempt.decisions
                played = self._tried(attempt, last.world, until)
                played = played._replace(decisions=[*before, *played.decisions])
                if not played.lost:
                    what = "another action in" if attempt.foretold is None else "another dispatch from"
                    self._why = f"the game over of step {death} is averted by {what} step {last.step}"
                    return played
                if played.step > longest.step:
                    longest = played
            if longest is course:
                break
            course = longest
        self._why = f"nothing was found that averts the game over of step {course.step}"
        return course

    def _tried(self, attempt: _Attempt, world: World, until: int) -> _Course:
        if attempt.foretold is None:
            return self._play(world, attempt.action, None, until)
        assert isinstance(self._guide, Planner)
        self._guide.forewarn(attempt.foretold)
        played = self._play(world, None, None, until)
        self._guide.forewarn(None)
        return played

    def _attempts_at(self, decisions: Sequence[_Decision]) -> Iterator[_Attempt]:
        """What is tried: first to tell the guide what comes, then other topology actions, the last decisions first."""
        crisis = len(decisions) - 1
        while crisis > 0 and not decisions[crisis - 1].safe:
            crisis -= 1
        if isinstance(self._guide, Planner) and self._present.task.injects:
            foretold = self._foretold(decisions[-1].world)
            for earlier in (0, *_EARLIER, self._ahead):
                at = max(crisis - earlier, 0)
                yield _Attempt(decisions[: at + 1], foretold=self._lost_from(decisions[at].world, foretold))
                if at == 0:
                    break
        if self._present.task.changes_topology:
            yield from self._topology_attempts(decisions, crisis)

    def _foretold(self, world: World) -> Foretold:
        """The last moment before a death, and all lines that are out then."""
        self._future.restore(world)
        state = self._future.state
        lines = np.flatnonzero(~state.line_status[0]).astype(np.int32)
        return Foretold(int(state.step[0]), lines, undispatched(state, self._future.grid))

    def _lost_from(self, world: World, foretold: Foretold) -> Foretold:
        """The same, of the lines that are in service in a world."""
        self._future.restore(world)
        return foretold._replace(lines=foretold.lines[self._future.state.line_status[0][foretold.lines]])

    def _topology_attempts(self, decisions: Sequence[_Decision], crisis: int) -> Iterator[_Attempt]:
        remedies = self._best_at(decisions[crisis].world)
        for at in range(len(decisions) - 1, crisis - 1, -1):
            yield from self._others(decisions[: at + 1], self._best_at(decisions[at].world))
        for at in (crisis - earlier for earlier in _EARLIER if earlier <= crisis):
            yield from self._others(decisions[: at + 1], remedies)

    def _others(self, decisions: Sequence[_Decision], topologies: Iterable[int]) -> Iterator[_Attempt]:
        """The last decision with other topology actions; what it injects in a joint task stays."""
        played = decisions[-1].action
        others = (topology for topology in topologies if topology != topology_part(played))
        return (_Attempt(decisions, _with_topology(played, topology)) for topology in others)

    def _best_at(self, world: World) -> list[int]:
        """Nothing, and the topology actions with the least worst loading in the next step."""
        self._future.restore(world)
        outcomes = self._future.what_if()
        loading = np.where(outcomes.legal, outcomes.worst_loading, np.inf)
        best = np.argsort(loading, kind="stable")[: self._candidates]
        return [int(action) for action in dict.fromkeys([*best[np.isfinite(loading[best])].tolist(), 0])]

    def _play(self, world: World, first: Action | None, most: int | None, until: int | None = None) -> _Course:
        """Let the guide play on, after an action of one's own.

        Args:
            world: where it begins.
            first: the action that is played first; None: the guide's.
            most: decisions at most.
            until: the grid step at which it ends.
        """
        future = self._future
        observation, info = future.restore(world)
        state, decisions, over = future.state, list[_Decision](), False
        lost = False
        while not over and (most is None or len(decisions) < most) and (until is None or int(state.step[0]) < until):
            before = future.save() if decisions else world
            step, safe = int(state.step[0]), is_safe(self._opened(state), 0)
            action = first if first is not None and not decisions else self._guide.act(observation, info)
            observation, _, lost, completed, info = future.step(action)
            decisions.append(_Decision(before, step, safe, action))
            over = lost or completed
        return _Course(decisions, None if over else future.save(), bool(lost), int(info["step"]))


def _with_topology(action: Action, topology: int) -> Action:
    return {**action, TOPOLOGY: topology} if isinstance(action, Mapping) else topology
