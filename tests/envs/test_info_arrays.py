"""Infos of many environments at once are those of each, put together by Gymnasium."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from returned import assert_same, copied, put_together

from rl2grid.envs.info import episode_info
from rl2grid.envs.info_arrays import InfoForm
from rl2grid.grids import load_grid
from rl2grid.handles import Handle
from rl2grid.mdp.reports import blank_report, write_report
from rl2grid.mdp.state import GridState, new_state
from rl2grid.structures import Role, fields_of

N = 5
GRID = load_grid("bus14")
EPISODES = np.arange(3 * N).reshape(3, N) + 100
OVER = np.arange(N) % 2 == 0
NAMES = ("scenario", "game_over_text", "action_effect", "action_set_hash")


@pytest.fixture
def state() -> GridState:
    """Numbers of which hardly any two are alike."""
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


def own_info(state: GridState, i: int, constraint: str | None) -> dict[str, Any]:
    """The info of one environment, texts excepted."""
    info = {
        "start": int(EPISODES[0, i]),
        "start_redraws": int(EPISODES[1, i]),
        **episode_info(state, i, constraint),
        "over": bool(OVER[i]),
        "discounted_reward": float(state.transition_discounted[i]),
    }
    info["grid_steps"] = int(EPISODES[2, i]) + info["step"]
    return info | {name: f"{name} {i}" for name in NAMES}


def infos(state: GridState, told: np.ndarray, constraint: int) -> dict[str, Any]:
    """The infos of the environments ``told``."""
    report = blank_report(N, GRID.n_line)
    handle = Handle(state)
    write_report(handle.address, np.flatnonzero(told), constraint, EPISODES, OVER, *report)
    words = np.array([[f"{name} {i}" if told[i] else None for i in range(N)] for name in NAMES], object)
    return InfoForm(NAMES, True, N).named(words, report, told)


@pytest.mark.parametrize(("constraint", "column"), [(None, -1), ("LSI", 0), ("TLO", 1)])
def test_every_environment_has_its_own_info(state, constraint, column):
    mine = infos(state, np.ones(N, np.bool_), column)
    assert_same(copied(mine), put_together([own_info(state, i, constraint) for i in range(N)]))


@pytest.mark.parametrize("ended", [[2], [0, 3, 4]])
def test_where_only_some_have_infos_those_of_others_are_blank(state, ended):
    told = np.isin(np.arange(N), ended)
    mine = {"final_info": infos(state, told, -1), "_final_info": told}
    theirs = put_together([{"final_info": own_info(state, i, None)} if told[i] else {} for i in range(N)])
    assert_same(copied(mine), theirs)


def test_keys_are_there_where_they_are_meant_to_be():
    report = blank_report(N, GRID.n_line)
    named = InfoForm(["scenario"], False, N).named(np.full((1, N), "", object), report)
    assert "scenario" in named
    assert "discounted_reward" not in named
    assert "action_set_hash" not in named


def test_where_all_have_infos_steps_share_a_mask_that_cannot_be_written():
    form, words = InfoForm(NAMES, True, N), np.full((len(NAMES), N), "", object)
    infos, later = (form.named(words, blank_report(N, GRID.n_line)) for _ in range(2))
    explicit = form.named(words, blank_report(N, GRID.n_line), np.ones(N, np.bool_))
    assert_same(copied(infos), copied(explicit))
    infos["step"][:] = 7
    infos["costs"]["LSI"][:] = 7
    infos["mine"] = infos["costs"]["mine"] = 7
    assert_same(copied(later), copied(explicit))
    with pytest.raises(ValueError, match="read-only"):
        infos["_step"][0] = False
