"""What is learned from is never tested on."""

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.scenarios import months
from rl2grid.scenarios.episodes import MAX_STEPS, plan_episode
from rl2grid.scenarios.fingerprint import VERSION
from rl2grid.scenarios.library import generator_version, list_scenarios, scenario_pack_hash, split_version
from rl2grid.scenarios.month_names import parse_months
from rl2grid.scenarios.splits import FIRST_TRAINING_SEED, HELD_OUT_SPLITS, SPLIT_VERSION, SPLITS, TRAINING_SEEDS

BUS14 = load_grid("bus14")
HELD_OUT = ("validation", "test")


def test_held_out_months_are_of_other_years_and_never_of_training() -> None:
    months = {split: [parse_months(name) for name in names] for split, names in HELD_OUT_SPLITS.items()}
    assert {split: len(names) for split, names in months.items()} == {"validation": 200, "test": 500}
    seeds = [each.seed for split in months.values() for each in split]
    assert len(set(seeds)) == 700
    assert max(seeds) < FIRST_TRAINING_SEED
    assert not set(seeds) & set(TRAINING_SEEDS)
    assert not set(seeds) & {*range(10_000, 20_000), *range(700_000, 700_020), *range(800_000, 800_020)}, "used before"


@pytest.mark.parametrize("split", HELD_OUT)
def test_the_first_months_of_a_list_are_balanced_over_the_seasons(split: str) -> None:
    months = [parse_months(name) for name in HELD_OUT_SPLITS[split]]
    assert all(each.n_months == 1 for each in months)
    for n in range(1, len(months) + 1):
        per_month = np.bincount([each.first for each in months[:n]], minlength=12)
        per_season = np.bincount([(each.first + 1) % 12 // 3 for each in months[:n]], minlength=4)
        assert np.ptp(per_month) <= 1
        assert np.ptp(per_season) <= 2


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_splits_are_listed_where_they_end(grid_id: str) -> None:
    for split in HELD_OUT:
        assert list_scenarios(grid_id, split) == tuple(f"generated/{name}" for name in HELD_OUT_SPLITS[split])
    with pytest.raises(
        UsageError, match="is a library that episodes are drawn from, not a list: choose one of validation, "
    ):
        list_scenarios(grid_id, "train")


@pytest.mark.parametrize("split", HELD_OUT)
def test_held_out_months_are_refused_in_training(split: str) -> None:
    for name in HELD_OUT_SPLITS[split][::50]:
        for window in ("", "[0:288]"):
            with pytest.raises(UsageError, match="not in the split train of bus14: choose one such as generated/"):
                plan_episode(BUS14, "train", 0, 0, scenario=f"generated/{name}{window}")
    with pytest.raises(UsageError, match=f"not in the split {split} of bus14: choose one of generated/"):
        plan_episode(BUS14, split, 0, 0, scenario=f"generated/{FIRST_TRAINING_SEED}-03")
    with pytest.raises(UsageError, match="not in the split train"):
        plan_episode(BUS14, "train", 0, 0, scenario="bundled/0000")


@pytest.mark.parametrize("split", HELD_OUT)
def test_held_out_plans_enumerate_whole_months(split: str) -> None:
    plan = plan_episode(BUS14, split, 0, 1)
    name = HELD_OUT_SPLITS[split][1]
    assert (plan.scenario_id, plan.start, plan.n_steps) == (f"generated/{name}", 0, MAX_STEPS)


def test_a_window_of_a_listed_scenario_may_be_played() -> None:
    scenario = f"{list_scenarios('bus14', 'validation')[0]}[100:400]"
    assert plan_episode(BUS14, "validation", 0, 0, scenario=scenario).n_steps == 299


def test_results_name_the_generator_and_what_was_played(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(months, "HELD_OUT_SPLITS", {split: names[:2] for split, names in HELD_OUT_SPLITS.items()})
    hashes = [scenario_pack_hash("bus14", split) for split in SPLITS]
    assert hashes == [scenario_pack_hash("bus14", split) for split in SPLITS]
    assert len(set(hashes)) == 4
    first = list_scenarios("bus14", "validation")[:1]
    assert scenario_pack_hash("bus14", "validation", first) not in hashes
    for split, text in zip(SPLITS, hashes, strict=True):
        version, _, digest = text.rpartition("-")
        assert version == ("" if split == "bundled" else VERSION)
        assert len(digest) == 16
        assert generator_version("bus14", split) == (version or None)
        assert split_version("bus14", split) == (SPLIT_VERSION if split in HELD_OUT else None)
