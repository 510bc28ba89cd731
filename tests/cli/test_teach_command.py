"""``rl2grid teach``: what it says, how it goes on, and how it refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rl2grid.cli.main import main
from rl2grid.records.labels import LABELS_FILE, month_path, read_labels, read_labels_description
from rl2grid.training import teaching

SHORT = ["--months", "2", "--episode-length", "20", "--workers", "0"]


@pytest.fixture(autouse=True)
def few_years(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two years of the library are enough."""
    draw = teaching.draw_scenario
    monkeypatch.setattr(teaching, "draw_scenario", lambda grid, split, seed, number: draw(grid, split, 0, number % 2))


def test_labels_are_made_told_and_go_on(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    folder = tmp_path / "labels"
    command = ["teach", "do-nothing", "bus14-T0", *SHORT, "--thin", "1", "--output", str(folder)]
    assert main([*command, "--quiet"]) == 0
    assert capsys.readouterr().out == (
        f"40 labels of do-nothing in {folder}, round 0: 2 months of bus14-T0, 40 decisions, 0 actions of the teacher, "
        "survival 1.000.\n"
    )
    assert main([*command, "--months", "3", "--json"]) == 0
    told: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert (told["folder"], told["round"], told["months"], told["labels"]) == (str(folder), 0, 3, 60)
    assert main([*command, "--months", "3", "--pupil", "random", "--pupil-share", "0.5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["round"] == 1
    assert main([*command, "--months", "3", "--pupil", "random", "--pupil-share", "0.5", "--quiet"]) == 0
    assert capsys.readouterr().out.endswith(" with random acting.\n")
    assert month_path(folder, 1, 2).is_file()
    assert read_labels([folder], "bus14-T0")[0].rounds == 2


def test_the_stored_command_goes_on(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    assert main(["teach", "do-nothing", "bus14-T0", *SHORT, "--heuristic", "idle", "--seed", "3", "--quiet"]) == 0
    folder = Path("runs/bus14-T0-v0-do-nothing/labels/seed-3-idle-episode-length-20")
    (of_round,) = read_labels_description(folder)["rounds"]
    assert of_round["command"] == (
        "rl2grid teach do-nothing bus14-T0 --months 2 --seed 3 --thin 10 --heuristic idle --episode-length 20"
    )
    monkeypatch.setattr(teaching, "make_crew", None)
    assert main([*of_round["command"].split()[1:], "--quiet"]) == 0
    assert str(folder) in capsys.readouterr().out


def test_an_interrupt_tells_how_it_goes_on(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: Any):
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(teaching, "make_crew", interrupted)
    assert main(["teach", "do-nothing", "bus14-T0", *SHORT, "--output", str(tmp_path / "labels")]) == 130
    assert "the same command goes on where it stopped" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["nobody", "bus14-T0"], "Agent 'nobody' does not exist"),
        (["greedy", "bus15-T0"], "Task 'bus15-T0' does not exist"),
        (["greedy"], "The following arguments are required: task"),
        (["greedy", "bus14-T0", "--months", "0"], "months=0 is not allowed"),
        (["greedy", "bus14-T0", "--months", "many"], "--months takes a whole number, not 'many'"),
        (["greedy", "bus14-T0", "--split", "test"], "Unrecognized arguments: --split test"),
        (["greedy", "bus14-T0", "--thin", "0"], "thin=0.0 is not allowed"),
        (["greedy", "bus14-T0", "--gamma", "2"], "gamma=2.0 is not allowed"),
        (["greedy", "bus14-T0", "--heuristic", "bold"], "choose from 'None', 'idle', 'recovery', 'careful'"),
        (["greedy", "bus14-T0", "--pupil", "random", "--pupil-share", "2"], "pupil_share=2.0 is not allowed"),
        (["greedy", "bus14-T0", "--pupil", "random"], "holds no labels yet"),
        (["recovery", "bus14-R"], "'recovery' cannot play a redispatching task"),
        (["planner", "bus14-T0", "--engine", "reference"], 'choose engine="native"'),
    ],
)
def test_bad_requests_are_refused_with_one_sentence(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, words: list[str], sentence: str
):
    assert main(["teach", *words, "--output", str(tmp_path / "labels"), "--quiet"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("rl2grid: ")
    assert sentence in line
    assert not (tmp_path / "labels" / LABELS_FILE).exists()


def test_labels_below_a_file_are_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    (tmp_path / "file").touch()
    assert main(["teach", "greedy", "bus14-T0", "--output", str(tmp_path / "file" / "labels")]) == 2
    assert "cannot be made" in capsys.readouterr().err
    assert main(["teach", "greedy", "bus14-T0", "--output", str(tmp_path / "file")]) == 2
    assert "is a file: give a folder" in capsys.readouterr().err
