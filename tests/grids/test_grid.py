"""The grid data says what the live environments say."""

import json
from importlib import resources

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS, load_grid

# Paper, Table 1 and the contract: substations, lines, generators, loads, storages, opponent.
TABLE_1 = {
    "bus14": (14, 20, 6, 11, 0, "none"),
    "bus36-M": (36, 59, 22, 37, 0, "none"),
    "bus36-MO-v0": (36, 59, 22, 37, 0, "weighted"),
    "bus36-MO-v1": (36, 59, 22, 37, 0, "geometric"),
    "bus118-M": (118, 186, 62, 99, 0, "none"),
    "bus118-MOB-v0": (118, 186, 62, 91, 7, "geometric"),
    "bus118-MOB-v1": (118, 186, 62, 99, 7, "multi_area"),
}


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_sizes_are_those_of_the_paper(grid_id):
    grid = load_grid(grid_id)
    sizes = (grid.n_sub, grid.n_line, grid.n_gen, grid.n_load, grid.n_storage, grid.opponent.kind)
    assert sizes == TABLE_1[grid_id]
    assert grid.dim_topo == 2 * grid.n_line + grid.n_gen + grid.n_load + grid.n_storage


@pytest.mark.parametrize("grid_id", ["bus14", "bus36-MO-v0", "bus118-MOB-v1"])
def test_data_equals_the_live_environment(grid_id):
    check_against_live_environment(grid_id)


@pytest.mark.slow
@pytest.mark.parametrize("grid_id", ["bus36-M", "bus36-MO-v1", "bus118-M", "bus118-MOB-v0"])
def test_data_of_the_other_grids_equals_the_live_environment(grid_id):
    check_against_live_environment(grid_id)


def check_against_live_environment(grid_id):
    from rl2grid.engines.reference.extract import describe_environment

    stored = json.loads((resources.files("rl2grid.grids") / "data" / f"{grid_id}.json").read_text())
    assert describe_environment(grid_id) == stored


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_positions_cover_the_topology_vector_once(grid_id):
    grid = load_grid(grid_id)
    positions = np.concatenate(
        [
            grid.line_or_pos_topo_vect,
            grid.line_ex_pos_topo_vect,
            grid.gen_pos_topo_vect,
            grid.load_pos_topo_vect,
            grid.storage_pos_topo_vect,
        ]
    )
    assert sorted(positions.tolist()) == list(range(grid.dim_topo))
    assert (grid.element_to_subid[grid.line_or_pos_topo_vect] == grid.line_or_to_subid).all()
    assert (grid.element_to_subid[grid.gen_pos_topo_vect] == grid.gen_to_subid).all()


def test_arrays_are_read_only():
    with pytest.raises(ValueError, match="read-only"):
        load_grid("bus14").thermal_limit[0] = 1.0


def test_unknown_grid_is_refused_with_the_right_ones():
    with pytest.raises(UsageError, match=r"Grid 'bus15' does not exist: choose one of bus14, bus36-M,"):
        load_grid("bus15")
