"""Crises rehearsed before they are played, in worlds that an operator imagines (``docs/algorithms/rehearsal.md``)."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import gymnasium

from rl2grid.agents.agent import (
    Action,
    Agent,
    Considered,
    ExplainingAgent,
    Info,
    Observation,
    OverruledAgent,
    ProposingAgent,
    topology_part,
)
from rl2grid.agents.courses import Averted, Course, Courses, Guided, Reach
from rl2grid.agents.planner import Planner
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.errors import UsageError
from rl2grid.handles import AsOpened
from rl2grid.mdp.heuristics import is_safe
from rl2grid.mdp.state import GridState

_USUAL = Reach(ahead=24, candidates=24, attempts=300)
"""Steps that must be survived, actions tried per decision and attempts per crisis, unless others are asked for."""
_AT_ONCE = 60
"""Attempts at one decision."""


class Rehearsal(Guided):
    """Plays what its guide, the planner, plays; in a crisis, only after it went well in an imagined world.

    While the grid is safe, the guide decides. When it is not, what the guide would play is played on from an imagined
    world of this moment: forecasts, announced maintenance, the attack under way, and what the guide would do then. If
    the game is over there within two hours, other topology actions are tried, those shortly before that end first, and
    the guide plays on from each; the first course that outlives that end by two hours is kept, else the one that lives
    longest. What is kept is rehearsed anew at every decision, from the world as it has become, and played as long as it
    goes well. So lines may trip on the way if what is left of the grid lives: no search for a safe state a few steps
    ahead finds such courses. It knows what an operator knows, and nothing else.

    In a joint task the guide injects, and topology actions are replaced. In a redispatching task other injections are
    tried, which the guide has to propose: a policy does.

    Args:
        guide: who plays while the grid is safe, and a copy of whom plays in rehearsals; None: the planner.
        ahead: grid steps of a rehearsal.
        candidates: other actions that are tried per decision: the best ones by the worst loading in the next step.
        attempts: at courses that go well in one crisis, until the grid is safe again; sixty at most at one decision.

    Raises:
        UsageError: the guide is no agent, or one of the others no whole number of at least 1.
    """

    name = "rehearsal"
    kinds: tuple[str, ...] = ("T", "H")
    rules: ClassVar[Mapping[str, int]] = {"H": Planner.rules["H"]}  # of the guide, which injects

    def __init__(
        self,
        guide: Agent | None = None,
        ahead: int = _USUAL.ahead,
        candidates: int = _USUAL.candidates,
        attempts: int = _USUAL.attempts,
    ) -> None:
        super().__init__(guide, Reach(ahead, candidates, attempts), _USUAL)
        self._understudy = copy.deepcopy(self._guide)

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Make a copy of the environment, in which crises are rehearsed.

        Raises:
            UsageError: a redispatching task, which has no topology actions to try, and a guide that proposes no
                injections, or the reference engine, which imagines nothing.
        """
        base: Any = env.unwrapped
        if not (base.task.changes_topology or isinstance(self._guide, ProposingAgent)):
            raise UsageError(
                f"Agent {self.name!r} cannot play a redispatching task (-R-), which has no topology actions: "
                "choose planner, a policy as the guide, or a task with topology."
            )
        if not isinstance(base.engine, NativeEngine):
            raise UsageError(f'Agent {self.name!r} imagines worlds of the native engine: choose engine="native".')
        self._env = base
        self._opened: AsOpened[GridState] = AsOpened()
        self._courses = Courses(base, self._understudy, self._reach.candidates)
        self._guide.bind(env)

    def reset(self, i: int) -> None:
        """A new episode: nothing is kept, and no attempt was made."""
        self._guide.reset(0)
        self._courses.reset()
        self._kept: Sequence[Action] = []
        self._left, self._why = self._reach.attempts, ""

    def act(self, observation: Observation, info: Info) -> Action:
        """The guide's action, or that of the course that went well."""
        state: GridState = self._env.state
        self._why = ""
        proposed = self._guide.act(observation, info)
        if is_safe(self._opened(state), 0):
            self._kept, self._left = [], self._reach.attempts
            return proposed
        course = self._rehearsed(int(state.step[0]), proposed)
        action = course.decisions[0].action
        self._kept = [decision.action for decision in course.decisions[1:]]
        if isinstance(self._guide, OverruledAgent) and topology_part(action) != topology_part(proposed):
            self._guide.overruled(action)
        return action

    def overruled(self, played: Action) -> None:
        """Another action than the rehearsed one was played: what was to follow it is of no use."""
        self._kept = []
        if isinstance(self._guide, OverruledAgent):
            self._guide.overruled(played)

    def explain(self) -> Considered | None:
        """What the rehearsal said; while the grid is safe, why the guide plays what it plays."""
        if self._why:
            return Considered("", (), (), self._why)
        return self._guide.explain() if isinstance(self._guide, ExplainingAgent) else None

    def _rehearsed(self, step: int, proposed: Action) -> Course:
        """The course that goes well, or lives longest."""
        world, until = self._env.imagine(step), step + self._reach.ahead
        kept = self._courses.play(world, self._kept, until=until) if self._kept else None
        if kept is not None and not kept.lost:
            self._why = "what was rehearsed before still goes well"
            return kept
        guided = self._courses.play(world, [proposed], until=until)
        if not guided.lost:
            self._why = "what the guide plays goes well"
            return guided
        longest = guided if kept is None or guided.step >= kept.step else kept
        averted = self._courses.averted(longest, min(self._left, _AT_ONCE))
        self._left -= averted.attempts
        self._why = _reason(longest.step, averted)
        return averted.course


def _reason(death: int, averted: Averted) -> str:
    if averted.attempt is None:
        return f"nothing was found that averts a game over after step {averted.course.step}, this lives longest"
    return f"a game over after step {death} is averted by another action in step {averted.attempt.decisions[-1].step}"
