"""How long a grid can be kept alive by one who knows what comes (``docs/algorithms/foresight.md``)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from rl2grid.agents.agent import Action, Agent, Considered, Info, Observation
from rl2grid.agents.courses import (
    EARLIER,
    Attempt,
    Averted,
    Course,
    Courses,
    Decision,
    Guided,
    Reach,
    begin_of_crisis,
)
from rl2grid.agents.planner import Foretold, Planner
from rl2grid.agents.trend import undispatched
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.worlds import World
from rl2grid.errors import UsageError

_USUAL = Reach(ahead=96, candidates=24, attempts=300)
"""Decisions played in advance, actions tried per decision and attempts per death, unless others are asked for."""


@dataclass(frozen=True, kw_only=True)
class _Telling(Attempt):
    """The guide is told something, from the last decision on."""

    foretold: Foretold


class Foresight(Guided):
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
        ahead: int = _USUAL.ahead,
        candidates: int = _USUAL.candidates,
        attempts: int = _USUAL.attempts,
    ) -> None:
        super().__init__(guide, Reach(ahead, candidates, attempts), _USUAL)

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
        self._courses = _Told(base, self._guide, self._reach)

    def reset(self, i: int) -> None:
        """Forget what was foreseen."""
        self._courses.reset()
        self._course: deque[Decision] = deque()
        self._end: World | None = None
        self._ends = False  # the end of the episode is in the course, good or bad
        self._why = ""

    def act(self, observation: Observation, info: Info) -> Action:
        """The next action of the course that was found."""
        self._why = ""
        if not self._course:
            self._end = self._present.save()
        while not self._ends and len(self._course) < self._reach.ahead:
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
        course = self._courses.play(self._end, most=self._reach.ahead - len(self._course))
        decisions = [*self._course, *course.decisions]
        if course.lost:
            averted = self._courses.averted(course._replace(decisions=decisions), self._reach.attempts)
            self._why = _reason(course.step, averted)
            course = averted.course
            decisions = course.decisions
        self._course, self._end, self._ends = deque(decisions), course.end, course.end is None


class _Told(Courses):
    """Where power can be dispatched, the planner is told what comes before anything else is tried."""

    def __init__(self, env: Any, guide: Agent, reach: Reach) -> None:
        super().__init__(env, guide, reach.candidates)
        self._ahead = reach.ahead

    def attempts_at(self, decisions: Sequence[Decision]) -> Iterator[Attempt]:
        if isinstance(self._guide, Planner) and self._env.task.injects:
            crisis, foretold = begin_of_crisis(decisions), self._foretold(decisions[-1].world)
            for earlier in (0, *EARLIER, self._ahead):
                at = max(crisis - earlier, 0)
                yield _Telling(decisions[: at + 1], foretold=self._lost_from(decisions[at].world, foretold))
                if at == 0:
                    break
        if self._env.task.changes_topology:
            yield from super().attempts_at(decisions)

    def tried(self, attempt: Attempt, world: World, until: int) -> Course:
        if not isinstance(attempt, _Telling):
            return super().tried(attempt, world, until)
        assert isinstance(self._guide, Planner)
        self._guide.forewarn(attempt.foretold)
        played = self.play(world, until=until)
        self._guide.forewarn(None)
        return played

    def _foretold(self, world: World) -> Foretold:
        """The last moment before a death, and all lines that are out then."""
        self._env.restore(world)
        state = self._env.state
        lines = np.flatnonzero(~state.line_status[0]).astype(np.int32)
        return Foretold(int(state.step[0]), lines, undispatched(state, self._env.grid))

    def _lost_from(self, world: World, foretold: Foretold) -> Foretold:
        """The same, of the lines that are in service in a world."""
        self._env.restore(world)
        return foretold._replace(lines=foretold.lines[self._env.state.line_status[0][foretold.lines]])


def _reason(death: int, averted: Averted) -> str:
    if averted.attempt is None:
        return f"nothing was found that averts the game over of step {averted.course.step}"
    what = "another dispatch from" if isinstance(averted.attempt, _Telling) else "another action in"
    return f"the game over of step {death} is averted by {what} step {averted.attempt.decisions[-1].step}"
