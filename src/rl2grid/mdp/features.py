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

With the keyword ``operator_features`` come, behind these, what an operator knows and the paper's observation lacks. Its
value names groups, separated by commas, or is ``"all"``; in all tasks:

============ ======================================================= ========= ====== =================================
group        feature                                                 unit      shift  scale
============ ======================================================= ========= ====== =================================
``calendar`` ``day_sine``, ``day_cosine``, ``week_sine``,            1         0      1
             ``week_cosine``, ``year_sine``, ``year_cosine``
``trips``    ``steps_to_trip``                                       steps     0      ``rules.overflow_allowed`` + 1
``attacks``  ``attacked``                                            0 or 1    0      1
``attacks``  ``steps_since_attack``                                  steps     0      a day, 288
``security`` ``loading_after_loss``                                  1         0      1
============ ======================================================= ========= ====== =================================

The calendar tells how far the day, the week (from Monday) and the year have gone, as an angle. The others have an entry
for each line: the steps after which the protections open it if it stays overloaded (all that it may take where it is
not); whether the opponent holds it; steps since it last did (a day where that is longer ago, or never was in this
episode); and how much the worst line is loaded after the loss of this one, by :mod:`rl2grid.mdp.security`, at most 2 (2
also where the grid falls apart), and 0 for what need not be expected to be lost now.

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
from rl2grid.errors import UsageError, one_of
from rl2grid.grids import STEPS_PER_HOUR, Grid

KINDS: tuple[str, ...] = ("T", "R", "H")
"""Topology tasks, redispatching tasks, and joint tasks of both."""

OPERATOR_FEATURES: dict[str, tuple[str, ...]] = {
    "calendar": ("day_sine", "day_cosine", "week_sine", "week_cosine", "year_sine", "year_cosine"),
    "trips": ("steps_to_trip",),
    "attacks": ("attacked", "steps_since_attack"),
    "security": ("loading_after_loss",),
}
"""Features of each group that may be observed beside those of the paper, in this order."""
CALENDAR = "calendar"
"""The group whose features are of time; those of all others are of lines."""
ALL_GROUPS = "all"

_DAY = 24 * STEPS_PER_HOUR
_WEEK = 7 * _DAY
_HALF_TURN = 180.0


def feature_slices(grid: Grid, kind: str, operator_features: str | None = None) -> dict[str, slice]:
    """Where each feature lies in an observation of a task of this kind, in order.

    Args:
        grid: the grid.
        kind: of task.
        operator_features: groups that are observed as well; see :func:`operator_groups`.

    Raises:
        UsageError: ``kind`` is none of :data:`KINDS`, or there is no such group.
    """
    slices: dict[str, slice] = {}
    begin = 0
    for name, _, scale in _layout(grid, kind, operator_features):
        slices[name] = slice(begin, begin + len(scale))
        begin += len(scale)
    return slices


def observation_size(grid: Grid, kind: str, operator_features: str | None = None) -> int:
    """Number of entries of an observation; arguments and errors as of :func:`feature_slices`."""
    return sum(len(scale) for _, _, scale in _layout(grid, kind, operator_features))


def physical_scale(grid: Grid, kind: str, operator_features: str | None = None) -> tuple[F32, F32]:
    """``shift`` and ``scale``, float32 [feature], of the module's tables; no scale is 0.

    Arguments and errors are those of :func:`feature_slices`.
    """
    layout = _layout(grid, kind, operator_features)
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


def operator_groups(names: str | None) -> tuple[str, ...]:
    """The groups of :data:`OPERATOR_FEATURES` that a value of the keyword names, in their order.

    Raises:
        UsageError: there is no such group, or one is named twice.
    """
    if names is None:
        return ()
    if names == ALL_GROUPS:
        return tuple(OPERATOR_FEATURES)
    given = names.split(",") if isinstance(names, str) else []
    if not given or not set(given) <= set(OPERATOR_FEATURES) or len(set(given)) < len(given):
        raise UsageError(
            f"operator_features={names!r} is not allowed: give some of {', '.join(OPERATOR_FEATURES)}, separated by "
            f"commas and each once, or {ALL_GROUPS}."
        )
    return tuple(group for group in OPERATOR_FEATURES if group in given)


def operator_line_features(names: str | None) -> tuple[str, ...]:
    """The features that a value of the keyword adds to every line, in order; errors as of :func:`operator_groups`."""
    groups = (group for group in operator_groups(names) if group != CALENDAR)
    return tuple(name for group in groups for name in OPERATOR_FEATURES[group])


@functools.cache
def _layout(grid: Grid, kind: str, operator_features: str | None) -> tuple[tuple[str, float, F32], ...]:
    """(name, shift, scale [entry]) of every feature, in order."""
    check_kind(kind)
    rows = (
        *_shared_features(grid),
        *(_topology_features(grid) if changes_topology(kind) else ()),
        *(_redispatch_features(grid) if injects(kind) else ()),
        *_planned_and_stored_features(grid),
        *(row for group in operator_groups(operator_features) for row in _operator_features(grid, group)),
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


def _operator_features(grid: Grid, group: str) -> Rows:
    of_lines = {"steps_to_trip": grid.rules.overflow_allowed + 1, "steps_since_attack": _DAY}
    for name in OPERATOR_FEATURES[group]:
        yield name, 0.0, 1.0 if group == CALENDAR else np.full(grid.n_line, of_lines.get(name, 1.0))


def _maintenance_window(grid: Grid) -> int:
    return (grid.maintenance.end_hour - grid.maintenance.start_hour) * STEPS_PER_HOUR


def _longest_cooldown(grid: Grid) -> int:
    rules = grid.rules
    return max(rules.cooldown_line, rules.reconnection, grid.opponent.max_duration, _maintenance_window(grid))
