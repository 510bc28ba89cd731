"""Scenarios by name."""

from datetime import timedelta

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS
from rl2grid.scenarios.library import list_scenarios, load_scenario, scenario_pack_hash


def test_names_are_readable() -> None:
    assert list_scenarios("bus14", "bundled") == (
        "bundled/0000",
        "bundled/0001",
        "bundled/0002",
        "bundled/rte_case14_realistic/000",
        "bundled/rte_case14_realistic/001",
        "bundled/rte_case14_redisp/0",
        "bundled/rte_case14_redisp/1",
    )
    assert "bundled/x2.5/001" in list_scenarios("bus118-M", "bundled")
    assert "bundled/x1/001" in list_scenarios("bus118-M", "bundled")


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_every_bundled_scenario_loads(grid_id: str) -> None:
    for scenario_id in list_scenarios(grid_id, "bundled"):
        scenario = load_scenario(grid_id, scenario_id)
        assert scenario.id == scenario_id
        assert scenario.grid_id == grid_id
        assert scenario is load_scenario(grid_id, scenario_id)
        lengths = {len(array) for array in scenario.arrays().values()}
        assert lengths == {scenario.n_rows}
        assert scenario.n_steps == scenario.n_rows - 1


def test_a_window_is_part_of_its_series() -> None:
    whole = load_scenario("bus36-MO-v0", "bundled/Scenario_august_dummy")
    part = load_scenario("bus36-MO-v0", "bundled/Scenario_august_dummy[100:400]")
    assert part.n_rows == 300
    assert part.first_row == 100
    assert part.series_rows == whole.n_rows
    assert part.start_datetime == whole.start_datetime + timedelta(minutes=500)
    assert part.series_start_datetime == whole.start_datetime
    assert part.arrays().keys() == whole.arrays().keys()
    for name, array in part.arrays().items():
        np.testing.assert_array_equal(array, getattr(whole, name)[100:400])
        assert np.shares_memory(array, getattr(whole, name))
    assert part.content_hash != whole.content_hash


@pytest.mark.parametrize(
    ("scenario_id", "message"),
    [
        ("0000", "must look like bundled/0000"),
        ("generated/7", "must look like 17-03"),
        ("made/7", "must look like bundled/0000"),
        ("bundled/0000[5]", "must look like bundled/0000"),
        ("bundled/0003", "choose one of bundled/0000, bundled/0001, bundled/0002, bundled/rte_case14_realistic/000"),
        ("bundled/0000[0:577]", "at least 2 of the rows 0 to 576"),
        ("bundled/0000[20:21]", "at least 2 of the rows 0 to 576"),
        ("bundled/0000[30:20]", "at least 2 of the rows 0 to 576"),
    ],
)
def test_unknown_scenarios_are_refused(scenario_id: str, message: str) -> None:
    with pytest.raises(UsageError) as error:
        load_scenario("bus14", scenario_id)
    assert message in str(error.value)


def test_unknown_grids_and_splits_are_refused() -> None:
    with pytest.raises(UsageError, match="choose one of bus14, bus36-M"):
        list_scenarios("bus15", "train")
    with pytest.raises(UsageError, match="choose one of bus14, bus36-M"):
        load_scenario("bus15", "bundled/0000")
    with pytest.raises(UsageError, match="choose one of train, validation, test, bundled"):
        scenario_pack_hash("bus14", "all")


def test_pack_hashes_tell_grids_apart() -> None:
    hashes = [scenario_pack_hash(grid_id, "bundled") for grid_id in GRID_IDS]
    assert len(set(hashes)) == len(hashes)
    assert hashes == [scenario_pack_hash(grid_id, "bundled") for grid_id in GRID_IDS]
    assert all(len(text) == 16 for text in hashes)
