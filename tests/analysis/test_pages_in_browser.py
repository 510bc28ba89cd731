"""Pages in a real browser: that they are whole, fit a phone, need no network, and that the table of episodes works."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from headless_browser import DESK, PHONE, visiting
from sample_results import curve, result
from test_watching import made_up

from rl2grid.analysis.report import write_report
from rl2grid.analysis.watch_page import write_watch_page
from rl2grid.grids import load_grid
from rl2grid.records.collection import Collection
from rl2grid.records.trainings import TrainingRun

pytestmark = pytest.mark.slow

N_SCENARIOS, N_SEEDS = 100, 15


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page of 3,000 episodes of two methods, one of which is never lost."""
    random = np.random.default_rng(0)
    lost = random.uniform(0, 0.9, (N_SCENARIOS, N_SEEDS)).tolist()
    results = [
        result("a-policy-with-a-rather-long-name", [[1.0] * N_SEEDS] * N_SCENARIOS, "recovery", agent_hash="a"),
        result("do-nothing", lost),
    ]
    run = TrainingRun(Path("runs/one"), "rl2grid/bus14-T0-v0", {}, 1, curve())
    path = tmp_path_factory.mktemp("page") / "report.html"
    command = "rl2grid report " + " ".join(f"a-folder-{k}" for k in range(20))
    write_report(
        path, Collection(results, [run]), title="Some results", command=command, train_commands={run.folder: "train"}
    )
    return path


@pytest.fixture(scope="module")
def watch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "watch.html"
    grid = load_grid("bus14")
    write_watch_page(path, grid, [made_up(grid, 40)])
    return path


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [PHONE, DESK])
@pytest.mark.parametrize("name", ["report", "watch"])
def test_pages_are_whole_and_fit(name, size, scheme, request):
    with visiting(request.getfixturevalue(name), size, scheme) as visit:
        assert visit.errors == []
        assert visit.requests == []
        assert visit.overflow == 0
        paper = visit.page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert paper == ("rgb(255, 255, 255)" if scheme == "light" else "rgb(21, 24, 28)")


def test_the_table_of_episodes_sorts_and_filters(report):
    def column(name: str) -> list[str]:
        places = page.locator("#explorer th").evaluate_all("all => all.map(one => one.dataset.name)")
        return page.locator(f"#explorer tbody td:nth-child({places.index(name) + 1})").all_inner_texts()

    with visiting(report, DESK) as visit:
        page = visit.page
        assert page.locator("#shown").inner_text().startswith("3,000 of 3,000 episodes")
        page.get_by_role("button", name="Survival").click()
        shown = [float(text) for text in column("survival")]
        assert len(shown) == 50
        assert shown == sorted(shown)
        assert shown[-1] < 0.1
        page.get_by_role("button", name="Survival").click()
        assert set(column("survival")) == {"1"}
        page.locator("#method").select_option("do-nothing")
        assert set(column("method")) == {"do-nothing"}
        assert page.locator("#shown").inner_text().startswith("1,500 of 3,000 episodes")
        page.locator("#search").fill("survival<0.5 seed=3")
        assert set(column("seed")) == {"3"}
        assert all(float(text) < 0.5 for text in column("survival"))
        page.locator("#search").fill("made=e2 scenario=scenario")
        assert page.locator("#shown").inner_text().startswith("0 of 3,000 episodes")
        page.locator("#search").fill("made=e2")
        assert page.locator("#shown").inner_text().startswith("1,500 of 3,000 episodes")
        page.locator("#search").fill("nothing of the kind")
        assert page.locator("#shown").inner_text().startswith("0 of 3,000 episodes")
        assert visit.errors == []


def test_pages_of_the_table_turn_and_lead_to_commands(report):
    with visiting(report, PHONE) as visit:
        page = visit.page
        assert page.locator("#previous").is_disabled()
        page.locator("#next").click()
        assert page.locator("#page").inner_text() == "51 to 100"
        page.locator("#explorer tbody a").first.click()
        assert page.url.endswith("#e1")
        assert page.locator("#e1").is_visible()


def test_curves_are_read_zoomed_and_switched(report):
    with visiting(report, DESK) as visit:
        page = visit.page
        chart = page.locator("figure.chart").filter(has_text="Performance profiles")
        axes, readout = chart.locator("svg.axes"), chart.locator(".readout")
        axes.scroll_into_view_if_needed()
        box = axes.bounding_box()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        assert readout.is_visible()
        assert "do-nothing" in readout.inner_text()
        whole = axes.locator("text").all_text_contents()
        page.mouse.down()
        page.mouse.move(box["x"] + 0.8 * box["width"], box["y"] + 0.7 * box["height"], steps=3)
        page.mouse.up()
        assert axes.locator("text").all_text_contents() != whole
        assert chart.get_by_role("button", name="Whole").is_visible()
        page.mouse.move(0, 0)
        chart.get_by_role("button", name="Whole").click()
        assert axes.locator("text").all_text_contents() == whole
        key = chart.locator(".keys button").filter(has_text="do-nothing")
        key.click()
        assert key.get_attribute("aria-pressed") == "false"
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        assert "do-nothing" not in readout.inner_text()
        assert visit.errors == []


def ready(page):
    """What is compressed in the page has been unpacked."""
    page.wait_for_function("window.page !== undefined")


def test_keys_move_the_clock_of_an_episode(watch):
    with visiting(watch, PHONE) as visit:
        ready(visit.page)
        before = visit.page.locator("#clock").inner_text()
        visit.page.keyboard.press("Shift+ArrowRight")
        assert visit.page.locator("#clock").inner_text() != before


def test_the_timeline_is_in_view_and_nothing_jumps(watch):
    with visiting(watch, (1400, 900)) as visit:
        page = visit.page
        ready(page)
        places = set()
        for key in ("Home", *["ArrowRight"] * 9, "End"):
            page.keyboard.press(key)
            boxes = [page.locator(name).bounding_box() for name in (".map svg", "#timeline", "#slider")]
            places.add(tuple(tuple(box.values()) for box in boxes))
        assert len(places) == 1
        assert boxes[-1]["y"] + boxes[-1]["height"] <= 900
        assert page.evaluate("document.documentElement.scrollHeight") <= 900
        assert visit.errors == []


def test_maps_zoom_pan_and_find(watch):
    with visiting(watch, DESK) as visit:
        page = visit.page
        ready(page)
        view = page.locator(".map svg")
        whole = view.get_attribute("viewBox")
        page.locator("#search").fill("load_4_3")
        assert view.get_attribute("viewBox") != whole
        assert page.locator("#found h2").inner_text() == "load 3 (load_4_3)"
        page.locator("#fit").click()
        assert view.get_attribute("viewBox") == whole
        page.locator("#in").click()
        near = view.get_attribute("viewBox")
        box = view.bounding_box()
        page.mouse.move(box["x"] + 200, box["y"] + 200)
        page.mouse.down()
        page.mouse.move(box["x"] + 260, box["y"] + 230, steps=4)
        page.mouse.up()
        assert view.get_attribute("viewBox") not in (near, whole)


def test_names_are_written_on_demand(watch):
    with visiting(watch, DESK) as visit:
        page = visit.page
        ready(page)
        assert page.locator(".names text").count() == 0
        page.locator("#names").select_option("names")
        assert "load_4_3" in page.locator(".names text").all_text_contents()
