"""An episode is a function of its seed and number."""

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.scenarios.episodes import EpisodePlan, admissible_starts, maintenance_matrix, plan_episode
from rl2grid.scenarios.library import RECORDED_SPLITS, list_scenarios, load_scenario

BUS14 = load_grid("bus14")


@pytest.mark.parametrize("grid_id", GRID_IDS)
@pytest.mark.parametrize("split", RECORDED_SPLITS)
def test_plans_are_playable_and_reproducible(grid_id: str, split: str) -> None:
    grid = load_grid(grid_id)
    for number in range(30):
        plan = plan_episode(grid, split, 7, number)
        assert plan == plan_episode(grid, split, 7, number)
        scenario = load_scenario(grid_id, plan.scenario_id)
        assert plan.scenario_id in list_scenarios(grid_id, split)
        assert 1 <= plan.n_steps <= 8064
        assert plan.n_steps == min(8064, scenario.n_rows - 1 - plan.start)
        if split == "train":
            assert plan.n_steps >= min(288, scenario.n_steps / 2)
        else:
            assert plan.start == 0


def test_seeds_and_numbers_differ() -> None:
    plans = {(plan_episode(BUS14, "train", seed, number).start) for seed in range(5) for number in range(5)}
    assert len(plans) >= 24


def test_training_samples_rows_uniformly() -> None:
    plans = [plan_episode(BUS14, "train", seed, 0) for seed in range(2000)]
    ids = list_scenarios("bus14", "train")
    starts = np.array([admissible_starts(load_scenario("bus14", name).n_steps) for name in ids])
    counts = np.array([sum(plan.scenario_id == name for plan in plans) for name in ids])
    assert counts.sum() == 2000
    np.testing.assert_allclose(counts / 2000, starts / starts.sum(), atol=0.03)
    longest = ids[int(starts.argmax())]
    quantiles = np.quantile([plan.start for plan in plans if plan.scenario_id == longest], [0.25, 0.5, 0.75])
    np.testing.assert_allclose(quantiles / starts.max(), [0.25, 0.5, 0.75], atol=0.05)


@pytest.mark.parametrize(("n_steps", "starts"), [(8064, 7777), (575, 288), (288, 145), (287, 144), (71, 36), (1, 1)])
def test_admissible_starts(n_steps: int, starts: int) -> None:
    assert admissible_starts(n_steps) == starts


def test_evaluation_enumerates() -> None:
    ids = list_scenarios("bus14", "bundled")
    assert [plan_episode(BUS14, "bundled", 0, number).scenario_id for number in range(len(ids))] == list(ids)
    assert [plan_episode(BUS14, "bundled", seed, 0).scenario_id for seed in range(len(ids))] == list(ids)


def test_options_replace_only_what_they_name() -> None:
    free = plan_episode(BUS14, "train", 3, 1)
    chosen = plan_episode(BUS14, "train", 3, 1, scenario=free.scenario_id)
    assert chosen == free
    plan = plan_episode(BUS14, "test", 3, 1, scenario="bundled/rte_case14_redisp/1", start=np.int64(5000))
    assert plan == EpisodePlan(3, 1, "bundled/rte_case14_redisp/1", 5000, 3064)
    assert type(plan.start) is int
    assert plan_episode(BUS14, "train", 3, 1, start=0, maintenance=False).maintenance is False


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"split": "holdout"}, "Split 'holdout' does not exist: choose one of train, validation, test, bundled, "),
        ({"split": "train", "scenario": "bundled/rte_case14_redisp/1"}, "not in the split train of bus14: choose one"),
        ({"split": "test", "scenario": "0000"}, "bundled/rte_case14_realistic/001, bundled/rte_case14_redisp/1"),
        ({"split": "test", "start": 8064}, "choose an integer from 0 to 8063"),
        ({"split": "test", "start": -1}, "choose an integer from 0 to 8063"),
        ({"split": "test", "start": 1.5}, "choose an integer from 0 to 8063"),
        ({"split": "test", "start": True}, "choose an integer from 0 to 8063"),
    ],
)
def test_bad_requests_are_refused_in_one_sentence(keywords: dict, message: str) -> None:
    with pytest.raises(UsageError) as error:
        plan_episode(BUS14, keywords.pop("split"), 0, 0, **keywords)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_recorded_outages_are_played_and_can_be_left_out() -> None:
    grid = load_grid("bus36-MO-v0")
    scenario = load_scenario("bus36-MO-v0", "bundled/Scenario_august_dummy")
    plan = plan_episode(grid, "bundled", 0, 0, scenario=scenario.id)
    assert maintenance_matrix(grid, scenario, plan) is scenario.maintenance
    assert scenario.maintenance.any()
    without = plan_episode(grid, "bundled", 0, 0, scenario=scenario.id, maintenance=False)
    assert not maintenance_matrix(grid, scenario, without).any()


def test_sampled_outages_follow_the_seed_and_the_number() -> None:
    grid, name = load_grid("bus36-M"), "bundled/Scenario_april_000"
    scenario = load_scenario(grid.id, name)
    samples = [
        maintenance_matrix(grid, scenario, EpisodePlan(seed, number, name, 0, 2878))
        for seed, number in [(0, 0), (0, 0), *[(1, n) for n in range(20)]]
    ]
    assert samples[0].shape == (2879, grid.n_line)
    assert np.array_equal(samples[0], samples[1])
    assert len({sample.tobytes() for sample in samples}) > 5
    lines = np.flatnonzero(np.any(samples, axis=(0, 1)))
    assert set(lines) <= set(grid.maintenance.lines)


def test_a_window_has_the_outages_of_its_series() -> None:
    grid, name = load_grid("bus36-M"), "bundled/Scenario_april_000"
    whole, part = load_scenario(grid.id, name), load_scenario(grid.id, f"{name}[1440:1920]")
    seen = 0
    for seed in range(20):
        sample = maintenance_matrix(grid, whole, EpisodePlan(seed, 2, name, 0, 2878))
        window = maintenance_matrix(grid, part, EpisodePlan(seed, 2, part.id, 7, 472))
        np.testing.assert_array_equal(window, sample[1440:1920])
        seen += int(window.sum())
    assert seen


def test_a_grid_that_records_none_and_samples_none_has_none() -> None:
    grid = load_grid("bus36-MO-v0")
    scenario = load_scenario(grid.id, "bundled/Scenario_february_dummy")
    assert not maintenance_matrix(grid, scenario, EpisodePlan(0, 0, scenario.id, 0, 864)).any()
