"""From a training to its page and its entry of a leaderboard, by the commands alone."""

from __future__ import annotations

import shlex
from dataclasses import asdict
from pathlib import Path

import pytest

from rl2grid.cli.main import main
from rl2grid.ledger.making import find_evaluation, make_entry
from rl2grid.ledger.verification import verify_entry
from rl2grid.records.evaluations import load_evaluation
from rl2grid.records.trainings import RUN_FILE, read_training_run
from rl2grid.training.commands import training_command
from rl2grid.training.request import read_config

TRAINING = [
    *("train", "ppo", "bus14-T0", "--heuristic", "idle", "--decisions", "256", "--num-envs", "4", "--num-steps"),
    *("32", "--actor-layers", "8", "8", "--no-normalize-advantages", "--evaluate-every", "256", "--seed", "3"),
]


@pytest.mark.slow
def test_a_run_can_be_made_again_reported_and_handed_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    assert main([*TRAINING, "--output", str(run)]) == 0
    command = training_command(run)
    for word in ("--num-steps 32", "--actor-layers 8 8", "--no-normalize-advantages", "--evaluate-every 256"):
        assert word in command
    assert "--gamma" not in command  # as by default
    again = shlex.split(command.replace(str(run), str(tmp_path / "again")))[1:]
    assert main(again) == 0
    first, second = (read_config(tmp_path / name)[0] for name in ("run", "again"))
    assert asdict(first.hyperparameters) == asdict(second.hyperparameters)
    assert first.env_keywords == second.env_keywords
    assert first.evaluate_every == second.evaluate_every

    assert main(["evaluate", str(run), "bus14-T0", "--months", "2"]) == 0
    assert len(load_evaluation(run / "evaluation" / "validation-2-months").episodes) == 2
    entry = make_entry(find_evaluation(run, "validation"))
    assert entry.training is not None
    assert entry.training["command"] == command
    assert verify_entry(entry) is None

    assert read_training_run(run).seed == 3
    assert main(["report", str(run), "--output", str(tmp_path / "report")]) == 0
    page = (tmp_path / "report" / "report.html").read_text()
    assert command in page
    assert f"rl2grid evaluate {run} bus14-T0 --split validation --seeds 1 --months 2" in page
    (run / RUN_FILE).write_text("{}")
    assert main(["report", str(run), "--output", str(tmp_path / "refused")]) == 2
    assert not (tmp_path / "refused").exists()
    assert "is no description of a run" in capsys.readouterr().err
