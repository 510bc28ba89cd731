"""Rows on the reference engine in this process, played one after the other."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import I64
from rl2grid.envs.description import one_by_one
from rl2grid.envs.engine_rows import EngineRows
from rl2grid.mdp.actions import StepAction
from rl2grid.scenarios.episodes import EpisodePlan


class LocalRows(EngineRows[list[StepAction]]):
    """:class:`~rl2grid.envs.rows.Rows` that need Python at every step."""

    def _decide(self, actions: Any) -> list[StepAction]:
        return [self._step_action(action) for action in one_by_one(self.task, actions)]

    def _play(self, rows: I64, decisions: list[StepAction]) -> None:
        for i in rows.tolist():
            self.transitions.play(i, decisions[i])

    def _effects(self, decisions: list[StepAction]) -> NDArray[np.object_]:
        effects = np.empty(self._n, object)
        effects[:] = [self.transitions.action_effects[i] for i in range(self._n)]
        return effects

    def _start(self, rows: I64, plans: list[EpisodePlan]) -> None:
        for i, plan in zip(rows.tolist(), plans, strict=True):
            self.transitions.reset(i, plan)

    def _observations(self) -> NDArray[np.float32]:
        observations = np.zeros((self._n, self._size), np.float32)
        for i in range(self._n):
            self.write_observation(i, observations[i])
        return observations

    def observations_of(self, rows: I64) -> NDArray[np.float32]:
        observations = np.zeros((len(rows), self._size), np.float32)
        for i, observation in zip(rows.tolist(), observations, strict=True):
            self.write_observation(i, observation)
        return observations
