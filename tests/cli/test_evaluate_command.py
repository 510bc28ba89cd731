"""``rl2grid evaluate``: several agents on the same months, compared; what is played is made up."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest
from sample_results import result, with_foresight

from rl2grid.cli import evaluate as command
from rl2grid.cli.main import main
from rl2grid.evaluation import l2rpn
from rl2grid.records.l2rpn import L2RPNScores

SURVIVALS = {"do-nothing": [[0.1], [0.3], [0.2]], "greedy": [[0.5], [0.8], [0.6]], "random": [[0.1], [0.2], [0.1]]}


@pytest.fixture(autouse=True)
def played(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    asked: list[dict[str, Any]] = []

    def evaluate(agent: str, task: Any, **options: Any):
        asked.append({"agent": agent, **options})
        made = result(str(getattr(agent, "name", agent)), SURVIVALS.get(agent, [[0.4]]), split=options["split"])
        return replace(made, folder=options["output"])

    monkeypatch.setattr(command, "evaluate", evaluate)
    return asked


def test_agents_are_compared_with_the_first_on_the_same_months(played, capsys):
    assert main(["evaluate", "do-nothing", "greedy", "random", "bus14-T0", "--months", "3"]) == 0
    shown = capsys.readouterr().out
    assert [one["agent"] for one in played] == ["do-nothing", "greedy", "random"]
    assert {one["months"] for one in played} == {3}
    assert "survival, to do-nothing" in shown
    assert "+0.433" in shown
    assert "Holm's correction over these 2 comparisons" in " ".join(shown.split())
    assert "outside of a ledger" not in shown


def test_who_knows_the_future_is_marked_and_neither_best_nor_compared(monkeypatch, capsys):
    survivals = {**SURVIVALS, "foresight": [[1.0], [0.9], [1.0]]}

    def evaluate(agent: str, task: Any, **options: Any):
        made = replace(result(agent, survivals[agent], split=options["split"]), folder=options["output"])
        return with_foresight(made) if agent == "foresight" else made

    monkeypatch.setattr(command, "evaluate", evaluate)
    words = ["evaluate", "foresight", "do-nothing", "greedy", "bus14-T0", "--months", "3"]
    assert main(words) == 0
    shown = capsys.readouterr().out
    assert "foresight (with foresight)" in " ".join(shown.split())
    assert "survival, to do-nothing" in shown
    assert "+0.433" in shown
    assert "survival, to foresight" not in shown
    assert main([*words, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert [one["foresight"] for one in printed["summaries"]] == [True, False, False]


def test_one_agent_is_not_compared_and_a_look_at_test_months_is_told(capsys):
    assert main(["evaluate", "greedy", "bus14-T0", "--split", "test", "--months", "3"]) == 0
    shown = capsys.readouterr().out
    assert "Paired differences" not in shown
    assert "These test months were looked at outside of a ledger" in shown


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["greedy", "greedy"], "named twice"),
        (["greedy", "random", "--output", "here"], "--output is the folder of one agent"),
        (["greedy", "nobody"], "Agent 'nobody'"),
        (["greedy", "--seconds", "1"], "--seconds is for the agent planner"),
        (["planner", "--seconds", "0"], "seconds=0.0 is not allowed"),
        (["do-nothing", "dc-opf"], "Agent 'dc-opf' cannot play"),
        (["do-nothing", "planner", "--engine", "reference"], "asks what-ifs of the native engine"),
    ],
)
def test_what_cannot_be_played_is_refused_before_anything_is(played, capsys, words, sentence):
    agents = words[: next((k for k, word in enumerate(words) if word[0] == "-"), None)]
    assert main(["evaluate", *agents, "bus14-T0", *words[len(agents) :]]) == 2
    assert sentence in capsys.readouterr().err
    assert played == []


def test_the_planner_searches_for_as_long_as_it_is_told(played, capsys):
    assert main(["evaluate", "planner", "bus14-T0", "--months", "1", "--seconds", "0.1"]) == 0
    (one,) = played
    assert one["agent"].name == "planner (0.1 s)"
    assert one["command"].endswith("--months 1 --seconds 0.1")
    assert one["output"].name == "validation-1-months-0.1-seconds"


def test_the_seconds_of_the_planner_are_not_those_of_who_plays_beside_it(played, capsys):
    assert main(["evaluate", "greedy", "planner", "bus14-T0", "--months", "3", "--seconds", "0.1"]) == 0
    greedy, planner = played
    assert (greedy["agent"], planner["agent"].name) == ("greedy", "planner (0.1 s)")
    assert (greedy["output"].name, planner["output"].name) == ("validation-3-months", "validation-3-months-0.1-seconds")
    assert greedy["command"].endswith("--months 3")


def test_scores_of_l2rpn_stand_in_a_table_of_their_own(monkeypatch, capsys):
    def scored(result, on_progress):
        on_progress(len(result.episodes))
        return tuple(L2RPNScores(80.0, 70.0, 100.0, 84.0) for _ in result.episodes)

    monkeypatch.setattr(l2rpn, "l2rpn_scores", scored)
    words = ["evaluate", "do-nothing", "greedy", "bus14-T0", "--months", "3", "--json", "--l2rpn"]
    assert main(words) == 0
    first, second = json.loads(capsys.readouterr().out)["l2rpn"]
    assert (first["Method"], second["Method"]) == ("do-nothing", "greedy")
    assert second["L2RPN 2020"]["value"] == 80
    assert second["2023 without alerts"]["value"] == 84
    assert second["Cost"] == "-"


def test_a_length_is_asked_for_and_named(played, monkeypatch, capsys):
    monkeypatch.setattr(command, "evaluate", lambda agent, task, **asked: with_length(agent, asked))
    assert main(["evaluate", "greedy", "bus14-T0", "--episode-length", "2016"]) == 0
    shown = capsys.readouterr().out
    assert "bus14-T0-v0, validation scenarios, episodes of 2016 steps" in shown
    assert "validation-episode-length-2016" in shown


def with_length(agent: str, asked: dict[str, Any]):
    assert "--episode-length 2016" in asked["command"]
    made = result(agent, SURVIVALS[agent], split=asked["split"], episode_length=asked["episode_length"])
    return replace(made, folder=asked["output"])
