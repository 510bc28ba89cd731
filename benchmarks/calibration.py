"""Fit the scenario generator to the bundled series.

``python benchmarks/calibration.py [GRID ...]`` writes ``src/rl2grid/scenarios/generator/data/<grid>.json``. What the
generator then makes is measured by ``benchmarks/scenarios.py``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import F64
from rl2grid.grids import GRID_IDS, Grid, load_grid
from rl2grid.scenarios.bundled import bundled_folders
from rl2grid.scenarios.generator.calendar import ROWS_PER_DAY, seasonal
from rl2grid.scenarios.generator.constants import Constants, RenewableConstants, constants_from_record
from rl2grid.scenarios.generator.demand import active_demand, new_demand
from rl2grid.scenarios.generator.draws import Portion
from rl2grid.scenarios.generator.renewables import new_weather, renewable_production
from rl2grid.scenarios.library import load_scenario
from rl2grid.scenarios.scenario import Scenario

DATA = Path(__file__).resolve().parents[1] / "src" / "rl2grid" / "scenarios" / "generator" / "data"
FIRST_SEED = 10_000

BUS36 = ("bus36-M", "bus36-MO-v0", "bus36-MO-v1")
POOLS = {grid: BUS36 if grid in BUS36 else (grid,) for grid in GRID_IDS}
"""The 36-bus grids have the same loads and generators and share their series."""
YEARS = {
    "bus14": 2019,
    "bus36-M": 2012,
    "bus36-MO-v0": 2012,
    "bus36-MO-v1": 2012,
    "bus118-M": 2012,
    "bus118-MOB-v0": 2050,
    "bus118-MOB-v1": 2035,
}

# Demand of a month relative to February. Levels come from the bundled months (named), the months between are drawn
# through them; bus14 and bus118-M show no season, the bus118-MOB grids that of ChroniX2Grid, 5.5/7 + 1.5/7 cos. Of
# bus36-M only April is bundled; its other months are levelled so that neither winter nor summer is much the harder one.
# Autumn of bus118-MOB-v0 is 1 to 3 percent above ChroniX2Grid's.
_FLAT = [1.0] * 12
_BUS36 = [0.99, 1.0, 0.86, 0.74, 0.67, 0.64, 0.63, 0.63, 0.65, 0.71, 0.82, 0.93]  # Feb 1.0, Apr 0.72, Aug 0.63
_CHRONIX = [0.985, 1.0, 0.969, 0.892, 0.786, 0.68, 0.602, 0.571, 0.602, 0.68, 0.786, 0.892]
SEASONS = {
    "bus14": [1.01, 1.01, 1.0, 0.99, 0.99, 0.98, 0.98, 0.98, 0.99, 1.0, 1.0, 1.01],
    "bus36-M": [0.93, 0.95, 0.8, 0.58, 0.62, 0.66, 0.66, 0.66, 0.68, 0.73, 0.8, 0.88],
    "bus36-MO-v0": _BUS36,
    "bus36-MO-v1": _BUS36,
    "bus118-M": [1.04, 1.04, 1.0, 0.95, 0.94, 0.96, 0.99, 1.0, 0.97, 0.96, 0.99, 1.03],
    "bus118-MOB-v0": [0.99, 1.0, 0.969, 0.892, 0.786, 0.68, 0.602, 0.571, 0.612, 0.7, 0.81, 0.91],
    "bus118-MOB-v1": _CHRONIX,
}
# Largest hydro production of each bundled month relative to pmax, and a reservoir's year through them.
GUIDES = {
    "bus14": _FLAT,
    "bus36-M": [0.85, 0.99, 0.8, 0.6, 0.55, 0.5, 0.42, 0.38, 0.36, 0.4, 0.5, 0.7],
    "bus118-M": [0.66, 0.66, 0.6, 0.54, 0.54, 0.53, 0.52, 0.5, 0.48, 0.5, 0.55, 0.62],
    "bus118-MOB-v0": [0.66, 0.69, 0.65, 0.58, 0.52, 0.46, 0.41, 0.38, 0.38, 0.42, 0.5, 0.6],
    "bus118-MOB-v1": [0.66, 0.66, 0.62, 0.56, 0.51, 0.45, 0.4, 0.37, 0.37, 0.42, 0.5, 0.6],
}
MIXES = {"bus118-M": [1.0, 1.15]}
"""bus118-M is bundled with two amounts of wind and sun, 0.4 and 1 in this unit; little is overloaded with the less."""
VARIETY = {"bus14": 1.5}
"""The wind of bus14 is more changeable."""
GUSTS = {
    "bus14": 0.015,
    "bus36-M": 0.01,
    "bus36-MO-v0": 0.012,
    "bus36-MO-v1": 0.025,
    "bus118-M": 0.015,
    "bus118-MOB-v0": 0.03,
    "bus118-MOB-v1": 0.03,
}
WIND, SUN = {"bus118-M": 1.4}, {"bus118-M": 0.38}
"""Factors on what is fitted: bus118-M has no overload in winter with less wind, and few secure days in summer with
more sun."""
MOST_SUN = 1.2
"""bus36-MO-v1 is bundled with days of more sun than pmax."""
EXCHANGE_NOISE = 0.95
"""Share of the variance of interconnections that they do not make up for among themselves, as a factor on its root."""
LEVELS = {"bus14": 1.02, "bus36-M": 1.12, "bus36-MO-v0": 1.1, "bus36-MO-v1": 1.04, "bus118-MOB-v0": 1.01}
"""Factor on demand that brings the difficulty to its target; 1 where it is there already."""
WANDER = 0.02
GRID_STEP = 0.02
LEAST_SLACK = {"bus118-MOB-v0": 25.0}
"""MW that the slack generator is scheduled at least: what losses differ from their forecast must not exhaust it."""


def calibrate(grid_id: str) -> dict[str, Any]:
    """Constants of one grid."""
    grid = load_grid(grid_id)
    own = bundled(grid)
    pool = [scenario for other in POOLS[grid_id] for scenario in bundled(load_grid(other))]
    record: dict[str, Any] = {
        "year": YEARS[grid_id],
        "demand": fit_demand(grid, own, pool),
        "renewables": fit_renewables(grid, own, pool),
        "supply": fit_supply(grid, pool),
        "forecast": fit_forecast(grid, own),
        "voltage": None if own[0].prod_v is None else own[0].prod_v[0].tolist(),
    }
    if any(record["demand"]["absorb"]):
        record["demand"]["surplus"] = usual_surplus(grid, constants_from_record(record))
    return record


def bundled(grid: Grid) -> list[Scenario]:
    """All bundled series of a grid."""
    return [load_scenario(grid.id, f"bundled/{name}") for name in bundled_folders(grid)]


def day_parts(scenario: Scenario, year: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Row of the year, hour of the day and kind of day of each row."""
    start = scenario.start_datetime
    minutes = start.hour * 60 + start.minute + 5 * np.arange(scenario.n_rows)
    day = minutes // 1440
    first = start.timetuple().tm_yday - 1
    row = first * ROWS_PER_DAY + minutes // 5
    weekday = (start.weekday() + day) % 7
    return row, (minutes // 60) % 24, np.maximum(weekday - 4, 0)


def kinds_of_day() -> F64:
    """[3, 24] demand on working days, Saturdays and Sundays relative to working days, from the bundled months."""
    totals = np.zeros((3, 24))
    counts = np.zeros((3, 24))
    for scenario in bundled(load_grid("bus14")):
        if scenario.n_rows < 4000:
            continue
        _, hour, kind = day_parts(scenario, 2019)
        np.add.at(totals, (kind, hour), scenario.load_p.sum(axis=1))
        np.add.at(counts, (kind, hour), 1)
    mean = totals / counts
    return mean / mean[0]


def signed_loads(scenarios: list[Scenario]) -> NDArray[np.int64]:
    """Interconnections: reactive demand is negative somewhere."""
    return np.flatnonzero(np.any([(s.load_q < -0.5).any(axis=0) for s in scenarios], axis=0))


def fit_demand(grid: Grid, own: list[Scenario], scenarios: list[Scenario]) -> dict[str, Any]:
    season = np.array(SEASONS[grid.id])
    kind_factor = kinds_of_day()
    signed = signed_loads(scenarios)
    n = grid.n_load
    by_hour, counts = np.zeros((24, n)), np.zeros(24)
    for scenario in scenarios:
        row, hour, kind = day_parts(scenario, YEARS[grid.id])
        factor = np.array([seasonal(season, int(r)) for r in row]) * kind_factor[kind, hour]
        np.add.at(by_hour, hour, scenario.load_p / factor[:, None])
        np.add.at(counts, hour, 1)
    by_hour /= counts[:, None]
    base = by_hour.mean(axis=0)
    shape = (by_hour / np.where(base == 0, 1, base)).T
    base[signed] = 0.0
    noise = []
    for scenario in scenarios:
        active = np.setdiff1d(np.flatnonzero(scenario.load_p.mean(axis=0) > 1), signed)
        values = scenario.load_p[:, active].astype(float)
        second = np.diff(values, n=2, axis=0) / values.mean(axis=0)
        noise.append(np.median(second.std(axis=0)) / np.sqrt(6))
    reactive = np.tile([0.0, 0.7], (n, 1))
    exchange = {name: np.zeros(n) for name in ("slow", "fast", "low", "high", "absorb")}
    curve, mean, absorbing = np.zeros((n, 24)), np.zeros((n, 12)), np.ones(12)
    unusual = unusual_surplus(grid, signed, scenarios)
    if len(signed):
        absorbing = fit_absorbing(signed, scenarios, unusual)
    for load in signed:
        p = np.concatenate([s.load_p[:, load] for s in scenarios]).astype(float)
        q = np.concatenate([s.load_q[:, load] for s in scenarios]).astype(float)
        slope, level = np.polyfit(p, q, 1)
        reactive[load] = level, slope
        level = month_means([s.load_p[:, load] for s in scenarios], scenarios)
        mean[load] = exchange_level(level | month_means([s.load_p[:, load] for s in own], own))
        power = np.concatenate([s.load_p[:, load] - level[s.start_datetime.month] for s in scenarios])
        exchange["absorb"][load] = share = round(float(power @ unusual / (unusual @ unusual)), 3)
        hours = np.concatenate([day_parts(s, YEARS[grid.id])[1] for s in scenarios])
        rest = power - share * unusual
        curve[load] = [rest[hours == h].mean() for h in range(24)]
        rest -= curve[load][hours]
        curve[load] -= curve[load].mean()
        days = np.array([part.mean() for part in np.array_split(rest, len(rest) // ROWS_PER_DAY)])
        exchange["slow"][load] = EXCHANGE_NOISE * days.std()
        exchange["fast"][load] = EXCHANGE_NOISE * np.sqrt(max(rest.var() - days.var(), 1.0))
        exchange["low"][load], exchange["high"][load] = p.min(), p.max()
    for scenario in scenarios:
        if scenario.n_rows < 4000:
            continue
        days = (
            scenario.load_p[: scenario.n_rows // ROWS_PER_DAY * ROWS_PER_DAY].reshape(-1, ROWS_PER_DAY, n).mean(axis=1)
        )
        share = days / days.sum(axis=1, keepdims=True)
        exchange["slow"] = np.maximum(exchange["slow"], (share / share.mean(axis=0)).std(axis=0))
    return {
        "base": rounded(base * LEVELS.get(grid.id, 1.0), 2),
        "shape": rounded(shape, 3),
        "kind": rounded(kind_factor, 3),
        "season": season.tolist(),
        "regional": [0.016 if grid.id == "bus14" else 0.03],
        "noise": [round(float(np.median(noise)), 4)],
        "reactive": rounded(reactive, 4),
        "mean": rounded(mean, 1),
        "curve": rounded(curve, 1),
        **{name: rounded(array, 3) for name, array in exchange.items()},
        "absorbing": rounded(absorbing, 3),
        "surplus": [0.0] * 12,
    }


def fit_absorbing(signed: NDArray[np.int64], scenarios: list[Scenario], unusual: F64) -> F64:
    """[12] what all interconnections take of an unusual MW in each calendar month, relative to all bundled rows."""
    exchanged = [s.load_p[:, signed].sum(axis=1) for s in scenarios]
    level = month_means(exchanged, scenarios)
    power = np.concatenate([x - level[s.start_datetime.month] for x, s in zip(exchanged, scenarios, strict=True)])
    months = np.repeat([s.start_datetime.month for s in scenarios], [s.n_rows for s in scenarios])
    shares = {
        int(m): float(power[months == m] @ unusual[months == m] / np.square(unusual[months == m]).sum())
        for m in np.unique(months)
    }
    return exchange_level(shares) / float(power @ unusual / np.square(unusual).sum())


def unusual_surplus(grid: Grid, signed: NDArray[np.int64], scenarios: list[Scenario]) -> F64:
    """[row] MW of wind and sun less ordinary demand, relative to the mean of the calendar month."""
    ordinary = np.setdiff1d(np.arange(grid.n_load), signed)
    surplus = [
        (s.prod_p[:, grid.gen_renewable].sum(axis=1) - s.load_p[:, ordinary].sum(axis=1)).astype(float)
        for s in scenarios
    ]
    level = month_means(surplus, scenarios)
    return np.concatenate([x - level[s.start_datetime.month] for x, s in zip(surplus, scenarios, strict=True)])


def month_means(series: list[Any], scenarios: list[Scenario]) -> dict[int, float]:
    """Mean of the rows of every calendar month (1 .. 12) that is bundled."""
    months = np.repeat([s.start_datetime.month for s in scenarios], [len(values) for values in series])
    rows = np.concatenate(series)
    return {int(month): float(rows[months == month].mean()) for month in np.unique(months)}


def usual_surplus(grid: Grid, constants: Constants) -> list[float]:
    """[12] mean of generated wind and sun less ordinary demand around the middle of each calendar month, MW."""
    ordinary = constants.demand.base > 0
    rows = 365 * ROWS_PER_DAY
    month = (np.arange(rows) * 12) // rows
    totals = []
    for seed in range(FIRST_SEED, FIRST_SEED + 12):
        portion = Portion(seed, 0, 0, rows)
        renewables = renewable_production(new_weather(grid, constants.renewables, portion))
        active = active_demand(new_demand(grid, constants, portion), renewables)
        totals.append(renewables.sum(axis=1) - active[:, ordinary].sum(axis=1))
    mean = np.mean(totals, axis=0) / 10
    return rounded([mean[month == k].mean() for k in range(12)], 1)


def exchange_level(means: dict[int, float]) -> F64:
    """[12] usual power of an interconnection: February, April and August are bundled, between them it drifts."""
    winter, spring, summer = means[2], means[4], means[8]
    known = np.array([1.0, 2.0, 4.0, 8.0, 9.0, 12.0, 13.0])
    return np.interp(np.arange(1, 13), known, [winter, winter, spring, summer, summer, winter, winter])


def fit_renewables(grid: Grid, own: list[Scenario], pool: list[Scenario]) -> dict[str, Any]:
    mixes = np.array(MIXES.get(grid.id, [1.0]))
    kinds = np.array(grid.gen_type)
    variety, gusts = VARIETY.get(grid.id, 1.0), GUSTS[grid.id]
    unit = RenewableConstants(
        wind=np.ones(1), solar=np.full(1, 0.6), variety=np.full(1, variety), gusts=np.full(1, gusts), mixes=np.ones(1)
    )

    rows = 365 * ROWS_PER_DAY
    cache = [renewable_production(new_weather(grid, unit, Portion(seed, 0, 0, rows))) / 10 for seed in range(6)]
    factor = {}
    for kind in ("wind", "solar"):
        gens = np.flatnonzero(kinds == kind)
        seen = expected = 0.0
        for scenario in own:
            row, _, _ = day_parts(scenario, YEARS[grid.id])
            near = (row[0] - 15 * ROWS_PER_DAY + np.arange(30 * ROWS_PER_DAY)) % len(cache[0])
            gens_seen = gens[scenario.prod_p[:, gens].max(axis=0) > 0]
            pmax = grid.gen_pmax[gens_seen].sum()
            share = scenario.prod_p[:, gens_seen].sum(axis=1).mean() / pmax
            mix = 0.4 if "/x1/" in scenario.id else 1.0
            seen += share / mix
            expected += np.mean([year[near][:, gens_seen].sum(axis=1).mean() for year in cache]) / pmax
        factor[kind] = seen / expected
    return {
        "wind": [round(factor["wind"] * WIND.get(grid.id, 1.0), 3)],
        "solar": [round(min(0.6 * factor["solar"] * SUN.get(grid.id, 1.0), MOST_SUN), 3)],
        "variety": [variety],
        "gusts": [gusts],
        "mixes": mixes.tolist(),
    }


def fit_supply(grid: Grid, scenarios: list[Scenario]) -> dict[str, Any]:
    """Supply curves against the price, which is the share of what can be produced that is produced."""
    units = np.flatnonzero(~grid.gen_renewable)
    types = np.array(grid.gen_type)[units]
    guide = np.array(GUIDES["bus36-M" if grid.id in BUS36 else grid.id])
    guides = np.ones((len(units), 12))
    guides[types == "hydro"] = guide
    production = np.concatenate([s.prod_p[:, units] for s in scenarios]).astype(float)
    rows = np.concatenate([day_parts(s, YEARS[grid.id])[0] for s in scenarios])
    level = np.array([seasonal(guide, int(row)) for row in rows])
    pmax = grid.gen_pmax[units].astype(float)
    slack = int(np.flatnonzero(units == grid.slack_gen)[0])
    high = pmax - 1.0
    for k, kind in enumerate(types):
        if kind == "nuclear" and grid.id.startswith("bus118-MOB"):
            high[k] = 0.9 * pmax[k] - 1.0
        if kind == "hydro" and grid.id != "bus14":
            high[k] = pmax[k]
    low = np.zeros(len(units))
    if grid.id != "bus14":
        low[slack] = max(np.floor(np.percentile(production[:, slack], 1)), LEAST_SLACK.get(grid.id, 8.0))
    available = high[None, :] * np.where(types == "hydro", level[:, None], 1.0)
    price = production.sum(axis=1) / available.sum(axis=1)
    running = production.max(axis=0) > 0.1 * high
    begin, width = np.zeros(len(units)), np.ones(len(units))
    cost = grid.gen_cost_per_mw[units].astype(float)
    sample = slice(None, None, 3)
    for k in range(len(units)):
        if not running[k]:
            continue
        best = np.inf
        share = (production[sample, k] - low[k]) / np.maximum(available[sample, k] - low[k], 1.0)
        for b in np.arange(-0.6, 1.2, GRID_STEP):
            for w in np.arange(0.06, 3.0, 0.06):
                error = np.square(share - np.clip((price[sample] - b) / w, 0, 1)).mean()
                if error < best - 1e-9:
                    best, begin[k], width[k] = error, b, w
    top = price.max()
    for k in np.flatnonzero(~running):
        begin[k] = top + 0.004 * (cost[k] - cost[~running].min())
        width[k] = 0.5
    losses = np.mean([np.mean(s.prod_p.sum(axis=1)) / np.mean(s.load_p.sum(axis=1)) - 1 for s in scenarios])
    return {
        "gen": units.tolist(),
        "low": rounded(low, 1),
        "high": rounded(high, 1),
        "begin": rounded(begin, 3),
        "width": rounded(width, 3),
        "guide": rounded(guides, 3),
        "wander": [WANDER],
        "losses": [round(float(losses), 4)],
    }


def fit_forecast(grid: Grid, scenarios: list[Scenario]) -> dict[str, Any]:
    first = scenarios[0]
    horizon = first.load_p_forecast.shape[1]
    twelve = horizon > 1
    return {
        "horizon": [horizon],
        "load": [0.02 if twelve else 0.01],
        "wind": [0.03],
        "solar": [0.03],
    }


def rounded(values: NDArray[Any], digits: int) -> list[Any]:
    """Values as JSON holds them."""
    return np.round(np.asarray(values, float), digits).tolist()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("grids", nargs="*", default=list(GRID_IDS))
    for grid_id in parser.parse_args().grids:
        path = DATA / f"{grid_id}.json"
        path.write_text(json.dumps(calibrate(grid_id), separators=(",", ":")) + "\n")
        print(path, path.stat().st_size, flush=True)


if __name__ == "__main__":
    main()
