"""Measure what the scenario generator makes.

``survival [GRID ...]`` prints, as a table, what doing nothing survived of the test months by the ledger,
``measure [GRID ...] --seeds N`` plays N generated months doing nothing, ``compare [GRID ...]`` sets generated against
bundled series, ``outages [GRID ...]`` does so after the loss of each line that opponent or planned outages open,
``unreachable [GRID ...]`` counts the outages whose overload no action brings below the limit; the last four write
``benchmarks/results/scenarios.json``. ``plot [GRID ...] --folder F`` draws a year.
Seeds begin at 10,000: no split uses those.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from calibration import FIRST_SEED, bundled, rounded
from numpy.typing import NDArray

from rl2grid.analysis.table import markdown_row, with_interval
from rl2grid.arrays import F32, F64, I32
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.entry import reset_one, step_one
from rl2grid.engines.native.orders import write_order
from rl2grid.engines.native.what_if import WhatIf, snapshot_of
from rl2grid.envs.tasks import find_task
from rl2grid.grids import GRID_IDS, Grid, find_system, load_grid
from rl2grid.mdp.actions import DO_NOTHING, StepAction, level_catalogue, reconnect
from rl2grid.mdp.opponents import draw_opponent
from rl2grid.powerflow.batch import NOTHING, SWITCH, Changes, Snapshot
from rl2grid.powerflow.model import load_network
from rl2grid.records.ledger import read_ledger
from rl2grid.records.statistics import UNIT, Scores, estimate, median_score
from rl2grid.scenarios.generator import generate_month
from rl2grid.scenarios.generator.calendar import MONTH_ROWS, MONTH_STEPS, MONTHS, ROWS_PER_DAY, ROWS_PER_HOUR
from rl2grid.scenarios.generator.constants import Constants, load_constants
from rl2grid.scenarios.generator.security import assess
from rl2grid.scenarios.generator.year import generate_year
from rl2grid.scenarios.library import list_scenarios
from rl2grid.scenarios.maintenance import sample_outages
from rl2grid.scenarios.month_names import parse_months
from rl2grid.scenarios.scenario import Scenario
from rl2grid.scenarios.splits import TEST
from rl2grid.streams import Purpose, Stream

KINDS = ("nuclear", "hydro", "thermal", "wind", "solar")

RESULTS = Path(__file__).resolve().parent / "results" / "scenarios.json"
LEDGER = RESULTS.with_name("baselines.json")
OUTAGE_YEARS, UNREACHABLE_MONTHS = 12, 48
"""Generated years that are set against the bundled series after the loss of lines; months, each of a year of its own,
whose outages are asked for what can be done about them."""
_NEVER = 1_000_000
"""Times the limit, and steps above it, at which a protection trips that never does."""
SEASON_MONTHS = {"winter": (0, 1, 11), "spring": (2, 3, 4), "summer": (5, 6, 7), "autumn": (8, 9, 10)}


def begin_month(engine: NativeEngine, grid: Grid, seed: int, month: int) -> int:
    """Begin a month with the opponent and planned outages; how many steps it has."""
    scenario = generate_month(grid, seed, month)
    stream = Stream(seed, month, Purpose.MAINTENANCE)
    config = find_system(grid.id).scenarios.maintenance(grid, "generated")
    outages = sample_outages(config, scenario.start_datetime, scenario.n_rows, stream)
    draws = None
    if grid.opponent.kind != "none":
        draws = draw_opponent(grid, Stream(seed, month, Purpose.OPPONENT), scenario.n_steps)
    engine.begin(0, scenario, 0, scenario.n_steps, outages, draws)
    reset_one(engine.address, 0)
    return scenario.n_steps


def survive(engine: NativeEngine, grid: Grid, seed: int, month: int) -> int:
    """Steps that doing nothing survives in a month, with the opponent and planned outages."""
    n_steps = begin_month(engine, grid, seed, month)
    write_order(engine.environments.orders, 0, DO_NOTHING)
    steps = 0
    while not engine.state.terminated[0] and steps < n_steps:
        step_one(engine.address, 0)
        steps += not engine.state.terminated[0]
    return steps


def tested(grid_id: str) -> str:
    """A row of a Markdown table: months, mean and median with their intervals, mean of each season."""
    tests = read_ledger(LEDGER).values()
    (test,) = (one for one in tests if one.label == "do-nothing" and one.task == find_task(f"{grid_id}-T0").id)
    values = test.by_month["survival"]
    names = list_scenarios(grid_id, TEST)[: len(values)]
    months = np.array([parse_months(name.removeprefix("generated/")).first for name in names])
    scores = Scores(values[None], UNIT)
    figures = (estimate(scores), estimate(scores, median_score))
    seasons = (f"{values[np.isin(months, part)].mean():.2f}" for part in SEASON_MONTHS.values())
    return markdown_row([grid_id, str(len(values)), *(with_interval(one, 3) for one in figures), *seasons])


def measure(grid_id: str, seeds: int) -> dict[str, Any]:
    """Difficulty and soundness of one month of each of ``seeds`` years; months follow each other."""
    grid = load_grid(grid_id)
    constants = load_constants(grid_id)
    engine = NativeEngine(grid, 1)
    survived, year_seconds, spares, attempts, deviations, short, slack = [], [], [], [], [], [], []
    diverged = insecure = 0
    loading = []
    for number in range(seeds):
        seed, month = FIRST_SEED + number, number % MONTHS
        began = time.perf_counter()
        year = generate_year(grid, seed)
        year_seconds.append(time.perf_counter() - began)
        spares.append(sum(spare > 0 for spare in year.spares))
        attempts.append(year.attempt)
        short.append(year.short / 10)
        survived.append(survive(engine, grid, seed, month) / MONTH_STEPS)
        rows = slice(month * MONTH_STEPS, month * MONTH_STEPS + MONTH_ROWS)
        verdict = assess(grid, constants.voltage, *(array[rows].astype(np.int32) for array in year[:3]))
        diverged += not verdict.converged
        insecure += bool(verdict.loading[: ROWS_PER_DAY + 1].max() > 1)
        loading.append(float((verdict.loading > 1).mean()))
        slack.append(verdict.slack)
        deviations.append(verdict.slack - year.prod_p[rows, grid.slack_gen] / 10)
    values = np.array(survived)
    by_season = [values[np.isin(np.arange(seeds) % MONTHS, part)] for part in SEASON_MONTHS.values()]
    power, deviation = np.concatenate(slack), np.concatenate(deviations)
    scores = Scores(values[None, :, None], UNIT)
    mean, median = estimate(scores), estimate(scores, median_score)
    return {
        "months": seeds,
        "do_nothing_mean": round(mean.value, 4),
        "do_nothing_mean_interval": rounded(np.array([mean.low, mean.high]), 4),
        "do_nothing_median": round(median.value, 4),
        "do_nothing_median_interval": rounded(np.array([median.low, median.high]), 4),
        "completed": round(float((values >= 1).mean()), 3),
        "mean_by_season": {name: round(float(v.mean()), 4) for name, v in zip(SEASON_MONTHS, by_season, strict=True)},
        "rows_overloaded": round(float(np.mean(loading)), 4),
        "year_seconds_median": round(float(np.median(year_seconds)), 2),
        "year_seconds_max": round(float(np.max(year_seconds[1:])), 2),
        "first_days_replaced": round(float(np.mean(spares)) / MONTHS, 3),
        "years_discarded": int(np.sum(attempts)),
        "months_diverged": diverged,
        "months_beginning_overloaded": insecure,
        "undelivered_mwh_per_year": round(float(np.mean(short)) / ROWS_PER_HOUR, 2),
        "slack_mw": rounded(np.percentile(power, [0, 1, 50, 99, 100]), 1),
        "slack_minus_schedule_mw": rounded(np.percentile(deviation, [0, 1, 50, 99, 100]), 2),
    }


def compare(grid_id: str, seeds: int) -> dict[str, Any]:
    """Generated against bundled series, in the calendar months that are bundled."""
    grid = load_grid(grid_id)
    constants = load_constants(grid_id)
    own = bundled(grid)
    months = {(s.start_datetime.timetuple().tm_yday + 1) // 28 for s in own}
    made = []
    for number in range(seeds):
        year = generate_year(grid, FIRST_SEED + number)
        for month in months:
            rows = slice(month * MONTH_STEPS, (month + 1) * MONTH_STEPS)
            made.append(tuple(array[rows].astype(np.int32) for array in year[:3]))
    real = [tuple(np.rint(a * 10).astype(np.int32) for a in (s.load_p, s.load_q, s.prod_p)) for s in own]
    return {"bundled": _describe(grid, constants, real), "generated": _describe(grid, constants, made)}


def outages(grid_id: str, years: int) -> dict[str, Any]:
    """Worst loading after the loss of each line that opponent or planned outages open, one at a time.

    One row an hour, in the reference topology otherwise. Beside every bundled day are those of the same weekday in the
    same month of 28 days of the generated years: most bundled series are of one to three days, working days or Sundays.
    """
    grid = load_grid(grid_id)
    lines, own = opened_lines(grid), bundled(grid)
    real = [_after_losses(grid, lines, s.load_p, s.load_q, s.prod_p, voltage_of(grid, s)) for s in own]
    days = np.concatenate([days_of_year(s) for s in own])
    made = []
    for number in range(years):
        year = generate_year(grid, FIRST_SEED + number)
        beside = {}
        for day in {int(day) for each in days for day in _days_beside(each)}:
            rows = slice(day * ROWS_PER_DAY, (day + 1) * ROWS_PER_DAY)
            megawatt = [array[rows].astype(np.float32) / np.float32(10) for array in year[:3]]
            beside[day] = _after_losses(grid, lines, *megawatt, voltage_of(grid, own[0]))
        made += [beside[int(day)] for each in days for day in _days_beside(each)]
    worst = {"bundled": np.concatenate(real), "generated": np.concatenate(made)}
    secure = {source: loading[loading[:, 0] <= 1] for source, loading in worst.items()}
    return {
        "days": {"bundled": len(days), "generated": len(made)},
        "pooled": {source: _loadings(loading[:, 1:]) for source, loading in worst.items()},
        "pooled_median_ratio": _ratio_of_medians(worst),
        "pooled_where_secure_before": {source: _loadings(loading[:, 1:]) for source, loading in secure.items()},
        "pooled_median_ratio_where_secure_before": _ratio_of_medians(secure),
        "without_loss": {source: _loadings(loading[:, 0]) for source, loading in worst.items()},
        "lines": {
            str(line): {source: _loadings(loading[:, k + 1]) for source, loading in worst.items()}
            for k, line in enumerate(lines)
        },
    }


def _ratio_of_medians(worst: dict[str, F32]) -> float:
    return round(float(np.median(worst["generated"][:, 1:]) / np.median(worst["bundled"][:, 1:])), 3)


def days_of_year(scenario: Scenario) -> NDArray[np.int64]:
    """The days, counted from January 1st, of which a series has more than half."""
    start = scenario.start_datetime
    middle = start.hour * ROWS_PER_HOUR + start.minute // 5 + ROWS_PER_DAY // 2
    days = (middle + np.arange(scenario.n_rows - ROWS_PER_DAY // 2)[::ROWS_PER_DAY]) // ROWS_PER_DAY
    return np.asarray(start.timetuple().tm_yday - 1 + days, np.int64)


def _days_beside(day: int) -> NDArray[np.int64]:
    """[4] the days of the same weekday in the month of 28 days that holds a day of the year."""
    return min(day // 28, MONTHS - 1) * 28 + day % 7 + 7 * np.arange(4)


def opened_lines(grid: Grid) -> list[int]:
    """The lines that opponent or planned outages of generated months open."""
    attacked = {line for area in grid.opponent.areas for line in area}
    return sorted(attacked | set(find_system(grid.id).scenarios.maintenance(grid, "generated").lines))


def unreachable(grid_id: str, months: int) -> dict[str, Any]:
    """Outages that nothing can be done about: no action of the largest level, alone, leaves no line above its limit.

    Months are played with the opponent and planned outages, but without protections, so that every outage happens in
    the reference topology, at the loadings of its moment; lines are closed again as soon as they may be. In the row
    after each loss all actions of the level are asked for, legal or not. The survival that remains if each such outage
    ends a month is a bound for one action at a time: two in a row, or one before the loss, may do better, and where
    the overloaded line trips, the rest may hold.
    """
    grid = load_grid(grid_id)
    rules = dataclasses.replace(grid.rules, hard_overflow=_NEVER, overflow_allowed=_NEVER)
    engine = NativeEngine(dataclasses.replace(grid, rules=rules), 1, network=load_network(grid))
    solver, levels = WhatIf(grid), [level_catalogue(grid, level) for level in range(len(grid.level_sizes))]
    losses = overloading = 0
    first, pairs = [], Counter()
    for number in range(months):
        seed, month = FIRST_SEED + number, number % MONTHS
        n_steps = begin_month(engine, grid, seed, month)
        end = n_steps
        was_closed = engine.state.line_status[0].copy()
        for step in range(n_steps):
            write_order(engine.environments.orders, 0, _close_one(engine))
            step_one(engine.address, 0)
            if engine.state.terminated[0]:
                end = min(end, step)
                break
            lost = np.flatnonzero(was_closed & ~engine.state.line_status[0])
            was_closed = engine.state.line_status[0].copy()
            if not len(lost):
                continue
            losses += len(lost)
            loading = engine.state.rho[0]
            if loading.max() <= 1:
                continue
            overloading += len(lost)
            # Small levels first: most overloads are within their reach, and the largest one takes a second.
            snapshot = snapshot_of(engine, 0)
            if all(solver.actions(snapshot, level).worst_loading.min() > 1 for level in levels):
                pairs.update((int(loading.argmax()), int(line)) for line in lost)
                end = min(end, step)
        first.append(end / n_steps)
    return {
        "months": months,
        "actions": len(levels[-1]),
        "outages_per_month": round(losses / months, 2),
        "overloading": round(overloading / max(losses, 1), 4),
        "unreachable": round(sum(pairs.values()) / max(losses, 1), 4),
        "months_with_one": round(float(np.mean(np.array(first) < 1)), 3),
        "survival_bound": round(float(np.mean(first)), 3),
        "share_of_outages_by_overloaded_and_lost_line": {
            f"{line} after {lost}": round(count / losses, 4) for (line, lost), count in pairs.most_common(8)
        },
    }


def _close_one(engine: NativeEngine) -> StepAction:
    """Close the first open line that may be closed."""
    state = engine.state
    may = ~state.line_status[0] & (state.time_before_cooldown_line[0] == 0)
    return reconnect(int(np.argmax(may))) if may.any() else DO_NOTHING


def voltage_of(grid: Grid, scenario: Scenario) -> F32:
    """[gen] voltage set-points of a series, per unit; bundled ones keep theirs."""
    network = load_network(grid)
    voltage = network.gen_setpoint if scenario.prod_v is None else scenario.prod_v[0] / network.gen_kilovolt
    return np.asarray(voltage, np.float32)


def _after_losses(grid: Grid, lines: list[int], load_p: F32, load_q: F32, prod_p: F32, voltage: F32) -> F32:
    """[hour, 1 + line] worst loading without and with the loss of each line; inf where there is no flow."""
    solver, everything = WhatIf(grid), np.ones(grid.dim_topo, np.int32)
    chosen: I32 = np.array(lines, np.int32)
    idle, loading = np.zeros(grid.n_line, np.int32), []
    for row in range(0, len(load_p), ROWS_PER_HOUR):
        snapshot = Snapshot(
            *(everything, everything, idle, np.zeros(grid.n_sub, np.int32), prod_p[row], voltage),
            *(load_p[row], load_q[row], np.zeros(grid.n_storage, np.float32)),
        )
        # A change of no line: what is loaded without a loss.
        kind = np.array([NOTHING] + [SWITCH] * len(lines), np.int8)
        target = np.concatenate([[0], chosen]).astype(np.int32)
        loading.append(solver.solve(snapshot, Changes(kind, target, np.zeros((len(kind), 1), np.uint64))).worst_loading)
    return np.array(loading)


def _loadings(worst: F32) -> dict[str, float]:
    return {
        "median": round(float(np.median(worst)), 3),
        "p90": round(float(np.quantile(worst, 0.9, method="higher")), 3),
        "above_1": round(float((worst > 1).mean()), 4),
        "above_1.5": round(float((worst > 1.5).mean()), 4),
        "no_flow": round(float(np.isinf(worst).mean()), 4),
    }


def _describe(grid: Grid, constants: Constants, series: list[Any]) -> dict[str, Any]:
    kinds = np.array(grid.gen_type)
    demand = [p.sum(axis=1) / 10 for p, _, _ in series]
    verdicts = [assess(grid, constants.voltage, *each) for each in series]
    worst = np.concatenate([v.loading for v in verdicts])
    losses = np.concatenate([v.losses / p.sum(axis=1) for v, (p, _, _) in zip(verdicts, series, strict=True)])
    result = {
        "demand_mw": rounded(np.percentile(np.concatenate(demand), [0, 5, 50, 95, 100]), 0),
        "demand_step_mw": round(float(np.mean([np.diff(d).std() for d in demand])), 2),
        "demand_autocorrelation_1h_6h": rounded(
            [np.mean([_correlation(d, lag) for d in demand]) for lag in (12, 72)], 3
        ),
        "reactive_ratio": round(float(np.mean([q.sum() / p.sum() for p, q, _ in series])), 3),
        "losses": rounded(np.percentile(losses, [5, 50, 95]), 4),
        "loading": rounded(np.percentile(worst, [0, 25, 50, 75, 95, 100]), 3),
        "rows_overloaded": round(float((worst > 1).mean()), 4),
        "slack_mw": rounded(np.percentile(np.concatenate([v.slack for v in verdicts]), [0, 5, 50, 95, 100]), 1),
    }
    for kind in KINDS:
        gens = np.flatnonzero(kinds == kind)
        if not len(gens):
            continue
        shares = [p[:, gens] / (10 * grid.gen_pmax[gens]) for _, _, p in series]
        total = [p[:, gens].sum(axis=1) / (10 * grid.gen_pmax[gens].sum()) for _, _, p in series]
        result[kind] = {
            "share_of_pmax": rounded(np.percentile(np.concatenate(total), [0, 5, 50, 95, 100]), 3),
            "step": round(float(np.mean([np.diff(s, axis=0).std() for s in shares])), 4),
            "autocorrelation_1h_6h": _memory(total),
        }
    return result


def _memory(series: list[F64]) -> list[float]:
    """Autocorrelation after one and after six hours."""
    return rounded([np.mean([_correlation(values, lag) for values in series]) for lag in (12, 72)], 3)


def _correlation(values: F64, lag: int) -> float:
    if values[lag:].std() == 0 or values[:-lag].std() == 0:
        return 1.0
    return float(np.corrcoef(values[lag:], values[:-lag])[0, 1])


def plot(grid_id: str, seed: int, folder: Path) -> None:
    """Draw a year's demand and production, two of its weeks, and the bundled series."""
    from matplotlib import pyplot

    grid = load_grid(grid_id)
    kinds = np.array(grid.gen_type)
    year = generate_year(grid, seed)
    weeks = [(f"week {w + 1}", year.load_p, year.prod_p, slice(w * 2016, (w + 1) * 2016)) for w in (1, 30)]
    real = [(s.id, np.rint(s.load_p * 10), np.rint(s.prod_p * 10), slice(0, 2016)) for s in bundled(grid)[-2:]]
    pictures = [("year", year.load_p, year.prod_p, slice(None)), *weeks, *real]
    figure, axes = pyplot.subplots(len(pictures), 1, figsize=(14, 4 * len(pictures)))
    for axis, (name, load, production, rows) in zip(axes, pictures, strict=True):
        hours = np.arange(len(load[rows])) / 12
        parts = [
            production[rows][:, kinds == kind].sum(axis=1) / 10
            for kind in ("nuclear", "hydro", "thermal", "wind", "solar")
        ]
        axis.stackplot(hours, parts, labels=("nuclear", "hydro", "thermal", "wind", "solar"))
        axis.plot(hours, load[rows].sum(axis=1) / 10, "k", linewidth=0.7, label="demand")
        axis.set(title=f"{grid_id} seed {seed}: {name}", ylabel="MW", xlabel="h")
    axes[0].legend(loc="upper right")
    figure.tight_layout()
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / f"{grid_id}-{seed}.png", dpi=60)


def record(section: str, grid_id: str, value: dict[str, Any]) -> None:
    """Keep a result in the results file."""
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    results.setdefault(section, {})[grid_id] = value
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    print(section, grid_id, json.dumps(value), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("survival", "measure", "compare", "outages", "unreachable", "plot"))
    parser.add_argument("grids", nargs="*", default=list(GRID_IDS))
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--folder", type=Path, default=Path("plots"))
    arguments = parser.parse_args()
    for grid_id in arguments.grids:
        if arguments.command == "survival":
            print(tested(grid_id))
        elif arguments.command == "measure":
            record("difficulty", grid_id, measure(grid_id, arguments.seeds))
        elif arguments.command == "compare":
            record("realism", grid_id, compare(grid_id, min(arguments.seeds, 6)))
        elif arguments.command == "outages":
            record("outages", grid_id, outages(grid_id, min(arguments.seeds, OUTAGE_YEARS)))
        elif arguments.command == "unreachable":
            record("unreachable", grid_id, unreachable(grid_id, min(arguments.seeds, UNREACHABLE_MONTHS)))
        else:
            plot(grid_id, FIRST_SEED, arguments.folder)


if __name__ == "__main__":
    main()
