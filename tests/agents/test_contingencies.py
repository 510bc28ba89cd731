"""Which outages are expected, and what they threaten."""

from typing import Any

import gymnasium
import numpy as np

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.agents.contingencies import NONE, Contingencies, danger, expected
from rl2grid.engines.native.what_if import WhatIf, snapshot_of


def standing(task: str, **keywords: Any) -> Any:
    env = gymnasium.make(f"rl2grid/{task}-v0", split="bundled", disable_env_checker=True, **keywords).unwrapped
    env.reset(seed=0)
    return env


def test_without_opponent_only_announced_outages_are_expected():
    env = standing("bus14-T0")
    env.state.time_next_maintenance[0] = -1
    assert len(expected(env.grid, env.state).lines) == 0
    env.state.time_next_maintenance[0][[3, 5, 7]] = 60, 61, 0
    found = expected(env.grid, env.state)
    assert found.lines.tolist() == [3]
    assert found.weight.tolist() == [3.0]


def test_attackable_lines_count_as_often_as_a_weighted_opponent_chooses_them():
    env = standing("bus36-MO-v0-T0")
    env.state.time_next_maintenance[0] = -1
    found = expected(env.grid, env.state)
    config = env.grid.opponent
    assert found.lines.tolist() == sorted(config.areas[0])
    share = {
        line: float(env.state.rho[0][line]) / usual
        for line, usual in zip(config.areas[0], config.rho_normalization, strict=True)
    }
    np.testing.assert_allclose(found.weight / found.weight.sum(), [share[k] / sum(share.values()) for k in found.lines])
    np.testing.assert_allclose(found.weight.mean(), 1.0)


def test_lines_that_are_out_and_attacks_during_an_attack_are_not_expected():
    env = standing("bus36-MO-v0-T0")
    env.state.time_next_maintenance[0] = -1
    env.state.line_status[0][45] = False
    assert 45 not in expected(env.grid, env.state).lines
    env.state.attacked[0][45] = True
    assert len(expected(env.grid, env.state).lines) == 0


def test_where_there_are_several_areas_an_attack_does_not_exclude_another():
    env = standing("bus118-MOB-v1-T0")
    areas = env.grid.opponent.areas
    env.state.attacked[0][areas[0][0]] = True
    assert set(areas[1]) <= set(expected(env.grid, env.state).lines.tolist())


def test_danger_is_the_weighted_overload_that_outages_leave():
    env = standing("bus36-MO-v0-T0")
    what_if, point = WhatIf(env.grid), snapshot_of(env.engine, 0)
    lines = np.array([45, 56, 23], np.int32)
    alone = [danger(what_if, point, Contingencies(np.array([line], np.int32), np.ones(1))) for line in lines]
    excess = np.clip(what_if.outages(point, lines).worst_loading - 1.0, 0.0, 1.0)
    np.testing.assert_allclose(alone, excess, rtol=1e-6)
    weights = np.array([1.0, 3.0, 0.5])
    np.testing.assert_allclose(danger(what_if, point, Contingencies(lines, weights)), weights @ excess, rtol=1e-6)
    assert danger(what_if, point, NONE) == 0.0
