"""Plays episodes and keeps what a teacher decided in their states, whoever acted."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from rl2grid.agents.agent import (
    Action,
    Agent,
    AimingAgent,
    Considered,
    ExplainingAgent,
    Info,
    Observation,
    OverruledAgent,
    RankingAgent,
    has_injections,
    has_topology_actions,
    injection_part,
    intervenes,
    key_of,
    no_intervention,
    seed_together,
    topology_part,
)
from rl2grid.arrays import F32, F64, I64, Flags
from rl2grid.envs.description import step_action, task_catalogue
from rl2grid.envs.tasks import Task
from rl2grid.evaluation.reasons import explanation_of
from rl2grid.handles import AsOpened
from rl2grid.mdp.heuristics import is_safe
from rl2grid.mdp.state import GridState
from rl2grid.records.labels import COMPLETED, GAME_OVER, NO_CANDIDATE, WENT_ON, Labels
from rl2grid.streams import Purpose, Stream

_THINNING, _SHARING = 0, 1
"""Streams of an episode's seed: which decisions are kept, and in which the pupil acts."""


class _Kept(NamedTuple):
    """A decision that is kept; arrays as those of :class:`Labels` have them, without the first axis."""

    place: int  # among all decisions of the episode
    observation: F32
    mask: Flags | None
    action: Action
    aim: F32 | None
    candidates: I64
    values: F32
    weight: float
    pupil: bool


class _Transition(NamedTuple):
    """What came of a decision."""

    reward: float
    n_steps: int
    ending: int


class Labeller:
    """An agent that asks a teacher in every state, plays what it says or what a pupil says, and remembers.

    Args:
        task: that is played.
        teacher: not bound yet.
        pupil: who acts; None: the teacher.
        pupil_share: probability with which the pupil acts in a decision.
        thin: of so many decisions in which the grid is safe and the teacher does nothing, one is kept, at random.
        candidates: actions that the teacher is asked for with what it thinks of them.
    """

    def __init__(
        self, task: Task, teacher: Agent, pupil: Agent | None, pupil_share: float, thin: float, candidates: int
    ) -> None:
        self.name = teacher.name
        self._task, self._teacher, self._pupil = task, teacher, pupil
        self._pupil_share, self._thin, self._n_candidates = pupil_share, thin, candidates

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Bind the teacher and the pupil.

        Raises:
            UsageError: one of them cannot play the task.
        """
        base: Any = env.unwrapped
        self._env, self._space = base, env.action_space
        self._opened: AsOpened[GridState] = AsOpened()
        self._catalogue = task_catalogue(self._task, base.grid)
        self._teacher.bind(env)
        if self._pupil is not None:
            self._pupil.bind(env)

    def seed_episode(self, seed: int, episode: int) -> None:
        """Draw from streams of that seed, in the teacher and the pupil too."""
        self._thinning = Stream(seed, _THINNING, Purpose.AGENT)
        self._sharing = Stream(seed, _SHARING, Purpose.AGENT)
        seed_together((self._teacher, self._pupil), seed, episode)

    def reset(self, i: int) -> None:
        """Forget the last episode."""
        self._kept: list[_Kept] = []
        self._transitions: list[_Transition] = []
        self.acted = 0
        """Decisions of the episode in which the teacher does something."""
        self._teacher.reset(i)
        if self._pupil is not None:
            self._pupil.reset(i)

    def act(self, observation: Observation, info: Info) -> Action:
        """What is played: the teacher's action, or the pupil's."""
        chosen = self._teacher.act(observation, info)
        action = self._legal(chosen)
        acts, by_pupil = intervenes(action), self._pupil_acts()
        self.acted += acts
        asks_for_something = acts or not is_safe(self._opened(self._env.state), 0)
        drawn = bool(self._thinning.uniform(1)[0] * self._thin < 1.0)
        if asks_for_something or drawn:
            aim = self._aim(action, chosen) if has_injections(self._space) else None
            self._keep(observation, action, aim, 1.0 if asks_for_something else self._thin, by_pupil)
        return self._played_by_pupil(action, observation, info) if by_pupil else action

    def note(self, lost: bool, completed: bool, info: Info) -> None:
        """Remember what came of the last action."""
        ending = GAME_OVER if lost else COMPLETED if completed else WENT_ON
        self._transitions.append(_Transition(info["discounted_reward"], info["n_steps"], ending))

    def labels(self, gamma: float) -> Labels:
        """The labels of the episode that has just ended, with the discount ``gamma`` of its rewards."""
        kept = self._kept
        places = np.array([each.place for each in kept], np.int64)
        rewards = np.array([each.reward for each in self._transitions], np.float64)
        n_steps = np.array([each.n_steps for each in self._transitions], np.int64)
        ending = np.array([each.ending for each in self._transitions], np.int8)
        size, k = self._env.observation_space.shape[0], self._n_candidates
        topology = has_topology_actions(self._space)
        injects, dimensions = has_injections(self._space), self._task.n_injections
        injections = [injection_part(each.action) for each in kept] if injects else []
        return Labels(
            observations=_stacked([each.observation for each in kept], size, np.float32),
            masks=_stacked([each.mask for each in kept], self._task.n_topology_actions, np.bool_) if topology else None,
            topology=np.array([topology_part(each.action) for each in kept], np.int64) if topology else None,
            injection=_stacked(injections, dimensions, np.float32) if injects else None,
            aim=_stacked([each.aim for each in kept], dimensions, np.float32) if injects else None,
            candidates=_stacked([each.candidates for each in kept], k, np.int64),
            values=_stacked([each.values for each in kept], k, np.float32),
            weights=np.array([each.weight for each in kept], np.float32),
            rewards=rewards[places],
            n_steps=n_steps[places],
            ending=ending[places],
            pupil=np.array([each.pupil for each in kept], np.bool_),
            returns=returns_of(rewards, n_steps, gamma)[places],
        )

    def _pupil_acts(self) -> bool:
        return self._pupil is not None and bool(self._sharing.uniform(1)[0] < self._pupil_share)

    def _played_by_pupil(self, action: Action, observation: Observation, info: Info) -> Action:
        assert self._pupil is not None
        played = self._pupil.act(observation, info)
        if isinstance(self._teacher, OverruledAgent) and key_of(played) != key_of(action):
            self._teacher.overruled(played)
        return played

    def _keep(self, observation: Observation, action: Action, aim: F32 | None, weight: float, by_pupil: bool) -> None:
        mask = self._env.action_masks() if has_topology_actions(self._space) else None
        candidates, values = self._candidates(mask)
        place, seen = len(self._transitions), np.array(observation, np.float32)
        self._kept.append(_Kept(place, seen, mask, action, aim, candidates, values, weight, by_pupil))

    def _aim(self, action: Action, chosen: Action) -> F32:
        """Where the teacher wants injections; of an illegal action, for which nothing was played, nowhere else."""
        if action is chosen and isinstance(self._teacher, AimingAgent):
            return self._teacher.aim()
        return injection_part(action)

    def _legal(self, action: Action) -> Action:
        """What the environment would play: of an illegal action nothing is kept, neither part.

        Raises:
            UsageError: it is no action of the task.
        """
        acts = intervenes(action)
        if acts or self._pupil is not None:  # else the environment refuses what is no action
            step_action(self._task, self._env.grid, self._catalogue, action)
        if acts and has_topology_actions(self._space) and not self._env.action_masks()[topology_part(action)]:
            return no_intervention(self._space)
        return action

    def _candidates(self, mask: Flags | None) -> tuple[I64, F32]:
        """Legal actions that the teacher considered, the best first, and what it thinks of them."""
        candidates = np.full(self._n_candidates, NO_CANDIDATE, np.int64)
        values = np.zeros(self._n_candidates, np.float32)
        considered = self._considered()
        if considered is None or mask is None:
            return candidates, values
        sign = -1.0 if _is_less_better(considered.values) else 1.0
        found: dict[int, float] = {}
        for action, value in zip(considered.actions, considered.values, strict=True):
            entry = topology_part(action)
            if len(found) < len(candidates) and 0 <= entry < len(mask) and mask[entry] and math.isfinite(value):
                found.setdefault(entry, sign * value)
        candidates[: len(found)], values[: len(found)] = list(found), list(found.values())
        return candidates, values

    def _considered(self) -> Considered | None:
        if self._n_candidates == 0:
            return None
        if isinstance(self._teacher, RankingAgent):
            return self._teacher.ranking(2 * self._n_candidates)
        return explanation_of(self._teacher)


def says_candidates(agent: Agent) -> bool:
    """Whether an agent can say what it thinks of topology actions."""
    return isinstance(agent, RankingAgent | ExplainingAgent)


def returns_of(rewards: F64, n_steps: I64, gamma: float) -> F64:
    """Discounted sum of the rewards from each decision to the last, float64 [decision].

    Args:
        rewards: discounted rewards of the transitions, [decision].
        n_steps: their grid steps, [decision].
        gamma: discount of a grid step.
    """
    returns, later = np.zeros(len(rewards)), 0.0
    for k in reversed(range(len(rewards))):
        later = rewards[k] + gamma ** int(n_steps[k]) * later
        returns[k] = later
    return returns


def _is_less_better(values: Any) -> bool:
    """Whether of values, the best first, less is better."""
    return len(values) > 1 and bool(values[0] < values[-1])


def _stacked(rows: list[Any], size: int, dtype: Any) -> Any:
    """Rows one below the other, [row, size], also if there are none."""
    return np.stack(rows).astype(dtype, copy=False) if rows else np.zeros((0, size), dtype)
