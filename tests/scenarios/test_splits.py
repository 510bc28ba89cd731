"""What is learned from is never tested on."""

import numpy as np
import pytest

from rl2grid.grids import GRID_IDS
from rl2grid.scenarios.library import list_scenarios, load_scenario
from rl2grid.scenarios.scenario import Scenario

PARTS = ("train", "validation", "test")


def rows_of(scenario: Scenario) -> set[tuple[str, int]]:
    name = scenario.id.partition("[")[0]
    return {(name, row) for row in range(scenario.first_row, scenario.first_row + scenario.n_rows)}


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_every_row_is_in_exactly_one_split(grid_id: str) -> None:
    windows = [load_scenario(grid_id, scenario_id) for part in PARTS for scenario_id in list_scenarios(grid_id, part)]
    whole = [load_scenario(grid_id, scenario_id) for scenario_id in list_scenarios(grid_id, "bundled")]
    assert sum(window.n_rows for window in windows) == sum(series.n_rows for series in whole)
    assert set().union(*map(rows_of, windows)) == set().union(*map(rows_of, whole))


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_no_demand_of_one_split_is_in_another(grid_id: str) -> None:
    """Also where two series of different names hold the same demand."""
    demand = {
        part: {
            row.tobytes()
            for scenario_id in list_scenarios(grid_id, part)
            for row in np.hstack([getattr(load_scenario(grid_id, scenario_id), name) for name in ("load_p", "load_q")])
        }
        for part in PARTS
    }
    assert not demand["train"] & demand["test"]
    assert not demand["train"] & demand["validation"]
    assert not demand["validation"] & demand["test"]


def test_the_mixes_share_their_demand() -> None:
    one, other = (load_scenario("bus118-M", f"bundled/{mix}/001") for mix in ("x1", "x2.5"))
    assert np.array_equal(one.load_p, other.load_p)
    assert not np.array_equal(one.prod_p, other.prod_p)


def test_bus14_has_real_months_on_both_sides() -> None:
    months = [name for name in list_scenarios("bus14", "bundled") if load_scenario("bus14", name).n_steps == 8064]
    assert len(months) == 4
    assert set(months) & set(list_scenarios("bus14", "train"))
    assert set(months) & set(list_scenarios("bus14", "test"))
    assert sum(load_scenario("bus14", name).n_rows for name in list_scenarios("bus14", "validation")) >= 7 * 288


@pytest.mark.parametrize("grid_id", ["bus36-M", "bus118-MOB-v0"])
def test_a_single_series_is_cut_at_two_thirds(grid_id: str) -> None:
    (test,) = (load_scenario(grid_id, name) for name in list_scenarios(grid_id, "test"))
    (validation,) = (load_scenario(grid_id, name) for name in list_scenarios(grid_id, "validation"))
    assert test.first_row + test.n_rows == test.series_rows
    assert test.first_row == pytest.approx(test.series_rows * 2 / 3, abs=1)
    assert validation.first_row == pytest.approx(test.first_row * 3 / 4, abs=1)
