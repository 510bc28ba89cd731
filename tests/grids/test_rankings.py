"""The committed rankings."""

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.grids.rankings import ranking, ranking_hash


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_a_ranking_serves_every_level_below_the_highest(grid_id):
    grid, ranked = load_grid(grid_id), ranking(grid_id)
    assert ranked.ids.dtype == np.int32
    assert len(ranked.ids) >= grid.level_sizes[-2] - 1
    assert len(ranked.ids) <= 12_000
    assert len(np.unique(ranked.ids)) == len(ranked.ids)
    assert ranked.ids.min() >= 1
    assert ranked.ids.max() < grid.level_sizes[-1]


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_a_ranking_tells_how_it_was_made(grid_id):
    metadata = ranking(grid_id).metadata
    assert metadata["version"] == "provisional-1"
    assert metadata["command"].startswith(f"rl2grid rank {grid_id} --provisional ")
    assert metadata["grid"] == grid_id
    assert metadata["split"] == "train"
    assert sum(metadata["states"].values()) >= 200


def test_hashes_differ_between_grids_and_follow_the_ids():
    assert len({ranking_hash(grid_id) for grid_id in GRID_IDS}) == len(GRID_IDS)
    assert all(len(ranking_hash(grid_id)) == 16 for grid_id in GRID_IDS)


def test_a_ranking_can_not_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        ranking("bus14").ids[0] = 1


def test_an_unknown_grid_is_refused():
    with pytest.raises(UsageError, match="'bus15' does not exist: choose one of bus14"):
        ranking("bus15")
