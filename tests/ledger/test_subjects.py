"""Tests that are played once, and verified by playing again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from sample_results import result
from toy_runs import falling, request, toy_envs

from rl2grid.algorithms.pretrained import pretrained
from rl2grid.cli.main import main
from rl2grid.envs.tasks import Task
from rl2grid.errors import UsageError
from rl2grid.ledger import subjects
from rl2grid.ledger.subjects import find_subject, play_test
from rl2grid.records.evaluations import identity_hash
from rl2grid.records.ledger import agent_of, choice_hash, read_ledger
from rl2grid.records.looks import budget
from rl2grid.records.versions import TARGETS_VERSION
from rl2grid.scenarios.splits import SPLIT_VERSION
from rl2grid.training.runs import train


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What was asked of the protocol, which answers with a made-up evaluation."""
    asked: list[dict[str, Any]] = []

    def evaluate(agent: str, task: Task, **options: Any):
        asked.append({"agent": agent, "task": task, **options})
        months = {"split": "test", "split_version": SPLIT_VERSION, "generator_version": "1"}
        return result(getattr(agent, "name", agent), [[0.5], [1.0]], options["heuristic"], task=task.id, **months)

    monkeypatch.setattr(subjects, "evaluate", evaluate)
    return asked


def test_an_agent_whose_rules_changed_says_so_where_they_did():
    assert find_subject("planner@bus14-R:recovery").configuration["rules"] == 3
    assert find_subject("planner@bus14-H0").digest != identity_hash(
        {name: value for name, value in find_subject("planner@bus14-H0").configuration.items() if name != "rules"}
    )
    assert "rules" not in find_subject("greedy@bus14-T0").configuration
    assert "rules" not in find_subject("do-nothing@bus14-R").configuration


def test_a_heuristic_whose_rules_changed_says_so_where_power_can_be_dispatched():
    assert find_subject("do-nothing@bus14-R:secure").configuration["heuristic_rules"] == 2
    assert find_subject("do-nothing@bus14-H0:secure").configuration["heuristic_rules"] == 2
    for other in ("do-nothing@bus14-T0:secure", "do-nothing@bus14-R:recovery", "do-nothing@bus14-R"):
        assert "heuristic_rules" not in find_subject(other).configuration


def test_an_agent_without_training_is_named_with_its_task(played):
    subject = find_subject("random@bus14-T0:idle")
    who = {"agent": "random", "task": "rl2grid/bus14-T0-v0", "heuristic": "idle"}
    assert subject.configuration == {**who, "test": {"split_version": SPLIT_VERSION, "months": 500}}
    play_test(subject)
    assert (played[0]["split"], played[0]["heuristic"]) == ("test", "idle")
    assert len(played[0]["scenarios"]) == 500
    few = find_subject("random@bus14-T0:idle", months=3)
    assert few.digest != subject.digest
    play_test(few)
    assert played[1]["scenarios"] == played[0]["scenarios"][:3]
    for text, sentence in (
        ("random@bus15-T0", "Task"),
        ("nobody@bus14-T0", "Agent 'nobody'"),
        ("random@bus14-T0:sleepy", "heuristic, 'sleepy'"),
        ("milp@bus14-R", "cannot play a redispatching task"),
    ):
        with pytest.raises(UsageError, match=sentence):
            find_subject(text)


def test_a_run_plays_its_last_policy_beside_the_best_and_tells_of_earlier_looks(played, tmp_path: Path, monkeypatch):
    run = train(request(tmp_path / "run"), evaluate=falling, make_envs=toy_envs)
    subject = find_subject(str(run), months=2)
    assert (subject.training["best_after"], subject.training["decisions"], subject.heuristic) == (96, 384, "idle")
    stored = play_test(subject)
    assert [one["agent"] for one in played] == [run, run / "checkpoint.pt"]
    assert [one["split"] for one in played] == ["test", "test"]
    assert stored.last == stored.values != {}
    asked = {"decisions": 384, "evaluate_every": 96, "validation_months": request(run).validation_months}
    assert dict(budget(stored)) == asked
    assert (stored.configuration["targets_version"], stored.training["tested_before"]) == (TARGETS_VERSION, False)
    monkeypatch.setattr("rl2grid.ledger.subjects.was_evaluated", lambda folder, split: split == "test")
    assert find_subject(str(run), months=2).training["tested_before"]
    best_is_last = train(
        request(tmp_path / "rising"), evaluate=lambda agent: {"survival": 1.0, "return": 2.0}, make_envs=toy_envs
    )
    assert find_subject(str(best_is_last), months=2).last is None


def test_a_policy_of_the_package_is_tested_as_its_card_says(played):
    subject = find_subject("pretrained/bus14-T0-idle", months=2)
    card = pretrained("pretrained/bus14-T0-idle")
    assert subject.configuration["policy_hash"] == card.policy_hash
    assert (subject.task.id, subject.heuristic) == ("rl2grid/bus14-T0-v0", "idle")
    stored = play_test(subject)
    assert (played[0]["agent"], played[0]["heuristic"]) == ("pretrained/bus14-T0-idle", "idle")
    assert stored.label == "pretrained/bus14-T0-idle + idle"


def test_the_best_of_several_actions_is_another_configuration_of_the_same_method(played):
    subject = find_subject("pretrained/bus14-T0", months=2)
    best = find_subject("pretrained/bus14-T0", months=2, top_k=3)
    assert best.digest != subject.digest
    assert best.method == subject.method
    assert play_test(best).label == "pretrained/bus14-T0, best of 3"
    assert played[0]["agent"].name == "pretrained-bus14-T0, best of 3"
    with pytest.raises(UsageError, match="top_k compares the best actions of a trained policy"):
        find_subject("greedy@bus14-T0", top_k=3)


def test_a_policy_that_rehearses_its_crises_is_another_configuration_of_the_same_method(played):
    subject = find_subject("pretrained/bus14-T0", months=2)
    rehearsing = find_subject("pretrained/bus14-T0", months=2, top_k=3, rehearse=24)
    assert rehearsing.digest != subject.digest
    assert rehearsing.method == subject.method
    assert str(rehearsing).startswith("pretrained/bus14-T0, best of 3, rehearsing 24 steps on bus14-T0")
    assert play_test(rehearsing).label == "pretrained/bus14-T0, best of 3, rehearsing 24 steps"
    assert played[0]["agent"].name == "pretrained-bus14-T0, best of 3, rehearsing 24 steps"
    with pytest.raises(UsageError, match="rehearse plays the crises of a trained policy in advance"):
        find_subject("greedy@bus14-T0", rehearse=24)


def test_what_a_training_learned_from_counts_by_content_and_seeds_are_one_choice():
    begun = {"algorithm": "imitation", "decisions": 10, "path": "a", "policy_hash": "1"}
    labels = {"teacher": "greedy", "rounds": 1, "labels": ["f00"], "grid_hash": "0"}
    found = [
        {
            "algorithm": "ppo",
            "hyperparameters": {"seed": i},
            **subjects._learned_from({"labels": labels, "start": start}),
        }
        for i, start in enumerate([begun, begun | {"path": "b", "policy_hash": "2"}, begun | {"decisions": 20}])
    ]
    assert found[0]["labels"] == {"teacher": "greedy", "rounds": 1, "labels": ["f00"]}
    assert agent_of(found[0]) == "ppo from imitation"
    assert choice_hash(found[0]) == choice_hash(found[1]) != choice_hash(found[2])
    assert choice_hash(found[0]) != choice_hash(found[0] | {"labels": {"labels": ["bad"]}})


def test_a_policy_of_the_same_budget_begins_the_same_choice_whatever_its_best_one_is_from():
    def begun(**start: Any) -> dict[str, Any]:
        learned = {"algorithm": "imitation", "path": "a", "policy_hash": "1", **start}
        return {"algorithm": "ppo", **subjects._learned_from({"start": learned})}

    first, other, longer = (
        begun(decisions=10, budget=40),
        begun(decisions=20, budget=40),
        begun(decisions=10, budget=80),
    )
    assert first != other
    assert choice_hash(first) == choice_hash(other) != choice_hash(longer)


def test_labels_of_as_many_other_months_repeat_a_training_and_choose_nothing():
    def learned_from(contents: str, months: list[int]) -> dict[str, Any]:
        labels = {"teacher": "greedy", "rounds": 2, "months": [months], "labels": [contents], "grid_hash": "0"}
        return {"algorithm": "imitation", **subjects._learned_from({"labels": labels})}

    first, other, fewer = learned_from("f00", [20, 20]), learned_from("bad", [20, 20]), learned_from("f00", [20, 10])
    assert first != other
    assert choice_hash(first) == choice_hash(other) != choice_hash(fewer)


def test_a_configuration_is_tested_once_and_verified_as_often_as_asked(played, tmp_path: Path, capsys):
    ledger = tmp_path / "ledger.json"
    words = ["greedy@bus14-T0", "--ledger", str(ledger)]
    assert main(["leaderboard", "test", *words]) == 0
    before = ledger.read_bytes()
    assert main(["leaderboard", "test", *words]) == 0
    assert len(played) == 1
    shown = capsys.readouterr().out
    assert f"Look 1 of 100 at the test months of bus14, version {SPLIT_VERSION}.\n" in shown
    assert "has had its test: see ledger.json." in shown
    assert main(["leaderboard", "verify", *words]) == 0
    assert capsys.readouterr().out == "greedy on bus14-T0, heuristic None: the same, bit for bit.\n"
    assert ledger.read_bytes() == before
    assert main(["leaderboard", "table", "--ledger", str(ledger), "--task", "bus14-T0", "--to", "greedy"]) == 0
    assert "| bus14-T0 | greedy | none |" in capsys.readouterr().out
    assert main(["leaderboard", "table", "--ledger", str(ledger), "--to", "random"]) == 2
    assert "Reference 'random' does not exist: choose one of greedy." in capsys.readouterr().err
    assert len(read_ledger(ledger)) == 1


def test_what_differs_is_named(played, tmp_path: Path, capsys):
    ledger = tmp_path / "ledger.json"
    words = ["greedy@bus14-T0", "--ledger", str(ledger)]
    main(["leaderboard", "test", *words])
    contents = json.loads(ledger.read_text())
    (stored,) = contents.values()
    del stored["checksum"]
    stored["episodes_hash"] = "0" * 16
    stored["test"]["survival"] += 0.0001
    ledger.write_text(json.dumps(contents))
    assert main(["leaderboard", "verify", *words]) == 1
    assert "differs in episodes_hash, test." in capsys.readouterr().out
    assert main(["leaderboard", "verify", "random@bus14-T0", "--ledger", str(ledger)]) == 2
    assert "The ledger has no test of 'random'" in capsys.readouterr().err


def test_a_list_is_used_up(played, tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setattr(subjects, "LOOKS", 1)
    words = ["--ledger", str(tmp_path / "ledger.json"), "--months", "2"]
    assert main(["leaderboard", "test", "greedy@bus14-T0", "greedy@bus36-M-T0", *words]) == 0
    assert main(["leaderboard", "test", "greedy@bus14-R", *words]) == 2
    assert f"The test months of bus14, version {SPLIT_VERSION} are used up: 1 conf" in capsys.readouterr().err
    assert len(played) == 2


def test_what_is_no_finished_run_has_no_test(tmp_path: Path):
    with pytest.raises(UsageError, match="holds no run"):
        find_subject(str(tmp_path))


def test_a_length_is_part_of_a_configuration_where_it_was_given():
    """Configurations that were entered before there were lengths are called as they were."""
    assert subjects._frozen({"heuristic": None, "episode_length": None}) == {"heuristic": None}
    assert subjects._frozen({"episode_length": 2016}) == {"episode_length": 2016}
    assert subjects._frozen({"operator_features": None}) == {}
    assert subjects._frozen({"operator_features": "all"}) == {"operator_features": "all"}
