"""The keywords of the environments: declared once, from which signatures, refusals and flags follow."""

from __future__ import annotations

import argparse
import inspect
import pickle
from pathlib import Path
from typing import Any

import gymnasium
import pytest

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.cli import keywords
from rl2grid.cli.main import main
from rl2grid.envs.grid_env import PowerGridEnv
from rl2grid.envs.options import OPTION_NAMES, TaskOptions, changed_options, option_texts, options_of
from rl2grid.envs.tasks import find_task
from rl2grid.envs.vector import PowerGridVectorEnv
from rl2grid.errors import UsageError
from rl2grid.evaluation.flags import flag_of

DEFAULTS = TaskOptions()


@pytest.mark.parametrize(
    ("constructor", "own"),
    [(PowerGridEnv, ["render_mode"]), (PowerGridVectorEnv, ["num_threads", "num_workers"])],
)
def test_the_signature_of_an_environment_names_every_keyword_with_its_default(constructor: Any, own: list[str]):
    parameters = inspect.signature(constructor).parameters
    named = [name for name, each in parameters.items() if each.kind is inspect.Parameter.KEYWORD_ONLY]
    assert named == [*own, *OPTION_NAMES]
    assert all(parameters[name].default == getattr(DEFAULTS, name) for name in OPTION_NAMES)


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_an_unknown_keyword_is_refused_in_one_sentence_that_names_those_allowed(make: Any):
    said = r"^There is an unexpected keyword argument 'heuristics': choose one of .*(num_threads|render)"
    with pytest.raises(UsageError, match=said) as e:
        make("rl2grid/bus14-T0-v0", heuristics="idle")
    assert isinstance(e.value, TypeError), "libraries try again without a keyword that Python does not know"
    assert all(name in str(e.value) for name in OPTION_NAMES)


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_a_constraint_that_contradicts_the_id_is_refused(make: Any):
    with pytest.raises(UsageError, match=r"^constraint='TLO' contradicts task 'rl2grid/bus14-T0-LSI-v0': leave it out"):
        make("rl2grid/bus14-T0-LSI-v0", constraint="TLO")


@pytest.mark.parametrize(
    ("task", "keyword", "constraint"),
    [
        ("bus14-T0-LSI", None, "LSI"),
        ("bus14-T0-LSI", "LSI", "LSI"),
        ("bus14-T0", "TLO", "TLO"),
        ("bus14-T0", None, None),
    ],
)
def test_the_constraint_is_that_of_the_id_or_of_the_keyword(task: str, keyword: str | None, constraint: str | None):
    assert options_of(find_task(task), {"constraint": keyword}).constraint == constraint


@pytest.mark.parametrize(("name", "value"), [("engine", None), ("heuristic", "None"), ("split", 3), ("maintenance", 1)])
def test_values_of_another_kind_are_refused(name: str, value: Any):
    with pytest.raises(UsageError, match=name):
        TaskOptions(**{name: value})


@pytest.mark.parametrize("length", [0, -1, 8065, 1.5, True, "2016"])
def test_lengths_that_no_episode_can_have_are_refused(length: Any):
    with pytest.raises(UsageError, match="is not allowed: give a number of grid steps from 1 to 8064, or None"):
        TaskOptions(episode_length=length)


def test_every_keyword_says_what_it_means():
    texts = option_texts()
    assert tuple(texts) == OPTION_NAMES
    assert texts["normalize"] == "physical: divide observations by constants of the grid; None: physical units."
    assert 'info["cost"]' in texts["constraint"]


def test_flags_follow_from_the_declaration(capsys: pytest.CaptureFixture[str]):
    parser = argparse.ArgumentParser()
    keywords.add_flags(parser)
    words = [
        "--engine",
        "reference",
        "--heuristic",
        "None",
        "--reward",
        "1,2,0",
        "--no-opponent",
        "--episode-length",
        "2016",
        "--normalize",
        "None",
    ]
    assert keywords.given(parser.parse_args(words)) == {
        "engine": "reference",
        "heuristic": None,
        "reward": (1.0, 2.0, 0.0),
        "normalize": None,
        "opponent": False,
        "episode_length": 2016,
    }
    assert keywords.given(parser.parse_args([])) == {}
    assert keywords.given(parser.parse_args(["--episode-length", "None"])) == {"episode_length": None}
    with pytest.raises(UsageError, match=r"^--episode-length week is not allowed: give a whole number, or None"):
        keywords.given(parser.parse_args(["--episode-length", "week"]))
    with pytest.raises(SystemExit):
        parser.parse_args(["--dispatch", "fast"])
    assert "exact" in capsys.readouterr().err


@pytest.mark.parametrize("command", [["evaluate", "--help"], ["train", "ppo", "bus14-T0", "--help"]])
def test_help_shows_every_keyword_that_is_a_flag(command: list[str], capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(command)
    shown = capsys.readouterr().out
    assert all(f"--{flag_of(name)}" in shown for name in keywords.NAMES)


def test_an_opponent_that_the_grid_has_not_is_refused_when_asked_for():
    with pytest.raises(UsageError, match=r"^opponent=True is not allowed: bus14 has no opponent; leave it out"):
        gymnasium.make("rl2grid/bus14-T0-v0", opponent=True)
    assert options_of(find_task("bus36-MO-v0-T0"), {"opponent": True}).opponent
    assert options_of(find_task("bus14-T0"), {"opponent": False, "heuristic": None}) == TaskOptions(opponent=False)
    assert changed_options({"opponent": True, "heuristic": None, "reward": "paper", "more": 1}) == {
        "reward": "paper",
        "more": 1,
    }


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (
            ["evaluate", "do-nothing", "bus14-T0", "--months", "999"],
            "months=999 is not allowed: the split validation of",
        ),
        (["evaluate", "do-nothing", "bus14-T0", "--seeds", "-1"], "--seeds -1 is not allowed"),
        (["evaluate", "do-nothing", "bus14-T0", "--reward", "1,2"], "Reward (1.0, 2.0) does not exist"),
        (["evaluate", "do-nothing", "bus14-T0", "--opponent"], "bus14 has no opponent"),
        (["train", "ppo", "bus14-T0", "--reward", "1,2"], "Reward (1.0, 2.0) does not exist"),
        (["train", "ppo", "bus14-T0", "--opponent"], "bus14 has no opponent"),
        (["train", "ppo", "bus14-T0", "--validation-months", "999"], "months=999 is not allowed"),
    ],
)
def test_what_would_be_ignored_is_refused(
    words: list[str], part: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    (sentence,) = capsys.readouterr().err.strip().splitlines()
    assert part in sentence
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("engine", ["native", "reference"])
def test_closed_environments_say_so(engine: str):
    here: dict[str, Any] = {"num_workers": 0} if engine == "reference" else {"num_threads": 1}
    for env, action in (
        (gymnasium.make("rl2grid/bus14-T0-v0", engine=engine, split="bundled"), 0),
        (gymnasium.make_vec("rl2grid/bus14-T0-v0", 2, engine=engine, split="bundled", **here), [0, 0]),
    ):
        env.reset(seed=0)
        env.close()
        env.close()
        for call in (lambda env=env, action=action: env.step(action), env.reset, env.unwrapped.action_masks):
            with pytest.raises(UsageError, match=r"^The environment was closed: make another one\.$"):
                call()


def test_tasks_and_options_travel_to_other_processes_and_are_keys():
    task = find_task("bus36-M-T1-TLO")
    options = options_of(task, {"heuristic": "idle", "reward": (1.0, 0.5, 0.0)})
    assert pickle.loads(pickle.dumps((task, options))) == (task, options)
    assert {task: 1, options: 2} == {find_task(task.id): 1, options: 2}
    assert find_task(task) is task


@pytest.mark.parametrize(
    ("given", "kept"), [("attacks,calendar", "calendar,attacks"), ("trips,security,attacks,calendar", "all")]
)
def test_the_same_features_are_the_same_option(given: str, kept: str):
    assert TaskOptions(operator_features=given) == TaskOptions(operator_features=kept)
    assert TaskOptions(operator_features=given).operator_features == kept
