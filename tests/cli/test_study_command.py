"""The command ``rl2grid study``: what it prints, and how it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from rl2grid.cli.main import main
from rl2grid.records.files import write_json
from rl2grid.studies import run as study_run
from rl2grid.studies.cell import FINISHED, CellResult

STUDY = """
name = "few"
months = 1
[scale.quick]
budget = 512
[scale.full]
seeds = [1, 2]
[[group]]
algorithms = ["ppo"]
agents = ["do-nothing"]
tasks = ["bus14-T0"]
"""


@pytest.fixture
def file(tmp_path: Path) -> str:
    path = tmp_path / "few.toml"
    path.write_text(STUDY)
    return str(path)


def refused(capsys, *command_line: str) -> str:
    assert main(["study", *command_line]) == 2
    (sentence,) = capsys.readouterr().err.strip().splitlines()
    return sentence


def test_list_names_the_included_studies_and_their_sizes(capsys):
    assert main(["study", "list"]) == 0
    output = capsys.readouterr().out
    assert "paper" in output
    assert "baselines" in output
    assert "quick" in output


def test_status_before_anything_began(capsys, file: str, tmp_path: Path):
    assert main(["study", "status", file, "--scale", "full", "--output", str(tmp_path / "out")]) == 0
    assert "few (full): 3 cells, 0 done, 0 running, 0 failed" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("command_line", "part"),
    [
        (["run", "papr"], "(did you mean 'paper'?): choose one of baselines, field, field-1, field-2, paper"),
        (["run", "FILE", "--scale", "quik"], "Scale 'quik' does not exist (did you mean 'quick'?)"),
        (["run", "FILE", "--backend", "cloud"], "Backend 'cloud' does not exist: choose one of local, ray, slurm"),
        (["run", "FILE", "--jobs", "0"], "--jobs 0 is not allowed"),
        (["tune", "nothing.toml"], "File 'nothing.toml' does not exist"),
    ],
)
def test_bad_requests_are_refused_in_one_sentence(capsys, file: str, command_line: list[str], part: str):
    assert part in refused(capsys, *(file if word == "FILE" else word for word in command_line))


def test_a_failed_cell_is_told_and_the_others_are_finished(capsys, file: str, tmp_path: Path, monkeypatch):
    class Job:
        def __init__(self, folder: Path) -> None:
            self.status = 1 if "ppo" in folder.name else FINISHED
            if self.status:
                (folder / "log.txt").write_text("Traceback\nMemoryError: no more\n")
            else:
                write_json(folder / "result.json", vars(CellResult(0.1, "abc", 0.5, 1)))

        def poll(self) -> int:
            return self.status

        def stop(self) -> None: ...

    class Backend:
        slots = 2

        def submit(self, folder: Path) -> Job:
            return Job(folder)

    monkeypatch.setattr(study_run, "write_study_episodes", lambda folder, cells: None)
    monkeypatch.setattr(study_run, "_POLL_SECONDS", 0.01)
    monkeypatch.setattr("rl2grid.studies.backends.make_backend", lambda *_: Backend())
    output = tmp_path / "out"
    assert main(["study", "run", file, "--output", str(output)]) == 1
    captured = capsys.readouterr()
    course = captured.err.splitlines()  # nobody looks: a line for whatever changes
    assert course[0].startswith("few (quick): 2 cells, 0 done")
    assert any(line.endswith(": done, survival 0.500") for line in course)
    assert any(
        line.endswith(" failed: MemoryError: no more") or line.endswith(": failed: MemoryError: no more")
        for line in course
    )
    shown = captured.out
    assert "2 cells, 1 done, 0 running, 1 failed" in shown
    assert "MemoryError: no more" in shown
    assert "1 cells failed" in shown
    assert main(["study", "status", file, "--output", str(output)]) == 0
    assert "MemoryError: no more" in capsys.readouterr().out
