"""Evaluations put together, and training runs likewise: what belongs into one table or curve, and what does not."""

from __future__ import annotations

import json

import numpy as np
import pytest
from sample_results import TASK, result

from rl2grid.errors import UsageError
from rl2grid.records.evaluations import Evaluation
from rl2grid.records.methods import group_methods, interval_units, interval_words, is_fair
from rl2grid.records.trainings import group_curves, read_training_run

OTHER_TASK = "rl2grid/bus36-MO-v0-T0-v0"


def test_runs_of_one_agent_are_one_method():
    first = result("ppo", [[1.0, 0.5], [0.2, 0.4]], "idle", agent_hash="a")
    second = result("ppo", [[0.1, 0.3], [0.6, 0.8]], "idle", agent_hash="b")
    plain = result("ppo", [[0.1, 0.3], [0.6, 0.8]], agent_hash="c")
    methods = group_methods([first, plain, second])[TASK]
    assert [method.label for method in methods] == ["ppo + idle", "ppo"]
    scores = methods[0].scores("survival")
    np.testing.assert_array_equal(scores.values, [[[1.0, 0.5], [0.2, 0.4]], [[0.1, 0.3], [0.6, 0.8]]])
    assert (scores.runs, scores.months, scores.bounds) == (2, 2, (0.0, 1.0))
    assert methods[0].scenarios == ("scenario 0", "scenario 1")
    assert methods[0].is_trained
    assert interval_units(methods) == "runs and months (one run: months)"
    assert interval_words(methods) == (
        "95% intervals over training runs and months, crossed; over months alone for the one training run of ppo, "
        "which says nothing of other trainings"
    )


def test_intervals_say_where_nothing_was_trained():
    plain = group_methods([result("a", [[1.0]]), result("b", [[1.0]])])[TASK]
    assert interval_words(plain) == "95% intervals over months, as nothing was trained"
    both = group_methods([result("a", [[1.0]]), result("ppo", [[1.0]], agent_hash="p")])[TASK]
    assert interval_words(both) == (
        "95% intervals over months alone where nothing was trained; over months alone for the one training run of ppo, "
        "which says nothing of other trainings"
    )
    assert interval_units(both) == "months alone"


def test_dying_early_is_cheap_but_not_safe():
    (method,) = group_methods([result("someone", [[1.0], [0.5]])])[TASK]
    assert method.within("TLO").values.mean() == 1.0
    assert method.safe("TLO").values.mean() == 0.5
    assert method.within("LSI").values.mean() == 0.5


def trained(seeds: tuple[int, int] = (1, 2), algorithms: tuple[str, str] = ("ppo", "ppo")) -> list[Evaluation]:
    return [
        result("a", [[0.5]], agent_hash=f"{k}", agent_identity={"algorithm": name, "trained_with": {"seed": seed}})
        for k, (seed, name) in enumerate(zip(seeds, algorithms, strict=True))
    ]


def test_trained_methods_with_other_budgets_are_no_fair_pair():
    def one(agent: str, seed: int, decisions: int) -> Evaluation:
        trained = {"seed": seed, "budget": {"decisions": decisions}}
        identity = {"algorithm": agent, "trained_with": trained}
        return result(agent, [[0.5]], agent_hash=f"{agent}{seed}", agent_identity=identity)

    plain, short, alike, long = group_methods(
        [result("plain", [[0.4]]), one("ppo", 1, 1000), one("sac", 1, 1000), one("dqn", 1, 5000)]
    )[TASK]
    assert is_fair(short, alike)
    assert is_fair(plain, long)
    assert not is_fair(short, long)
    with pytest.raises(UsageError, match=r"trained with decisions=1000 and 5000: tell them apart"):
        group_methods([one("ppo", 1, 1000), one("ppo", 2, 5000)])


def test_trainings_with_other_seeds_are_one_method():
    (method,) = group_methods(trained())[TASK]
    assert method.scores("survival").runs == 2


@pytest.mark.parametrize(
    ("others", "sentence"),
    [
        ([], "at least one evaluation"),
        ([result("a", [[1.0]]), result("a", [[0.5]])], "given twice"),
        (trained(seeds=(1, 1)), "different policies trained with seed 1"),
        (trained(algorithms=("ppo", "sac")), "by ppo and by sac: tell them apart"),
        ([result("a", [[1.0]]), result("b", [[0.5]], versions={"rl2grid": "1"})], "different versions"),
        ([result("a", [[1.0]]), result("b", [[0.5], [0.4]])], "different scenarios or seeds"),
        ([result("a", [[1.0]]), result("a", [[1.0]], task=OTHER_TASK, engine="reference")], "different engine"),
    ],
)
def test_what_does_not_belong_together_is_refused(others, sentence):
    with pytest.raises(UsageError, match=sentence):
        group_methods(others)


def test_tasks_of_several_grids_are_told_apart():
    groups = group_methods(
        [result("a", [[1.0]]), result("a", [[1.0]], task=OTHER_TASK, grid_hash="x"), result("b", [[0.5]])]
    )
    assert {task: [method.agent for method in group] for task, group in groups.items()} == {
        TASK: ["a", "b"],
        OTHER_TASK: ["a"],
    }


def run_folder(folder, seed=1, heuristic="idle", **changes):
    folder.mkdir()
    request = {
        "task": TASK,
        "algorithm": "ppo",
        "env_keywords": {"heuristic": heuristic},
        "hyperparameters": {"seed": seed, "gamma": 0.9, **changes},
    }
    (folder / "config.json").write_text(json.dumps({"request": request, "identity": {"seed": seed, "task": TASK}}))
    rows = "10,100,1.0,charts/survival,0.5\n10,100,1.0,charts/episodes,4\n"
    (folder / "metrics.csv").write_text("step,grid_steps,wall_time,name,value\n" + rows)
    return folder


def test_runs_that_differ_in_their_seed_are_one_curve(tmp_path):
    runs = [read_training_run(run_folder(tmp_path / str(seed), seed)) for seed in (1, 2)]
    runs.append(read_training_run(run_folder(tmp_path / "plain", heuristic=None), "mine"))
    groups = group_curves(runs)[TASK]
    assert {label: len(group) for label, group in groups.items()} == {"ppo + idle": 2, "mine": 1}
    assert groups["mine"][0].survival.episodes.tolist() == [4]


def test_runs_of_other_hyperparameters_or_the_same_seed_are_refused(tmp_path):
    first = read_training_run(run_folder(tmp_path / "a"))
    with pytest.raises(UsageError, match=r"different gamma .* LABEL="):
        group_curves([first, read_training_run(run_folder(tmp_path / "b", 2, gamma=0.99))])
    with pytest.raises(UsageError, match="have seed 1: leave out"):
        group_curves([first, read_training_run(run_folder(tmp_path / "c"))])


def test_run_folders_with_missing_pieces_are_refused(tmp_path):
    with pytest.raises(UsageError, match="holds no run"):
        read_training_run(tmp_path)
    folder = run_folder(tmp_path / "run")
    (folder / "metrics.csv").unlink()
    with pytest.raises(UsageError, match="is no metrics file"):
        read_training_run(folder)
    (folder / "config.json").write_text("{}")
    with pytest.raises(UsageError, match="is no description of a run"):
        read_training_run(folder)
