"""What tables and figures are made from: runs, evaluations and studies as they lie in folders."""

from __future__ import annotations

import re
from dataclasses import asdict, replace

import pytest
from sample_folders import CELLS, cell, write_made_up_evaluation, write_made_up_run, write_made_up_study
from sample_results import TASK

from rl2grid.errors import UsageError
from rl2grid.records.collection import collect, was_evaluated
from rl2grid.records.episodes import EPISODES_FILE


def test_runs_bring_their_evaluations_on_the_split(tmp_path):
    write_made_up_run(tmp_path / "run")
    for name in ("validation", "validation-idle", "test"):
        write_made_up_evaluation(tmp_path / "run" / "evaluation" / name)
    collection = collect([str(tmp_path / "run")])
    assert [one.folder.name for one in collection.evaluations if one.folder] == ["validation", "validation-idle"]
    assert [(run.curve.label, run.seed) for run in collection.runs] == [("ppo + idle", 1)]
    assert collection.missing == []
    assert len(collect([str(tmp_path / "run")], "test").evaluations) == 1


def test_a_run_was_evaluated_in_its_folder_or_in_its_cell(tmp_path):
    write_made_up_run(tmp_path / "run")
    assert not was_evaluated(tmp_path / "run", "test")
    write_made_up_evaluation(tmp_path / "run" / "evaluation" / "test-20-months")
    assert was_evaluated(tmp_path / "run", "test")
    write_made_up_study(tmp_path / "study", [cell("bus14-T0-v0-ppo-idle-1")])
    of_cell = tmp_path / "study" / "cells" / "bus14-T0-v0-ppo-idle-1" / "run"
    assert was_evaluated(of_cell, "test")
    assert not was_evaluated(of_cell, "validation")


def test_the_last_policy_stands_beside_the_best(tmp_path):
    write_made_up_run(tmp_path / "run")
    write_made_up_evaluation(tmp_path / "run" / "evaluation" / "validation")
    write_made_up_evaluation(tmp_path / "run" / "evaluation" / "checkpoint-validation", "ppo (last)")
    for words, names in ((str(tmp_path / "run"), "ppo"), (f"mine={tmp_path / 'run'}", "mine")):
        collection = collect([words])
        assert [one.episodes[0].agent for one in collection.evaluations] == [names, f"{names} (last)"]
    assert not was_evaluated(tmp_path / "run", "test")
    write_made_up_evaluation(tmp_path / "run" / "evaluation" / "checkpoint-test", "ppo (last)")
    assert was_evaluated(tmp_path / "run", "test")


def test_what_a_run_lacks_is_told(tmp_path):
    write_made_up_run(tmp_path / "run")
    collection = collect([f"mine={tmp_path / 'run'}"])
    assert collection.evaluations == []
    assert collection.runs[0].curve.label == "mine"
    assert collection.missing == [
        f"Run {tmp_path / 'run'} was not evaluated on validation: rl2grid evaluate {tmp_path / 'run'} {TASK} "
        "--split validation"
    ]


def test_a_run_that_played_nothing_has_no_curve(tmp_path):
    write_made_up_run(tmp_path / "run")
    metrics = tmp_path / "run" / "metrics.csv"
    metrics.write_text(metrics.read_text().replace("charts/survival", "validation/survival"))
    write_made_up_evaluation(tmp_path / "run" / "evaluation" / "validation")
    collection = collect([str(tmp_path / "run")])
    assert len(collection.evaluations) == 1
    assert collection.runs == collection.missing == []


def test_a_study_brings_every_finished_cell_under_its_name(tmp_path):
    unfinished = cell("bus14-T0-v0-ppo-idle-3", seed=3, finished=False)
    write_made_up_study(tmp_path, [*map(dict, CELLS), unfinished])
    collection = collect([str(tmp_path)])
    agents = [one.episodes[0].agent for one in collection.evaluations]
    assert agents == ["ppo", "ppo", "ppo small-nets", "do-nothing"]
    labels = [(run.curve.label, run.seed) for run in collection.runs]
    assert labels == [("ppo + idle", 1), ("ppo + idle", 2), ("ppo small-nets + idle", 1)]
    assert collection.missing == [f"Cell bus14-T0-v0-ppo-idle-3 of the study {tmp_path} is not finished."]


def test_a_demonstration_brings_its_run_and_all_that_was_played(tmp_path):
    write_made_up_run(tmp_path / "run")
    with pytest.raises(UsageError, match="has no evaluation yet: 'rl2grid demo' goes on"):
        collect([str(tmp_path)])
    for agent in ("do-nothing", "PPO"):
        write_made_up_evaluation(tmp_path / "evaluation" / agent, agent)
    collection = collect([str(tmp_path)])
    assert sorted(one.episodes[0].agent for one in collection.evaluations) == ["PPO", "do-nothing"]
    assert [(run.curve.label, run.folder.name) for run in collection.runs] == [("ppo + idle", "run")]
    assert collection.missing == []
    played = collection.evaluations[0].identity["split"]
    other = "test" if played != "test" else "train"
    assert len(collect([str(tmp_path)], played).evaluations) == 2
    with pytest.raises(UsageError, match=f"has no evaluation on {other} yet"):
        collect([str(tmp_path)], other)
    with pytest.raises(UsageError, match="has names of its own"):
        collect([f"mine={tmp_path}"])


def test_the_only_scale_of_a_study_is_found(tmp_path):
    write_made_up_study(tmp_path / "quick", [dict(CELLS[0])])
    assert len(collect([str(tmp_path)]).evaluations) == 1
    write_made_up_study(tmp_path / "full", [dict(CELLS[0])])
    with pytest.raises(UsageError, match=r"holds several studies: give one of .*full, .*quick"):
        collect([str(tmp_path)])


def test_a_cell_of_a_study_is_a_folder_like_others(tmp_path):
    write_made_up_study(tmp_path, [dict(one) for one in CELLS])
    collection = collect([str(tmp_path / "cells" / CELLS[2]["name"])])
    assert [one.episodes[0].agent for one in collection.evaluations] == ["ppo small-nets"]
    assert len(collection.runs) == 1
    named = collect([f"mine={tmp_path / 'cells' / CELLS[2]['name']}"])
    assert named.evaluations[0].episodes[0].agent == named.runs[0].curve.label == "mine"


def test_a_label_renames_episodes_alone(tmp_path):
    write_made_up_evaluation(tmp_path / "one")
    named, plain = (collect([words]).evaluations[0] for words in (f"mine={tmp_path / 'one'}", str(tmp_path / "one")))
    assert [asdict(episode) for episode in named.episodes] == [
        asdict(replace(episode, agent="mine")) for episode in plain.episodes
    ]
    assert named.identity == plain.identity


@pytest.mark.parametrize(
    ("words", "split", "part"),
    [
        ("{}/nothing", None, "is no folder"),
        ("{}/empty", None, "holds neither a run nor a study nor an evaluation on validation"),
        ("{}/torn", None, "torn --output /"),
        ("{}/run", None, "metrics.csv is no metrics file"),
        ("{}/study", "train", "has no finished cell that was evaluated on train yet"),
        ("mine={}/study", None, "A study has names of its own"),
        ("={}/study", None, "give FOLDER or LABEL=FOLDER"),
    ],
)
def test_refusals_are_one_sentence(tmp_path, words, split, part):
    (tmp_path / "empty").mkdir()
    write_made_up_evaluation(tmp_path / "torn")
    (tmp_path / "torn" / EPISODES_FILE).unlink()
    write_made_up_run(tmp_path / "run")
    (tmp_path / "run" / "metrics.csv").unlink()
    write_made_up_study(tmp_path / "study", [dict(CELLS[0])])
    with pytest.raises(UsageError, match=re.escape(part)) as refusal:
        collect([words.format(tmp_path)], split)
    assert "\n" not in str(refusal.value)
