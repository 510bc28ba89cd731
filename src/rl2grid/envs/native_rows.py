"""Rows on the native engine, played together in compiled code."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import F32, I64
from rl2grid.engines.native.orders import refer_to_choices
from rl2grid.engines.native.transitions import Commands, NativeTransitions, commands_of
from rl2grid.envs.engine_rows import EngineRows
from rl2grid.envs.episode_table import StreamPositions
from rl2grid.envs.options import TaskOptions
from rl2grid.envs.tasks import Task
from rl2grid.grids import find_system
from rl2grid.mdp.actions import DO_NOTHING, INJECTION, TOPOLOGY
from rl2grid.mdp.features import observation_size
from rl2grid.scenarios.episodes import MAX_STEPS, EpisodePlan, PlannedStarts
from rl2grid.scenarios.months import GeneratedScenarios
from rl2grid.scenarios.splits import TRAIN

_LARGEST_SEED = 2**63 - 1


class NativeRows(EngineRows[Commands]):
    """:class:`~rl2grid.envs.rows.Rows` that play all of them in one call."""

    transitions: NativeTransitions

    def __init__(self, task: Task, options: TaskOptions, n: int, num_threads: int | None) -> None:
        super().__init__(task, options, n)
        self.num_threads = num_threads or os.cpu_count() or 1
        self._injections = replace(commands_of(task.grid, [DO_NOTHING] * n), injects=np.ones(n, np.bool_))
        self._no_injection = (np.zeros(n, np.bool_), np.zeros((n, 0), np.float32))
        if self._catalogue is not None:  # numbers as the engine takes them
            kinds, targets = self._catalogue.kind.astype(np.int64), self._catalogue.target.astype(np.int64)
            self._changes = kinds, targets, self._catalogue.mask.copy()
            if task.injects:
                kinds, targets, masks = self._changes
                self._injections = replace(self._injections, kinds=kinds, targets=targets, masks=masks)
        first = observation_size(task.grid, task.kind)
        self._engine_normaliser = tuple(constants[:first] for constants in self._normaliser)
        self._buffers = [np.zeros((n, self._size), np.float32) for _ in range(2)]
        self._last = np.zeros((n, self._size), np.float32)

    def _arguments(self) -> tuple[Any, ...]:
        return *super()._arguments(), self.num_threads

    def _decide(self, actions: Any) -> Commands:
        if self.task.kind == "H":
            chosen, end = self._choices(actions[TOPOLOGY], actions)
            return replace(self._injections, first=chosen, end=end, values=self._values(actions[INJECTION], actions))
        if self._catalogue is None:
            return replace(self._injections, values=self._values(actions, actions))
        chosen, end = self._choices(actions, actions)
        return Commands(chosen, end, *self._changes, *self._no_injection)

    def _play(self, rows: I64, decisions: Commands) -> None:
        self.transitions.play_rows(rows, decisions.take(rows), self.num_threads)

    def _effects(self, decisions: Commands) -> NDArray[np.object_]:
        return self.transitions.action_effects_of(decisions)

    def _begin_episodes(self, rows: I64, positions: StreamPositions) -> PlannedStarts:
        if not self._plays_library(positions):
            return super()._begin_episodes(rows, positions)
        return self.transitions.begin_training(
            rows,
            positions.seeds.astype(np.int64),
            positions.numbers,
            self.options.maintenance,
            self.num_threads,
            self.options.episode_length or MAX_STEPS,
        )

    def _plays_library(self, positions: StreamPositions) -> bool:
        """Whether episodes are drawn from the library of training years, and nobody chooses anything of them."""
        if positions.options or not self.transitions.is_compiled or max(positions.seeds, default=0) > _LARGEST_SEED:
            return False
        if self.options.split != TRAIN or self.options.scenario is not None:
            return False
        scenarios = find_system(self.grid.id).scenarios
        return isinstance(scenarios, GeneratedScenarios) and scenarios.generator_version(TRAIN) is not None

    def _start(self, rows: I64, plans: list[EpisodePlan]) -> None:
        if not self.transitions.is_compiled:
            for i, plan in zip(rows.tolist(), plans, strict=True):
                self.transitions.reset(i, plan)
            return
        for i, plan in zip(rows.tolist(), plans, strict=True):
            self.transitions.engine.prepare(i, plan)
            self.transitions.action_effects[i] = ""
        self.transitions.begin_rows(rows, self.num_threads)

    def _observations(self) -> NDArray[np.float32]:
        self._buffers.reverse()
        self._write_observations(self._rows, self._buffers[0])
        return self._buffers[0]

    def observations_of(self, rows: I64) -> NDArray[np.float32]:
        self._write_observations(rows, self._last)
        return self._last[rows]

    def _write_observations(self, rows: I64, out: F32) -> None:
        shift, scale = self._engine_normaliser
        self.transitions.write_observations(rows, shift, scale, out)
        if self._operator is not None:
            self._operator.write(self.transitions.opened_state, rows, out)

    def _choices(self, ids: Any, actions: Any) -> tuple[I64, I64]:
        """Topology actions as the engine takes them: the first change of each and the one behind its last, int64 [n].

        Args:
            ids: of the topology actions, one per row.
            actions: of which they are a part, or all.
        """
        assert self._catalogue is not None
        numbers = np.asarray(ids)
        if numbers.shape != (self._n,) or numbers.dtype.kind not in "iu":
            self._check(actions)
        chosen, end = numbers.astype(np.int64), np.empty(self._n, np.int64)
        if not refer_to_choices(chosen, len(self._catalogue), end):
            self._check(actions)
        return chosen, end

    def _values(self, injections: Any, actions: Any) -> F32:
        """Injections as the engine takes them, float32 [n, continuous]; ``actions`` are what they are a part of."""
        try:
            values = np.array(injections, np.float32, order="C")
        except (TypeError, ValueError):
            self._check(actions)
            raise
        # NaN compares as false.
        if values.shape != (self._n, self.task.n_injections) or not (np.abs(values) <= 1).all():
            self._check(actions)
        return values
