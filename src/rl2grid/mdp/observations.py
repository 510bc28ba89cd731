"""Writes what an agent observes: the features of :mod:`rl2grid.mdp.features`, in their order and in raw units."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import F32
from rl2grid.compile import jit
from rl2grid.mdp.features import check_kind
from rl2grid.mdp.state import GridState


def observation_writer(kind: str) -> Callable[[GridState, int, F32], None]:
    """The compiled ``(state, i, out)`` that writes a raw observation of row ``i`` to ``out``, float32 [feature].

    Raises:
        UsageError: ``kind`` is none of :data:`~rl2grid.mdp.features.KINDS`.
    """
    check_kind(kind)
    writers = {"T": write_topology_observation, "R": write_redispatch_observation, "H": write_joint_observation}
    return writers[kind]


@jit
def write_topology_observation(state: GridState, i: int, out: F32) -> None:
    """Write what a topology task observes in row ``i`` to ``out``, float32 [feature], in raw units."""
    _write_planned_and_stored(state, i, out, _write_topology(state, i, out, _write_shared(state, i, out)))


@jit
def write_redispatch_observation(state: GridState, i: int, out: F32) -> None:
    """Write what a redispatching task observes in row ``i`` to ``out``, float32 [feature], in raw units."""
    _write_planned_and_stored(state, i, out, _write_dispatch(state, i, out, _write_shared(state, i, out)))


@jit
def write_joint_observation(state: GridState, i: int, out: F32) -> None:
    """Write what a joint task observes in row ``i`` to ``out``, float32 [feature], in raw units."""
    end = _write_topology(state, i, out, _write_shared(state, i, out))
    _write_planned_and_stored(state, i, out, _write_dispatch(state, i, out, end))


@jit
def _write_shared(state: GridState, i: int, out: F32) -> int:
    out[0] = np.float32(np.float64(state.step[i]) / np.float64(state.episode_length[i]))
    end = _write(state.gen_p[i], out, 1)
    end = _write(state.gen_theta[i], out, end)
    end = _write(state.load_p[i], out, end)
    end = _write(state.load_theta[i], out, end)
    end = _write(state.rho[i], out, end)
    return _write(state.time_before_cooldown_line[i], out, end)


@jit
def _write_topology(state: GridState, i: int, out: F32, begin: int) -> int:
    end = _write(state.topo_vect[i], out, begin)
    end = _write(state.line_status[i], out, end)
    end = _write(state.timestep_overflow[i], out, end)
    return _write(state.time_before_cooldown_sub[i], out, end)


@jit
def _write_dispatch(state: GridState, i: int, out: F32, begin: int) -> int:
    end = _write(state.target_dispatch[i], out, begin)
    end = _write(state.actual_dispatch[i], out, end)
    end = _write(state.gen_margin_up[i], out, end)
    end = _write(state.gen_margin_down[i], out, end)
    end = _write(state.gen_p_before_curtail[i], out, end)
    end = _write(state.curtailment[i], out, end)
    return _write(state.curtailment_limit[i], out, end)


@jit
def _write_planned_and_stored(state: GridState, i: int, out: F32, begin: int) -> None:
    end = _write(state.time_next_maintenance[i], out, begin)
    end = _write(state.duration_next_maintenance[i], out, end)
    end = _write(state.storage_charge[i], out, end)
    end = _write(state.storage_power_target[i], out, end)
    end = _write(state.storage_power[i], out, end)
    _write(state.storage_theta[i], out, end)


@jit
def _write(row: NDArray[Any], out: F32, begin: int) -> int:
    size: int = row.shape[0]
    part = out[begin : begin + size]
    for k in range(size):
        part[k] = np.float32(row[k])
    return begin + size
