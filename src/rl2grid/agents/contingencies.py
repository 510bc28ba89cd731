"""Outages that an operator expects: announced maintenance, and what the published opponent may attack."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import F64, I32
from rl2grid.engines.native.what_if import OutageOutcomes, WhatIf
from rl2grid.grids import Grid
from rl2grid.mdp.state import GridState
from rl2grid.powerflow.batch import Snapshot

_SOON = 60
"""Steps before an announced outage from which on the grid is made ready for it."""
_MAINTENANCE_WEIGHT = 3.0
"""What an outage counts that is sure to come, beside an attack that may."""

_CERTAIN_WEIGHT = 20.0
"""The same of one that somebody knows of."""
_DISARMED_BY_AN_OPEN_LINE = ("geometric", "multi_area")
"""Kinds of opponent."""


class Contingencies(NamedTuple):
    """Lines in service that may be lost soon, one at a time."""

    lines: I32  # [outage]
    weight: F64  # [outage] what the loss of each counts


NONE = Contingencies(np.zeros(0, np.int32), np.zeros(0))


def expected(grid: Grid, state: GridState, areas: Sequence[tuple[int, ...]] | None = None) -> Contingencies:
    """What may be lost from row 0, by what is published and announced; attacks in some areas, None: in all.

    Attackable lines count as often as the opponent would choose them now: all alike, or, of a weighted opponent, by
    their loading beside the usual one; the mean weight is 1. Nobody attacks a second line while one is attacked, but
    where there are several areas.
    """
    soon = state.time_next_maintenance[0]
    planned = np.flatnonzero((soon > 0) & (soon <= _SOON) & state.line_status[0])
    busy = len(grid.opponent.areas) == 1 and bool(state.attacked[0].any())
    attacked = grid.opponent.areas if areas is None else areas
    attackable = np.array(sorted({line for area in attacked for line in area}), np.int64)
    attackable = (
        attackable[state.line_status[0][attackable] & ~np.isin(attackable, planned)] if not busy else planned[:0]
    )
    lines = np.concatenate((planned, attackable)).astype(np.int32)
    weight = np.concatenate((np.full(len(planned), _MAINTENANCE_WEIGHT), _attack_weights(grid, state, attackable)))
    return Contingencies(lines, weight)


def areas_to_attack(grid: Grid, state: GridState) -> list[tuple[int, ...]]:
    """The opponent's areas in which it may attack: some opponents do not where one of the area's lines is open
    (``docs/mdp.md``, *Opponents that an open line disarms*).
    """
    closed, areas = state.line_status[0], grid.opponent.areas
    if grid.opponent.kind not in _DISARMED_BY_AN_OPEN_LINE:
        return list(areas)
    return [area for area in areas if closed[list(area)].all()]


def with_certain(contingencies: Contingencies, lines: I32) -> Contingencies:
    """The same, and the loss of these lines as sure as announced maintenance many times over."""
    others = ~np.isin(contingencies.lines, lines)
    weight = np.concatenate((np.full(len(lines), _CERTAIN_WEIGHT), contingencies.weight[others]))
    return Contingencies(np.concatenate((lines, contingencies.lines[others])).astype(np.int32), weight)


def without_lines(point: Snapshot, grid: Grid, lines: NDArray[np.integer], cooldown: I32 | int) -> Snapshot:
    """The operating point without some lines, and with the steps for which nobody can close them."""
    topology, cooldowns = point.topo_vect.copy(), point.cooldown_line.copy()
    topology[grid.line_or_pos_topo_vect[lines]] = -1
    topology[grid.line_ex_pos_topo_vect[lines]] = -1
    cooldowns[lines] = cooldown
    return point._replace(topo_vect=topology, cooldown_line=cooldowns)


def danger(what_if: WhatIf, point: Snapshot, contingencies: Contingencies) -> float:
    """Sum over the outages of the overload that each leaves, of its worst line, at most 1, times its weight."""
    if len(contingencies.lines) == 0:
        return 0.0
    outcomes = what_if.outages(point, contingencies.lines)
    return float((overload_after(outcomes) * contingencies.weight)[~outcomes.was_open].sum())


def overload_after(outcomes: OutageOutcomes) -> F64:
    """The overload that each outage leaves, of its worst line: at most 1, and 1 for a collapse; float64 [outage]."""
    overload: F64 = np.clip(outcomes.worst_loading.astype(np.float64) - 1.0, 0.0, 1.0)
    return overload


def _attack_weights(grid: Grid, state: GridState, lines: np.ndarray[tuple[int], np.dtype[np.int64]]) -> F64:
    usual = grid.opponent.rho_normalization
    if not usual or len(lines) == 0:
        return np.ones(len(lines))
    of_line = dict(zip(grid.opponent.areas[0], usual, strict=True))
    weight = np.array([float(state.rho[0][line]) / of_line[int(line)] for line in lines])
    return weight / max(float(weight.mean()), 1e-6)
