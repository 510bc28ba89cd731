"""Infos of many environments at once are those of each, put together by Gymnasium."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from returned import assert_same, copied, put_together

from rl2grid.envs.info import episode_info
from rl2grid.envs.info_arrays import Underway, info_arrays
from rl2grid.envs.vector import _with_masks
from rl2grid.grids import load_grid
from rl2grid.mdp.state import GridState, new_state
from rl2grid.structures import Role, fields_of

N = 5
GRID = load_grid("bus14")


@pytest.fixture
def state() -> GridState:
    """Numbers of which no two are alike."""
    random = np.random.default_rng(0)
    state = new_state(GRID, N)
    for name in fields_of(GridState, Role.KEPT):
        array = getattr(state, name)
        if array.dtype == np.bool_:
            array[:] = random.random(array.shape) < 0.5
        elif np.issubdtype(array.dtype, np.integer):
            array[:] = random.integers(1, 7, array.shape)
        else:
            array[:] = random.normal(size=array.shape)
    return state


@pytest.fixture
def underway() -> Underway:
    return Underway(
        np.array([f"month {i}" for i in range(N)], object),
        np.arange(N) + 10,
        np.arange(N) + 20,
        np.arange(N) + 100,
        np.arange(N) % 2 == 0,
        np.array([f"refused: {i}" for i in range(N)], object),
    )


def own_info(
    state: GridState, underway: Underway, i: int, constraint: str | None, tells_discounted: bool, digest: str | None
) -> dict[str, Any]:
    """The info of one environment."""
    info = {
        "scenario": underway.scenarios[i],
        "start": int(underway.starts[i]),
        "start_redraws": int(underway.redraws[i]),
        **episode_info(state, i, constraint),
        "action_effect": underway.effects[i],
    }
    info |= {"grid_steps": int(underway.earlier_steps[i]) + info["step"], "over": bool(underway.over[i])}
    if tells_discounted:
        info["discounted_reward"] = float(state.transition_discounted[i])
    if digest:
        info["action_set_hash"] = digest
    return info


@pytest.mark.parametrize(("constraint", "discounted", "digest"), [(None, False, None), ("TLO", True, "a1b2")])
def test_every_environment_has_its_own_info(state, underway, constraint, discounted, digest):
    arrays = info_arrays(state, underway, constraint, discounted, digest)
    mine = _with_masks(arrays.named(), np.ones(N, np.bool_))
    own = [own_info(state, underway, i, constraint, discounted, digest) for i in range(N)]
    assert list(arrays.named()) == list(own[0])
    assert_same(copied(mine), put_together(own))


@pytest.mark.parametrize("ended", [[2], [0, 3, 4], list(range(N))])
def test_only_chosen_environments_have_one(state, underway, ended):
    chosen = np.isin(np.arange(N), ended)
    arrays = info_arrays(state, underway, None, True, "a1b2").only(chosen)
    mine = _with_masks({"final_info": arrays.named()}, chosen)
    own = [{"final_info": own_info(state, underway, i, None, True, "a1b2")} if chosen[i] else {} for i in range(N)]
    assert_same(copied(mine), put_together(own))


def test_infos_stay_what_they_were(state, underway):
    named = info_arrays(state, underway, None, True, None).named()
    before = copied(named)
    for name in fields_of(GridState, Role.KEPT):
        getattr(state, name)[:] = 1
    for array in vars(underway).values():
        array[:] = 1
    assert_same(copied(named), before)
