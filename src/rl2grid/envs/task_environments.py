"""Environments of one task on one engine, addressed by row: what all Gymnasium classes play."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from datetime import datetime
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import I64
from rl2grid.engines.action_effects import clipping, refusal
from rl2grid.engines.base import Engine
from rl2grid.engines.transition import Listener, Transitions
from rl2grid.engines.worlds import Standing, Trail, World
from rl2grid.envs.description import action_number, action_numbers, step_action, task_catalogue
from rl2grid.envs.episode_table import EpisodeTable, StreamPositions
from rl2grid.envs.info import episode_info
from rl2grid.envs.operation import Operation, operation_of
from rl2grid.envs.operator_features import OperatorFeatures
from rl2grid.envs.options import TaskOptions
from rl2grid.envs.tasks import Task
from rl2grid.errors import UsageError
from rl2grid.mdp.actions import (
    ActionCatalogue,
    StepAction,
    action_set_hash,
    legal_actions,
)
from rl2grid.mdp.features import feature_slices, physical_scale
from rl2grid.mdp.heuristics import SAFE_RHO
from rl2grid.mdp.legality import verdict_on
from rl2grid.mdp.observations import observation_writer
from rl2grid.mdp.rewards import resolve_reward, reward_name
from rl2grid.mdp.state import GridState
from rl2grid.scenarios.episodes import EpisodePlan, PlannedStarts, plan_episode
from rl2grid.scenarios.library import open_series
from rl2grid.scenarios.scenario import STEP

if TYPE_CHECKING:
    from rl2grid.engines.native.engine import NativeEngine
    from rl2grid.engines.native.what_if import ActionOutcomes, FirstSafe, OutageOutcomes, WhatIf

OF_MASKS = "only topology actions have masks"
"""What is said where masks are asked for and there are none."""
_RESET_OPTIONS = ("scenario", "start")


@dataclass(frozen=True)
class SimulationResult:
    """What an action would bring on the forecast, without opponent and heuristic."""

    observation: NDArray[np.float32]
    """float32 [feature], as ``step`` returns it."""
    reward: float
    cost: float
    """Cost of the task's constraint; ``info["costs"]`` has both."""
    terminated: bool
    """The grid would collapse."""
    info: dict[str, Any]


def make_transitions(task: Task, options: TaskOptions, n: int) -> Transitions:
    """The transitions of ``n`` environments on the engine that ``options`` asks for."""
    reward = resolve_reward(options.reward)
    gamma = 1.0 if options.gamma is None else options.gamma
    # Engines are imported here: each loads much that the other does not need.
    if options.engine == "reference":
        from rl2grid.engines.reference.engine import ReferenceEngine

        reference = ReferenceEngine(task.grid, n, options.dispatch, options.opponent)
        return Transitions(reference, options.heuristic, task.kind, reward, gamma)
    from rl2grid.engines.native.engine import NativeEngine
    from rl2grid.engines.native.transitions import NativeTransitions

    native = NativeEngine(task.grid, n, options.dispatch, options.opponent)
    return NativeTransitions(native, options.heuristic, task.kind, reward, gamma)


class TaskEnvironments:
    """``n`` environments of one task, addressed by row: an engine's transitions as agents see them.

    What an engine computes with is :class:`rl2grid.engines.native.environments.Environments`, which knows no task. The
    single environment plays row 0 of one; :mod:`rl2grid.envs.rows` plays all rows together.
    """

    def __init__(self, task: Task, options: TaskOptions, n: int) -> None:
        self.task, self.options, self.grid = task, options, task.grid
        self.constraint = options.constraint
        self.transitions = make_transitions(task, options, n)
        self.engine: Engine = self.transitions.engine
        self._write_observation = observation_writer(task.kind)
        shift, scale = physical_scale(self.grid, task.kind, options.operator_features)
        if options.normalize != "physical":
            shift, scale = np.zeros_like(shift), np.ones_like(scale)
        self._size = len(shift)
        self._normaliser = shift, scale
        self._operator: OperatorFeatures | None = None
        if options.operator_features is not None:
            self._operator = OperatorFeatures(task, options.operator_features, self.engine, shift, scale)
        self._catalogue = task_catalogue(task, self.grid)
        self._hash = action_set_hash(self.grid, task.level) if task.changes_topology else None
        self._episodes = EpisodeTable(n, options.maintenance)
        self._pending = np.zeros(n, np.bool_)  # the episode ended inside reset, its ending is still to be returned
        self._solver: WhatIf | None = None
        self.imagined = np.zeros(n, np.bool_)
        """bool [n], which rows play an imagined world."""
        self.foresight = np.zeros(n, np.int64)
        """int64 [n], decisions of the running episode taken where its truth had been seen before."""
        self._trails: dict[int, Trail] = {}  # of rows of which a true world was saved or restored; others need none
        self._keywords = tuple((each.name, _in_words(getattr(options, each.name))) for each in fields(options))

    @property
    def state(self) -> GridState:
        return self.engine.state

    def begin(self, i: int, seed: int | None, options: dict[str, Any] | None) -> None:
        """Begin an episode in row ``i``: the first of ``seed``'s stream, or the next one of the running stream.

        Raises:
            UsageError: an option is unknown, or names a scenario or start that does not exist.
        """
        position = self._following(np.array([i]), [seed], options)
        (plan,) = self._plans(position)
        self._take_one(i, plan, int(position.grid_steps[0]), position.options)
        self.transitions.reset(i, plan)
        self._pending[i] = self.is_over(i)

    def play(self, i: int, action: Any) -> None:
        """Play the agent's action and the heuristic steps to the next decision.

        Raises:
            UsageError: the action has the wrong shape or value, or the episode is over.
        """
        self._check_begun(i)
        played = self._step_action(action)
        if self._pending[i]:
            self._pending[i] = False
            return
        if self.is_over(i):
            raise UsageError("The episode is over: call reset before the next step.")
        self._note_decisions()
        self.transitions.play(i, played)
        self._note_reached()

    def is_over(self, i: int) -> bool:
        """The episode of row ``i`` was lost or completed."""
        return bool(self.state.terminated[i] or self.state.truncated[i])

    def write_observation(self, i: int, out: NDArray[np.float32]) -> None:
        """Write the observation of row ``i`` to ``out``, float32 [feature]."""
        self._observe(i, out)
        self._scale(out)

    def observe(self, i: int, scaled: bool) -> dict[str, NDArray[np.float32]]:
        """The observation of row ``i`` by name; see :meth:`rl2grid.envs.row_view.RowMethods.observe`."""
        self._check_begun(i)
        values = np.zeros(self._size, np.float32)
        self._observe(i, values)
        if scaled:
            self._scale(values)
        slices = feature_slices(self.grid, self.task.kind, self.options.operator_features)
        return {name: values[part] for name, part in slices.items()}

    def reward(self, i: int) -> float:
        """Sum of the rewards of the last transition."""
        return float(self.state.transition_reward[i])

    def info(self, i: int) -> dict[str, Any]:
        """The ``info`` of row ``i``; see :data:`rl2grid.envs.info.INFO_KEYS`."""
        plan, state = self._plan(i), self.state
        info = {**_start_info(plan), **episode_info(state, i, self.constraint)}
        info["action_effect"] = self.transitions.action_effects[i]
        info["grid_steps"] = self._episodes.earlier_steps(i) + info["step"]
        info["over"] = bool(self._pending[i])
        if self.options.gamma is not None:
            info["discounted_reward"] = float(state.transition_discounted[i])
        if self._hash is not None:
            info["action_set_hash"] = self._hash
        return info

    def write_action_mask(self, i: int, out: NDArray[np.bool_]) -> None:
        """Write to ``out`` [action] which topology actions are legal in row ``i``."""
        catalogue = self._topology_catalogue(OF_MASKS)
        legal_actions(self.transitions.opened_state, i, catalogue.kind, catalogue.target, out)

    def _topology_catalogue(self, rule: str) -> ActionCatalogue:
        """The topology actions of the task.

        Args:
            rule: what is said where it has none.
        """
        if self._catalogue is None:
            raise UsageError(f"{self.task.id} has continuous actions: {rule}.")
        return self._catalogue

    def simulate(self, i: int, action: Any, horizon: int) -> SimulationResult:
        """What one step of ``action`` would bring on the forecast; see :meth:`PowerGridEnv.simulate`."""
        if not isinstance(horizon, int) or horizon < 1:
            raise UsageError(f"horizon={horizon!r} is not allowed: give a number of steps, at least 1.")
        played = self._step_action(action)
        if not self._is_playing(i):
            raise UsageError("There is no episode in progress to simulate from: call reset first.")
        effect = refusal(self.grid, verdict_on(self.state, i, played))
        result = self.transitions.simulate(i, played, horizon)
        observation = np.zeros(self._size, np.float32)
        forecast = self.transitions.opened_result(result)
        self._write_observation(forecast, 0, observation)
        if self._operator is not None:
            self._operator.write_raw(forecast, 0, i, observation)
        self._scale(observation)
        info = {**_start_info(self._plan(i)), **episode_info(result, 0, self.constraint)}
        info["action_effect"] = effect or clipping(self.grid, result, 0, played)
        reward = float(result.transition_reward[0])
        return SimulationResult(observation, reward, info["cost"], bool(result.terminated[0]), info)

    def clock(self, i: int, step: int) -> datetime:
        """The time in the scenario after ``step`` steps of the episode of row ``i``."""
        return self._beginning(i) + step * STEP

    def what_if(self, i: int, actions: Sequence[int] | None) -> ActionOutcomes:
        """What each action would do in the next step; see :meth:`PowerGridEnv.what_if`."""
        catalogue = self._topology_catalogue("a what-if is of topology actions")
        ids = None if actions is None else action_numbers(actions, len(catalogue))
        from rl2grid.engines.native.what_if import Moment, what_if

        return what_if(self._native_engine(i), i, catalogue, ids, Moment.NEXT_STEP)

    def first_safe(self, i: int, actions: Sequence[int]) -> FirstSafe:
        """Which of some actions to play; see :meth:`PowerGridEnv.first_safe`."""
        catalogue = self._topology_catalogue("a what-if is of topology actions")
        ids = action_numbers(actions, len(catalogue))
        from rl2grid.engines.native.what_if import first_safe

        return first_safe(self._native_engine(i), i, catalogue, ids, float(SAFE_RHO))

    def security(self, i: int) -> OutageOutcomes:
        """What the loss of each line would do now; see :meth:`PowerGridEnv.security`."""
        from rl2grid.engines.native.what_if import outages

        return outages(self._native_engine(i), i)

    def security_after(self, i: int, action: int) -> OutageOutcomes:
        """What the loss of each line would do after an action; see :meth:`PowerGridEnv.security`."""
        catalogue = self._topology_catalogue("N-1 after an action is of topology actions")
        played = catalogue[action_number(action, len(catalogue))]
        engine = self._native_engine(i)
        from rl2grid.engines.native.what_if import WhatIf
        from rl2grid.envs.outages_after_action import outages_after

        if self._solver is None:
            self._solver = WhatIf(self.grid)
        return outages_after(engine, i, played, self._solver)

    def n_minus_1_score(self, i: int) -> float:
        """Share of the outages that leave the grid safe; see :meth:`PowerGridEnv.n_minus_1_score`."""
        from rl2grid.engines.native.what_if import n_minus_1_score

        return n_minus_1_score(self._native_engine(i), i)

    def _native_engine(self, i: int) -> NativeEngine:
        if not self._is_playing(i):
            raise UsageError("There is no episode in progress to ask about: call reset first.")
        if self.options.engine != "native":
            raise UsageError('A what-if is answered by the native engine only: choose engine="native".')
        return cast("NativeEngine", self.engine)

    def save(self, i: int) -> World:
        """Everything of row ``i`` at this moment.

        Raises:
            UsageError: it was not reset yet.
        """
        self._check_begun(i)
        if not self.imagined[i] and i not in self._trails:
            self._trails[i] = Trail(int(self.state.step[i]))
        return self._world(i)

    def restore(self, i: int, world: World) -> None:
        """Bring row ``i`` to where ``world`` was saved.

        Raises:
            UsageError: the world is of another task, of other keywords or of an engine alone, or its series is not to
                be had.
        """
        standing = self._checked_standing(world)
        self.engine.restore(i, world)
        self._take_one(i, standing.plan, standing.earlier_steps, dict(standing.reset_options))
        self.transitions.action_effects[i] = standing.effect
        self._pending[i], self.imagined[i], self.foresight[i] = standing.pending, world.imagined, standing.foresight
        if standing.trail is not None:
            self._trails[i] = standing.trail

    def imagine(self, i: int, seed: int) -> World:
        """A world that goes on from row ``i`` as far as an operator may know; see ``docs/worlds.md``.

        Raises:
            UsageError: the seed is negative, there is no episode in progress, or the engine cannot imagine.
        """
        if not isinstance(seed, int | np.integer) or seed < 0:
            raise UsageError(f"seed={seed!r} is not allowed: give an integer, not negative.")
        self._check_begun(i)
        seed = int(seed)
        standing = self._standing(i)
        # Nobody can know the seed of the true episode, from which attacks follow. Later episodes are another stream's.
        plan = standing.plan._replace(seed=seed, number=0)
        return self.engine.imagine(i, seed).at(replace(standing, seed=seed, number=0, plan=plan, trail=None))

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Environments of their own, which are where these are."""
        rebuild, (kind, arguments, worlds, listeners) = self.__reduce__()
        return cast("Self", rebuild(kind, arguments, worlds, copy.deepcopy(listeners, memo)))

    def __reduce__(self) -> tuple[Any, ...]:
        worlds = [self.save(i) if begun else None for i, begun in enumerate(self._episodes.begun)]
        return _rebuild, (type(self), self._arguments(), worlds, self.transitions.listeners)

    def _arguments(self) -> tuple[Any, ...]:
        """What these environments were made with."""
        return self.task, self.options, len(self._pending)

    def _world(self, i: int) -> World:
        return self.engine.save(i).at(self._standing(i))

    def _standing(self, i: int) -> Standing:
        plan = self._plan(i)
        return Standing(
            task=self.task.id,
            options=self._keywords,
            seed=plan.seed,
            number=plan.number,
            reset_options=tuple(self._episodes.options(i).items()),
            earlier_steps=self._episodes.earlier_steps(i),
            pending=bool(self._pending[i]),
            plan=plan,
            effect=self._effect(i),
            foresight=int(self.foresight[i]),
            trail=self._trails.get(i),
        )

    def _effect(self, i: int) -> str:
        """What was refused or clipped of the last action in row ``i``."""
        return self.transitions.action_effects[i]

    def _checked_standing(self, world: World) -> Standing:
        standing = world.standing
        if standing is None:
            raise UsageError("This world is of an engine alone: restore one that an environment has saved.")
        if standing.task != self.task.id:
            raise UsageError(f"This world is of {standing.task}: it cannot be restored in {self.task.id}.")
        saved = dict(standing.options)
        if set(saved) != {name for name, _ in self._keywords}:
            raise UsageError(
                f"This world was saved by another version of rl2grid, whose environments have the keywords "
                f"{', '.join(saved)}: play the episode, or the training, again."
            )
        for name, mine in self._keywords:
            theirs = saved[name]
            if theirs != mine:
                raise UsageError(f"This world is of an environment with {name}={theirs}, this one has {name}={mine}.")
        return standing

    def _note_decisions(self) -> None:
        """Before a step: count those that are taken where the truth was seen before."""
        for i, trail in self._trails.items():
            self.foresight[i] += self.state.step[i] < trail.furthest and not self.is_over(i)

    def _note_reached(self) -> None:
        """After a step: note how far the truth has been seen."""
        for i, trail in self._trails.items():
            trail.furthest = max(trail.furthest, int(self.state.step[i]))

    def operation(self, i: int) -> Operation:
        """What the episode of row ``i`` has cost so far.

        Raises:
            UsageError: the environment was not reset yet.
        """
        return operation_of(self.state, i, self.grid.id, self._plan(i))

    def close(self) -> None:
        self.engine.close()

    def _check_begun(self, i: int) -> None:
        if not self._episodes.begun[i]:
            raise UsageError("The environment was not reset yet: call reset first.")

    def _is_playing(self, i: int) -> bool:
        return bool(self._episodes.begun[i]) and not self.is_over(i)

    def _plan(self, i: int) -> EpisodePlan:
        """What was decided of the episode of row ``i``."""
        self._check_begun(i)
        return self._episodes.plan(i, int(self.state.episode_length[i]))

    def _take_one(self, i: int, plan: EpisodePlan, grid_steps: int, options: Mapping[str, Any]) -> None:
        """Move row ``i`` to an episode of its stream."""
        self._episodes.take_one(i, plan, grid_steps, options)
        self._forget(i)

    def _take(self, rows: I64, positions: StreamPositions, starts: PlannedStarts) -> None:
        """Move ``rows`` to episodes of their streams, an entry each."""
        self._episodes.take(rows, positions, starts)
        if self._operator is None and not self._trails:
            self.imagined[rows], self.foresight[rows] = False, 0
            return
        for i in rows.tolist():
            self._forget(i)

    def _forget(self, i: int) -> None:
        """Leave behind what was noted of the last episode of row ``i``."""
        self.imagined[i], self.foresight[i] = False, 0
        self._trails.pop(i, None)
        if self._operator is not None:
            self._operator.begin(i, self._beginning(i))

    def _following(self, rows: I64, seeds: list[int | None] | None, options: dict[str, Any] | None) -> StreamPositions:
        """The episodes that ``rows`` play next; see :meth:`EpisodeTable.following`."""
        options = options or {}
        for name in options:
            if name not in _RESET_OPTIONS:
                raise UsageError(f"Reset option {name!r} does not exist: choose from {', '.join(_RESET_OPTIONS)}.")
        return self._episodes.following(rows, seeds, options, self.state.step)

    def _beginning(self, i: int) -> datetime:
        """The time in the scenario when the episode of row ``i`` began."""
        plan = self._plan(i)
        return open_series(self.grid.id, plan.scenario_id).start_datetime + plan.start * STEP

    def _plans(self, positions: StreamPositions) -> list[EpisodePlan]:
        """Decide the episodes of ``positions``."""
        scenario, start = positions.options.get("scenario", self.options.scenario), positions.options.get("start")
        return [
            plan_episode(
                self.grid,
                self.options.split,
                seed,
                number,
                scenario=scenario,
                start=start,
                maintenance=self.options.maintenance,
                episode_length=self.options.episode_length,
            )
            for seed, number in zip(positions.seeds, positions.numbers.tolist(), strict=True)
        ]

    def _observe(self, i: int, out: NDArray[np.float32]) -> None:
        """Write what is observed of row ``i``, in raw units."""
        state = self.transitions.opened_state
        self._write_observation(state, i, out)
        if self._operator is not None:
            self._operator.write_raw(state, i, i, out)

    def _scale(self, out: NDArray[np.float32]) -> None:
        shift, scale = self._normaliser
        out -= shift
        out /= scale

    def _step_action(self, action: Any) -> StepAction:
        return step_action(self.task, self.grid, self._catalogue, action)


def _rebuild(
    kind: type[TaskEnvironments], arguments: tuple[Any, ...], worlds: list[World | None], listeners: list[Listener]
) -> TaskEnvironments:
    """The environments that were copied or pickled."""
    environments = kind(*arguments)
    environments.transitions.listeners.extend(listeners)
    for i, world in enumerate(worlds):
        if world is not None:
            environments.restore(i, world)
    return environments


def _in_words(value: Any) -> str:
    return reward_name(value) if callable(value) else repr(value)


def _start_info(plan: EpisodePlan) -> dict[str, Any]:
    return {"scenario": plan.scenario_id, "start": plan.start, "start_redraws": plan.redraws}
