"""``rl2grid.tasks``, ``train`` and ``evaluate``: the package in four words."""

from __future__ import annotations

import inspect
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest

import rl2grid
from rl2grid.errors import UsageError
from rl2grid.evaluation import protocol
from rl2grid.records.episodes import EPISODES_FILE, read_episodes
from rl2grid.training.request import RunArgs

MONTH = "generated/710000-00"


def test_all_words_are_there_and_documented():
    for name in rl2grid.__all__:
        assert inspect.getdoc(getattr(rl2grid, name)), name


def test_importing_takes_neither_torch_nor_the_engine():
    code = (
        "import sys, rl2grid; rl2grid.tasks(); "
        "print([name for name in ('torch', 'numba', 'grid2op', 'matplotlib') if name in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_tasks_are_those_of_the_command():
    every = rl2grid.tasks()
    assert every["rl2grid/bus14-T0-v0"].n_actions == 50
    assert {task.grid_id for task in rl2grid.tasks("bus14").values()} == {"bus14"}
    assert set(rl2grid.tasks("bus14")) < set(every)
    with pytest.raises(UsageError, match=r"Grid 'bus15' does not exist: .*bus14"):
        rl2grid.tasks("bus15")


def test_defaults_are_those_of_the_rooms_below():
    def defaults(function):
        return {name: one.default for name, one in inspect.signature(function).parameters.items()}

    mine, theirs = defaults(rl2grid.evaluate), defaults(protocol.evaluate)
    for name in ("split", "months", "scenarios", "seeds", "output", "progress"):
        assert mine[name] == theirs[name], name
    stored = {each.name: each.default for each in fields(RunArgs)}
    for name in ("evaluate_every", "validation_months", "progress"):
        assert defaults(rl2grid.train)[name] == stored[name], name


def test_an_evaluation_is_that_of_the_protocol(tmp_path: Path):
    played = rl2grid.evaluate(
        "do-nothing", rl2grid.tasks()["rl2grid/bus14-T0-v0"], scenarios=[MONTH], seeds=[3], output=str(tmp_path / "out")
    )
    again = protocol.evaluate("do-nothing", "bus14-T0", scenarios=[MONTH], seeds=[3])
    assert played.identity == again.identity
    assert played.summary.survival == again.summary.survival
    assert read_episodes(tmp_path / "out" / EPISODES_FILE) == played.episodes
    with pytest.raises(UsageError, match="Task"):
        rl2grid.evaluate("do-nothing", "bus14-T9")


def test_a_training_is_a_run_that_comes_back_and_is_evaluated(tmp_path: Path):
    sizes = {"num_envs": 2, "num_steps": 8, "total_timesteps": 16, "update_epochs": 1, "seed": 4}
    folder = rl2grid.train(
        "ppo",
        "bus14-T0",
        folder=str(tmp_path / "run"),
        hyperparameters=sizes,
        validation_months=1,
        progress=False,
        heuristic="recovery",
    )
    assert folder == tmp_path / "run"
    assert rl2grid.load(folder).env_keywords["heuristic"] == "recovery"
    played = rl2grid.evaluate(folder, "bus14-T0", scenarios=[MONTH])
    assert (played.identity["agent"], played.identity["heuristic"]) == ("ppo", "recovery")
    with pytest.raises(UsageError, match="Algorithm"):
        rl2grid.train("qpo", "bus14-T0")
    with pytest.raises(UsageError, match="sizes"):
        rl2grid.train("ppo", "bus14-T0", hyperparameters={"sizes": 3})
    with pytest.raises(UsageError, match="num_threads=0"):
        rl2grid.train("ppo", "bus14-T0", folder=tmp_path / "none", num_threads=0, progress=False)
    assert not (tmp_path / "none").exists()


def test_a_training_begins_where_it_is_told_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    asked: list[RunArgs] = []
    monkeypatch.setattr("rl2grid.training.runs.train", lambda args, **_: asked.append(args))
    rl2grid.train("ppo", "bus14-T0", start_from=tmp_path / "first", hyperparameters={"seed": 3}, validation_months=0)
    rl2grid.train("ppo", "bus14-T0", validation_months=0)
    assert [args.hyperparameters.start_from for args in asked] == [str(tmp_path / "first"), None]  # type: ignore[attr-defined]
