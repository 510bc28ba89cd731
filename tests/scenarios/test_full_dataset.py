"""The full datasets of Grid2Op, played where the user has them and asks for them."""

import shutil
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.scenarios import full, months
from rl2grid.scenarios.bundled import bundled_folders
from rl2grid.scenarios.episodes import plan_episode
from rl2grid.scenarios.library import list_scenarios, load_scenario, scenario_pack_hash
from rl2grid.scenarios.scenario import STEP
from rl2grid.scenarios.splits import HELD_OUT_SPLITS

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
    monkeypatch.setattr(months, "HELD_OUT_SPLITS", {split: names[:2] for split, names in HELD_OUT_SPLITS.items()})
    full = scenario_pack_hash("bus14", "test")
    monkeypatch.delenv("RL2GRID_FULL_DATA")
    assert scenario_pack_hash("bus14", "test") != full


WEEK_ROWS = 2016
FIRST_MONDAY = datetime(2050, 1, 3)


def write_week(folder: Path, start: datetime, rows: int, first: int) -> None:
    """A scenario folder of bus14, each of whose rows shows its number, counted from ``first``."""
    folder.mkdir(parents=True)
    grid = load_grid("bus14")
    number = np.arange(first, first + rows)[:, np.newaxis] / 1000
    for name, names, scale in (
        ("load_p", grid.name_load, 1),
        ("load_q", grid.name_load, 0.7),
        ("prod_p", grid.name_gen, 2),
    ):
        table = np.broadcast_to(scale * number, (rows, len(names)))
        for suffix, shift in (("", 0), ("_forecasted", 0.001)):
            np.savetxt(folder / f"{name}{suffix}.csv", table + shift, "%.4f", ";", header=";".join(names), comments="")
    (folder / "start_datetime.info").write_text(f"{start - STEP:%Y-%m-%d %H:%M}\n")


def name_of(week: int, seed: int) -> str:
    return f"{FIRST_MONDAY + week * timedelta(weeks=1):%Y-%m-%d}_{seed}"


@pytest.fixture
def weekly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Writes weeks 0, 1, ... of 2050 as Grid2Op names them."""

    def write(*weeks: int, seed: int = 31, rows: int = WEEK_ROWS) -> None:
        for week in weeks:
            folder = tmp_path / "l2rpn_case14_sandbox" / "chronics" / name_of(week, seed)
            write_week(folder, FIRST_MONDAY + week * timedelta(weeks=1), rows, week * WEEK_ROWS)

    monkeypatch.setenv("RL2GRID_FULL_DATA", str(tmp_path))
    full._folders.cache_clear()
    return write


def listed() -> list[str]:
    return sorted(name for part in PARTS for name in _list(part))


def _list(part: str) -> tuple[str, ...]:
    try:
        return list_scenarios("bus14", part)
    except UsageError:
        return ()


@pytest.mark.parametrize("rows", [WEEK_ROWS, WEEK_ROWS + 1])
def test_four_weeks_are_a_month(weekly, rows: int) -> None:
    weekly(0, 1, 2, 3, rows=rows)
    assert listed() == ["full/2050-01-03_31-4weeks"]
    scenario = load_scenario("bus14", "full/2050-01-03_31-4weeks")
    assert scenario.start_datetime == FIRST_MONDAY - STEP
    assert scenario.n_rows == 3 * WEEK_ROWS + rows
    expected = np.arange(scenario.n_rows) / 1000
    np.testing.assert_allclose(scenario.load_p[:, 0], expected, atol=1e-4)
    np.testing.assert_allclose(scenario.prod_p[:, -1], 2 * expected, atol=1e-4)
    np.testing.assert_allclose(scenario.load_p_forecast[:, 0, 0], expected + 0.001, atol=1e-4)


def test_weeks_that_do_not_join_stay_weeks(weekly) -> None:
    weekly(0, 1, 2, 3)
    weekly(4, 5, 7)
    weekly(3, 4, 5, 6, seed=7)
    assert listed() == sorted(
        [
            "full/2050-01-03_31-4weeks",
            *(f"full/{name_of(week, 31)}" for week in (4, 5, 7)),
            *(f"full/{name_of(week, 7)}" for week in (3, 4, 5, 6)),
        ]
    )
    assert load_scenario("bus14", f"full/{name_of(5, 31)}").n_rows == WEEK_ROWS


def test_weeks_whose_time_stamps_do_not_follow_each_other_stay_weeks(weekly, tmp_path: Path) -> None:
    weekly(0, 1, 2, 3)
    info = tmp_path / "l2rpn_case14_sandbox" / "chronics" / name_of(2, 31) / "start_datetime.info"
    info.write_text("2050-01-16 23:50\n")
    full._folders.cache_clear()
    assert len(listed()) == 4


def test_a_month_is_in_the_split_of_its_weeks(weekly, tmp_path: Path) -> None:
    names = ["-".join(("full/" + name_of(4 * month, seed), "4weeks")) for month in range(3) for seed in range(10)]
    assert {full._split_of(name) for name in names} == set(PARTS)
    for month in range(3):
        for seed in range(10):
            weeks = {full._split_of(name_of(4 * month + week, seed)) for week in range(4)}
            assert weeks == {full._split_of(name_of(4 * month, seed) + "-4weeks")}


def test_numbered_weeks_are_joined_too() -> None:
    names = [f"Scenario_{month}_wk{week}" for month in ("april_17", "august_21") for week in range(4)]
    assert len({full._week_of(name).month for name in names}) == 2
    for name in ("Scenario_april_000", "0001", "2050-01-03", "2050-13-03_1", "2019-01-12"):
        assert full._week_of(name) is None


def test_a_week_of_other_length_is_named(weekly) -> None:
    weekly(0, 2, 3)
    weekly(1, rows=1000)
    with pytest.raises(UsageError, match=r"2050-01-10_31 has 1,000 rows: 2,016, or one more, are needed"):
        load_scenario("bus14", "full/2050-01-03_31-4weeks")
