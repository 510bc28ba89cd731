"""Series of a grid of one's own."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from own_grid import ROWS, own_series, own_system

from rl2grid.errors import UsageError
from rl2grid.grids import find_system, load_grid
from rl2grid.grids.systems import add_system, remove_system
from rl2grid.scenarios.bundled import bundled_folders
from rl2grid.scenarios.episodes import plan_episode
from rl2grid.scenarios.folder import FolderContent
from rl2grid.scenarios.inventory import inventory
from rl2grid.scenarios.library import (
    check_in_split,
    generator_version,
    list_scenarios,
    load_scenario,
    scenario_pack_hash,
)
from rl2grid.scenarios.months import GeneratedScenarios
from rl2grid.scenarios.recorded import RecordedScenarios


@pytest.fixture
def play():
    """Registers a grid that plays some scenarios."""

    def register(scenarios):
        system = replace(own_system(), scenarios=scenarios)
        add_system(system)
        return system.grid

    yield register
    remove_system("mine")


def test_splits_hold_what_was_said_and_else_everything(play):
    play(own_system().scenarios)
    assert list_scenarios("mine", "train") == ("recorded/first",)
    assert list_scenarios("mine", "validation") == ("recorded/second",)
    everything = ("recorded/first", "recorded/second")
    assert list_scenarios("mine", "test") == list_scenarios("mine", "bundled") == everything
    check_in_split("mine", "train", "recorded/first[0:20]")
    with pytest.raises(UsageError, match="'recorded/second' is not in the split train of mine: choose one of rec"):
        check_in_split("mine", "train", "recorded/second")
    assert generator_version("mine", "train") is None


def test_arrays_are_played_as_they_were_given(play):
    play(own_system().scenarios)
    scenario, given = load_scenario("mine", "recorded/second"), own_series(ROWS - 2)
    assert scenario.start_datetime == given.start_datetime
    assert scenario.arrays().keys() == given.arrays.keys()
    for name, array in scenario.arrays().items():
        np.testing.assert_array_equal(array, given.arrays[name])
    assert scenario.content_hash != load_scenario("mine", "recorded/first").content_hash
    assert load_scenario("mine", "recorded/first[10:40]").n_rows == 30


def test_episodes_are_functions_of_seed_and_number(play):
    grid = play(RecordedScenarios({name: own_series(k) for k, name in enumerate("abcd")}))
    plans = [plan_episode(grid, "train", 3, number) for number in range(20)]
    assert plans == [plan_episode(grid, "train", 3, number) for number in range(20)]
    assert {plan.scenario_id for plan in plans} == {f"recorded/{name}" for name in "abcd"}
    assert len({plan.start for plan in plans}) > 1
    enumerated = [plan_episode(grid, "validation", 1, number).scenario_id for number in range(5)]
    assert enumerated == [f"recorded/{name}" for name in "bcdab"]


def test_the_pack_hash_names_the_values(play):
    play(own_system().scenarios)
    first = scenario_pack_hash("mine", "train")
    assert len(first) == 16
    assert first != scenario_pack_hash("mine", "validation")
    assert first == scenario_pack_hash("mine", "train", ["recorded/first"])


def test_folders_are_read_and_their_columns_renamed(play, tmp_path):
    source = bundled_folders(load_grid("bus14"))["0000"]
    folder = shutil.copytree(source, tmp_path / "month")
    (folder / "load_p.csv.bz2").unlink()
    bus14 = load_scenario("bus14", "bundled/0000")
    header = ";".join(["other_name", *load_grid("bus14").name_load[1:]])
    np.savetxt(folder / "load_p.csv", bus14.load_p.astype(np.float64), delimiter=";", header=header, comments="")
    columns = {"other_name": load_grid("bus14").name_load[0]}
    grid = play(RecordedScenarios({"month": folder}, columns=columns))
    scenario = load_scenario("mine", "recorded/month")
    for name, array in bus14.arrays().items():
        np.testing.assert_array_equal(getattr(scenario, name), array)
    (kept,) = inventory(grid)
    assert (kept.kind, kept.what, kept.place) == ("recorded", "1 series", tmp_path)


def test_own_series_may_exceed_limits_a_little(play):
    content = own_series()
    content.arrays["prod_p"] = content.arrays["prod_p"] * np.float32(1.02)
    play(RecordedScenarios({"much": content}))
    np.testing.assert_array_equal(load_scenario("mine", "recorded/much").prod_p, content.arrays["prod_p"])


def changed(**arrays):
    content = own_series()
    kept = {name: array for name, array in {**content.arrays, **arrays}.items() if array is not None}
    return FolderContent(content.start_datetime, kept)


def not_a_number():
    load_q = own_series().arrays["load_q"].copy()
    load_q[7, 3] = np.nan
    return load_q


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lambda: changed(load_q=None), "lacks load_q: load_p, load_q, prod_p are needed"),
        (lambda: changed(prod_p=np.zeros((ROWS, 5))), r"has prod_p of shape \(289, 5\): \(289, 6\) is needed"),
        (lambda: changed(load_q=np.zeros((9, 11))), r"has load_q of shape \(9, 11\): \(289, 11\) is needed"),
        (lambda: changed(load_q=not_a_number()), "has a value in load_q that is no finite number"),
        (lambda: changed(wind=np.zeros((ROWS, 6))), "'wind' does not exist: choose one of load_p"),
        (lambda: changed(load_p=np.zeros((1, 11))), "has 1 rows: at least 2 are needed"),
    ],
)
def test_impossible_arrays_are_refused(play, content, message):
    play(RecordedScenarios({"bad": content()}))
    with pytest.raises(UsageError, match=message):
        load_scenario("mine", "recorded/bad")


def test_unknown_names_are_refused(play):
    play(own_system().scenarios)
    with pytest.raises(UsageError, match="'recorded/third' does not exist: choose one of recorded/first, recorded/sec"):
        load_scenario("mine", "recorded/third")
    with pytest.raises(UsageError, match=r"is no id: it must look like recorded/first, folder/<name>, or a window"):
        load_scenario("mine", "generated/17-03")
    with pytest.raises(UsageError, match="Scenario folder/x of mine was not imported"):
        load_scenario("mine", "folder/x")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (({"a/b": None},), "cannot name a scenario"),
        (({"a": None}, {"dev": ("a",)}), "Split 'dev' does not exist"),
        (({"a": None}, {"test": ("b",)}), "Series of the split test, 'b' does not exist: choose one of a"),
    ],
)
def test_impossible_descriptions_are_refused(arguments, message):
    with pytest.raises(UsageError, match=message):
        RecordedScenarios(*arguments)


def test_months_are_generated_where_the_system_has_constants():
    shipped, like = find_system("bus14"), own_system("alike")
    scenarios = GeneratedScenarios(like.scenarios)
    add_system(replace(like, scenarios=scenarios, constants=shipped.constants))
    try:
        assert list_scenarios("alike", "bundled") == ("recorded/first", "recorded/second")
        assert list_scenarios("alike", "test") == list_scenarios("bus14", "test")
        month, other = (load_scenario(name, "generated/810000-00") for name in ("alike", "bus14"))
        np.testing.assert_array_equal(month.load_p, other.load_p)
        np.testing.assert_array_equal(month.prod_p, other.prod_p)
        assert generator_version("alike", "test") == generator_version("bus14", "test")
    finally:
        remove_system("alike")
