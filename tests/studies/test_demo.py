"""The demonstration names the command that makes it again."""

from __future__ import annotations

import shlex
from pathlib import Path

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
