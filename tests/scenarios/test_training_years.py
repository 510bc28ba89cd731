"""The library of training years: where its months lie, what they are, and how episodes are drawn from it."""

import os
from pathlib import Path

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.scenarios import training_years
from rl2grid.scenarios.cache import data_folder, series_folder
from rl2grid.scenarios.episodes import EpisodePlan, plan_episode, planned_outages
from rl2grid.scenarios.generator import month as generator
from rl2grid.scenarios.generator.calendar import MONTH_STEPS
from rl2grid.scenarios.library import load_scenario, open_series
from rl2grid.scenarios.month_names import Months
from rl2grid.scenarios.splits import (
    FIRST_TRAINING_SEED,
    HELD_OUT_SPLITS,
    TRAINING_SEEDS,
    TRAINING_YEARS,
    draw_training_months,
    years_for,
)
from rl2grid.scenarios.training_years import (
    TrainingMonths,
    check_library_room,
    has_library_room,
    is_year_there,
    training_months,
    training_year,
)

BUS14 = load_grid("bus14")
SEED = FIRST_TRAINING_SEED


def test_months_are_those_that_the_generator_makes() -> None:
    months = training_months(BUS14, Months(SEED, 3, 2))
    scenario = load_scenario("bus14", f"generated/{SEED}-03+04")
    assert (months.id, months.n_steps, months.n_rows) == (scenario.id, scenario.n_steps, scenario.n_rows)
    assert (months.start_datetime, months.series_rows) == (scenario.start_datetime, scenario.series_rows)
    third = generator.generate_month(BUS14, SEED, 3)
    for name, integers in zip(("load_p", "load_q", "prod_p"), months.rows(0, months.n_rows), strict=True):
        assert integers.dtype == np.int16
        assert not integers.flags.writeable
        np.testing.assert_array_equal((integers / 10.0).astype(np.float32), getattr(scenario, name))
        np.testing.assert_array_equal(getattr(third, name), getattr(scenario, name)[: MONTH_STEPS + 1])


@pytest.mark.parametrize("row", [0, 1, 4711, MONTH_STEPS - 1, MONTH_STEPS, MONTH_STEPS + 1, 2 * MONTH_STEPS])
def test_forecasts_are_made_for_the_row_in_which_somebody_asks(row: int) -> None:
    months = training_months(BUS14, Months(SEED, 10, 2))
    scenario = load_scenario("bus14", months.id)
    expected = scenario.load_p_forecast, scenario.load_q_forecast, scenario.prod_p_forecast
    for made, array in zip(months.forecasts(row), expected, strict=True):
        assert array is not None
        np.testing.assert_array_equal(made, array[row])


def test_a_year_is_made_once_and_kept_as_integers(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path))
    made = []
    generate = training_years.generate_year
    monkeypatch.setattr(training_years, "generate_year", lambda grid, seed: made.append(seed) or generate(grid, seed))
    assert not is_year_there(BUS14, SEED + 1)
    first = training_year(BUS14, SEED + 1)
    assert is_year_there(BUS14, SEED + 1)
    assert training_year(BUS14, SEED + 1) is first
    training_years._open_year.cache_clear()
    again = training_year(BUS14, SEED + 1)
    assert again.content_hash == first.content_hash
    assert made == [SEED + 1]
    files = [path for path in data_folder().rglob("*") if path.is_file() and path.suffix != ".lock"]
    assert sum(path.stat().st_size for path in files) < 1.001 * training_years.year_bytes(BUS14)
    files[0].with_suffix(".npy").write_bytes(b"damaged")
    training_years._open_year.cache_clear()
    assert training_year(BUS14, SEED + 1).content_hash == first.content_hash
    assert made == [SEED + 1] * 2


def test_a_library_that_does_not_fit_is_refused_and_a_year_that_fits_is_played(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path))
    monkeypatch.setattr(training_years, "free_bytes", lambda: 5 * 10**8)
    with pytest.raises(UsageError, match=r"bus14 takes 0\.5 GB in .* and 0\.5 GB are free: free some"):
        check_library_room(BUS14)
    check_library_room(BUS14, 90)
    assert not has_library_room(BUS14)
    assert not list(tmp_path.rglob("*.npy"))
    training_year(BUS14, SEED)
    assert is_year_there(BUS14, SEED)


def test_a_year_that_does_not_fit_is_refused_before_anything_is_written(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path))
    monkeypatch.setattr(training_years, "free_bytes", lambda: 10**6)
    with pytest.raises(UsageError, match=r"bus14 takes 5 MB in .*, and 1 MB are free: free some"):
        training_year(BUS14, SEED)
    assert not list(tmp_path.rglob("*.npy"))


def test_years_of_another_generator_and_expanded_months_give_way_to_a_year(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path))
    training_year(BUS14, SEED)
    current = next(series_folder("bus14").glob("year.*.npy"))
    removable = [current.with_name(f"{name}.npy") for name in ("year.1-older", "year.1-old", "generated.3-04-older")]
    kept = current.with_name("generated.3-04-latest.npy")
    for age, path in enumerate((*removable, kept)):
        path.write_bytes(bytes(10**6))
        os.utime(path, (1000 + age, 1000 + age))
    monkeypatch.setattr(
        training_years,
        "free_bytes",
        lambda: training_years.year_bytes(BUS14) - 10**6 * sum(path.exists() for path in removable),
    )
    training_year(BUS14, SEED + 1)
    assert not any(path.exists() for path in removable)
    assert kept.exists()
    assert is_year_there(BUS14, SEED)
    assert is_year_there(BUS14, SEED + 1)


def test_an_unwritable_data_folder_is_named(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path / "file"))
    with pytest.raises(UsageError, match="set RL2GRID_DATA to one that can"):
        training_year(BUS14, SEED)


def test_training_draws_from_all_of_the_library_and_from_nothing_else() -> None:
    drawn = [draw_training_months(seed, number) for seed in range(500) for number in range(40)]
    assert {each.seed for each in drawn} == set(TRAINING_SEEDS)
    assert len(set(drawn)) == 11 * TRAINING_YEARS >= 1_000
    counts = np.bincount([each.first for each in drawn], minlength=12)
    assert counts[11] == 0
    np.testing.assert_allclose(counts[:11] / len(drawn), 1 / 11, atol=0.01)
    held_out = {int(name.partition("-")[0]) for names in HELD_OUT_SPLITS.values() for name in names}
    assert not held_out & set(TRAINING_SEEDS)


def test_first_episodes_are_drawn_from_few_years_and_neighbours_draw_for_themselves() -> None:
    for number in range(5):
        years = [draw_training_months(seed, number).seed - FIRST_TRAINING_SEED for seed in range(400)]
        assert max(years) < years_for(number)
        assert len(set(years)) > 0.9 * years_for(number)
    assert [years_for(number) for number in range(4)] == [4, 24, 96, 96]


def test_plans_do_not_expand_the_months(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path))
    plan = plan_episode(BUS14, "train", 5, 0)
    assert isinstance(open_series("bus14", plan.scenario_id), TrainingMonths)
    assert not list(data_folder().rglob("generated.*"))


def test_outages_of_months_are_those_of_their_scenario() -> None:
    for number in range(6):
        plan = EpisodePlan(7, number, f"generated/{SEED}-06+07", 0, 100)
        series = training_months(BUS14, Months(SEED, 6, 2)), load_scenario("bus14", f"generated/{SEED}-06+07")
        first, second = (planned_outages(BUS14, each, plan) for each in series)
        np.testing.assert_array_equal(first, second)


def test_windows_and_other_seeds_are_no_months_of_the_library() -> None:
    assert not isinstance(open_series("bus14", f"generated/{SEED}-03[0:288]"), TrainingMonths)
    assert not isinstance(open_series("bus14", "generated/17-03"), TrainingMonths)
