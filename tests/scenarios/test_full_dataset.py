"""The full datasets of Grid2Op, played where the user has them and asks for them."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.scenarios.bundled import bundled_folders
from rl2grid.scenarios.episodes import plan_episode
from rl2grid.scenarios.library import list_scenarios, load_scenario, scenario_pack_hash

PARTS = ("train", "validation", "test")


@pytest.fixture
def full_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Twenty scenarios of bus14, all with the data of one."""
    source = bundled_folders(load_grid("bus14"))["0001"]
    for number in range(20):
        shutil.copytree(source, tmp_path / "l2rpn_case14_sandbox" / "chronics" / f"{number:04}")
    monkeypatch.setenv("RL2GRID_FULL_DATA", str(tmp_path))
    return tmp_path


def test_every_scenario_is_in_one_split(full_data: Path) -> None:
    listed = [name for part in PARTS for name in list_scenarios("bus14", part)]
    assert sorted(listed) == [f"full/{number:04}" for number in range(20)]
    assert len(list_scenarios("bus14", "train")) > len(list_scenarios("bus14", "test")) > 0
    assert list_scenarios("bus14", "bundled")[0] == "bundled/0000"


def test_the_split_does_not_depend_on_what_else_is_there(
    full_data: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = list_scenarios("bus14", "train")
    fewer = tmp_path_factory.mktemp("fewer")
    for name in before[:3]:
        path = f"l2rpn_case14_sandbox/chronics/{name.partition('/')[2]}"
        shutil.copytree(full_data / path, fewer / path)
    monkeypatch.setenv("RL2GRID_FULL_DATA", str(fewer))
    assert list_scenarios("bus14", "train") == before[:3]
    with pytest.raises(UsageError, match="has no scenario for the split test"):
        list_scenarios("bus14", "test")


def test_its_scenarios_load_and_are_planned(full_data: Path) -> None:
    plan = plan_episode(load_grid("bus14"), "train", 0, 0)
    assert plan.scenario_id.startswith("full/")
    scenario = load_scenario("bus14", plan.scenario_id)
    assert scenario.source == "full"
    np.testing.assert_array_equal(scenario.load_p, load_scenario("bus14", "bundled/0001").load_p)
    assert scenario.content_hash == load_scenario("bus14", "bundled/0001").content_hash
    assert len({plan_episode(load_grid("bus14"), "train", seed, 0).scenario_id for seed in range(30)}) > 3


def test_mixes_of_one_month_stay_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for mix in ("x1", "x2.5"):
        for number in range(30):
            (tmp_path / "l2rpn_neurips_2020_track2_small" / mix / "chronics" / f"Scenario_{number}").mkdir(parents=True)
    monkeypatch.setenv("RL2GRID_FULL_DATA", str(tmp_path))
    for part in PARTS:
        names = [name.split("/") for name in list_scenarios("bus118-M", part)]
        months = {mix: {month for _, other, month in names if other == mix} for mix in ("x1", "x2.5")}
        assert months["x1"] == months["x2.5"]


def test_asking_for_data_that_is_not_there_is_an_error(full_data: Path) -> None:
    with pytest.raises(UsageError, match="RL2GRID_FULL_DATA must name the folder that holds l2rpn_wcci_2020"):
        list_scenarios("bus36-M", "train")
    assert list_scenarios("bus36-M", "bundled") == ("bundled/Scenario_april_000",)
    with pytest.raises(UsageError, match=r"choose one of full/0000, .*full/0019\."):
        load_scenario("bus14", "full/0099")


def test_the_pack_hash_is_that_of_the_full_split(full_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = scenario_pack_hash("bus14", "test")
    monkeypatch.delenv("RL2GRID_FULL_DATA")
    assert scenario_pack_hash("bus14", "test") != full
