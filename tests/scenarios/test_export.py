"""What is exported is played by Grid2Op, and imported again without a difference."""

import warnings
from pathlib import Path

import grid2op
import numpy as np
import pytest
from grid2op.Chronics import MultifolderWithCache
from lightsim2grid import LightSimBackend

from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.scenarios import library
from rl2grid.scenarios.bundled import wheel_data_folder
from rl2grid.scenarios.cache import data_folder
from rl2grid.scenarios.export import export_scenario
from rl2grid.scenarios.folder import read_folder
from rl2grid.scenarios.imported import imported_folder, imported_names
from rl2grid.scenarios.library import import_folder, list_scenarios, load_scenario

BUS14 = load_grid("bus14")
SERIES = [
    ("bus14", "generated/17-03"),
    ("bus14", "bundled/rte_case14_redisp/0[100:700]"),
    ("bus36-M", "bundled/Scenario_april_000[5:300]"),
    ("bus118-M", "bundled/x1/001"),
    ("bus118-MOB-v1", "bundled/2035-08-20_0[3:40]"),
]
"""Among them: with and without voltages and recorded outages, and with forecasts of 12 steps."""


@pytest.mark.parametrize(("grid_id", "scenario_id"), SERIES)
def test_an_exported_scenario_is_imported_without_a_difference(grid_id: str, scenario_id: str, tmp_path: Path) -> None:
    grid, scenario = load_grid(grid_id), load_scenario(grid_id, scenario_id)
    folder = export_scenario(grid, scenario, tmp_path / f"{grid_id}-copy")
    imported = import_folder(grid, folder)
    assert imported.id == f"folder/{grid_id}-copy"
    assert imported.start_datetime == scenario.start_datetime
    assert imported.arrays().keys() == scenario.arrays().keys()
    for name, array in scenario.arrays().items():
        np.testing.assert_array_equal(getattr(imported, name), array)
        assert (np.signbit(getattr(imported, name)) == np.signbit(array)).all() or array.dtype == np.bool_
    assert load_scenario(grid_id, imported.id) is imported


def test_hashes_survive_the_round_trip(tmp_path: Path) -> None:
    scenario = load_scenario("bus14", "generated/17-03")
    assert (
        import_folder(BUS14, export_scenario(BUS14, scenario, tmp_path / "copy")).content_hash == scenario.content_hash
    )


@pytest.mark.parametrize(
    ("grid_id", "environment", "scenario_id"),
    [
        ("bus14", "l2rpn_case14_sandbox", "generated/17-03[0:300]"),
        ("bus36-M", "l2rpn_wcci_2020", "bundled/Scenario_april_000[0:300]"),
    ],
)
def test_grid2op_plays_an_exported_folder(grid_id: str, environment: str, scenario_id: str, tmp_path: Path) -> None:
    grid, scenario = load_grid(grid_id), load_scenario(grid_id, scenario_id)
    export_scenario(grid, scenario, tmp_path / "chronics" / "mine")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = grid2op.make(
            str(wheel_data_folder() / environment), backend=LightSimBackend(), chronics_path=str(tmp_path / "chronics")
        )
    assert not isinstance(env.chronics_handler.real_data, MultifolderWithCache)
    observation = env.reset(options={"time serie id": "mine"})
    assert Path(env.chronics_handler.real_data.data.path).name == "mine"
    assert env.chronics_handler.max_timestep() == scenario.n_steps
    for row in range(25):
        np.testing.assert_array_equal(observation.load_p, scenario.load_p[row])
        np.testing.assert_array_equal(observation.load_q, scenario.load_q[row])
        others = np.arange(grid.n_gen) != grid.slack_gen
        np.testing.assert_allclose(observation.gen_p[others], scenario.prod_p[row, others], atol=1e-3)
        np.testing.assert_array_equal(
            env.chronics_handler.real_data.data.load_p_forecast[row], scenario.load_p_forecast[row, 0]
        )
        observation, _, done, info = env.step(env.action_space())
        assert not done, info
    env.close()


def test_an_existing_folder_is_left_alone(tmp_path: Path) -> None:
    scenario = load_scenario("bus14", "bundled/0000[0:5]")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").touch()
    (tmp_path / "file").touch()
    for name in ("full", "file"):
        with pytest.raises(UsageError, match="exists already: choose a folder that does not"):
            export_scenario(BUS14, scenario, tmp_path / name)
    with pytest.raises(UsageError, match="cannot be written"):
        export_scenario(BUS14, scenario, tmp_path / "file" / "below")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "full", "mine.txt"]
    (tmp_path / "empty").mkdir()
    export_scenario(BUS14, scenario, tmp_path / "empty")
    assert read_folder(BUS14, tmp_path / "empty").start_datetime == scenario.start_datetime


def test_an_imported_series_stays_when_its_folder_is_gone(tmp_path: Path) -> None:
    scenario = load_scenario("bus14", "bundled/0000[0:50]")
    folder = export_scenario(BUS14, scenario, tmp_path / "gone")
    import_folder(BUS14, folder)
    folder.rename(tmp_path / "elsewhere")
    np.testing.assert_array_equal(load_scenario("bus14", "folder/gone[10:20]").load_p, scenario.load_p[10:20])
    assert "gone" in imported_names(BUS14)
    with pytest.raises(
        UsageError, match=r"folder/gone of bus36-M was not imported: `rl2grid data import bus36-M FOLDER`"
    ):
        load_scenario("bus36-M", "folder/gone")


def test_nothing_is_imported_by_half(tmp_path: Path) -> None:
    folder = export_scenario(BUS14, load_scenario("bus14", "bundled/0000[0:50]"), tmp_path / "broken")
    (folder / "prod_p.csv.bz2").unlink()
    whole = export_scenario(BUS14, load_scenario("bus14", "bundled/0000[0:50]"), tmp_path / "whole")
    import_folder(BUS14, whole)  # also keeps what an import reads of the months of the package
    before = sorted(data_folder().rglob("*"))
    with pytest.raises(UsageError, match="prod_p"):
        import_folder(BUS14, folder)
    assert sorted(data_folder().rglob("*")) == before
    assert "broken" not in imported_names(BUS14)


def test_a_damaged_import_is_named(tmp_path: Path) -> None:
    folder = export_scenario(BUS14, load_scenario("bus14", "bundled/0000[0:50]"), tmp_path / "damaged")
    import_folder(BUS14, folder)
    file = imported_folder(BUS14) / "damaged.npz"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 255
    file.write_bytes(content)
    library._load_series.cache_clear()
    with pytest.raises(UsageError, match=r"is damaged .*: import its folder again"):
        load_scenario("bus14", "folder/damaged[0:10]")
    import_folder(BUS14, folder)
    assert load_scenario("bus14", "folder/damaged[0:10]").n_rows == 10


def test_names_that_no_id_can_hold_are_refused(tmp_path: Path) -> None:
    folder = export_scenario(BUS14, load_scenario("bus14", "bundled/0000[0:50]"), tmp_path / "one[0:5]")
    with pytest.raises(UsageError, match="rename it without brackets"):
        import_folder(BUS14, folder)
    assert list_scenarios("bus14", "bundled")


def test_progress_is_told_to_the_end(tmp_path: Path) -> None:
    scenario = load_scenario("bus14", "bundled/rte_case14_redisp/0[0:5000]")
    written: list[tuple[int, int]] = []
    folder = export_scenario(BUS14, scenario, tmp_path / "told", lambda *told: written.append(told))
    read: list[tuple[int, int]] = []
    import_folder(BUS14, folder, lambda *told: read.append(told))
    for told in (written, read):
        assert len({total for _, total in told}) == 1
        done = [each for each, _ in told]
        assert done == sorted(done)
        assert len(done) >= 3 * len(scenario.arrays())
    assert written[-1][0] == written[-1][1] == sum(array.size for array in scenario.arrays().values())
    infos = sum(file.stat().st_size for file in folder.glob("*.info"))
    assert read[-1][0] == read[-1][1] - infos
