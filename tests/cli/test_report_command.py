"""``rl2grid report``: from folders to one page, and how it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest
from forged import rewrite
from sample_folders import CELLS, write_made_up_evaluation, write_made_up_run, write_made_up_study

from rl2grid.cli.main import main


@pytest.fixture(autouse=True)
def _no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rl2grid.analysis.section.evaluation_pictures", lambda methods: [])
    monkeypatch.setattr("rl2grid.analysis.section.training_pictures", lambda curves: [])
    # Made-up runs have no settings that a command could name.
    monkeypatch.setattr("rl2grid.training.commands.training_command", lambda folder: f"rl2grid train for {folder}")


def test_a_study_becomes_a_page(tmp_path, capsys):
    write_made_up_study(tmp_path / "study", [dict(one) for one in CELLS])
    page = tmp_path / "page" / "report.html"
    assert main(["report", str(tmp_path / "study"), "--output", str(page.parent), "--title", "A <study>"]) == 0
    output = capsys.readouterr().out
    assert "0 figures, 8 episodes." in output
    assert f"Written: {page} ({page.stat().st_size / 1e6:.1f} MB)." in output
    text = page.read_text()
    assert "<h1>A &lt;study&gt;</h1>" in text
    for words in (
        "ppo small-nets + idle",
        f"rl2grid train for {tmp_path / 'study' / 'cells' / CELLS[1]['name'] / 'run'}",
    ):
        assert words in text
    assert f"--output {page.parent} --title &#x27;A &lt;study&gt;&#x27;" in text


def test_what_is_missing_is_said(tmp_path, capsys):
    write_made_up_run(tmp_path / "run")
    write_made_up_evaluation(tmp_path / "nothing", "do-nothing", None)
    folders = [str(tmp_path / "run"), str(tmp_path / "nothing")]
    assert main(["report", *folders, "--output", str(tmp_path / "page")]) == 0
    sentence = f"Run {tmp_path / 'run'} was not evaluated on validation"
    assert sentence in capsys.readouterr().out
    assert sentence in (tmp_path / "page" / "report.html").read_text()


def test_the_headline_is_what_was_played(tmp_path):
    write_made_up_evaluation(tmp_path / "one")
    assert main(["report", str(tmp_path / "one"), "--output", str(tmp_path / "page")]) == 0
    assert "<h1>Results on bus14-T0</h1>" in (tmp_path / "page" / "report.html").read_text()


@pytest.mark.parametrize(
    ("names", "part"),
    [
        (["nowhere"], "is no folder"),
        (["empty"], "holds neither a run nor a study nor an evaluation"),
        (["one", "one"], "was given twice"),
        (["one", "other"], "Results of different grid_hash do not belong into one table"),
        (["run"], "metrics.csv is no metrics file"),
    ],
)
def test_refusals_are_one_sentence_and_write_nothing(tmp_path: Path, capsys, names, part):
    (tmp_path / "empty").mkdir()
    write_made_up_evaluation(tmp_path / "one")
    write_made_up_evaluation(tmp_path / "other", "do-nothing", None)
    path = tmp_path / "other" / "evaluation.json"
    rewrite(path, lambda record: record["identity"].update(grid_hash="another"))
    write_made_up_run(tmp_path / "run")
    (tmp_path / "run" / "metrics.csv").unlink()
    assert main(["report", *(str(tmp_path / name) for name in names), "--output", str(tmp_path / "page")]) == 2
    (sentence,) = capsys.readouterr().err.strip().splitlines()
    assert part in sentence
    assert not (tmp_path / "page").exists()
