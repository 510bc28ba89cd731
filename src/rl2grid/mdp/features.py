"""What an agent observes: which features, in which order, and the constants that scale them.

A topology task (kind ``"T"``) and a redispatching task (``"R"``) observe the table's features from top to
bottom (paper, appendix on the state space), and a joint task (``"H"``) all of them. Attributes are Grid2Op's. With
``normalize="physical"`` an entry ``x`` becomes ``(x - shift) / scale``, with constants of the grid that no run has to
estimate:

======================================================= ========= ====== ===== ====================================
feature                                                 unit      tasks  shift scale
======================================================= ========= ====== ===== ====================================
``t``                                                   step / T  T R H  0     1
``gen_p``                                               MW        T R H  0     ``gen_pmax``
``gen_theta``                                           degrees   T R H  0     180 (that is, pi)
``load_p``                                              MW        T R H  0     ``load_p_max``
``load_theta``                                          degrees   T R H  0     180
``rho``                                                 1         T R H  0     1
``time_before_cooldown_line``                           steps     T R H  0     the longest cooldown, see below
``topo_vect``                                           busbar    T H    1     1: the reference is 0, busbar 2 is 1
``line_status``                                         0 or 1    T H    0     1
``timestep_overflow``                                   steps     T H    0     ``rules.overflow_allowed``
``time_before_cooldown_sub``                            steps     T H    0     ``rules.cooldown_sub``
``target_dispatch``, ``actual_dispatch``                MW        R H    0     ``gen_pmax``
``gen_margin_up``                                       MW        R H    0     ``gen_max_ramp_up``
``gen_margin_down``                                     MW        R H    0     ``gen_max_ramp_down``
``gen_p_before_curtail``                                MW        R H    0     ``gen_pmax``
``curtailment``, ``curtailment_limit``                  of pmax   R H    0     1
``time_next_maintenance``                               steps     T R H  0     a week, 2016
``duration_next_maintenance``                           steps     T R H  0     a day's maintenance window
``storage_charge``                                      MWh       T R H  0     ``storage_emax``
``storage_power_target``, ``storage_power``             MW        T R H  0     the unit's larger maximum power
``storage_theta``                                       degrees   T R H  0     180
======================================================= ========= ====== ===== ====================================

What writes them is :mod:`rl2grid.mdp.observations`: this table compiles nothing.

The storage features exist where the grid has storage. The longest cooldown of a line is what a switch, a
protection, an attack or a day's maintenance can set. Where the constant of an element is 0 (a generator
without ramp, a load that is always 0, a rule without cooldown) the scale is 1: the entry stays in its unit.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from rl2grid.arrays import F32
from rl2grid.errors import one_of
from rl2grid.grids import STEPS_PER_HOUR, Grid

KINDS: tuple[str, ...] = ("T", "R", "H")
"""Topology tasks, redispatching tasks, and joint tasks of both."""

_WEEK = 7 * 24 * STEPS_PER_HOUR
_HALF_TURN = 180.0


def feature_slices(grid: Grid, kind: str) -> dict[str, slice]:
    """Where each feature lies in an observation of a task of this kind, in order.

    Raises:
        UsageError: ``kind`` is none of :data:`KINDS`.
    """
    slices: dict[str, slice] = {}
    begin = 0
    for name, _, scale in _layout(grid, kind):
        slices[name] = slice(begin, begin + len(scale))
        begin += len(scale)
    return slices


def observation_size(grid: Grid, kind: str) -> int:
    """Number of entries of an observation.

    Raises:
        UsageError: ``kind`` is none of :data:`KINDS`.
    """
    return sum(len(scale) for _, _, scale in _layout(grid, kind))


def physical_scale(grid: Grid, kind: str) -> tuple[F32, F32]:
    """``shift`` and ``scale``, float32 [feature], of the module's table; no scale is 0.

    Raises:
        UsageError: ``kind`` is none of :data:`KINDS`.
    """
    layout = _layout(grid, kind)
    shift = np.concatenate([np.full(len(scale), shift, np.float32) for _, shift, scale in layout])
    scale = np.concatenate([scale for _, _, scale in layout])
    return shift, np.where(scale > 0, scale, np.float32(1.0))


def changes_topology(kind: str) -> bool:
    """Whether tasks of this kind have topology actions, and observe the topology."""
    return kind in ("T", "H")


def injects(kind: str) -> bool:
    """Whether tasks of this kind redispatch, curtail and store, and observe the dispatch."""
    return kind in ("R", "H")


def check_kind(kind: str) -> None:
    """Refuse what is no kind of task.

    Raises:
        UsageError: ``kind`` is none of :data:`KINDS`.
    """
    if kind not in KINDS:
        raise one_of("Kind of task", kind, KINDS)


@functools.cache
def _layout(grid: Grid, kind: str) -> tuple[tuple[str, float, F32], ...]:
    """(name, shift, scale [entry]) of every feature, in order."""
    check_kind(kind)
    rows = (
        *_shared_features(grid),
        *(_topology_features(grid) if changes_topology(kind) else ()),
        *(_redispatch_features(grid) if injects(kind) else ()),
        *_planned_and_stored_features(grid),
    )
    return tuple((name, shift, np.atleast_1d(np.asarray(scale, np.float32))) for name, shift, scale in rows)


Rows = Iterator[tuple[str, float, ArrayLike]]


def _shared_features(grid: Grid) -> Rows:
    yield "t", 0.0, 1.0
    yield "gen_p", 0.0, grid.gen_pmax
    yield "gen_theta", 0.0, np.full(grid.n_gen, _HALF_TURN)
    yield "load_p", 0.0, grid.load_p_max
    yield "load_theta", 0.0, np.full(grid.n_load, _HALF_TURN)
    yield "rho", 0.0, np.ones(grid.n_line)
    yield "time_before_cooldown_line", 0.0, np.full(grid.n_line, _longest_cooldown(grid))


def _topology_features(grid: Grid) -> Rows:
    yield "topo_vect", 1.0, np.ones(grid.dim_topo)
    yield "line_status", 0.0, np.ones(grid.n_line)
    yield "timestep_overflow", 0.0, np.full(grid.n_line, grid.rules.overflow_allowed)
    yield "time_before_cooldown_sub", 0.0, np.full(grid.n_sub, grid.rules.cooldown_sub)


def _redispatch_features(grid: Grid) -> Rows:
    yield "target_dispatch", 0.0, grid.gen_pmax
    yield "actual_dispatch", 0.0, grid.gen_pmax
    yield "gen_margin_up", 0.0, grid.gen_max_ramp_up
    yield "gen_margin_down", 0.0, grid.gen_max_ramp_down
    yield "gen_p_before_curtail", 0.0, grid.gen_pmax
    yield "curtailment", 0.0, np.ones(grid.n_gen)
    yield "curtailment_limit", 0.0, np.ones(grid.n_gen)


def _planned_and_stored_features(grid: Grid) -> Rows:
    yield "time_next_maintenance", 0.0, np.full(grid.n_line, _WEEK)
    yield "duration_next_maintenance", 0.0, np.full(grid.n_line, _maintenance_window(grid))
    if grid.n_storage == 0:
        return
    power = np.maximum(grid.storage_max_p_absorb, grid.storage_max_p_prod)
    yield "storage_charge", 0.0, grid.storage_emax
    yield "storage_power_target", 0.0, power
    yield "storage_power", 0.0, power
    yield "storage_theta", 0.0, np.full(grid.n_storage, _HALF_TURN)


def _maintenance_window(grid: Grid) -> int:
    return (grid.maintenance.end_hour - grid.maintenance.start_hour) * STEPS_PER_HOUR


def _longest_cooldown(grid: Grid) -> int:
    rules = grid.rules
    return max(rules.cooldown_line, rules.reconnection, grid.opponent.max_duration, _maintenance_window(grid))
