"""Training runs: what a folder holds, what is refused, and that a kill at any moment changes nothing."""

from __future__ import annotations

import json
import random
import signal
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from forged import rewrite
from killed_runs import KILLED, refusal_of_a_second_process, run_until_killed
from toy_grid import ToyGrid
from toy_runs import SMALL, assert_same, assert_same_run, falling, request, table, toy_envs

from rl2grid.algorithms.checkpoint import load_checkpoint, save_checkpoint
from rl2grid.algorithms.policy_agent import PolicyAgent, load_agent
from rl2grid.algorithms.ppo import Args
from rl2grid.errors import UsageError
from rl2grid.records.files import DamageWarning
from rl2grid.training.limits import TimeLimit
from rl2grid.training.request import RunArgs, hyperparameters
from rl2grid.training.runs import is_finished, resume, train


def test_runs_that_differ_in_one_element_are_not_the_same():
    for zeros in (np.zeros(5000, np.float32), torch.zeros(5000)):
        changed = zeros + 0
        assert_same({"a": [zeros]}, {"a": [changed]})
        changed[2500] = 1
        for other in (changed, zeros[:-1], zeros.astype(float) if isinstance(zeros, np.ndarray) else zeros.double()):
            with pytest.raises(AssertionError, match="/a/0"):
                assert_same({"a": [zeros]}, {"a": [other]})


# --- The folder -----------------------------------------------------------------------------------------------------


def test_a_run_folder_holds_everything_about_the_run(tmp_path: Path):
    folder = train(request(tmp_path / "a" / "run", tensorboard=True), evaluate=falling, make_envs=toy_envs)
    assert folder == tmp_path / "a" / "run"
    present = {path.name for path in folder.iterdir()} - {".lock"}
    assert present == {
        "config.json",
        "metrics.csv",
        "tensorboard",
        "checkpoint.pt",
        "best.pt",
        "energy.json",
        "log.txt",
    }
    config = json.loads((folder / "config.json").read_text())
    assert config["identity"]["task"] == "rl2grid/bus14-T0-v0"
    assert config["identity"]["engine"] == "native"
    assert {"grid_hash", "scenario_pack_hash", "action_set_hash", "seed", "versions"} <= config["identity"].keys()
    assert config["request"]["env_keywords"]["normalize"] == "physical"  # defaults are spelt out
    assert config["request"]["hyperparameters"]["seed"] == 5
    assert config["seeds"] == {"algorithm": 5, "first_environment": 20}
    checkpoint = load_checkpoint(folder / "checkpoint.pt", task="rl2grid/bus14-T0-v0")
    assert checkpoint["decisions"] == SMALL.total_timesteps
    assert checkpoint["identity"] == config["identity"]
    wide = pd.read_csv(folder / "metrics.csv").pivot(index="step", columns="name", values="value")
    assert wide.index.tolist() == list(range(32, 32 * 12 + 1, 32))
    assert {"charts/SPS", "charts/survival", "charts/episodic_return", "losses/approx_kl"} <= set(wide.columns)
    assert "finished at 384 decisions" in (folder / "log.txt").read_text()


@pytest.mark.parametrize(("name", "value"), [("targets_version", 1), ("split_version", "1")])
def test_a_run_of_another_list_or_other_targets_is_not_resumed(tmp_path: Path, name: str, value: Any):
    folder = train(request(tmp_path / "run"), evaluate=falling, make_envs=toy_envs)
    now = json.loads((folder / "config.json").read_text())["identity"][name]
    rewrite(folder / "config.json", lambda config: config["identity"].update({name: value}))
    with pytest.raises(UsageError, match=f"cannot be resumed: its {name} was {value}, now it is {now}"):
        resume(folder, evaluate=falling, make_envs=toy_envs)


def test_the_best_policy_by_validation_survival_is_kept(tmp_path: Path):
    folder = train(request(tmp_path / "run"), evaluate=falling, make_envs=toy_envs)
    assert load_agent(folder, "bus14-T0").identity["decisions"] == 96
    wide = pd.read_csv(folder / "metrics.csv").pivot(index="step", columns="name", values="value")
    validated = wide["validation/survival"].dropna()
    assert validated.index.tolist() == [96, 192, 288, 384]
    assert validated.tolist() == pytest.approx([1.0, 0.904, 0.808, 0.712])
    assert wide["validation/return"].dropna().tolist() == [2.0] * 4


def test_the_best_policy_under_a_constraint_is_the_one_most_often_safe(tmp_path: Path):
    """Then the one that survives longest, then the latest; without the constraint survival alone decides."""
    safe = {96: 0.5, 192: 0.75, 288: 0.75, 384: 0.75}
    survival = {96: 1.0, 192: 0.9, 288: 0.95, 384: 0.9}

    def validate(agent: PolicyAgent) -> Mapping[str, float]:
        decisions = agent.identity["decisions"]
        return {"survival": survival[decisions], "safe_completed": safe[decisions]}

    for name, changes, best in (
        ("id", {"task": "bus14-T0-LSI"}, 288),
        ("keyword", {"env_keywords": {"constraint": "TLO"}}, 288),
        ("neither", {}, 96),
    ):
        folder = train(request(tmp_path / name, **changes), evaluate=validate, make_envs=toy_envs)
        assert load_agent(folder).identity["decisions"] == best, name
    assert load_checkpoint(tmp_path / "id" / "checkpoint.pt")["run"]["best_score"] == (0.75, 0.95)
    assert "75.00% safe and completed, survival 0.9500, after 288" in (tmp_path / "id" / "log.txt").read_text()


def test_validation_does_not_disturb_training(tmp_path: Path):
    def drawing(agent: PolicyAgent) -> Mapping[str, float]:
        torch.randn(10)
        agent.seed_episode(1, 1)
        return {"survival": random.random()}

    with_validation = train(request(tmp_path / "a"), evaluate=drawing, make_envs=toy_envs)
    without = train(request(tmp_path / "b"), make_envs=toy_envs)
    assert_same(*(load_checkpoint(folder / "checkpoint.pt")["training"] for folder in (with_validation, without)))


def test_redispatching_tasks_are_trained_with_continuous_actions(tmp_path: Path):
    args = hyperparameters("ppo", "bus14-R", **_sizes(SMALL))
    folder = train(request(tmp_path / "run", task="bus14-R", hyperparameters=args), make_envs=toy_envs)
    assert "log_std" in load_checkpoint(folder / "checkpoint.pt")["policy"]["network"]


def test_the_default_folder_names_task_algorithm_and_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    args = replace(request(tmp_path), folder=None)
    assert train(args, make_envs=toy_envs) == Path("runs/bus14-T0-v0-ppo-5")
    assert (tmp_path / "runs" / "bus14-T0-v0-ppo-5" / "checkpoint.pt").exists()


def _sizes(args: Args) -> dict[str, Any]:
    return {name: getattr(args, name) for name in ("total_timesteps", "num_envs", "num_steps", "gamma")}


# --- Folders that cannot be written or resumed ----------------------------------------------------------------------


def test_a_folder_that_exists_is_not_written(tmp_path: Path):
    folder = train(request(tmp_path / "run"), make_envs=toy_envs)
    before = (folder / "checkpoint.pt").read_bytes()
    with pytest.raises(UsageError, match="exists already"):
        train(request(tmp_path / "run"), make_envs=toy_envs)
    assert (folder / "checkpoint.pt").read_bytes() == before


def test_a_training_whose_months_have_no_room_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path / "data"))
    monkeypatch.setattr("rl2grid.scenarios.training_years.free_bytes", lambda: 10**8)
    asked = RunArgs("bus14-T0", hyperparameters("ppo", "bus14-T0"), folder=tmp_path / "run")
    with pytest.raises(UsageError, match=r"bus14 takes 0\.5 GB in .*, and 0\.1 GB are free: free some"):
        train(asked)
    assert not (tmp_path / "run").exists()


def test_a_folder_without_a_run_is_not_resumed(tmp_path: Path):
    with pytest.raises(UsageError, match=r"no config\.json"):
        resume(tmp_path, make_envs=toy_envs)
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(UsageError, match="is no description of a run: line 1 is no JSON"):
        resume(tmp_path, make_envs=toy_envs)


def test_a_run_is_not_resumed_with_other_data(tmp_path: Path):
    folder = train(request(tmp_path / "run"), make_envs=toy_envs)
    rewrite(folder / "config.json", lambda config: config["identity"].update(action_set_hash="0123"))
    with pytest.raises(UsageError, match="action_set_hash was 0123"):
        resume(folder, make_envs=toy_envs)


def test_a_checkpoint_of_another_version_is_not_resumed(tmp_path: Path):
    folder = train(request(tmp_path / "run"), make_envs=toy_envs)
    contents = load_checkpoint(folder / "checkpoint.pt")
    del contents["run"]["best_score"]
    save_checkpoint(folder / "checkpoint.pt", contents)
    with pytest.raises(UsageError, match="lacks 'best_score', because another version of rl2grid wrote it"):
        resume(folder, make_envs=toy_envs)


def test_a_run_whose_checkpoint_is_gone_is_not_begun_again(tmp_path: Path):
    folder = train(request(tmp_path / "run"), evaluate=falling, make_envs=toy_envs)
    (folder / "checkpoint.pt").unlink()
    before = {name: (folder / name).read_bytes() for name in ("best.pt", "metrics.csv", "energy.json", "log.txt")}
    with pytest.raises(UsageError, match=r"cannot be resumed: its checkpoint\.pt is missing, and to begin again would"):
        resume(folder, evaluate=falling, make_envs=toy_envs)
    (folder / "checkpoint.pt").write_bytes(b"PK")
    with pytest.raises(UsageError, match="is not a checkpoint that can be read"):
        resume(folder, evaluate=falling, make_envs=toy_envs)
    assert {name: (folder / name).read_bytes() for name in before} == before


def test_the_checkpoint_of_another_run_is_not_gone_on_with(tmp_path: Path):
    folder = train(request(tmp_path / "run"), make_envs=toy_envs)
    other = train(request(tmp_path / "other", hyperparameters=replace(SMALL, seed=6)), make_envs=toy_envs)
    (folder / "checkpoint.pt").write_bytes((other / "checkpoint.pt").read_bytes())
    with pytest.raises(UsageError, match="of a run with other hyperparameters than its config"):
        resume(folder, make_envs=toy_envs)


def test_a_run_that_has_just_begun_has_no_policy(tmp_path: Path):
    def end(args: RunArgs) -> Any:
        envs = toy_envs(args)
        envs.step = lambda actions: 1 / 0  # type: ignore[method-assign]
        return envs

    with pytest.raises(ZeroDivisionError):
        train(request(tmp_path / "run"), make_envs=end)
    with pytest.raises(UsageError, match="has no policy yet: its run has just begun"):
        load_agent(tmp_path / "run")
    assert is_finished(resume(tmp_path / "run", make_envs=toy_envs))


def test_damaged_decoration_is_set_aside_and_the_run_goes_on(tmp_path: Path):
    straight = train(request(tmp_path / "straight"), evaluate=falling, make_envs=toy_envs)
    folder = train(request(tmp_path / "run"), evaluate=falling, limit=TimeLimit(1e-9), make_envs=toy_envs)
    (folder / "energy.json").write_bytes(b"[[[")
    (folder / "metrics.csv").write_bytes(b"\xff\xfe\x00" * 100)
    with pytest.warns(DamageWarning, match="set aside as") as warned:
        resume(folder, evaluate=falling, make_envs=toy_envs)
    assert {str(each.message).rsplit(" ", 1)[1] for each in warned} == {"energy.json.damaged.", "metrics.csv.damaged."}
    assert is_finished(folder)
    rows = table(straight)
    assert table(folder).equals(rows[rows["step"] > 32].reset_index(drop=True))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -4e37])
def test_weights_that_nobody_learned_are_not_played(tmp_path: Path, value: float):
    folder = train(request(tmp_path / "run"), evaluate=falling, make_envs=toy_envs)
    contents = load_checkpoint(folder / "best.pt")
    next(iter(contents["policy"]["network"].values())).reshape(-1)[3] = value
    save_checkpoint(folder / "best.pt", contents)
    with pytest.raises(UsageError, match=r"best\.pt' cannot be played: some of its (numbers|weights) are"):
        load_agent(folder)


def test_networks_larger_than_their_weights_are_not_built(tmp_path: Path):
    folder = train(request(tmp_path / "run"), make_envs=toy_envs)
    contents = load_checkpoint(folder / "checkpoint.pt")
    contents["policy"]["actor_layers"] = [10**6, 10**6]
    save_checkpoint(folder / "checkpoint.pt", contents)
    with pytest.raises(UsageError, match="its networks have other sizes than its weights"):
        load_agent(folder)


def test_a_run_has_one_writer(tmp_path: Path):
    def second_writer(args: RunArgs) -> Any:
        raise AssertionError("got past the lock")

    def evaluate(agent: PolicyAgent) -> Mapping[str, float]:
        assert "is being written by another process" in refusal_of_a_second_process(tmp_path / "run")
        return {"survival": 0.0}

    train(request(tmp_path / "run", evaluate_every=10_000), evaluate=evaluate, make_envs=toy_envs)


# --- Interruptions --------------------------------------------------------------------------------------------------


def test_an_interrupt_ends_the_run_after_the_iteration_and_it_can_be_resumed(tmp_path: Path):
    straight = train(request(tmp_path / "straight"), evaluate=falling, make_envs=toy_envs)

    class Interrupting(ToyGrid):
        steps = 0

        def step(self, actions: Any) -> Any:
            self.steps += 1
            if self.steps == 35:  # in the middle of the fifth iteration
                signal.raise_signal(signal.SIGINT)
            return super().step(actions)

    handler = signal.getsignal(signal.SIGINT)
    folder = train(
        request(tmp_path / "run", checkpoint_seconds=1e9),
        evaluate=falling,
        make_envs=lambda args: Interrupting(4, gamma=0.9),
    )
    assert signal.getsignal(signal.SIGINT) is handler
    assert load_checkpoint(folder / "checkpoint.pt")["decisions"] == 5 * 32
    assert "stopped at 160 decisions" in (folder / "log.txt").read_text()
    assert not is_finished(folder)
    resume(folder, evaluate=falling, make_envs=toy_envs)
    assert is_finished(folder)
    assert_same_run(folder, straight)


@pytest.fixture
def interruptible():
    """A process in the background of a shell begins with interrupts ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_a_second_interrupt_ends_the_run_at_once(tmp_path: Path):
    class Interrupting(ToyGrid):
        def step(self, actions: Any) -> Any:
            signal.raise_signal(signal.SIGINT)
            return super().step(actions)

    with pytest.raises(KeyboardInterrupt):
        train(request(tmp_path / "run"), make_envs=lambda args: Interrupting(4, gamma=0.9))
    assert load_checkpoint(tmp_path / "run" / "checkpoint.pt")["decisions"] == 0
    assert not is_finished(tmp_path / "run")


def test_a_finished_run_stays_as_it_is(tmp_path: Path):
    folder = train(request(tmp_path / "run"), evaluate=falling, make_envs=toy_envs)
    before = {name: (folder / name).read_bytes() for name in ("checkpoint.pt", "best.pt", "metrics.csv")}
    resume(folder, evaluate=falling, make_envs=toy_envs)
    assert {name: (folder / name).read_bytes() for name in before} == before


@pytest.mark.parametrize(
    "kills",
    [
        ["before-write:1", "mid-write:3", "after-replace:2"],
        ["mid-row:40", "before-replace:4"],
    ],
    ids=["writing", "recording"],
)
def test_a_run_killed_at_the_worst_moments_ends_like_one_that_was_not(tmp_path: Path, kills: list[str]):
    straight = train(request(tmp_path / "straight"), evaluate=falling, make_envs=toy_envs)
    for kill in kills:
        assert run_until_killed(tmp_path / "run", kill) == KILLED
    resume(tmp_path / "run", evaluate=falling, make_envs=toy_envs)
    assert_same_run(tmp_path / "run", straight)


@pytest.mark.slow
def test_a_run_killed_at_random_moments_ends_like_one_that_was_not(tmp_path: Path):
    straight = train(request(tmp_path / "straight"), evaluate=falling, make_envs=toy_envs)
    for attempt in range(2):
        seconds = random.uniform(0.0, 0.35)
        status = run_until_killed(tmp_path / "run", after_seconds=seconds)
        print(f"attempt {attempt}: killed after {seconds:.3f} s, exit status {status}")
    if not (tmp_path / "run").exists():
        train(request(tmp_path / "run"), evaluate=falling, make_envs=toy_envs)
    else:
        resume(tmp_path / "run", evaluate=falling, make_envs=toy_envs)
    assert_same_run(tmp_path / "run", straight)


@pytest.mark.parametrize(
    ("task", "engine", "sizes"),
    [
        ("bus14-T0", "native", {"num_envs": 20, "num_steps": 8}),
        pytest.param("bus14-R", "native", {"num_envs": 20, "num_steps": 8}, marks=pytest.mark.slow),
        ("bus14-T0", "reference", {"num_envs": 2, "num_steps": 2}),
    ],
)
def test_a_run_on_the_grid_broken_off_and_resumed_ends_like_one_that_was_not(
    tmp_path: Path, task: str, engine: str, sizes: dict[str, int]
):
    iteration = sizes["num_envs"] * sizes["num_steps"]

    class BrokenOffError(Exception):
        pass

    def break_off(agent: PolicyAgent) -> Mapping[str, float]:
        if agent.identity["decisions"] == 3 * iteration:  # after two saved iterations, in the middle of the third
            raise BrokenOffError
        return {"survival": 0.0}

    def validate(agent: PolicyAgent) -> Mapping[str, float]:
        return {"survival": 0.0}

    sizes = {**sizes, "total_timesteps": 4 * iteration, "update_epochs": 2}
    changes = {
        "task": task,
        "hyperparameters": hyperparameters("ppo", task, seed=1, **sizes),
        "env_keywords": {"engine": engine, "heuristic": "idle"},
        "num_workers": 0 if engine == "reference" else None,
        "evaluate_every": iteration,
    }
    straight = train(request(tmp_path / "straight", **changes), evaluate=validate)
    with pytest.raises(BrokenOffError):
        train(request(tmp_path / "run", **changes), evaluate=break_off)
    assert load_checkpoint(tmp_path / "run" / "checkpoint.pt")["decisions"] == 2 * iteration
    resume(tmp_path / "run", evaluate=validate)
    assert_same_run(tmp_path / "run", straight)
    assert load_checkpoint(straight / "checkpoint.pt")["training"]["grid_steps"] > 4 * iteration


def test_a_setting_that_is_wrong_is_refused_before_there_is_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("RL2GRID_MAKERS", "many")
    with pytest.raises(UsageError, match="RL2GRID_MAKERS=many is no number of processes"):
        train(request(tmp_path / "run"))
    assert not (tmp_path / "run").exists()
