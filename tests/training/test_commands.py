"""Commands: typed again, they ask for the same run."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from toy_runs import toy_envs

from rl2grid.cli import train as command
from rl2grid.cli.keywords import NAMES
from rl2grid.cli.main import main
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError
from rl2grid.evaluation.flags import evaluate_command, flags
from rl2grid.training import request, runs
from rl2grid.training.commands import train_command, training_command

CASES: list[tuple[str, str, str, dict[str, Any], dict[str, Any]]] = [
    ("ppo", "bus14-T0", "default", {}, {}),
    ("ppo", "bus14-T0", "default", {"seed": 3, "num_envs": 4, "actor_layers": (8, 16)}, {"heuristic": "idle"}),
    ("sac", "bus14-R", "paper", {"gamma": 0.95}, {"maintenance": False, "dispatch": "grid2op", "constraint": "TLO"}),
    ("td3", "bus14-R", "default", {}, {"reward": (1.0, 0.5, 1e-3), "normalize": None, "opponent": False}),
    ("sac", "bus14-T0", "tuned", {"gamma": 0.9}, {"heuristic": "careful"}),
    ("dqn", "bus36-M-T0", "default", {"mask_actions": False, "huber_delta": None}, {"reward": "paper"}),
    ("ppo", "bus14-T0", "paper", {"torch_threads": 2, "device": "auto"}, {"scenario": "a month/of its own"}),
    ("ppo", "bus14-T0", "default", {}, {"episode_length": 2016}),
    ("ppo", "bus14-H0", "default", {"joint_actions": "box", "gamma": 0.9, "mask_actions": False}, {}),
    ("ppo", "bus14-T0", "default", {"start_from": "runs/a run", "teacher_coefficient": 0.5}, {"heuristic": "idle"}),
    ("imitation", "bus14-T0", "default", {"labels": ("labels/one", "labels/two"), "acting_weight": 3.0}, {}),
    ("imitation", "bus14-H0", "default", {"labels": ("labels/one",), "policy": "sac"}, {}),
    ("lagrangian-ppo", "bus14-T0-TLO", "default", {"thresholds": (20.0,), "constraints": ("TLO",)}, {}),
]


@pytest.mark.parametrize(("algorithm", "task", "preset", "changes", "keywords"), CASES)
def test_a_command_asks_for_the_run_that_it_was_made_from(
    algorithm: str,
    task: str,
    preset: str,
    changes: dict[str, Any],
    keywords: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
):
    chosen = request.hyperparameters(algorithm, task, preset, **changes)
    args = request.RunArgs(
        find_task(task).id, chosen, algorithm=algorithm, env_keywords=keywords, evaluate_every=700, validation_months=3
    )
    asked: list[request.RunArgs] = []
    monkeypatch.setattr(runs, "train", lambda args, **_: asked.append(args))
    monkeypatch.setattr(command, "_report", lambda *_: 0)
    words = shlex.split(train_command(args, preset))
    assert words[:2] == ["rl2grid", "train"]
    command.train(words[2:])
    (typed,) = asked
    assert typed.hyperparameters == args.hyperparameters
    assert {name: typed.env_keywords[name] for name in keywords} == keywords
    assert replace(typed, env_keywords=keywords) == args


def test_what_has_no_influence_on_results_is_left_out():
    args = request.RunArgs(
        "rl2grid/bus14-T0-v0", request.hyperparameters("ppo", "bus14-T0"), num_threads=2, checkpoint_seconds=1.0
    )
    assert train_command(args) == "rl2grid train ppo bus14-T0"


def test_a_run_without_validation_is_resumed_and_made_again_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    heard: list[Any] = []

    def train(args: request.RunArgs, **chosen: Any) -> Path:
        heard.append(chosen["evaluate"])
        return original(args, make_envs=toy_envs, **chosen)

    def resume(folder: Path, **chosen: Any) -> Path:
        heard.append(chosen["evaluate"])
        return folder

    original, folder = runs.train, tmp_path / "run"
    monkeypatch.setattr(runs, "train", train)
    monkeypatch.setattr(runs, "resume", resume)
    sizes = ["--num-envs", "4", "--num-steps", "8", "--decisions", "32"]
    asked = ["ppo", "bus14-T0", *sizes, "--validation-months", "0", "--output", str(folder)]
    assert command.train(asked) == 0
    assert command.train(["--resume", str(folder)]) == 0
    assert heard == [None, None]
    assert not (folder / "best.pt").exists()
    assert "--validation-months 0" in training_command(folder)


@pytest.mark.parametrize(
    "keywords",
    [
        {},
        {"heuristic": None},
        {"heuristic": "idle", "reward": (1.0, 0.5, 0.0), "opponent": False, "maintenance": False},
        {"engine": "reference", "dispatch": "grid2op", "normalize": None, "constraint": "LSI"},
    ],
)
def test_a_command_asks_for_the_evaluation_that_it_was_made_from(
    keywords: dict[str, Any], monkeypatch: pytest.MonkeyPatch
):
    asked: list[tuple[Any, dict[str, Any]]] = []

    def listen(*arguments: Any, **chosen: Any) -> None:
        asked.append((arguments, chosen))
        raise UsageError("heard")

    monkeypatch.setattr("rl2grid.cli.evaluate.evaluate", listen)
    words = shlex.split(evaluate_command("greedy", find_task("bus14-T0"), "test", 3, 2, keywords))
    assert words[:2] == ["rl2grid", "evaluate"]
    assert main(words[1:]) == 2
    (((agent, task), chosen),) = asked
    assert (agent, task.id, chosen["split"]) == ("greedy", "rl2grid/bus14-T0-v0", "test")
    assert (list(chosen["seeds"]), chosen["months"]) == ([0, 1, 2], 2)
    assert {name: value for name, value in chosen.items() if name in ("heuristic", *NAMES)} == keywords


def test_flags_of_all_kinds_of_values():
    values = {"num_envs": 3, "mask_actions": False, "opponent": True, "layers": [8, 16]}
    assert flags(values) == ["--num-envs", "3", "--no-mask-actions", "--opponent", "--layers", "8", "16"]
