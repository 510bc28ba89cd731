"""``rl2grid analyse``: from folders to tables and figures, and how it refuses."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest
from sample_folders import CELLS, write_made_up_study

from rl2grid.cli.main import main
from rl2grid.evaluation.protocol import evaluate


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two evaluations of a month of bus14, which both lose within days."""
    folder = tmp_path_factory.mktemp("evaluations")
    evaluate("do-nothing", "bus14-T0", scenarios=["generated/710000-00"], output=folder / "nothing")
    evaluate("random", "bus14-T0", scenarios=["generated/710000-00"], output=folder / "random")
    return folder


def analyse(folder: Path, *names: str) -> Sequence[str]:
    return ["analyse", *names, "--output", str(folder / "section")]


def test_tables_and_figures_are_written(folder, capsys, monkeypatch):
    monkeypatch.setattr("rl2grid.analysis.section.evaluation_pictures", lambda methods: [])
    assert main(analyse(folder, str(folder / "nothing"), f"dice={folder / 'random'}")) == 0
    assert "7 tables and 0 figures" in capsys.readouterr().out
    table = (folder / "section" / "tables" / "survival-topology.md").read_text()
    assert "Baselines do-nothing" in table
    assert "Baselines dice" in table
    assert f"dice={folder / 'random'}" in (folder / "section" / "index.md").read_text()


def test_evaluations_below_a_folder_are_those_of_the_split(folder, capsys, monkeypatch):
    monkeypatch.setattr("rl2grid.analysis.section.evaluation_pictures", lambda methods: [])
    for name in ("test", "validation-idle"):
        (folder / "agent" / "evaluation").mkdir(parents=True, exist_ok=True)
        shutil.copytree(folder / "nothing", folder / "agent" / "evaluation" / name)
    assert main(analyse(folder, str(folder / "agent"))) == 0
    assert "6 tables" in capsys.readouterr().out
    assert main([*analyse(folder, str(folder / "agent")), "--split", "train"]) == 2


def test_a_study_is_a_folder_like_others(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("rl2grid.analysis.section.evaluation_pictures", lambda methods: [])
    monkeypatch.setattr("rl2grid.analysis.section.training_pictures", lambda curves: [])
    unfinished = {**CELLS[1], "finished": False}
    write_made_up_study(tmp_path / "study", [dict(CELLS[0]), unfinished, dict(CELLS[3])])
    assert main(analyse(tmp_path, str(tmp_path / "study"))) == 0
    output = capsys.readouterr().out
    assert f"Cell {CELLS[1]['name']} of the study" in output
    assert "6 tables" in output


@pytest.mark.parametrize(
    ("names", "part"),
    [
        (["{}"], "holds neither a run nor a study nor an evaluation on validation"),
        (["{}/nothing", "{}/nothing"], "was given twice"),
        (["=x"], "give FOLDER or LABEL=FOLDER"),
    ],
)
def test_refusals_are_one_sentence(folder, capsys, names, part):
    assert main(analyse(folder / "refused", *(name.format(folder) for name in names))) == 2
    (sentence,) = capsys.readouterr().err.strip().splitlines()
    assert part in sentence
    assert not (folder / "refused").exists()
