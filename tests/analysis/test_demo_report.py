"""Figures and the report: that they show what they claim, whole, in light and dark."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser

import matplotlib
import numpy as np
import pytest
from sample_results import curve, recording, result

from rl2grid.analysis.demo_report import write_demo_report
from rl2grid.analysis.figures import episode_loading, save_figure, survival_by_agent, training_curves
from rl2grid.drawing.theme import DARK, LIGHT
from rl2grid.errors import UsageError

RESULTS = [result("do-nothing", [[0.2, 0.3], [0.1, 0.4]]), result("ppo", [[1.0, 0.9], [0.8, 1.0]], "idle")]


def texts(figure):
    return [text.get_text() for text in figure.findobj(matplotlib.text.Text)]


@pytest.mark.parametrize("theme", [LIGHT, DARK])
def test_files_are_pictures_and_repeat_themselves(tmp_path, theme):
    for name in ("a", "b"):
        paths = save_figure(survival_by_agent(RESULTS, theme=theme), tmp_path / name)
        assert [path.name for path in paths] == [f"{name}.png", f"{name}.pdf"]
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()
    assert len(list(tmp_path.iterdir())) == 4


def test_nothing_global_changes():
    before = dict(matplotlib.rcParams)
    survival_by_agent(RESULTS, theme=DARK)
    assert dict(matplotlib.rcParams) == before


def test_every_episode_is_a_dot():
    axes = survival_by_agent(RESULTS).axes[0]
    dots = [line for line in axes.lines if line.get_marker() == "o"]
    assert sorted(x for line in dots for x in line.get_xdata()) == sorted(
        episode.survival for one in RESULTS for episode in one.episodes
    )
    assert [label.get_text() for label in axes.get_yticklabels()] == ["do-nothing", "ppo\n+ idle"]


def test_one_run_shows_its_points_and_several_their_mean():
    alone = training_curves([curve()]).axes[0]
    assert any(len(line.get_xdata()) == 30 and line.get_marker() == "." for line in alone.lines)
    several = training_curves([curve(seed=k) for k in range(4)], x="grid_steps").axes[0]
    (line,) = [line for line in several.lines if line.get_linestyle() == "-"]
    assert line.get_label() == "ppo (4 runs)"
    assert line.get_xdata()[-1] == pytest.approx(36_000)
    (validation,) = [line for line in several.lines if line.get_marker() == "D"]
    expected = np.mean([curve(seed=k).validation.values for k in range(4)], axis=0)
    np.testing.assert_allclose(validation.get_ydata(), expected)


def test_a_short_overload_stays_visible_in_a_long_episode():
    long = recording(8064)
    image = episode_loading(long).axes[1].images[0].get_array()
    assert image.shape[1] < 400
    row = (
        np.argsort(-np.quantile(np.where(long.line_status, long.rho, 0), 0.95, axis=0), kind="stable").tolist().index(2)
    )
    assert image[row, -1] == pytest.approx(1.2)
    assert image.mask[5].sum() > 100  # the line that is out, last in order, is drawn as such


def test_the_ending_is_told():
    lost, completed = texts(episode_loading(recording())), texts(episode_loading(recording(game_over="")))
    assert "game over" in lost
    assert "game over" not in completed
    assert any("survived 700 of 1,400 steps; the grid fell into several pieces" in text for text in lost)
    assert any("the episode was completed" in text for text in completed)
    cut_off = texts(episode_loading(replace(recording(game_over=""), episode_length=8064)))
    assert any("survived 700 of 8,064 steps; it was not played further" in text for text in cut_off)
    assert "acts (1)" in lost
    assert "decides (2)" in lost
    assert "attacked" in lost


def test_an_episode_lost_at_once_can_be_drawn(tmp_path):
    save_figure(episode_loading(recording(0)), tmp_path / "once")


class Page(HTMLParser):
    """Notes unbalanced tags and everything that would be fetched."""

    VOID = ("meta", "img", "source")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.fetched: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag not in self.VOID:
            self.open.append(tag)
        self.fetched += [value for name, value in attrs if name in ("src", "srcset", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_a_report_is_one_page_with_everything(tmp_path):
    page = write_demo_report(
        tmp_path / "report",
        RESULTS,
        title="A <b>title</b>",
        introduction="First & foremost.",
        curves=[curve()],
        recordings=[recording()],
        commands={"training": "rl2grid train --seed 1"},
    )
    text = page.read_text(encoding="utf-8")
    parser = Page()
    parser.feed(text)
    assert parser.open == []
    assert len(parser.fetched) == 4  # two figures, light and dark
    assert text.count("<figure class=chart>") == 1  # training
    first, second = re.findall(r"<tr[^>]*><td>([^<]*)", text)[:2]
    assert (first, second) == ("ppo", "do-nothing")
    assert text.count("<tr class=best>") == 1
    assert "2 months are too few to prove an order." in text
    assert "ppo: one training." not in text  # nothing says that it was trained
    assert all(address.startswith("data:image/png;base64,") for address in parser.fetched)
    assert "http" not in re.sub(r"base64,[^']*", "", text)
    assert "A &lt;b&gt;title&lt;/b&gt;" in text
    for words in (
        "First &amp; foremost.",
        "rl2grid evaluate ppo",
        "rl2grid train --seed 1",
        "92.5%",
        "width=device-width",
    ):
        assert words in text
    assert "**0.925" in (tmp_path / "report" / "results.md").read_text()
    names = {path.name for path in (tmp_path / "report" / "figures").iterdir()}
    assert names == {
        f"{name}.{kind}" for name in ("survival", "training", "episode-0-someone") for kind in ("png", "pdf")
    }
    assert not list((tmp_path / "report").rglob("*.tmp"))


def test_a_report_can_be_written_again(tmp_path):
    for _ in range(2):
        page = write_demo_report(tmp_path, RESULTS, title="Again")
    assert page.exists()


def test_results_that_do_not_belong_together_make_no_report(tmp_path):
    with pytest.raises(UsageError, match="different task"):
        write_demo_report(tmp_path / "report", [RESULTS[0], result("a", [[1.0]], task="another")], title="No")
    assert not (tmp_path / "report").exists()
