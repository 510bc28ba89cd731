"""The demonstration names the command that makes it again."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import pytest

from rl2grid.cli.main import main
from rl2grid.studies import demo


@pytest.mark.parametrize("decisions", [None, 6400])
@pytest.mark.parametrize("output", [Path("reports/demo"), Path("a folder")])
def test_the_command_asks_for_the_same_demonstration(
    output: Path, decisions: int | None, monkeypatch: pytest.MonkeyPatch
):
    asked: list[tuple[Path, int | None]] = []

    def listen(output: Path, decisions: int | None, *, progress: bool) -> demo.Demonstration:
        asked.append((output, decisions))
        return demo.Demonstration(output / "report.html", ())

    monkeypatch.setattr(demo, "run_demo", listen)
    words = shlex.split(demo.demo_command(output, decisions))
    assert words[0] == "rl2grid"
    assert main(words[1:]) == 0
    assert asked == [(output, decisions)]


THERE = {
    "processor": "x86_64 znver4",
    "versions": {"python": "3.11.7", "torch": "2.13.0+cpu"},
    "survival": {"PPO": 0.925, "random": 0.061},
}


@pytest.mark.parametrize(
    ("here", "sentences"),
    [
        ({}, ["The same survival as in the README, to the last bit"]),
        ({"survival": {"PPO": 0.853, "random": 0.061}}, ["PPO 0.925 there, 0.853 here", "versions are the same"]),
        (
            {"survival": {"PPO": 0.853}, "processor": "x86_64 skylake", "versions": {"python": "3.11.7"}},
            ["processor x86_64 znver4 there, x86_64 skylake here", "torch 2.13.0+cpu there, none here"],
        ),
    ],
)
def test_what_differs_from_the_readme_is_said(here: dict[str, Any], sentences: list[str]):
    said = demo.what_differs({**THERE, **here}, THERE)
    assert all(sentence in said for sentence in sentences)
    assert "random" not in said
    assert "python" not in said


def test_the_readme_shows_the_published_figures():
    published = demo.published()
    readme = Path(__file__).parents[2].joinpath("README.md").read_text(encoding="utf-8")
    assert published["processor"] in readme
    rows = {"DQN": "DQN + idle", "do-nothing": "do nothing", "random": "random + idle"}
    for agent, value in published["survival"].items():
        assert f"| {rows[agent]} | {value:.3f} [" in readme
