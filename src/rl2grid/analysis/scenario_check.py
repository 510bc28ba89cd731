"""Generated beside bundled series: distributions, autocorrelation, ramps, losses, reactive ratio, thermal loading.

The calendar months of the bundled series are compared with the same months of generated years. What needs a power
flow is computed once an hour, in the reference topology, with everything in service.
"""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rl2grid.analysis import page
from rl2grid.analysis.figures import png_bytes
from rl2grid.analysis.table import Cell, Column, ResultTable
from rl2grid.arrays import F64
from rl2grid.drawing.theme import DARK, LIGHT, Theme, style
from rl2grid.errors import UsageError
from rl2grid.grids import STEPS_PER_HOUR, Grid, find_system
from rl2grid.scenarios.fingerprint import VERSION, generator_fingerprint
from rl2grid.scenarios.generator.security import assess
from rl2grid.scenarios.library import list_scenarios, load_scenario
from rl2grid.scenarios.month_names import MONTHS, month_name
from rl2grid.scenarios.scenario import STEP, Scenario

SOURCES = ("bundled", "generated")
ROWS_PER_DAY = 24 * STEPS_PER_HOUR
_MONTH_DAYS = 28
_SHORTEST_PART = 2
"""A correlation over lags of more than one part in this many of a series is not worth showing."""


class Quantity(NamedTuple):
    """Something that is compared."""

    key: str
    label: str
    unit: str
    rows: int
    """Rows of a series from one value to the next."""


QUANTITIES = (
    Quantity("load", "Demand", "MW", 1),
    Quantity("wind", "Wind", "MW", 1),
    Quantity("solar", "Sun", "MW", 1),
    Quantity("load_ramp", "Ramp of demand", "MW in 5 min", 1),
    Quantity("dispatch_ramp", "Ramp of dispatched generation", "MW in 5 min", 1),
    Quantity("reactive_ratio", "Reactive by active demand", "MVAr/MW", 1),
    Quantity("losses", "Losses by demand", "%", STEPS_PER_HOUR),
    Quantity("slack", "Production of the slack generator", "MW", STEPS_PER_HOUR),
    Quantity("loading", "Largest loading of a line", "%", STEPS_PER_HOUR),
)
CORRELATED = ("load", "wind", "solar")
"""Quantities of which autocorrelation and day are shown."""
LAGS = (1, 2, 3, 6, 12, 24, 36, 48, 72, 96, 120, 144, 180, 216, 252, 288, 432, 576)
"""Rows."""


@dataclass(frozen=True)
class Sample:
    """What is measured on one series."""

    source: str
    """One of :data:`SOURCES`."""
    scenario_id: str
    first_row: int
    """Row of its day in which it begins."""
    values: Mapping[str, F64]
    """By key of a quantity; empty where the grid has nothing of the kind."""


@dataclass(frozen=True)
class Comparison:
    """The series of both sources."""

    grid_id: str
    fingerprint: str
    """Of the generator."""
    samples: tuple[Sample, ...]

    def values(self, source: str, key: str) -> F64:
        """All values of a quantity."""
        return np.concatenate([each.values[key] for each in self.of(source)])

    def of(self, source: str) -> tuple[Sample, ...]:
        """The series of one source."""
        return tuple(each for each in self.samples if each.source == source)

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Those of which there is something, in either source."""
        return tuple(
            each for each in QUANTITIES if any(np.any(sample.values[each.key] != 0) for sample in self.samples)
        )


def wanted_scenarios(grid: Grid, years: int) -> tuple[str, ...]:
    """Ids of all bundled series, and of the same months of the generated years 0 to ``years - 1``.

    Raises:
        UsageError: no months of the grid can be generated.
    """
    find_system(grid.id).required_constants()
    bundled = list_scenarios(grid.id, "bundled")
    months = sorted({month for name in bundled for month in _months_of(load_scenario(grid.id, name))})
    return bundled + tuple(f"generated/{month_name(year, month)}" for year in range(years) for month in months)


def measure(grid: Grid, scenario: Scenario) -> Sample:
    """The quantities of one series.

    Raises:
        UsageError: The power flow of one of its rows has no solution.
    """
    load, reactive = _total(scenario.load_p), _total(scenario.load_q)
    kinds = np.array(grid.gen_type)
    hourly = _hourly_flow(grid, scenario)
    start = scenario.start_datetime
    return Sample(
        source="generated" if scenario.source == "generated" else "bundled",
        scenario_id=scenario.id,
        first_row=start.hour * STEPS_PER_HOUR + start.minute * STEPS_PER_HOUR // 60,
        values={
            "load": load,
            "wind": _total(scenario.prod_p[:, kinds == "wind"]),
            "solar": _total(scenario.prod_p[:, kinds == "solar"]),
            "load_ramp": _ramps(load),
            "dispatch_ramp": _ramps(_total(scenario.prod_p[:, ~grid.gen_renewable])),
            "reactive_ratio": reactive / load,
            **hourly,
        },
    )


def compare(grid: Grid, samples: Sequence[Sample]) -> Comparison:
    """The comparison of series of which there is at least one of each source."""
    return Comparison(grid.id, generator_fingerprint(grid), tuple(samples))


def autocorrelation(series: Sequence[F64]) -> tuple[NDArray[np.int64], F64]:
    """Correlation of a quantity with itself later, pooled over series around their common mean.

    Args:
        series: values of several series, float64 [row].

    Returns:
        Lags in rows, int64 [lag], those of :data:`LAGS` that half of the longest series still covers, and the
        correlations, float64 [lag]; NaN where nothing varies.
    """
    longest = max(len(values) for values in series)
    lags = [lag for lag in LAGS if lag * _SHORTEST_PART <= longest]
    everything = np.concatenate(series)
    mean, variance = everything.mean(), everything.var()
    correlations = []
    for lag in lags:
        pairs = [((values[:-lag] - mean) * (values[lag:] - mean)) for values in series if len(values) > lag]
        correlations.append(np.concatenate(pairs).mean() / variance if variance > 0 else np.nan)
    return np.array(lags), np.array(correlations)


def distance(one: F64, other: F64) -> float:
    """Largest difference of two distributions (Kolmogorov and Smirnov), 0 to 1."""
    points = np.concatenate([one, other])
    shares = [np.searchsorted(np.sort(values), points, side="right") / len(values) for values in (one, other)]
    return float(np.abs(shares[0] - shares[1]).max())


def check_table(comparison: Comparison) -> ResultTable:
    """The table that the command line prints."""
    columns = tuple(Column(heading, words=number < 2) for number, heading in enumerate(HEADINGS))
    rows = tuple(tuple(Cell(text) for text in cells) for cells in table_rows(comparison))
    return ResultTable("quantities", "", columns, rows)


HEADINGS = ("quantity", "source", "mean", "deviation", "5%", "median", "95%", "after 1 h", "distance")


def table_rows(comparison: Comparison) -> list[list[str]]:
    """Two rows per quantity, under :data:`HEADINGS`."""
    rows = []
    for quantity in comparison.quantities:
        values = {source: comparison.values(source, quantity.key) for source in SOURCES}
        for source in SOURCES:
            statistics = [values[source].mean(), values[source].std(), *np.quantile(values[source], [0.05, 0.5, 0.95])]
            lag = STEPS_PER_HOUR // quantity.rows
            later = _correlation([each.values[quantity.key] for each in comparison.of(source)], lag)
            rows.append(
                [
                    f"{quantity.label} ({quantity.unit})" if source == SOURCES[0] else "",
                    source,
                    *(_number(value) for value in statistics),
                    _number(later),
                    f"{distance(*values.values()):.2f}" if source == SOURCES[1] else "",
                ]
            )
    return rows


def write_page(comparison: Comparison, path: Path) -> None:
    """Write the comparison as one HTML page that needs no other file, in the place of an earlier one.

    Raises:
        UsageError: ``path`` cannot be written.
    """
    pictures = [
        ("Distributions. Shares of all values; bars reach from the lowest to the highest.", _draw_distributions),
        ("Mean day, and between which values nine tenths of the days are.", _draw_days),
        ("Autocorrelation: how much a value says about a later one.", _draw_correlations),
        ("The first week of a series of each source.", _draw_week),
    ]
    parts = [_header(comparison), _table(comparison), *(_figure(comparison, *each) for each in pictures)]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        page.write_page(path, _title(comparison), parts)
    except OSError as error:
        raise UsageError(f"Page {path} cannot be written ({error}): choose another place.") from error


def _months_of(scenario: Scenario) -> set[int]:
    """Blocks of 28 days of the year, 0 .. 11, that hold a row of a series."""
    end = scenario.start_datetime + (scenario.n_rows - 1) * STEP
    days = (end.date() - scenario.start_datetime.date()).days + 1
    first = scenario.start_datetime.timetuple().tm_yday - 1
    # A series that touches a day only with its first row, at 23:55, is of the next one.
    first, days = (first + 1, days - 1) if scenario.start_datetime.hour == 23 else (first, days)
    return {min((first + day) % 365 // _MONTH_DAYS, MONTHS - 1) for day in range(days)}


def _total(array: NDArray[np.float32]) -> F64:
    return _decimal(array.astype(np.float64).sum(axis=1))


def _ramps(values: F64) -> F64:
    return _decimal(np.diff(values))


def _decimal(values: F64) -> F64:
    """Series are decimals, which sums and differences of binary fractions only come close to."""
    rounded: F64 = np.round(values, 3)
    return rounded


def _hourly_flow(grid: Grid, scenario: Scenario) -> dict[str, F64]:
    load_p, load_q, prod_p = (
        np.rint(10.0 * array[::STEPS_PER_HOUR].astype(np.float64)).astype(np.int32)
        for array in (scenario.load_p, scenario.load_q, scenario.prod_p)
    )
    voltage = None if scenario.prod_v is None else np.array(scenario.prod_v[0])
    verdict = assess(grid, voltage, load_p, load_q, prod_p)
    if not verdict.converged:
        raise UsageError(f"Scenario {scenario.id} of {grid.id} has a row whose power flow has no solution.")
    return {
        "losses": 100.0 * verdict.losses / load_p.sum(axis=1),
        "slack": verdict.slack.astype(np.float64),
        "loading": 100.0 * verdict.loading.astype(np.float64),
    }


def _correlation(series: Sequence[F64], lag: int) -> float:
    lags, correlations = autocorrelation(series)
    found = np.flatnonzero(lags == lag)
    return float(correlations[found[0]]) if len(found) else float("nan")


def _number(value: float) -> str:
    return "" if np.isnan(value) else f"{value:,.3g}" if abs(value) < 1000 else f"{value:,.0f}"


def _title(comparison: Comparison) -> str:
    return f"Generated and bundled series of {comparison.grid_id}"


def _header(comparison: Comparison) -> str:
    facts = [
        ("grid", comparison.grid_id),
        ("bundled series", str(len(comparison.of(SOURCES[0])))),
        ("generated months", str(len(comparison.of(SOURCES[1])))),
        ("generator", f"{VERSION} {comparison.fingerprint}"),
    ]
    listed = ", ".join(each.scenario_id for each in comparison.samples)
    return (
        f"<header><h1>{html.escape(_title(comparison))}</h1>"
        "<p>The months of the year that the bundled series are of, beside the same months of generated years. Losses, "
        "slack and loading come from the AC power flow of every hour, in the reference topology.</p>"
        f"{page.facts_html(facts)}<p class=note>{html.escape(listed)}</p></header>"
    )


def _table(comparison: Comparison) -> str:
    return (
        f"<section><h2>In numbers</h2>{page.table_html(HEADINGS, table_rows(comparison))}"
        "<p class=note>After 1 h: correlation of a value with the one an hour later. Distance: largest "
        "difference of the two cumulative distributions, from 0 (the same) to 1.</p></section>"
    )


def _figure(comparison: Comparison, caption: str, draw: Callable[[Comparison, Theme], Figure]) -> str:
    light, dark = (_png(comparison, draw, theme) for theme in (LIGHT, DARK))
    return page.figure_html(caption, light, dark)


def _png(comparison: Comparison, draw: Callable[[Comparison, Theme], Figure], theme: Theme) -> bytes:
    with matplotlib.rc_context(style(theme)):
        return png_bytes(draw(comparison, theme))


def _colours(theme: Theme) -> list[tuple[str, str]]:
    return [(SOURCES[0], theme.text), (SOURCES[1], theme.series[1])]


def _panels(n: int, columns: int, height: float) -> tuple[Figure, list[Axes]]:
    rows = -(-n // columns)
    figure = Figure(figsize=(8.4, height * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for unused in axes[n:]:
        unused.set_visible(False)
    return figure, axes[:n]


def _draw_distributions(comparison: Comparison, theme: Theme) -> Figure:
    quantities = comparison.quantities
    figure, panels = _panels(len(quantities), 3, 2.0)
    for axes, quantity in zip(panels, quantities, strict=True):
        both = np.concatenate([comparison.values(source, quantity.key) for source in SOURCES])
        low, high = np.quantile(both, [0.001, 0.999]).tolist()
        bins = np.linspace(low, high, 41) if high > low else np.array([low - 1.0, low + 1.0])
        for source, colour in _colours(theme):
            values = comparison.values(source, quantity.key)
            share = np.histogram(values, bins)[0] / len(values)
            axes.stairs(share, bins, color=colour, linewidth=1.4, label=source)
        axes.set_title(f"{quantity.label}, {quantity.unit}", fontsize=8)
        axes.set_yticks([])
    panels[0].legend()
    return figure


def _draw_days(comparison: Comparison, theme: Theme) -> Figure:
    shown = _shown(comparison)
    figure, panels = _panels(len(shown), 3, 2.4)
    for axes, quantity in zip(panels, shown, strict=True):
        for source, colour in _colours(theme):
            hours = [
                np.concatenate([_in_hour(each, quantity.key, hour) for each in comparison.of(source)])
                for hour in range(24)
            ]
            known = [hour for hour in range(24) if len(hours[hour])]
            low, high = np.array([np.quantile(hours[hour], [0.05, 0.95]) for hour in known]).T
            axes.fill_between(known, low, high, color=colour, alpha=0.12, linewidth=0)
            axes.plot(known, [hours[hour].mean() for hour in known], color=colour, linewidth=1.4, label=source)
        axes.set_title(f"{quantity.label}, {quantity.unit}", fontsize=8)
        axes.set(xlabel="Hour", xticks=range(0, 25, 6))
    panels[0].legend()
    return figure


def _draw_correlations(comparison: Comparison, theme: Theme) -> Figure:
    shown = _shown(comparison)
    figure, panels = _panels(len(shown), 3, 2.4)
    for axes, quantity in zip(panels, shown, strict=True):
        for source, colour in _colours(theme):
            lags, values = autocorrelation([each.values[quantity.key] for each in comparison.of(source)])
            axes.plot(lags / STEPS_PER_HOUR, values, ".-", color=colour, linewidth=1.2, label=source)
        axes.set_title(quantity.label, fontsize=8)
        axes.set(xlabel="Hours later", ylim=(-1.05, 1.05), xticks=range(0, 49, 12))
        axes.grid(axis="y")
    panels[0].legend()
    return figure


def _draw_week(comparison: Comparison, theme: Theme) -> Figure:
    shown = _shown(comparison)
    figure, panels = _panels(len(shown), 1, 1.7)
    for axes, quantity in zip(panels, shown, strict=True):
        for source, colour in _colours(theme):
            longest = max(comparison.of(source), key=lambda each: len(each.values["load"]))
            values = longest.values[quantity.key][: 7 * ROWS_PER_DAY]
            # Series that begin at 23:55 begin just before day 0.
            first = (longest.first_row + STEPS_PER_HOUR) % ROWS_PER_DAY - STEPS_PER_HOUR
            days = (first + np.arange(len(values))) / ROWS_PER_DAY
            axes.plot(days, values, color=colour, linewidth=0.9, label=f"{source} ({longest.scenario_id})")
        axes.set_ylabel(f"{quantity.label}, {quantity.unit}")
    panels[-1].set_xlabel("Days")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return figure


def _shown(comparison: Comparison) -> list[Quantity]:
    return [quantity for quantity in comparison.quantities if quantity.key in CORRELATED]


def _in_hour(sample: Sample, key: str, hour: int) -> F64:
    values = sample.values[key]
    hours = (sample.first_row + np.arange(len(values))) % ROWS_PER_DAY // STEPS_PER_HOUR
    chosen: F64 = values[hours == hour]
    return chosen
