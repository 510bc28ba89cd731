"""Algorithms by name, and one of a user's own beside them."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from rl2grid.algorithms import registry
from rl2grid.algorithms.registry import (
    Algorithm,
    algorithm_names,
    algorithms_for,
    find_algorithm,
    register_algorithm,
)
from rl2grid.errors import UsageError
from rl2grid.studies.tuning import WEIGHT_CHOICES, search_space
from rl2grid.training.request import hyperparameters

RESULTS = Path(__file__).resolve().parents[2] / "benchmarks" / "results"
OURS = ("ppo", "lagrangian-ppo", "dqn", "sac", "td3", "imitation")


@dataclass(frozen=True)
class Args:
    """Hyperparameters of nothing."""

    seed: int = 1
    total_timesteps: int = 10
    num_envs: int = 1
    num_steps: int = 1
    gamma: float = 0.5


def preset(name: str, *, continuous: bool, **changes: object) -> Args:
    assert name == "default"
    return replace(Args(), **changes)  # type: ignore[arg-type]


@pytest.fixture
def mine(monkeypatch: pytest.MonkeyPatch) -> Algorithm:
    """An algorithm that is registered during a test."""
    monkeypatch.setattr(registry, "_ADDED", {})
    algorithm = Algorithm("mine", Args, lambda args, envs: None, ("R",), preset, lambda state: None, {"gamma": (0.1,)})  # type: ignore[arg-type, return-value]
    register_algorithm(algorithm)
    return algorithm


@pytest.mark.parametrize("name", OURS)
def test_each_is_found_by_its_name(name: str):
    algorithm = find_algorithm(name)
    assert algorithm.name == name
    for kind in algorithm.kinds:
        args = algorithm.preset("default", continuous=kind == "R")
        assert type(args) is algorithm.args
    assert algorithm.type_hints().keys() == vars(args).keys()
    assert algorithm.search_space.keys() - {"num_envs * num_steps"} <= vars(args).keys()


def test_the_preset_tuned_is_what_the_search_found():
    found = json.loads((RESULTS / "tuning.json").read_text())["algorithms"]["sac"]["hyperparameters"]
    tuned, usual = (find_algorithm("sac").preset(preset, continuous=False) for preset in ("tuned", "default"))
    for key, value in found.items():
        assert getattr(tuned, key) == (tuple(value) if isinstance(value, list) else pytest.approx(value, rel=0.05)), key
    others = vars(tuned).keys() - {*found, "last_learning_rate_share"}
    assert {key: vars(tuned)[key] for key in others} == {key: vars(usual)[key] for key in others}


def test_of_redispatch_it_is_what_survived_longest_in_the_search_and_again_with_other_seeds():
    found = json.loads((RESULTS / "families.json").read_text())["36-R"]["ppo"]
    survival = {name: sum(trainings) for name, trainings in found["search"]["trainings"].items()}
    assert max(survival, key=survival.get) == "wide"  # type: ignore[arg-type]
    assert found["compare"]["compared"]["wide"]["p"] < 0.05
    tuned, usual = (find_algorithm("ppo").preset(preset, continuous=True) for preset in ("tuned", "default"))
    assert tuned == replace(usual, initial_log_std=0.0)


def test_of_sac_it_is_what_survived_longer_than_the_default_with_other_seeds():
    compared = json.loads((RESULTS / "families.json").read_text())["36-R"]["sac"]["compare"]["compared"]
    assert compared["temperature 0.0003"]["p"] < 0.05
    calm = {"tune_temperature": False, "initial_temperature": 3e-4, "last_learning_rate_share": 0.05, "tau": 0.03}
    few = {"train_frequency": 32, "batch_size": 512, "actor_learning_rate": 1e-3, "critic_learning_rate": 3e-3}
    tuned, usual = (find_algorithm("sac").preset(preset, continuous=True) for preset in ("tuned", "default"))
    assert tuned == replace(usual, **calm, **few)


def test_where_nothing_was_found_it_is_refused():
    with pytest.raises(UsageError, match="choose 'default' or 'paper'"):
        find_algorithm("ppo").preset("tuned", continuous=False)


def test_kinds_of_tasks_and_names():
    assert algorithm_names() == OURS
    assert algorithms_for("T") == ("ppo", "lagrangian-ppo", "dqn", "sac", "imitation")
    assert algorithms_for("R") == ("ppo", "lagrangian-ppo", "sac", "td3", "imitation")
    with pytest.raises(UsageError, match="'a2c' does not exist: choose one of ppo, lagrangian-ppo, dqn, sac, td3"):
        find_algorithm("a2c")


def test_one_of_a_users_own_stands_beside_them(mine: Algorithm):
    assert find_algorithm("mine") is mine
    assert algorithm_names() == (*OURS, "mine")
    assert algorithms_for("R")[-1] == "mine"
    assert hyperparameters("mine", "bus14-R", seed=3) == Args(seed=3)
    assert search_space("mine") == {"gamma": [0.1], **{name: list(values) for name, values in WEIGHT_CHOICES.items()}}
    with pytest.raises(UsageError, match=r"'mine' cannot learn .* discrete actions: choose one of ppo, lagrangian-ppo"):
        hyperparameters("mine", "bus14-T0")


def test_names_are_given_once(mine: Algorithm):
    register_algorithm(mine)  # the same again, as by a module that is read twice
    with pytest.raises(UsageError, match="'mine' exists already: choose another name"):
        register_algorithm(replace(mine, kinds=("T",)))
    with pytest.raises(UsageError, match="'ppo' exists already"):
        register_algorithm(replace(mine, name="ppo"))


def test_names_are_known_without_pytorch():
    """So that help and refusals are quick, and possible where it is not installed."""
    code = "import sys; from rl2grid.algorithms.registry import algorithm_names; algorithm_names()"
    code += "; from rl2grid.cli.train import train; train(['--help']); assert 'torch' not in sys.modules"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert f"({', '.join(OURS)})" in shown


class Point:
    """An entry point."""

    def __init__(self, name: str, offered: object) -> None:
        self.name, self.offered = name, offered

    def load(self) -> object:
        return self.offered


@pytest.fixture
def offered(monkeypatch: pytest.MonkeyPatch) -> list[Point]:
    """What installed packages offer during a test."""
    points: list[Point] = []
    monkeypatch.setattr(registry, "entry_points", lambda group: points if group == "rl2grid.algorithms" else [])
    monkeypatch.setattr(registry, "_installed", registry._installed.__wrapped__)
    return points


def test_installed_packages_offer_theirs(mine: Algorithm, offered: list[Point]):
    theirs = replace(mine, name="theirs")
    offered += [Point("theirs", theirs), Point("ppo", mine)]
    assert algorithm_names() == (*OURS, "theirs", "mine")
    assert find_algorithm("theirs") is theirs
    assert find_algorithm("ppo").name == "ppo"  # nobody takes its place
    with pytest.raises(UsageError, match="'theirs' exists already"):
        register_algorithm(theirs)
    offered.append(Point("wrong", 3))
    with pytest.raises(UsageError, match="'wrong' is offered by an entry point that is no Algorithm, but 3"):
        find_algorithm("wrong")
