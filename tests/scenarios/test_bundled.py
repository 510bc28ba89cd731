"""The bundled series hold exactly what Grid2Op plays."""

import subprocess
import sys
import warnings
from pathlib import Path

import grid2op
import numpy as np
import pandas as pd
import pytest
from grid2op.Chronics import GridStateFromFileWithForecasts
from lightsim2grid import LightSimBackend

from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.scenarios.bundled import bundled_folders, interconnections, wheel_data_folder
from rl2grid.scenarios.library import list_scenarios, load_scenario
from rl2grid.scenarios.scenario import Scenario

OWN = [
    (grid_id, scenario_id)
    for grid_id in GRID_IDS
    for scenario_id in list_scenarios(grid_id, "bundled")
    if "rte_case14" not in scenario_id
]
BORROWED = [name for name in list_scenarios("bus14", "bundled") if "rte_case14" in name]
ARRAYS = ("load_p", "load_q", "prod_p", "prod_v")


def folder_of(grid_id: str, scenario_id: str) -> Path:
    return bundled_folders(load_grid(grid_id))[scenario_id.partition("/")[2]]


def assert_same(scenario: Scenario, reference: GridStateFromFileWithForecasts) -> None:
    assert scenario.start_datetime == reference.start_datetime
    for name in ARRAYS:
        for ours, theirs in (
            (getattr(scenario, name), getattr(reference, name)),
            (getattr(scenario, f"{name}_forecast"), getattr(reference, f"{name}_forecast")),
        ):
            assert (ours is None) == (theirs is None), name
            if ours is not None:
                assert ours.dtype == theirs.dtype == np.float32
                np.testing.assert_array_equal(ours.reshape(theirs.shape), theirs)
    assert scenario.n_rows == reference.n_
    assert scenario.n_steps == reference.max_timestep()


@pytest.mark.parametrize(("grid_id", "scenario_id"), OWN)
def test_equals_the_files_as_grid2op_reads_them(grid_id: str, scenario_id: str) -> None:
    grid, scenario = load_grid(grid_id), load_scenario(grid_id, scenario_id)
    horizon = scenario.load_p_forecast.shape[1]
    assert horizon == (12 if grid_id == "bus118-MOB-v1" else 1)
    reference = GridStateFromFileWithForecasts(
        str(folder_of(grid_id, scenario_id)), h_forecast=tuple(range(5, 5 * horizon + 1, 5))
    )
    reference.initialize(grid.name_load, grid.name_gen, grid.name_line, grid.name_sub)
    assert_same(scenario, reference)
    if grid.maintenance.lines:
        assert scenario.maintenance is None
    else:
        np.testing.assert_array_equal(scenario.maintenance, reference.maintenance)


@pytest.mark.slow
@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_equals_what_a_live_environment_plays(grid_id: str) -> None:
    for environment in [name for name in load_grid(grid_id).bundled_names if not name.startswith("rte_")]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            env = grid2op.make(str(wheel_data_folder() / environment), backend=LightSimBackend())
        for path in sorted((wheel_data_folder() / environment / "chronics").iterdir()):
            if not path.is_dir():
                continue
            observation = env.reset(options={"time serie id": path.name})
            data = env.chronics_handler.real_data.data
            assert Path(data.path).resolve() == path.resolve()
            (name,) = (name for name, folder in bundled_folders(load_grid(grid_id)).items() if folder == path)
            scenario = load_scenario(grid_id, f"bundled/{name}")
            assert_same(scenario, data)
            np.testing.assert_array_equal(observation.load_p, scenario.load_p[0])
            if scenario.maintenance is not None:
                np.testing.assert_array_equal(data.maintenance, scenario.maintenance)
        env.close()


@pytest.mark.parametrize("scenario_id", BORROWED)
def test_months_of_other_grids_are_mapped_by_substation(scenario_id: str) -> None:
    grid, scenario = load_grid("bus14"), load_scenario("bus14", scenario_id)
    folder = folder_of("bus14", scenario_id)
    assert scenario.n_rows == 8065
    expected_source = {"gen_1_0": "gen_1_0", "gen_2_1": "gen_2_1", "gen_5_2": "gen_5_2", "gen_0_5": "gen_0_4"}
    expected_source["gen_7_4"] = "gen_7_3"
    for suffix, forecast in (("", ""), ("_forecasted", "_forecast")):
        generation = pd.read_csv(folder / f"prod_p{suffix}.csv.bz2", sep=";")
        ours = getattr(scenario, f"prod_p{forecast}").reshape(8065, 6)
        for column, name in enumerate(grid.name_gen):
            theirs = generation[expected_source[name]] if name in expected_source else np.zeros(8065)
            np.testing.assert_array_equal(ours[:, column], np.asarray(theirs, np.float32))
        for quantity in ("load_p", "load_q"):
            demand = pd.read_csv(folder / f"{quantity}{suffix}.csv.bz2", sep=";")
            ours = getattr(scenario, f"{quantity}{forecast}").reshape(8065, 11)
            for name in demand.columns:
                column = list(grid.load_to_subid).index(int(name.split("_")[1]))
                np.testing.assert_array_equal(ours[:, column], np.asarray(demand[name], np.float32))


@pytest.mark.parametrize("scenario_id", BORROWED)
def test_months_of_other_grids_fit_the_grid(scenario_id: str) -> None:
    grid, scenario = load_grid("bus14"), load_scenario("bus14", scenario_id)
    own = load_scenario("bus14", "bundled/0000")
    assert (scenario.prod_p <= grid.gen_pmax).all()
    assert (np.unique(own.prod_v, axis=0) == scenario.prod_v).all()
    assert (scenario.prod_v_forecast[:, 0] == scenario.prod_v).all()
    assert scenario.maintenance is None
    for name in ("maintenance", "hazards"):
        file = folder_of("bus14", scenario_id) / f"{name}.csv.bz2"
        assert not file.exists() or not pd.read_csv(file, sep=";").to_numpy().any()


def test_own_voltages_never_change() -> None:
    for name in ("0000", "0001", "0002"):
        assert len(np.unique(load_scenario("bus14", f"bundled/{name}").prod_v, axis=0)) == 1


def test_interconnections_are_the_loads_named_so() -> None:
    grid = load_grid("bus36-MO-v0")
    expected = tuple(i for i, name in enumerate(grid.name_load) if name.startswith("interco"))
    assert len(expected) == 8
    assert interconnections(grid) == expected
    assert interconnections(load_grid("bus14")) == ()


def test_arrays_are_mapped_and_read_only() -> None:
    scenario = load_scenario("bus36-M", "bundled/Scenario_april_000")
    root = scenario.load_p
    while isinstance(root, np.ndarray) and not isinstance(root, np.memmap):
        root = root.base
    assert isinstance(root, np.memmap)
    for array in scenario.arrays().values():
        assert type(array) is np.ndarray
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_neither_grid2op_nor_pandas_is_imported() -> None:
    code = (
        "import sys; from rl2grid.scenarios.episodes import plan_episode; from rl2grid.grids import load_grid; "
        "plan_episode(load_grid('bus14'), 'bundled', 0, 0); "
        "print([name for name in ('grid2op', 'pandas', 'torch', 'numba') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
