"""Masks of many environments are those of each."""

import numpy as np
import pytest

from rl2grid.grids import load_grid
from rl2grid.handles import Handle
from rl2grid.mdp.action_masks import write_action_masks
from rl2grid.mdp.actions import is_legal, level_catalogue
from rl2grid.mdp.state import new_state

ROWS = 3


@pytest.mark.parametrize("level", [1, 4])
def test_masks_tell_which_actions_are_legal(level):
    grid = load_grid("bus36-M")
    catalogue, state = level_catalogue(grid, level), new_state(grid, ROWS)
    random = np.random.default_rng(0)
    state.time_before_cooldown_line[:] = random.integers(2, size=(ROWS, grid.n_line))
    state.time_before_cooldown_sub[:] = random.integers(2, size=(ROWS, grid.n_sub))
    masks, handle = np.zeros((ROWS, len(catalogue)), bool), Handle(state)
    write_action_masks(handle.address, catalogue.runs, catalogue.kind, catalogue.target, masks)
    tried = random.choice(len(catalogue), 400) if level == 4 else range(len(catalogue))
    for i in range(ROWS):
        assert 0 < masks[i].sum() < len(catalogue)
        for action in tried:
            assert masks[i, action] == is_legal(state, i, catalogue.kind[action], catalogue.target[action])
