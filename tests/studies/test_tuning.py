"""Searches for hyperparameters: what a file means, what is refused, and that all trials are played once."""

from __future__ import annotations

import json
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import rl2grid
from rl2grid.algorithms.registry import algorithm_names, find_algorithm
from rl2grid.errors import UsageError
from rl2grid.studies import search as search_module
from rl2grid.studies.search import (
    Reports,
    _begin,
    _open,
    _prepare,
    _put_back_interrupted,
    best_command,
    effort,
    one_score,
    run_tuning,
    work,
)
from rl2grid.studies.tuning import Tuning, parse_tuning
from rl2grid.training import request, runs

SOURCES = str(Path(rl2grid.__file__).parents[1])
SEARCH: dict[str, Any] = {"name": "search", "algorithm": "ppo", "task": "bus14-T0", "budget": 512, "trials": 2}


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"trails": 3}, "(did you mean 'trials'?)"),
        ({"algorithm": "pop"}, "(did you mean 'ppo'?)"),
        ({"space": {"gama": [0.9]}}, "(did you mean 'gamma'?)"),
        ({"space": {"gamma": 0.9}}, "a list of choices or a range"),
        ({"space": {"gamma": {"low": 0.9, "high": 0.8}}}, "a list of choices or a range"),
        ({"space": {}}, "at least one hyperparameter"),
        ({"algorithm": "lagrangian-ppo", "space": {"gamma": [0.9]}}, "Lagrangian PPO needs a constraint"),
        ({"hyperparameters": {"initial_do_nothing": "x"}}, "initial_do_nothing must be a number, not 'x'"),
        ({"hyperparameters": {"gamma": 0.9}, "space": {"gamma": [0.8]}}, "gamma is both fixed, in [hyperparameters]"),
        ({"hyperparameters": {"num_steps": 8}, "space": {"num_envs * num_steps": [64]}}, "in two ways"),
        ({"space": {"gamma": ["x"]}}, "Each choice for gamma must be a number, not 'x'"),
        ({"space": {"gamma": [0.9, 1.1]}}, "The space of gamma holds 1.1, which cannot work"),
        ({"space": {"num_steps": {"low": 1, "high": 10_000}}}, "The space of num_steps holds 10000"),
        ({"space": {"num_envs": {"low": 1.5, "high": 2.5}}}, "Each choice for num_envs must be a whole number"),
        ({"space": {"actor_layers": [8, 8]}}, "Each choice for actor_layers must be a list"),
        (
            {"algorithm": "lagrangian-ppo", "task": "bus14-T0-TLO", "space": {"thresholds": [[0.0], [50.0]]}},
            "The thresholds cannot be searched",
        ),
        ({"budget": 10}, "total_timesteps (--decisions) of at least"),
        ({"seeds": []}, "a list of different whole numbers"),
        ({"seeds": [1, 1]}, "a list of different whole numbers"),
        ({"space": {"cost_weight": ["x"]}}, "Each choice for cost_weight must be a number"),
    ],
)
def test_a_bad_search_is_refused_in_one_sentence(changes: dict[str, Any], part: str):
    with pytest.raises(UsageError) as refusal:
        parse_tuning({**SEARCH, **changes})
    assert part in str(refusal.value)


@pytest.mark.parametrize("algorithm", algorithm_names())
def test_every_choice_of_every_default_space_can_be_trained(algorithm: str):
    task = "bus14-T0-TLO" if "T" in find_algorithm(algorithm).kinds else "bus14-R"
    tuning = parse_tuning({**SEARCH, "algorithm": algorithm, "task": task, "budget": 100_000})
    for name, values in tuning.space.items():
        for value in values:
            assert tuning.resolved({name: value}).total_timesteps == 100_000


def test_a_choice_that_works_beside_some_others_only_is_kept():
    space = {"num_envs": [1, 16], "num_steps": [32, 256]}
    assert parse_tuning({**SEARCH, "space": space}).space == space


def test_what_is_fixed_is_not_searched_by_default():
    tuning = parse_tuning({**SEARCH, "budget": 100_000, "hyperparameters": {"gamma": 0.9, "num_steps": 8}})
    assert not {"gamma", "num_steps", "num_envs * num_steps"} & set(tuning.space)
    assert "num_envs" in tuning.space
    assert tuning.resolved({}).num_steps == 8


def test_weights_of_the_reward_are_searched_as_the_paper_did():
    tuning = parse_tuning({**SEARCH, "budget": 100_000})
    assert tuning.space["cost_weight"] == [0.1, 0.25, 0.5]
    assert tuning.environment({}) == {"heuristic": None}
    assert tuning.environment({"survive_weight": 0.1})["reward"] == (0.1, 0.5, 0.5)
    fixed = parse_tuning({**SEARCH, "budget": 100_000, "hyperparameters": {"overload_weight": 1.0}})
    assert "overload_weight" not in fixed.space
    assert fixed.environment({"cost_weight": 0.25})["reward"] == (1.0, 1.0, 0.25)
    assert fixed.resolved({"cost_weight": 0.25}) == fixed.resolved({})
    assert [fixed.resolved({}, seed).seed for seed in fixed.seeds] == [1, 2, 3]


def test_transitions_per_update_become_steps():
    tuning = parse_tuning({**SEARCH, "budget": 100_000})
    assert tuning.space["num_envs * num_steps"] == [10_000, 20_000, 50_000]
    assert tuning.resolved({"num_envs": 50, "num_envs * num_steps": 20_000}).num_steps == 400


def test_processes_that_begin_at_the_same_time_begin_no_more_trials_than_asked_for(tmp_path: Path, monkeypatch):
    optuna = pytest.importorskip("optuna")
    tuning = parse_tuning({**SEARCH, "space": {"gamma": {"low": 0.5, "high": 0.9}}}, tmp_path)
    ask = optuna.study.Study.ask

    def slowly(study: Any) -> Any:
        time.sleep(0.2)
        return ask(study)

    monkeypatch.setattr(optuna.study.Study, "ask", slowly)
    _open(tuning)
    with ThreadPoolExecutor(4) as pool:
        begun = list(pool.map(lambda _: _begin(tuning, _open(tuning)), range(4)))
    assert sum(each is not None for each in begun) == tuning.trials == 2
    assert len({each[1]["gamma"] for each in begun if each}) == 2


def test_a_range_of_numbers_may_end_at_whole_numbers(tmp_path: Path):
    pytest.importorskip("optuna")
    space = {"gae_lambda": {"low": 0, "high": 1}, "num_envs": {"low": 1, "high": 4}}
    tuning = parse_tuning({**SEARCH, "space": space}, tmp_path)
    begun = _begin(tuning, _open(tuning))
    assert begun is not None
    assert 0.0 < begun[1]["gae_lambda"] < 1.0
    assert begun[1]["num_envs"] in (1, 2, 3, 4)


def search_by_formula(tuning: Tuning, interrupted_at: int | None) -> list[dict[str, Any]]:
    """What one process chooses, if gamma itself is what is reached."""
    tuning.output.mkdir()
    chosen: list[dict[str, Any]] = []
    study = _open(tuning)
    while (begun := _begin(tuning, study)) is not None:
        trial, choices = begun
        if len(chosen) == interrupted_at:
            interrupted_at = None
            _put_back_interrupted(tuning)
            study = _open(tuning)
            continue
        study.tell(trial, choices["gamma"])
        chosen.append(choices)
    return chosen


def test_one_process_chooses_by_the_seed_alone_interrupted_or_not(tmp_path: Path):
    pytest.importorskip("optuna")
    file = {**SEARCH, "trials": 13, "space": {"gamma": {"low": 0.5, "high": 0.9}, "num_envs": [1, 2, 4]}}
    straight = search_by_formula(parse_tuning(file, tmp_path / "straight"), None)
    assert len({choices["gamma"] for choices in straight}) == 13
    for place in (4, 11):
        assert search_by_formula(parse_tuning(file, tmp_path / f"killed {place}"), place) == straight
    assert search_by_formula(parse_tuning({**file, "seed": 2}, tmp_path / "other"), None) != straight


@pytest.mark.parametrize(("prune", "state"), [(False, "COMPLETE"), (True, "PRUNED")])
def test_of_equal_trials_one_is_trained_and_the_others_take_its_result(
    tmp_path: Path, monkeypatch, prune: bool, state: str
):
    optuna = pytest.importorskip("optuna")
    trained: list[Path] = []

    def train(args: request.RunArgs, *, evaluate: Any) -> None:
        assert args.folder is not None
        args.folder.mkdir(parents=True)
        trained.append(args.folder)
        time.sleep(0.5)
        assert args.env_keywords["reward"] == (1.0, 0.1, 0.5)
        evaluate(SimpleNamespace(identity={"decisions": 256}))
        (args.folder / "metrics.csv").write_text(
            "step,grid_steps,wall_time,name,value\n256,0,0.0,validation/survival,0.5\n"
        )

    monkeypatch.setattr(runs, "train", train)
    monkeypatch.setattr(runs, "is_finished", lambda folder: (folder / "metrics.csv").exists())
    monkeypatch.setattr(search_module, "validator", lambda args: lambda agent: {"survival": 0.5})
    monkeypatch.setattr(optuna.trial.Trial, "should_prune", lambda self: prune)
    file = {
        **SEARCH,
        "trials": 3,
        "seeds": [4, 5],
        "space": {"gamma": [0.9]},
        "hyperparameters": {"overload_weight": 0.1},
    }
    tuning = parse_tuning(file, tmp_path)
    _prepare(tuning)
    _open(tuning)
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(work, [tmp_path, tmp_path]))
    assert [folder.name for folder in trained] == (["4"] if prune else ["4", "5"])
    assert [trial.state.name for trial in _open(tuning).get_trials()] == [state] * 3
    spent = 256 if prune else 512 + 256
    assert effort(tuning) == {"trials": 3, "seeds": 2, "budget": 512, "decisions": spent}


@pytest.mark.slow
def test_a_search_finds_the_best_of_its_trials_and_is_gone_on_with(tmp_path: Path, monkeypatch):
    pytest.importorskip("optuna")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([SOURCES, os.environ.get("PYTHONPATH", "")]))
    file = {**SEARCH, "months": 1, "validations": 2, "seeds": [1, 2]}
    file["space"] = {"gamma": [0.9, 0.99], "actor_layers": [[8], [8, 8]]}
    tuning = parse_tuning(file, tmp_path)
    best = run_tuning(tuning, 1)
    assert best is not None
    stored = json.loads((tmp_path / "best.json").read_text())
    assert stored["survival"] == best.survival > 0.0
    assert best_command(tuning, best).startswith("rl2grid train ppo bus14-T0 --decisions 512")
    runs = set((tmp_path / "trials").iterdir())
    again = run_tuning(tuning, 1)
    assert again == best
    assert set((tmp_path / "trials").iterdir()) == runs


@pytest.mark.slow
def test_a_poor_trial_is_ended_by_its_validation_survival(tmp_path: Path, monkeypatch):
    pytest.importorskip("optuna")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([SOURCES, os.environ.get("PYTHONPATH", "")]))
    cautious, rash = 0.99, 0.001
    file = {**SEARCH, "trials": 6, "months": 1, "validations": 2, "seeds": [1]}
    file["space"] = {"initial_do_nothing": [cautious, rash]}
    tuning = parse_tuning({**file, "hyperparameters": {"actor_learning_rate": 1e-6}}, tmp_path)
    _prepare(tuning)
    # Nothing is ended before five trials are complete; equal ones cost one training.
    for choice in (*[cautious] * 5, rash):
        _open(tuning).enqueue_trial({"initial_do_nothing": choice})
    best = run_tuning(tuning, 1)
    assert best is not None
    assert best.hyperparameters == {"initial_do_nothing": cautious}
    *complete, pruned = _open(tuning).get_trials()
    assert [trial.state.name for trial in (*complete, pruned)] == ["COMPLETE"] * 5 + ["PRUNED"]
    assert list(pruned.intermediate_values) == [256], "it was ended half way"
    assert pruned.user_attrs["survival"] < best.survival
    metrics = tmp_path / "trials" / pruned.user_attrs["run"] / "1" / "metrics.csv"
    assert not any(line.startswith("512,") for line in metrics.read_text().splitlines())


ONE_TRIAL_AND_A_CRASH = """
import sys
from pathlib import Path
from rl2grid.studies.search import _begin, _open, _read
folder = Path(sys.argv[1])
tuning = _read(folder)
study = _open(tuning)
trial, _ = _begin(tuning, study)
trial.set_user_attr("survival", 0.5)
study.tell(trial, 0.5)
_begin(tuning, study)
"""


@pytest.mark.slow
def test_a_search_that_ends_short_of_trials_says_so(tmp_path: Path, monkeypatch):
    pytest.importorskip("optuna")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([SOURCES, os.environ.get("PYTHONPATH", "")]))
    tuning = parse_tuning({**SEARCH, "space": {"gamma": [0.9, 0.99]}}, tmp_path)
    with pytest.raises(UsageError, match="stopped after 1 of 2 trials"):
        run_tuning(tuning, 1, command=(sys.executable, "-c", ONE_TRIAL_AND_A_CRASH))
    assert json.loads((tmp_path / "best.json").read_text())["survival"] == 0.5


def test_searches_under_constraints_look_for_safety_before_survival():
    limits = {"TLO": 50.0}
    ranked = [(0.5, 0.2), (0.5, 0.9), (0.55, 0.1), (1.0, 1.0)]
    scores = [one_score({"safe_completed": safe, "survival": survival}, limits) for safe, survival in ranked]
    assert scores == sorted(set(scores))
    assert one_score({"survival": 0.7}, {}) == 0.7


def test_a_trial_reports_its_best_so_far_and_what_it_reached_before_an_interruption(tmp_path: Path):
    optuna = pytest.importorskip("optuna")

    class Patient(optuna.pruners.BasePruner):
        def prune(self, study: Any, trial: Any) -> bool:
            return trial.last_step == 30

    study = optuna.create_study(direction="maximize", pruner=Patient())
    trial = study.ask()
    rows = ["step,grid_steps,wall_time,name,value"]
    for step, survival in ((10, 0.6), (20, 0.4)):
        rows += [f"{step},0,0.0,validation/survival,{survival}", f"{step},0,0.0,losses/value_loss,9.0"]
    (tmp_path / "metrics.csv").write_text("\n".join(rows) + "\n")
    reports = Reports(trial, 50, {})
    reports.begin(tmp_path)
    assert reports.mean == 0.6
    with pytest.raises(optuna.TrialPruned):
        reports.add(30, {"survival": 0.5})
    reports.add(40, {"survival": 0.7})
    reports.begin(tmp_path / "the next run")
    reports.add(10, {"survival": 0.2})
    reports.add(20, {"survival": 0.3})
    told = study.get_trials()[0]
    values = {10: 0.6, 20: 0.6, 30: 0.6, 40: 0.7, 60: (0.7 + 0.2) / 2, 70: (0.7 + 0.3) / 2}
    assert told.intermediate_values == pytest.approx(values)
    assert told.user_attrs["survival"] == reports.mean == pytest.approx(0.5)
