"""Generated months: named, made once, kept, repaired, and never trained on where they are held out."""

import hashlib
import itertools
import json
import shutil
import threading
import zlib
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.scenarios import generated, library, packs
from rl2grid.scenarios.cache import data_folder
from rl2grid.scenarios.episodes import MAX_STEPS, EpisodePlan, maintenance_matrix, plan_episode
from rl2grid.scenarios.generator import month as generator
from rl2grid.scenarios.library import load_scenario, open_series
from rl2grid.scenarios.month_names import parse_months
from rl2grid.scenarios.series_hash import hash_of_series
from rl2grid.scenarios.splits import HELD_OUT_SPLITS

BUS14 = load_grid("bus14")
MONTH_STEPS = 8064


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """An empty data folder, and the months that the generator was asked for since."""
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path))
    months: list[tuple[int, int]] = []
    generate = generator.raw_month

    def counted(grid, seed, month):
        months.append((seed, month))
        return generate(grid, seed, month)

    monkeypatch.setattr(generator, "raw_month", counted)
    return months


def forget_expanded() -> None:
    shutil.rmtree(data_folder() / "series")
    library._load_generated_scenario.cache_clear()


def test_a_month_is_what_the_generator_makes(made) -> None:
    scenario, expected = load_scenario("bus14", "generated/17-03"), generator.generate_month(BUS14, 17, 3)
    assert (scenario.id, scenario.source, scenario.grid_id) == ("generated/17-03", "generated", "bus14")
    assert scenario.start_datetime == expected.start_datetime
    assert scenario.n_steps == MONTH_STEPS
    assert scenario.arrays().keys() == expected.arrays().keys()
    for name, array in expected.arrays().items():
        np.testing.assert_array_equal(getattr(scenario, name), array)
        assert not getattr(scenario, name).flags.writeable
    assert load_scenario("bus14", "generated/17-03") is scenario


def test_two_months_in_a_row_are_joined(made) -> None:
    both = load_scenario("bus14", "generated/17-03+04")
    first, second = (load_scenario("bus14", f"generated/17-{month}") for month in ("03", "04"))
    assert both.n_steps == 2 * MONTH_STEPS
    assert both.start_datetime == first.start_datetime
    assert second.start_datetime - first.start_datetime == timedelta(minutes=5 * MONTH_STEPS)
    for name, array in both.arrays().items():
        np.testing.assert_array_equal(array[:MONTH_STEPS], getattr(first, name)[:-1])
        np.testing.assert_array_equal(array[MONTH_STEPS:], getattr(second, name))
    for name in ("load_p", "load_q", "prod_p"):
        np.testing.assert_array_equal(getattr(first, name)[-1], getattr(second, name)[0])
    window = load_scenario("bus14", "generated/17-03+04[8000:8200]")
    np.testing.assert_array_equal(window.load_p, both.load_p[8000:8200])


def test_a_pack_spares_the_generator_and_a_damaged_one_is_made_again(made) -> None:
    before = load_scenario("bus14", "generated/17-03").content_hash
    forget_expanded()
    assert load_scenario("bus14", "generated/17-03").content_hash == before
    assert made == [(17, 3)]
    pack = generated.pack_path(BUS14, 17, 3)
    for damage in (lambda raw: raw[: len(raw) // 2], lambda raw: raw[:-40] + bytes(20) + raw[-20:], lambda raw: b""):
        made.clear()
        pack.write_bytes(damage(pack.read_bytes()))
        forget_expanded()
        assert load_scenario("bus14", "generated/17-03").content_hash == before
        assert made == [(17, 3)]


def test_the_pack_of_another_month_in_its_place_is_made_again(made) -> None:
    hashes = {name: generated.series_hash(BUS14, name) for name in ("17-03", "17-04")}
    packs = [generated.pack_path(BUS14, 17, month) for month in (3, 4)]
    shutil.copyfile(packs[1], packs[0])
    made.clear()
    assert generated.series_hash(BUS14, "17-03") == hashes["17-03"]
    assert made == [(17, 3)]
    shutil.copyfile(packs[1], packs[0])
    assert load_scenario("bus14", "generated/17-03").load_p.shape[0] == MONTH_STEPS + 1
    assert made == [(17, 3), (17, 3)]


def test_an_edited_hash_in_the_head_of_a_pack_is_noticed(made) -> None:
    before, path = generated.series_hash(BUS14, "17-03"), generated.pack_path(BUS14, 17, 3)
    path.write_bytes(path.read_bytes().replace(before.encode(), ("0" * len(before)).encode()))
    assert generated.series_hash(BUS14, "17-03") == before
    assert made == [(17, 3), (17, 3)]


def test_a_pack_that_expands_to_more_than_a_month_is_not_expanded(made) -> None:
    generated.series_hash(BUS14, "17-03")
    path = generated.pack_path(BUS14, 17, 3)
    month = packs.read_raw(path)
    size = 2 * sum(array.size for array in (month.load_p, month.load_q, month.prod_p))
    head, _, within = path.read_bytes().partition(b"\n")
    assert packs._expanded(within, size) is not None
    body = zlib.compress(bytes(2**22))
    header = json.loads(head) | {"sha256": hashlib.sha256(body).hexdigest()}
    del header["checksum"]
    path.write_bytes(json.dumps(header | {"checksum": packs._checksum(header)}).encode() + b"\n" + body)
    assert packs.read_head(path)["series"] == generated.series_hash(BUS14, "17-03")
    assert packs._expanded(body, size) is None
    with pytest.raises(UsageError, match="does not hold a month of bus14"):
        packs.read_raw(path)
    assert generated._read(BUS14, 17, 3) is None


def test_what_a_killed_maker_left_is_removed(made) -> None:
    folder = generated.pack_folder(BUS14)
    folder.mkdir(parents=True)
    for name in (".17-03.pack.12345", ".18-03.pack.12345"):
        (folder / name).write_bytes(b"half")
    generated.series_hash(BUS14, "17-03")
    assert [path.name for path in folder.glob(".*.pack.*")] == [".18-03.pack.12345"]


def test_a_month_is_made_once_by_several_makers(made) -> None:
    hashes: list[str] = []
    makers = [
        threading.Thread(target=lambda: hashes.append(generated.load_generated(BUS14, "17-05").content_hash))
        for _ in range(4)
    ]
    for maker in makers:
        maker.start()
    for maker in makers:
        maker.join()
    assert made == [(17, 5)]
    assert len(hashes) == 4
    assert len(set(hashes)) == 1


def test_packs_of_another_generator_are_not_read(made, monkeypatch) -> None:
    load_scenario("bus14", "generated/17-03")
    monkeypatch.setattr(generated, "generator_fingerprint", lambda grid: "another")
    library._load_generated_scenario.cache_clear()
    load_scenario("bus14", "generated/17-03")
    assert made == [(17, 3), (17, 3)]


def test_the_hash_of_a_month_is_in_the_head_of_its_pack(made) -> None:
    first = generated.series_hash(BUS14, "17-03")
    assert generated.series_hash(BUS14, "17-03+04") == f"{first}+{generated.series_hash(BUS14, '17-04')}"
    assert made == [(17, 3), (17, 4)]
    assert not (data_folder() / "series").exists(), "nothing was expanded"
    scenario = load_scenario("bus14", "generated/17-03")
    assert hash_of_series(scenario.load_p, scenario.load_q, scenario.prod_p) == first
    generated.pack_path(BUS14, 17, 3).write_bytes(b"no pack")
    assert generated.series_hash(BUS14, "17-03") == first


def test_only_the_latest_expanded_months_are_kept_and_mapped_ones_stay_readable(made, monkeypatch) -> None:
    monkeypatch.setattr(generated, "EXPANDED_BYTES", 1)
    monkeypatch.setattr(generated, "MONTHS_BETWEEN_CLEANUPS", 1)
    first = load_scenario("bus14", "generated/17-03")
    total = first.load_p.sum()
    load_scenario("bus14", "generated/17-04")
    kept = [path.name for path in (data_folder() / "series").rglob("*") if path.is_file()]
    assert sorted(name.rpartition(".")[2] for name in kept) == ["json", "lock", "npy"]
    assert all(name.startswith("generated.17-04-") for name in kept)
    assert first.load_p.sum() == total


def test_expanded_months_give_way_where_little_is_free(made, monkeypatch) -> None:
    monkeypatch.setattr(generated, "_EXPANDED_MONTHS", itertools.count(1))  # not when so many were expanded
    load_scenario("bus14", "generated/17-03")
    monkeypatch.setattr(generated, "free_bytes", lambda: generated.LEFT_FREE_BYTES - 1)
    load_scenario("bus14", "generated/17-04")
    assert not [path for path in (data_folder() / "series").rglob("generated.17-03-*") if path.is_file()]


def test_months_to_remove_are_looked_for_when_some_were_expanded_not_at_every_episode(made, monkeypatch) -> None:
    looked: list[int] = []
    monkeypatch.setattr(generated, "_keep_latest", lambda limit: looked.append(len(generated.expanded_copies())))
    monkeypatch.setattr(generated, "free_bytes", lambda: generated.LEFT_FREE_BYTES)
    monkeypatch.setattr(generated, "_EXPANDED_MONTHS", itertools.count())
    monkeypatch.setattr(generated, "MONTHS_BETWEEN_CLEANUPS", 2)
    for month in (3, 4, 3, 3, 5, 3):
        load_scenario("bus14", f"generated/17-{month:02d}")
    assert looked == [1, 3]


@pytest.mark.parametrize(
    "name", ["7", "17-12", "17-3", "17-03+05", "17-11+12", "-1-03", "017-03", "1e3-03", f"{10**19}-03", "17-03+"]
)
def test_names_of_nothing_are_refused(name: str) -> None:
    with pytest.raises(UsageError, match="must look like 17-03"):
        load_scenario("bus14", f"generated/{name}")


def test_training_plans_start_anywhere_and_go_on_in_the_next_month(made) -> None:
    plans = [plan_episode(BUS14, "train", 5, number) for number in range(12)]
    assert plans == [plan_episode(BUS14, "train", 5, number) for number in range(12)]
    assert all(plan.n_steps == MAX_STEPS and 0 <= plan.start < MONTH_STEPS for plan in plans)
    starts = [plan.start for plan in plans]
    assert len(set(starts)) == 12
    assert max(starts) > MONTH_STEPS / 2 > min(starts)
    chosen = plan_episode(BUS14, "train", 5, 0, start=7)
    assert (chosen.scenario_id, chosen.start) == (plans[0].scenario_id, 7)
    assert open_series("bus14", plans[0].scenario_id).n_rows == 2 * MONTH_STEPS + 1
    scenario = load_scenario("bus14", plans[0].scenario_id)
    assert maintenance_matrix(BUS14, scenario, plans[0]).shape == (2 * MONTH_STEPS + 1, BUS14.n_line)


def test_generated_months_have_outages_on_grids_whose_series_record_them() -> None:
    grid = load_grid("bus36-MO-v0")
    recorded = load_scenario(grid.id, "bundled/Scenario_august_dummy")
    scenario = replace(recorded, source="generated", maintenance=None)
    plans = [EpisodePlan(0, number, "generated/0-07", 0, scenario.n_steps) for number in range(40)]
    lines = np.any([maintenance_matrix(grid, scenario, plan).any(axis=0) for plan in plans], axis=0)
    assert set(np.flatnonzero(lines)) <= set(load_grid("bus36-M").maintenance.lines)
    assert lines.any()


def test_an_unwritable_data_folder_is_named(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path / "file"))
    with pytest.raises(UsageError, match="set RL2GRID_DATA to one that can"):
        load_scenario("bus14", "generated/17-03")


def test_both_engines_play_the_same_month(made) -> None:
    played = {}
    for engine in ("native", "reference"):
        env = gymnasium.make("rl2grid/bus14-T0-v0", engine=engine, split="validation", heuristic=None, opponent=False)
        observations = [env.reset(seed=0)[0]] + [env.step(0)[0] for _ in range(30)]
        played[engine] = np.array(observations)
        env.close()
    assert made == [parse_months(HELD_OUT_SPLITS["validation"][0])[:2]]
    np.testing.assert_allclose(played["native"], played["reference"], rtol=1e-4, atol=1e-4)
    assert np.ptp(played["native"], axis=0).any()
