"""The page of all results: that it holds everything, says what made it, and keeps to its size."""

from __future__ import annotations

import html
import re
from pathlib import Path

import pytest
from sample_results import TASK, curve, result
from test_demo_report import Page

from rl2grid.analysis import page_builder, section
from rl2grid.analysis.report import write_report
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
