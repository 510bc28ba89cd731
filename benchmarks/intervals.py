"""How often 95% intervals hold the truth, where the truth is known.

``python benchmarks/intervals.py [--datasets N]`` draws tables of runs by months with known components of variance, as
often as asked, computes the intervals that tables of results show, and counts how many hold what they estimate. It
writes ``benchmarks/results/intervals.json``: a row for each world, number of runs and number of months.

In a normal world a value is the sum of a run's, a month's and their common part. In a world of survival that sum is cut
at 0 and 1, so that many months are completed, or lost at once; the share of months above 1 is that of completed ones.
Differences are between two methods of the same world on the same months: the truth is 0, and the share of p-values
below 0.05 should be 0.05. The last figure is of five such methods: how often any of the ten pairs is called different
after Holm's correction.
"""

from __future__ import annotations

import argparse
import itertools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from rl2grid.records.comparisons import paired_differences, probability_of_improvement
from rl2grid.records.statistics import UNIT, Estimate, Scores, estimate, iqm_score, mean_score, resampled

RESULTS = Path(__file__).resolve().parent / "results" / "intervals.json"
FAMILY = 5
"""Methods that are compared with each other at once."""
IQM_EVERY = 5
"""The interquartile mean takes longest: it is looked at in every fifth dataset."""


@dataclass(frozen=True)
class World:
    """Standard deviations of what makes a value."""

    mean: float
    of_runs: float
    of_months: float
    of_both: float
    is_survival: bool = True

    def draw(self, random: np.random.Generator, methods: int, runs: int, months: int) -> NDArray[np.float64]:
        """Sums of the parts, not cut yet, float64 [method, run, month]; months are those of all methods."""
        of_months = self.of_months * random.normal(size=(1, 1, months))
        of_runs = self.of_runs * random.normal(size=(methods, runs, 1))
        return self.mean + of_runs + of_months + self.of_both * random.normal(size=(methods, runs, months))

    def scores(self, values: NDArray[np.float64]) -> Scores:
        """The table of one method [run, month]."""
        if self.is_survival:
            return Scores(np.clip(values, 0, 1)[:, :, None], UNIT)
        return Scores(values[:, :, None])

    def truth(self) -> dict[str, float]:
        """What the intervals estimate, by the quantiles of the distribution of values."""
        deviation = float(np.sqrt(self.of_runs**2 + self.of_months**2 + self.of_both**2))
        quantiles = stats.norm.ppf((np.arange(1_000_000) + 0.5) / 1_000_000, self.mean, deviation)
        values = np.clip(quantiles, 0, 1) if self.is_survival else quantiles
        return {
            "mean": float(values.mean()),
            "iqm": float(values[250_000:750_000].mean()),
            "completed": float(stats.norm.sf(1, self.mean, deviation)),
        }


WORLDS = {
    "normal, runs alike": World(0, 0.0, 1.0, 0.5, False),
    "normal, runs differ a little": World(0, 0.1, 1.0, 0.5, False),
    "normal, runs differ": World(0, 0.3, 1.0, 0.5, False),
    "normal, runs differ as much as months": World(0, 1.0, 1.0, 0.5, False),
    "normal, chance": World(0, 0.05, 0.1, 1.0, False),
    "survival, half": World(0.5, 0.15, 0.6, 0.3),
    "survival, easy": World(1.2, 0.1, 0.5, 0.3),
    "survival, hard": World(0.0, 0.05, 0.2, 0.1),
    "survival, runs differ as much as months": World(1.2, 0.3, 0.4, 0.3),
    "survival, nearly solved": World(1.6, 0.05, 0.3, 0.2),
}


def coverage(world: World, runs: int, months: int, datasets: int, seed: int) -> dict[str, float]:
    """Share of intervals that hold the truth, by figure.

    Args:
        world: what is drawn from; one run alone is taken as an agent that is not trained.
        runs: of a method.
        months: that all methods play.
        datasets: how often.
        seed: of the datasets.
    """
    if runs == 1:
        world = World(world.mean, 0.0, world.of_months, world.of_both, world.is_survival)
    random, truth = np.random.default_rng(seed), world.truth()
    found: dict[str, list[float]] = {}

    def note(name: str, interval: Estimate, value: float) -> None:
        found.setdefault(name, []).append(float(interval.low <= value <= interval.high))

    for number in range(datasets):
        values = world.draw(random, FAMILY, runs, months)
        methods = [world.scores(one) for one in values]
        note("mean", estimate(methods[0]), truth["mean"])
        low, high = np.quantile(resampled(methods[0], mean_score), [0.025, 0.975])
        note("mean, percentiles as they are", Estimate(0.0, low, high), truth["mean"])
        if number % IQM_EVERY == 0:
            note("iqm", estimate(methods[0], iqm_score), truth["iqm"])
        if world.is_survival:
            completed = Scores((values[0] >= 1).astype(np.float64)[:, :, None], UNIT)
            note("completed", estimate(completed), truth["completed"])
        differences = paired_differences(methods, list(itertools.combinations(range(FAMILY), 2)))
        note("difference", differences[0].estimate, 0.0)
        note("probability of improvement", probability_of_improvement(*methods[:2]), 0.5)
        found.setdefault("p below 0.05", []).append(float(differences[0].p < 0.05))
        found.setdefault("any of ten pairs", []).append(float(min(one.holm for one in differences) < 0.05))
    return {name: round(float(np.mean(held)), 4) for name, held in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--datasets", type=int, default=600)
    parser.add_argument("--runs", type=int, nargs="+", default=[1, 3, 5, 10])
    parser.add_argument("--months", type=int, nargs="+", default=[20, 200])
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for number, (name, runs, months) in enumerate(itertools.product(WORLDS, options.runs, options.months)):
        row = {"world": name, "runs": runs, "months": months}
        row |= coverage(WORLDS[name], runs, months, options.datasets, number)
        print(row, flush=True)
        rows.append(row)
    lines = ",\n".join(f"  {json.dumps(row)}" for row in rows)
    RESULTS.write_text(f'{{"datasets": {options.datasets}, "rows": [\n{lines}\n]}}\n')
    print(f"Written: {RESULTS}")


if __name__ == "__main__":
    main()
