"""Observations with what an operator knows beside the paper's features: the keyword ``operator_features``."""

from __future__ import annotations

from datetime import datetime

import numpy as np

from rl2grid.arrays import F32, I64
from rl2grid.engines.base import Engine
from rl2grid.envs.tasks import Task
from rl2grid.handles import Handle
from rl2grid.mdp.features import OPERATOR_FEATURES, observation_size, operator_groups
from rl2grid.mdp.operator_features import write_operator_features
from rl2grid.mdp.security import Security, new_security
from rl2grid.mdp.state import GridState
from rl2grid.structures import with_own_workspace

_EPOCH = datetime(1970, 1, 1)
_MINUTE = 60


class OperatorFeatures:
    """Writes the groups that were asked for behind the other features of an observation."""

    def __init__(self, task: Task, names: str, engine: Engine, shift: F32, scale: F32) -> None:
        """What writes the features of the environments of an engine.

        Args:
            task: of the environments.
            names: the value of the keyword; see :func:`rl2grid.mdp.features.operator_groups`.
            engine: plays them.
            shift: of whole observations, float32 [feature].
            scale: likewise.
        """
        grid, n = task.grid, len(engine.state.step)
        chosen = operator_groups(names)
        self._groups = np.array([group in chosen for group in OPERATOR_FEATURES])
        self._first = observation_size(grid, task.kind)
        self._shift, self._scale = shift[self._first :], scale[self._first :]
        self._overflow_allowed = grid.rules.overflow_allowed
        self._began = np.zeros(n, np.int64)
        # Every environment its own: the factors of its topology are kept.
        self._securities: list[Handle[Security]] = []
        if "security" in chosen:
            security = new_security(grid, engine.network, engine.attacks)
            self._securities = [Handle(with_own_workspace(security)) for _ in range(n)]
        self._addresses = np.array([each.address for each in self._securities] or [0] * n, np.int64)

    def begin(self, i: int, began: datetime) -> None:
        """The episode of row ``i`` has begun at this time in its scenario."""
        self._began[i] = round((began - _EPOCH).total_seconds()) // _MINUTE

    def write(self, state: GridState, rows: I64, out: F32) -> None:
        """Write what is observed of ``rows``, scaled, to the same rows of ``out``, float32 [n, feature].

        Args:
            state: of all rows, opened for compiled functions.
            rows: int64 [k].
            out: observations.
        """
        self._write(state, rows, rows, rows, out)
        out[rows, self._first :] = (out[rows, self._first :] - self._shift) / self._scale

    def write_raw(self, state: GridState, row: int, i: int, out: F32) -> None:
        """Write what is observed of one environment, in raw units, to ``out``, float32 [feature].

        Args:
            state: of all rows, or a forecast, opened for compiled functions.
            row: which of its rows.
            i: the environment.
            out: an observation.
        """
        self._write(state, np.array([row]), np.array([i]), np.zeros(1, np.int64), out[np.newaxis])

    def _write(self, state: GridState, rows: I64, environments: I64, places: I64, out: F32) -> None:
        write_operator_features(
            state,
            rows,
            self._groups,
            self._began[environments],
            self._addresses[environments],
            self._overflow_allowed,
            self._first,
            places,
            out,
        )
