"""Many environments of one task on the native engine, stepped together in compiled code."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.engines.native.transitions import Commands, NativeTransitions
from rl2grid.envs.info import batch_info
from rl2grid.envs.player import TaskPlayer, check_action
from rl2grid.envs.tasks import Task, TaskOptions
from rl2grid.errors import UsageError
from rl2grid.mdp.actions import ActionKind
from rl2grid.mdp.features import observation_size

Flags = NDArray[np.bool_]
Rows = NDArray[np.int64]


@dataclass
class NativeBatch:
    """What a step or reset of all environments returns."""

    observations: NDArray[np.float32]
    """float32 [n, feature]: one of two buffers, which take turns; valid until the step after the next."""
    rewards: NDArray[np.float64]
    """float64 [n]; zero after a reset."""
    terminated: Flags
    truncated: Flags
    info: dict[str, Any]
    """Arrays [n]: every environment has every key."""
    endings: dict[int, dict[str, Any]]
    """By row: ``final_obs`` and ``final_info`` of the episodes that ended in this step."""


class NativePlayer(TaskPlayer):
    """A :class:`~rl2grid.envs.player.TaskPlayer` that also plays all its rows in one call."""

    transitions: NativeTransitions

    def __init__(self, task: Task, options: TaskOptions, n: int, num_threads: int | None) -> None:
        super().__init__(task, options, n)
        self._n = n
        self._num_threads = num_threads or os.cpu_count() or 1
        size = observation_size(task.grid, task.kind)
        self._buffers = [np.zeros((n, size), np.float32) for _ in range(2)]
        self._rows = np.arange(n)
        self._scenarios = np.full(n, "", object)
        self._starts = np.zeros(n, np.int64)
        self._redraws = np.zeros(n, np.int64)
        self._earlier_steps = np.zeros(n, np.int64)  # grid steps of earlier episodes of a seed's stream
        self._nothing_said = np.full(n, "", object)

    def reset(self, i: int, seed: int | None, options: dict[str, Any] | None) -> None:
        """Begin an episode in row ``i``; see :meth:`TaskPlayer.reset`."""
        super().reset(i, seed, options)
        self._note_plan(i)

    def reset_all(self, seeds: list[int | None], options: dict[str, Any] | None) -> NativeBatch:
        """Begin an episode in every row."""
        self._begin(self._rows, seeds, options)
        return self._batch(self._nothing_said.copy())

    def step_all(self, actions: Any) -> NativeBatch:
        """Step every row; an ended episode makes way for the next one in the same step.

        Raises:
            UsageError: an action has the wrong shape or value, or nothing was reset yet; then no row has stepped.
        """
        commands = self._commands(actions)
        rows, waiting = self._rows, self._pending.copy()
        if waiting.any():  # these rows return the ending that their reset has already played
            rows = np.flatnonzero(~waiting)
            self._pending[:] = False
        self.transitions.play_rows(rows, commands.take(rows), self._num_threads)
        effects = self.transitions.effects_of(commands)
        effects[waiting] = ""
        state = self.state
        rewards, terminated, truncated = state.transition_reward.copy(), state.terminated.copy(), state.truncated.copy()
        ended = np.flatnonzero(terminated | truncated)
        endings = {i: self._ending(i, str(effects[i])) for i in ended.tolist()}
        if len(ended):
            self._begin(ended, [None] * len(ended), None)
            effects[ended] = ""
        batch = self._batch(effects)
        batch.rewards, batch.terminated, batch.truncated, batch.endings = rewards, terminated, truncated, endings
        return batch

    def restore_all(self, rows: list[dict[str, Any]]) -> NativeBatch:
        """Bring every row to where ``rows`` say it was; see :meth:`TaskPlayer.load_state_dict`."""
        self.load_state_dict(rows)
        return self._batch(self._nothing_said.copy())

    def action_masks(self) -> Flags:
        """Legal actions, bool [row, action]."""
        masks = np.zeros((self._n, self.task.n_actions), np.bool_)
        for i in range(self._n):
            self.write_action_mask(i, masks[i])
        return masks

    def _begin(self, rows: Rows, seeds: list[int | None], options: dict[str, Any] | None) -> None:
        if not self.transitions.is_compiled:
            for i, seed in zip(rows.tolist(), seeds, strict=True):
                self.reset(i, seed, options)
            return
        # All or none: no row may have begun when another's options are refused.
        seats = [self._next_seat(i, seed, options or {}) for i, seed in zip(rows.tolist(), seeds, strict=True)]
        plans = [self._plan(seat) for seat in seats]
        for i, seat, plan in zip(rows.tolist(), seats, plans, strict=True):
            self._seats[i], self._plans[i] = seat, plan
            self.transitions.engine.prepare(i, plan)
            self.transitions.effects[i] = ""
            self._note_plan(i)
        self.transitions.begin_rows(rows, self._num_threads)
        self._pending[rows] = self.state.terminated[rows] | self.state.truncated[rows]

    def _note_plan(self, i: int) -> None:
        plan, seat = self._plans[i], self._seat(i)
        assert plan is not None
        self._scenarios[i], self._starts[i], self._earlier_steps[i] = plan.scenario_id, plan.start, seat.grid_steps
        self._redraws[i] = plan.redraws

    def _commands(self, actions: Any) -> Commands:
        """The actions of all rows, checked, and noted in their seats."""
        seats = [self._seat(i) for i in range(self._n)]
        given = len(actions) if hasattr(actions, "__len__") else 1
        if given != self._n:
            raise UsageError(f"{given} actions were given for {self._n} environments: give one each.")
        commands = self._continuous(actions) if self._catalogue is None else self._discrete(actions)
        history = commands.values if self._catalogue is None else np.asarray(actions).tolist()
        for seat, action in zip(seats, history, strict=True):
            seat.actions.append(action)
        return commands

    def _discrete(self, actions: Any) -> Commands:
        assert self._catalogue is not None
        numbers = np.asarray(actions)
        valid = numbers.shape == (self._n,) and np.issubdtype(numbers.dtype, np.integer)
        if not valid or numbers.min() < 0 or numbers.max() >= len(self._catalogue):
            self._refuse(actions)
        kinds, targets, masks = self._catalogue.kind, self._catalogue.target, self._catalogue.mask
        return Commands(
            kinds[numbers].astype(np.int64),
            targets[numbers].astype(np.int64),
            masks[numbers].astype(np.int64),
            np.zeros((self._n, 0), np.float32),
        )

    def _continuous(self, actions: Any) -> Commands:
        try:
            values = np.array(actions, np.float32, order="C")
        except (TypeError, ValueError):
            self._refuse(actions)
            raise
        # NaN compares as false.
        if values.shape != (self._n, self.task.n_actions) or not (np.abs(values) <= 1).all():
            self._refuse(actions)
        zeros = np.zeros(self._n, np.int64)
        return Commands(np.full(self._n, int(ActionKind.INJECTION)), zeros, zeros, values)

    def _refuse(self, actions: Any) -> None:
        """Say what is wrong with the first wrong action."""
        for action in actions:
            check_action(self.task, action)

    def _ending(self, i: int, effect: str) -> dict[str, Any]:
        observation = np.zeros(self._buffers[0].shape[1], np.float32)
        self.write_observation(i, observation)
        self.transitions.effects[i] = effect
        return {"final_obs": observation, "final_info": self.info(i)}

    def _batch(self, effects: NDArray[np.object_]) -> NativeBatch:
        state, n = self.state, self._n
        self._buffers.reverse()
        self.transitions.write_observations(self._rows, *self._normaliser, self._buffers[0])
        info = {
            "scenario": self._scenarios.copy(),
            "start": self._starts.copy(),
            "start_redraws": self._redraws.copy(),
            **batch_info(state, self.constraint),
            "action_effect": effects,
        }
        info["grid_steps"] = self._earlier_steps + info["step"]
        info["over"] = self._pending.copy()
        if self.options.gamma is not None:
            info["discounted_reward"] = state.transition_discounted.copy()
        if self._hash is not None:
            info["action_set_hash"] = np.full(n, self._hash, object)
        off = np.zeros(n, np.bool_)
        return NativeBatch(self._buffers[0], np.zeros(n), off, off.copy(), info, {})
