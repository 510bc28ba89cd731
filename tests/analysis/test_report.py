"""The page of all results: that it holds everything, says what made it, and keeps to its size."""

from __future__ import annotations

import html
import re
from pathlib import Path

import numpy as np
import pytest
from sample_results import TASK, curve, result
from test_demo_report import Page

from rl2grid.analysis import comparison_table, page, page_builder, report, section
from rl2grid.analysis.report import write_report
from rl2grid.envs.tasks import all_tasks
from rl2grid.errors import UsageError
from rl2grid.records.collection import Collection
from rl2grid.records.trainings import TrainingRun

RUN = TrainingRun(Path("runs/one"), TASK, {}, 1, curve())
RESULTS = [
    result("ppo", [[1.0], [0.9], [1.0]], "idle", agent_hash="a"),
    result("do-<b>nothing", [[0.2], [0.1], [0.4]]),
    result("ppo", [[0.8], [0.7], [0.6]], "idle", agent_hash="b"),
]


@pytest.fixture(autouse=True)
def _few_figures(monkeypatch):
    chosen = section.evaluation_pictures
    names = ("levels", "months")
    monkeypatch.setattr(
        section, "evaluation_pictures", lambda methods: [p for p in chosen(methods) if p.name.startswith(names)]
    )


def write(folder: Path, collection: Collection, **changes) -> str:
    keywords = {
        "title": "A <b>title</b>",
        "command": "rl2grid report x",
        "train_commands": {RUN.folder: "rl2grid train"},
    }
    size = write_report(folder / "report.html", collection, **{**keywords, **changes})
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert size == len(text.encode())
    assert [path.name for path in folder.iterdir()] == ["report.html"]
    return text


def test_the_page_is_whole_and_needs_nothing_else(tmp_path):
    told: list[str] = []
    text = write(tmp_path, Collection(RESULTS, [RUN], ["Something is not there."]), on_figure=told.append)
    parser = Page()
    parser.VOID = (*Page.VOID, "input")
    parser.feed(text)
    assert parser.open == []
    pictures = section.plan_section(RESULTS, [RUN]).pictures
    assert len(told) == len(pictures) > 1
    charts = sum(picture.chart is not None for picture in pictures)
    assert text.count("<figure class=chart>") == charts == 1
    addresses = [address for address in parser.fetched if not address.startswith("#")]
    assert len(addresses) == 2 * (len(told) - charts)
    assert all(address.startswith("data:image/png;base64,") for address in addresses)
    assert "http" not in re.sub(r"base64,[^']*", "", text)
    places = {address[1:] for address in parser.fetched if address.startswith("#")}
    assert places <= set(re.findall(r"id='?([\w.-]+)", text))
    for words in ("A &lt;b&gt;title", "Something is not there.", "do-&lt;b&gt;nothing", "0.850"):
        assert words in text
    for command in (
        "rl2grid report x",
        "rl2grid train",
        "rl2grid evaluate ppo",
        "rl2grid evaluate do-&lt;b&gt;nothing",
    ):
        assert f"<code>{command}</code>" in text
    for table in section.plan_section(RESULTS, [RUN]).tables:
        assert html.escape(table.caption) in text


def test_the_ranking_leads_from_methods_to_their_commands(tmp_path):
    text = write(tmp_path, Collection(RESULTS))
    ranking = text[text.index("id=ranking") : text.index("id=tables")]
    first, second = re.findall(r"<tbody>(.*)</tbody>", ranking)[0].split("</tr>")[:2]
    assert "ppo + idle" in first
    assert re.findall(r"href='#(\w+)'", first) == ["e1", "e3"]
    assert re.findall(r"href='#(\w+)'", second) == ["e2"]


def test_runs_alone_make_a_page(tmp_path):
    text = write(tmp_path, Collection(runs=[RUN]))
    assert "id=ranking" not in text
    assert "id=episodes" not in text
    assert "rl2grid train" in text


def test_many_figures_are_folded_by_task(tmp_path, monkeypatch):
    collection = Collection(RESULTS, [RUN])
    number = len(section.plan_section(RESULTS, [RUN]).pictures)
    assert "<summary>bus14-T0: " not in write(tmp_path, collection)
    monkeypatch.setattr(page_builder, "UNFOLDED", number - 1)
    text = write(tmp_path, collection)
    assert f"<summary>bus14-T0: {number} figures</summary>" in text
    assert text.count("<figure") == number


def test_figures_shrink_until_the_page_fits(tmp_path):
    collection = Collection(RESULTS[:1])
    limit = 3 * len(write(tmp_path, collection).encode()) // 4
    assert len(write(tmp_path, collection, max_bytes=limit).encode()) <= limit
    # A limit that cannot be kept is no reason to lose the figures.
    pictures = section.plan_section(collection.evaluations, collection.runs).pictures
    assert write(tmp_path, collection, max_bytes=1).count("<figure") == len(pictures)


def test_results_that_do_not_belong_together_make_no_page(tmp_path):
    with pytest.raises(UsageError, match="different engine"):
        write(tmp_path, Collection([RESULTS[0], result("other", [[1.0], [1.0], [1.0]], engine="another")]))
    with pytest.raises(UsageError, match="nothing to analyse"):
        write(tmp_path, Collection())
    assert not list(tmp_path.iterdir())


def study(agents: int, tasks: int, seeds: int, months: int = 3) -> Collection:
    """A made-up study: every agent on every task, trained with every seed."""
    random = np.random.default_rng(0)
    names = [name for name in all_tasks() if "-LSI" not in name and "-TLO" not in name][:tasks]
    evaluations = []
    for task in names:
        for agent in range(agents):
            for seed in range(seeds):
                survivals = random.uniform(0, 0.9, (months, 1)).round(2).tolist()
                trained = {"trained_with": {"algorithm": f"agent-{agent}", "seed": seed}}
                evaluations.append(
                    result(f"agent-{agent}", survivals, task=task, agent_hash=f"{agent}-{seed}", agent_identity=trained)
                )
    return Collection(evaluations)


@pytest.mark.parametrize(("agents", "tasks", "seeds"), [(4, 3, 1), pytest.param(40, 12, 5, marks=pytest.mark.slow)])
def test_large_studies_stay_readable(tmp_path, monkeypatch, agents, tasks, seeds):
    monkeypatch.setattr(section, "evaluation_pictures", lambda methods: [])
    if agents < 40:
        # What is large is less, so that the test is short.
        monkeypatch.setattr(page, "FOLDED_FROM", 3)
        monkeypatch.setattr(report, "UNFOLDED_TASKS", 2)
        monkeypatch.setattr(report, "WIDEST", 3)
        monkeypatch.setattr(comparison_table, "MOST_COMPARED", 3)
    collection = study(agents, tasks, seeds)
    text = write(tmp_path, collection)
    ranking = text[text.index("id=ranking") : text.index("id=tables")]
    assert ranking.count("<details") == tasks
    assert ranking.count("<details open>") == 1
    assert ranking.count("<tr class=best>") == tasks
    tables = text[text.index("id=tables") : text.index("id=episodes")]
    assert tables.index("<h3>Overview</h3>") < tables.index("<h3>Aggregates</h3>")
    assert "<h3>Survival topology</h3>" not in tables  # has as many columns as there are agents
    bodies = re.findall(r"<tbody>(.*?)</tbody>", tables)
    rows = [body.count("<tr") for body in bodies]
    assert rows[0] == agents
    assert rows[-1] == (agents - 1) * tasks  # pairs with the first of each task
    assert tables.count("class=more") == sum(n > page.FOLDED_FROM for n in rows)
    assert ranking.count("class=more") == tasks
    assert all(f"agent-{agent}" in ranking for agent in range(agents))
    assert "3 months are too few" in text


def test_the_overview_is_in_the_order_of_the_mean_place():
    (overview, *_) = section.plan_section(study(3, 2, 1).evaluations).tables
    assert [column.heading for column in overview.columns] == ["Method", "Mean place", "bus14-T0", "bus14-T1"]
    places = [float(row[1].text) for row in overview.rows]
    assert places == sorted(places)
    assert sum(places) == pytest.approx(6)
    for column in (2, 3):
        values = {row[column].text: row[column].best for row in overview.rows}
        assert [text for text, best in values.items() if best] == [max(values)]
