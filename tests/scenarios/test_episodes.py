"""An episode is a function of its seed and number."""

from dataclasses import replace

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.scenarios import episodes
from rl2grid.scenarios.episodes import EpisodePlan, admissible_starts, maintenance_matrix, plan_episode
from rl2grid.scenarios.generator.security import assess
from rl2grid.scenarios.library import list_scenarios, load_scenario
from rl2grid.scenarios.scenario import Scenario
from rl2grid.streams import Purpose, Stream

BUS14 = load_grid("bus14")


def test_bundled_plans_are_playable_and_reproducible() -> None:
    for grid_id in GRID_IDS:
        grid = load_grid(grid_id)
        for number in range(8):
            plan = plan_episode(grid, "bundled", 7, number)
            assert plan == plan_episode(grid, "bundled", 7, number)
            scenario = load_scenario(grid_id, plan.scenario_id)
            assert plan.scenario_id in list_scenarios(grid_id, "bundled")
            assert (plan.start, plan.n_steps) == (0, min(8064, scenario.n_rows - 1))


def test_seeds_and_numbers_differ() -> None:
    plans = {(plan_episode(BUS14, "train", seed, number).start) for seed in range(3) for number in range(3)}
    assert len(plans) == 9


def test_training_samples_rows_uniformly() -> None:
    starts = [plan_episode(BUS14, "train", seed, 0).start for seed in range(100)]
    quantiles = np.quantile(starts, [0.25, 0.5, 0.75])
    np.testing.assert_allclose(quantiles / 8064, [0.25, 0.5, 0.75], atol=0.1)
    assert max(starts) < 8064


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
    plan = plan_episode(BUS14, "bundled", 3, 1, scenario="bundled/rte_case14_redisp/1", start=np.int64(5000))
    assert plan == EpisodePlan(3, 1, "bundled/rte_case14_redisp/1", 5000, 3064)
    assert type(plan.start) is int
    assert plan_episode(BUS14, "train", 3, 1, start=0, maintenance=False).maintenance is False


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"split": "holdout"}, "Split 'holdout' does not exist: choose one of train, validation, test, bundled."),
        ({"split": "train", "scenario": "bundled/rte_case14_redisp/1"}, "not in the split train of bus14: choose one"),
        ({"split": "bundled", "scenario": "0000"}, "choose one of bundled/0000, bundled/0001"),
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


@pytest.fixture(scope="module")
def hard_month() -> tuple[Scenario, np.ndarray]:
    """A month with more of demand and generation than planned, and which of its rows overload a line."""
    series = load_scenario("bus14", "generated/1000000-06+07")
    factor = np.float32(1.35)
    more = {name: np.round(factor * getattr(series, name), 1) for name in ("load_p", "load_q", "prod_p")}
    more["load_p"][:10], more["load_q"][:10], more["prod_p"][:10] = (
        series.load_p[:10],
        series.load_q[:10],
        series.prod_p[:10],
    )
    series = replace(series, **more)
    integers = [np.rint(10 * more[name][:8064]).astype(np.int32) for name in more]
    return series, assess(BUS14, np.array(series.prod_v[0]), *integers).loading > 1


def test_overloaded_starts_are_drawn_again_and_counted(hard_month) -> None:
    series, overloaded = hard_month
    assert 0.2 < overloaded.mean() < 0.9
    counts = []
    for seed in range(200):
        start = episodes._draw_start(BUS14, series, seed, 3)
        stream = Stream(seed, 3, Purpose.START)
        rows = [stream.integer(8064) for _ in range(start.redraws + 1)]
        assert overloaded[rows[:-1]].all()
        assert not overloaded[rows[-1]]
        assert start.row == rows[-1]
        counts.append(start.redraws)
    # Of the rows drawn, as many were overloaded as of all rows: within 4 standard deviations.
    drawn = sum(counts) + len(counts)
    assert sum(counts) / drawn == pytest.approx(overloaded.mean(), abs=4 * 0.5 / np.sqrt(drawn))


def test_starts_do_not_depend_on_what_was_drawn_before(hard_month) -> None:
    series, _ = hard_month
    forwards = [episodes._draw_start(BUS14, series, seed, 0) for seed in range(20)]
    backwards = [episodes._draw_start(BUS14, series, seed, 0) for seed in reversed(range(20))]
    assert forwards == backwards[::-1]


def test_a_month_without_a_secure_row_is_played_from_its_beginning(hard_month, monkeypatch) -> None:
    series, _ = hard_month
    monkeypatch.setattr(episodes, "_is_secure", lambda grid, series, row: False)
    assert episodes._draw_start(BUS14, series, 0, 0) == (0, episodes.MAX_REDRAWS)


def test_only_drawn_starts_of_generated_months_are_drawn_again(monkeypatch) -> None:
    plan = plan_episode(BUS14, "train", 0, 0)
    monkeypatch.setattr(episodes, "_is_secure", lambda grid, series, row: pytest.fail("a row was looked at"))
    assert plan_episode(BUS14, "train", 0, 0, start=plan.start).redraws == 0
    assert plan_episode(BUS14, "bundled", 0, 0).redraws == 0
    assert episodes._draw_start(BUS14, load_scenario("bus14", "bundled/0000"), 0, 0).redraws == 0


def test_an_episode_of_a_given_length_fits_where_it_starts() -> None:
    for seed in range(5):
        default, week = (plan_episode(BUS14, "train", seed, 1, episode_length=length) for length in (None, 2016))
        assert week == default._replace(n_steps=2016)
    assert plan_episode(BUS14, "bundled", 0, 0, episode_length=575).n_steps == 575
    assert admissible_starts(575, 500) == 76


@pytest.mark.parametrize(("start", "steps"), [(None, 575), (100, 475)])
def test_a_length_that_the_series_does_not_have_is_refused(start: int | None, steps: int) -> None:
    sentence = rf"^episode_length={steps + 1} is longer than scenario bundled/0000, which has {steps} steps from row "
    with pytest.raises(UsageError, match=sentence):
        plan_episode(BUS14, "bundled", 0, 0, scenario="bundled/0000", start=start, episode_length=steps + 1)
