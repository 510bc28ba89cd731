"""The comparison of series measures what it says, and its page stands alone."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rl2grid.analysis import scenario_check
from rl2grid.analysis.scenario_check import HEADINGS, Comparison, autocorrelation, compare, distance, measure
from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.scenarios.fingerprint import VERSION
from rl2grid.scenarios.library import load_scenario

BUS14 = load_grid("bus14")


@pytest.fixture(scope="module")
def comparison(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    """Two bundled days, and the same with 40 MW more of demand in place of a generated month."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RL2GRID_DATA", str(tmp_path_factory.mktemp("data")))
        scenario = load_scenario("bus14", "bundled/0000")
        load_p = scenario.load_p.copy()
        load_p[:, 0] += 40
        other = replace(scenario, id="generated/1-00", source="generated", load_p=load_p)
        return compare(BUS14, [measure(BUS14, scenario), measure(BUS14, other)])


def test_quantities_are_those_of_the_series(comparison: Comparison) -> None:
    scenario = load_scenario("bus14", "bundled/0000")
    (sample,) = comparison.of("bundled")
    values = sample.values
    load = scenario.load_p.sum(axis=1, dtype=np.float64)
    np.testing.assert_allclose(values["load"], load, atol=1e-3)
    np.testing.assert_allclose(values["load_ramp"], np.diff(load), atol=2e-3)
    np.testing.assert_allclose(values["solar"], _of_kind(scenario, "solar"), atol=1e-3)
    np.testing.assert_allclose(values["wind"], _of_kind(scenario, "wind"), atol=1e-3)
    np.testing.assert_allclose(values["reactive_ratio"], scenario.load_q.sum(axis=1) / load, rtol=1e-5)
    assert sample.first_row == 287
    # What the slack generator adds to the others is what demand and losses ask for.
    others = np.delete(scenario.prod_p[::12], BUS14.slack_gen, axis=1).sum(axis=1, dtype=np.float64)
    np.testing.assert_allclose(values["slack"] + others, load[::12] * (1 + values["losses"] / 100), atol=0.1)
    assert (values["losses"] > 0).all()
    assert ((values["loading"] > 10) & (values["loading"] < 150)).all()


def _of_kind(scenario, kind):
    kinds = np.array(BUS14.gen_type)
    return scenario.prod_p[:, kinds == kind].sum(axis=1)


def test_a_difference_shows(comparison: Comparison) -> None:
    rows = scenario_check.table_rows(comparison)
    assert all(len(cells) == len(HEADINGS) for cells in rows)
    assert len(rows) == 2 * len(comparison.quantities)
    assert [cells[1] for cells in rows[:2]] == ["bundled", "generated"]
    shift = comparison.values("generated", "load").mean() - comparison.values("bundled", "load").mean()
    assert shift == pytest.approx(40, abs=1e-3)
    far = distance(comparison.values("bundled", "load"), comparison.values("generated", "load"))
    assert far > 0.5
    assert distance(comparison.values("bundled", "wind"), comparison.values("generated", "wind")) == 0
    assert distance(comparison.values("bundled", "load_ramp"), comparison.values("generated", "load_ramp")) == 0
    assert rows[1][-1] == f"{far:.2f}"


def test_distance_of_known_distributions() -> None:
    ramp = np.arange(100.0)
    assert distance(ramp, ramp) == 0
    assert distance(ramp, ramp + 25) == pytest.approx(0.25)
    assert distance(ramp, ramp + 1000) == 1


def test_autocorrelation_of_known_series() -> None:
    wave = np.sin(2 * np.pi * np.arange(288 * 20) / 288)
    lags, values = autocorrelation([wave])
    # Sums over part of a period differ by a few thousandths.
    np.testing.assert_allclose(values, np.cos(2 * np.pi * lags / 288), atol=0.01)
    noise = np.random.default_rng(0).normal(size=50_000)
    assert np.abs(autocorrelation([noise])[1]).max() < 0.02
    lags, _ = autocorrelation([wave[:100], wave[:50]])
    assert lags.max() == 48
    assert np.isnan(autocorrelation([np.ones(100)])[1]).all()


def test_the_page_needs_no_other_file(comparison: Comparison, tmp_path: Path) -> None:
    path = tmp_path / "new" / "page.html"
    scenario_check.write_page(comparison, path)
    text = path.read_text()
    assert text.count("data:image/png;base64,") == 8
    assert set(re.findall(r"(?:src|href)=['\"]?(\w+:)", text)) == {"data:"}
    assert "http" not in re.sub(r"base64,[^']+", "", text)
    assert f"{VERSION} {comparison.fingerprint}" in text
    assert [path.name for path in path.parent.iterdir()] == ["page.html"]
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match="cannot be written"):
        scenario_check.write_page(comparison, tmp_path / "file" / "page.html")


def test_the_same_months_are_compared(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path))
    wanted = scenario_check.wanted_scenarios(load_grid("bus36-MO-v0"), 2)
    # Three days of August are in the eighth or ninth block of 28 days, three of February in the second.
    months = sorted({name[-2:] for name in wanted if name.startswith("generated/0-")})
    assert "01" in months
    assert set(months) <= {"01", "02", "07", "08"}
    assert sum(name.startswith("generated/1-") for name in wanted) == len(months)
    assert sum(name.startswith("bundled/") for name in wanted) == 2
