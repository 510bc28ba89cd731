"""Generated months: sound, joined, the same everywhere."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS, find_system, load_grid
from rl2grid.scenarios.bundled import interconnections
from rl2grid.scenarios.generator import generate_month
from rl2grid.scenarios.generator.arithmetic import exponential, gaussians, sine
from rl2grid.scenarios.generator.calendar import MONTH_ROWS, MONTH_STEPS, MONTHS, ROWS_PER_DAY, day_kinds, seasonal
from rl2grid.scenarios.generator.constants import load_constants
from rl2grid.scenarios.generator.demand import active_demand, new_demand
from rl2grid.scenarios.generator.dispatch import _share, dispatch, new_market
from rl2grid.scenarios.generator.draws import Channel, Draws, Portion
from rl2grid.scenarios.generator.fields import neighbourly, new_field, value
from rl2grid.scenarios.generator.month import hash_of
from rl2grid.scenarios.generator.security import assess
from rl2grid.scenarios.generator.year import generate_year

SEED = 10_000
"""A calibration seed: no split uses those from 10,000 on."""
HASHES = {
    "bus14": "11f55b18620cc076",
    "bus36-MO-v0": "12f70bcf638c25b3",
    "bus118-MOB-v0": "5db4ccb52e2bf52c",
}
"""First digits of the content hash of month 3 of seed 10,000; they change with every change of the generator."""


@pytest.fixture(params=[GRID_IDS[0], *(pytest.param(grid_id, marks=pytest.mark.slow) for grid_id in GRID_IDS[1:])])
def grid(request):
    return load_grid(request.param)


def test_sine_and_exponential_agree_with_the_library():
    turns = np.linspace(-3, 3, 1001)
    assert max(abs(sine(x) - np.sin(2 * np.pi * x)) for x in turns) < 1e-7
    powers = np.linspace(-19, 19, 1001)
    assert max(abs(exponential(x) / np.exp(x) - 1) for x in powers) < 1e-5


def test_gaussians_have_the_moments_of_a_normal_distribution():
    values = gaussians(Draws(1, 0, Channel.PRICE), 400_000)
    # Four standard errors; the sum of four uniforms has a kurtosis of 2.7.
    assert abs(values.mean()) < 4 / np.sqrt(400_000)
    assert abs(values.var() - 1) < 4 * np.sqrt(1.7 / 400_000)
    assert abs((values**4).mean() - 2.7) < 0.05


def test_channels_attempts_months_and_seeds_are_independent():
    keys = [(1, 0, Channel.PRICE, 0), (2, 0, Channel.PRICE, 0), (1, 1, Channel.PRICE, 0), (1, 0, Channel.MIX, 0)]
    first = [Draws(*key).uniform(1)[0] for key in [*keys, (1, 0, Channel.PRICE, 1)]]
    assert len(set(first)) == len(first)


def test_fields_vary_by_one_and_neighbours_more_alike_than_strangers():
    grid = load_grid("bus118-MOB-v0")
    field = new_field(
        Portion(3, 0, 0, 40_000), Channel.WIND_HOURS, 24, neighbourly(grid, np.arange(118, dtype=np.int32))
    )
    samples = np.array([[value(field, row, sub) for sub in range(118)] for row in range(0, 40_000, 24)])
    assert samples.std() == pytest.approx(1, abs=0.03)
    correlation = np.corrcoef(samples.T)
    place = np.array(grid.layout)
    distance = np.linalg.norm(place[:, None] - place[None], axis=2)
    near, far = distance < np.quantile(distance, 0.1), distance > np.quantile(distance, 0.9)
    assert correlation[near].mean() > correlation[far].mean() + 0.3


def test_season_holds_in_the_middle_of_its_months():
    knots = np.arange(12.0)
    middle = [round((month + 0.5) * 365 / 12 * ROWS_PER_DAY) for month in range(12)]
    assert [seasonal(knots, row) for row in middle] == pytest.approx(list(range(12)), abs=1e-3)


def test_kinds_of_day_follow_the_calendar():
    assert day_kinds(2012, 8).tolist() == [2, 0, 0, 0, 0, 0, 1, 2]  # January 1st, 2012, was a Sunday.


def test_dispatch_is_the_cheapest():
    """No two units can exchange production for less, beyond the rounding to whole 0.1 MW."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        floor, begin = rng.uniform(0, 100, 6), rng.uniform(-0.5, 1, 6)
        slope = (2000 - floor) / rng.uniform(0.06, 3, 6)
        low = rng.integers(100, 1000, 6)
        high = low + rng.integers(0, 1000, 6)
        asked = int(rng.integers(low.sum(), high.sum() + 1))
        power = np.zeros(6, np.int64)
        _share(asked, floor, slope, begin, low, high, power)
        assert power.sum() == asked
        assert (power >= low).all()
        assert (power <= high).all()
        # Optimal: no unit that can rise is cheaper than one that can fall, beyond the rounding to whole units.
        price = begin + (power - floor) / slope
        step = 1 / slope
        rising, falling = power < high, power > low
        for up in np.flatnonzero(rising):
            for down in np.flatnonzero(falling):
                assert price[down] - 2 * step[down] <= price[up] + 2 * step[up]


def test_dispatch_curtails_wind_and_sun_when_generators_cannot_go_lower():
    grid = load_grid("bus36-M")
    constants = load_constants(grid.id)
    market = new_market(grid, constants, Portion(0, 0, 0, 2000))
    production = np.where(grid.gen_renewable, 500, 0).astype(np.int32)[None].repeat(3, axis=0)
    consumption = np.full(3, 1000)
    assert dispatch(market, 0, 1, consumption, np.zeros(3, np.int64), production) == 0
    assert (production.sum(axis=1) == 1000).all()
    assert (production >= 0).all()
    assert np.ptp(production[:, grid.gen_renewable], axis=1).max() <= 1 + production.shape[1]


def test_thermal_units_start_before_a_peak_that_ramps_would_miss():
    """Demand rises faster than all thermal units can, far beyond what the others can meet, and nothing is missing."""
    grid = load_grid("bus118-MOB-v1")
    constants = load_constants(grid.id)
    supply, first, rows = constants.supply, 1200, 60
    market = new_market(grid, constants, Portion(0, 0, 0, 2000))
    thermal = np.array(grid.gen_type)[supply.gen] == "thermal"
    ramps = market.ramp[thermal].sum()
    available = [10 * high * seasonal(guide, first) for high, guide in zip(supply.high, supply.guide, strict=True)]
    others = np.array(available)[~thermal].sum()
    consumption = (others - 2 * ramps + 1.2 * ramps * np.clip(np.arange(rows) - 30, 0, 12)).astype(np.int64)
    production = np.zeros((rows, grid.n_gen), np.int32)
    assert dispatch(market, first, 1, consumption, np.zeros(rows, np.int64), production) == 0
    assert np.array_equal(production.sum(axis=1), consumption)
    # Without foresight they would be at their least until the others are at their most, and miss the peak by 2 ramps.
    climb = production[42, supply.gen[thermal]].sum() - production[31, supply.gen[thermal]].sum()
    assert climb <= 11 * ramps < consumption[42] - consumption[31]


def test_interconnections_take_a_share_of_the_sun():
    """A sunny portion of a year and the same without sun differ by the share of the season, within bounds."""
    grid = load_grid("bus36-M")
    constants = load_constants(grid.id)
    known, portion = constants.demand, Portion(SEED, 0, 0, ROWS_PER_DAY)
    demand = new_demand(grid, constants, portion)
    dark = np.zeros((ROWS_PER_DAY, grid.n_gen), np.int32)
    sunny = dark.copy()
    sunny[:, np.array(grid.gen_type) == "solar"] = 100
    before, after = active_demand(demand, dark), active_demand(demand, sunny)
    exchange = np.array(interconnections(grid))
    ordinary = np.setdiff1d(np.arange(grid.n_load), exchange)
    assert np.array_equal(after[:, ordinary], before[:, ordinary])
    before, after = before[:, exchange], after[:, exchange]
    low, high = 10 * known.low[exchange], 10 * known.high[exchange]
    free = (before > low + 1) & (after < high - 1) & (before < high - 1) & (after > low + 1)
    season = np.array([seasonal(known.absorbing, row) for row in range(ROWS_PER_DAY)])
    expected = season[:, None] * known.absorb[exchange] * sunny[0].sum()
    change = after - before
    assert free.mean() > 0.5
    assert np.abs(np.where(free, change - expected, 0)).max() <= 1
    assert (after >= np.floor(low)).all()
    assert (after <= np.ceil(high)).all()
    assert 0.5 < known.absorb.sum() < 0.8
    assert known.absorbing[1] > 1 > known.absorbing[7]


def test_portions_of_a_year_are_drawn_by_themselves():
    """The first knot of a portion is that of its first row; its values are as smooth and vary as much."""
    grid = load_grid("bus14")
    whole = new_field(Portion(3, 0, 0, 20_000), Channel.WIND_HOURS, 24, np.eye(grid.n_sub))
    assert whole.first == 0
    portion = new_field(Portion(3, 0, 9_995, 20_000, part=1), Channel.WIND_HOURS, 24, np.eye(grid.n_sub))
    samples = np.array([value(portion, row, 0) for row in range(9_995, 20_000)])
    assert samples.std() == pytest.approx(1, abs=0.1)
    assert np.abs(np.diff(samples)).max() < 0.3
    assert samples[5] != value(whole, 10_000, 0)


def test_months_have_the_rows_columns_and_units_of_a_scenario(grid):
    scenario = generate_month(grid, SEED, 3)
    assert scenario.id == "generated/10000-03"
    assert scenario.grid_id == grid.id
    assert scenario.n_rows == MONTH_ROWS
    assert scenario.n_steps == MONTH_STEPS
    assert (scenario.prod_v is None) == grid.id.startswith("bus118-MOB")
    for name, array in scenario.arrays().items():
        assert array.dtype == np.float32, name
        assert array.flags.c_contiguous, name
        assert not array.flags.writeable, name
        assert np.isfinite(array).all(), name
        if name.startswith(("load", "prod_p")):
            tenths = array.astype(np.float64) * 10
            assert np.array_equal((np.rint(tenths) / 10).astype(np.float32), array), name
    horizon = 12 if grid.id == "bus118-MOB-v1" else 1
    assert scenario.load_p_forecast.shape == (MONTH_ROWS, horizon, grid.n_load)


def test_consecutive_months_join(grid):
    first, second = generate_month(grid, SEED, 4), generate_month(grid, SEED, 5)
    for name in ("load_p", "load_q", "prod_p"):
        assert np.array_equal(getattr(first, name)[-1], getattr(second, name)[0]), name
    assert (second.start_datetime - first.start_datetime).days == 28


def test_limits_and_ramps_hold_in_every_step_of_the_year(grid):
    year = generate_year(grid, SEED)
    production = year.prod_p / 10
    assert (production >= 0).all()
    assert (production <= grid.gen_pmax + 1e-4).all()
    units = ~grid.gen_renewable
    steps = np.diff(production[:, units], axis=0)
    assert (steps <= grid.gen_max_ramp_up[units] + 1e-6).all()
    assert (-steps <= grid.gen_max_ramp_down[units] + 1e-6).all()


def test_demand_is_positive_and_reactive_demand_seven_tenths_of_it(grid):
    year = generate_year(grid, SEED)
    ordinary = np.setdiff1d(np.arange(grid.n_load), interconnections(grid))
    assert (year.load_p[:, ordinary] >= 0).all()
    assert np.abs(year.load_q[:, ordinary] - 0.7 * year.load_p[:, ordinary]).max() <= 0.5001


def test_year_is_operable_and_every_month_begins_secure(grid):
    """AC power flow of every row, reference topology, nothing trips."""
    year = generate_year(grid, SEED)
    series = (array.astype(np.int32) for array in (year.load_p, year.load_q, year.prod_p))
    verdict = assess(grid, load_constants(grid.id).voltage, *series)
    assert verdict.converged
    for month in range(MONTHS):
        first_day = verdict.loading[month * MONTH_STEPS : month * MONTH_STEPS + ROWS_PER_DAY + 1]
        assert first_day.max() <= 1
    assert year.short == 0
    assert verdict.slack.min() > 0
    assert verdict.slack.max() <= grid.gen_pmax[grid.slack_gen]
    # Losses are interpolated between half hours; what gusts between them change is left to the slack generator.
    assert np.abs(verdict.slack - year.prod_p[:, grid.slack_gen] / 10).max() < 25


def test_forecasts_miss_by_more_the_further_they_look():
    grid = load_grid("bus118-MOB-v1")
    scenario = generate_month(grid, SEED, 3)
    known = load_constants(grid.id).forecast
    load = int(scenario.load_p.mean(axis=0).argmax())
    for ahead in (0, 11):
        real = scenario.load_p[ahead + 1 :, load]
        error = scenario.load_p_forecast[: len(real), ahead, load] / real - 1
        assert error.std() == pytest.approx(known.load[0] * np.sqrt(ahead + 1), rel=0.05)


def test_same_month_again_and_another_month_for_another_seed(grid):
    again = generate_month(grid, SEED, 3)
    generate_year.cache_clear()
    assert generate_month(grid, SEED, 3).content_hash == again.content_hash
    assert generate_month(grid, SEED + 1, 3).content_hash != again.content_hash


_HASH = (
    "import sys; from rl2grid.grids import load_grid; from rl2grid.scenarios.generator import generate_month; "
    f"print(generate_month(load_grid(sys.argv[1]), {SEED}, 3).content_hash)"
)


@pytest.mark.slow
@pytest.mark.parametrize("grid_id", sorted(HASHES))
def test_same_bytes_on_a_processor_with_nothing_but_the_basics(grid_id, tmp_path):
    here = generate_month(load_grid(grid_id), SEED, 3).content_hash
    features = "SSE41 SSE42 POPCNT AVX F16C FMA3 AVX2 AVX512F AVX512CD AVX512_SKX X86_V2 X86_V3 X86_V4"
    reduced = {
        "NPY_DISABLE_CPU_FEATURES": " ".join(_dispatched(features.split())),
        "NUMBA_CPU_NAME": "generic",
        "NUMBA_CPU_FEATURES": "",
        "XDG_CACHE_HOME": str(tmp_path),
    }
    run = subprocess.run(
        [sys.executable, "-c", _HASH, grid_id], env=os.environ | reduced, capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == here


def _dispatched(features: list[str]) -> list[str]:
    """Features that NumPy knows how to do without; it refuses to start when told to disable others."""
    from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

    return [name for name in features if name in __cpu_dispatch__ and __cpu_features__.get(name)]


@pytest.mark.slow
@pytest.mark.parametrize("grid_id", sorted(HASHES))
def test_months_are_those_of_this_version_of_the_generator(grid_id):
    assert generate_month(load_grid(grid_id), SEED, 3).content_hash.startswith(HASHES[grid_id])


def test_hash_names_every_value():
    grid = load_grid("bus14")
    scenario = generate_month(grid, SEED, 0)
    arrays = scenario.arrays()
    assert hash_of(scenario.start_datetime, arrays) == scenario.content_hash
    changed = arrays["load_p"].copy()
    changed[17, 3] += np.float32(0.1)
    assert hash_of(scenario.start_datetime, arrays | {"load_p": changed}) != scenario.content_hash


def test_maintenance_of_grids_that_record_it_is_that_of_the_same_lines():
    for grid_id in GRID_IDS:
        grid = load_grid(grid_id)
        config = find_system(grid.id).scenarios.maintenance(grid, "generated")
        assert config.lines
        assert max(config.lines) < grid.n_line
        assert grid.maintenance.lines in ((), config.lines)


@pytest.mark.parametrize("seed", [-1, 2**63, 1.5, True, "1"])
def test_wrong_seeds_are_refused(seed):
    with pytest.raises(UsageError, match="choose an integer from 0 to"):
        generate_month(load_grid("bus14"), seed, 0)


@pytest.mark.parametrize("month", [-1, 12, 0.5, "0"])
def test_wrong_months_are_refused(month):
    with pytest.raises(UsageError, match="choose an integer from 0 to 11"):
        generate_month(load_grid("bus14"), SEED, month)
