"""The ranking rule on hand-made cases, and a small ranking run from end to end."""

import json

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.experiments import ranking
from rl2grid.experiments.ranking import rank_actions, run_ranking

INF = np.inf


def order(loadings, base, n_covered, pool=None, legal=None, n_ranked=100):
    loadings = np.array(loadings, np.float32)
    pool = np.arange(loadings.shape[1]) if pool is None else np.array(pool)
    legal = np.ones(loadings.shape, bool) if legal is None else np.array(legal)
    return rank_actions(loadings, legal, np.array(base, float), pool, n_covered, n_ranked).tolist()


def test_without_coverage_actions_follow_by_mean_relief():
    assert order([[1.0, 0.9, 0.7, 1.2], [1.0, 0.9, 0.8, 1.0]], [1.0, 1.0], 0) == [2, 1, 3]


def test_a_collapse_is_worse_than_any_overload():
    assert order([[1.0, INF, 1.9]], [1.0], 0) == [2, 1]
    assert order([[1.0, INF, 0.9], [1.0, 0.6, 0.95]], [1.0, 1.0], 0) == [2, 1]


def test_the_second_choice_helps_where_the_first_does_not():
    # Actions 1 and 2 are best in the first two snapshots, action 3 in the last one only.
    loadings = [[1.0, 0.70, 0.71, 1.0], [1.0, 0.70, 0.71, 1.0], [1.0, 1.0, 1.0, 0.70]]
    assert order(loadings, [1.0] * 3, 0) == [1, 2, 3]
    assert order(loadings, [1.0] * 3, 2) == [1, 3, 2]


def test_coverage_does_not_buy_a_dangerous_action():
    helpful, dangerous = [1.0, 0.9, 1.0], [1.0, 1.0, 0.5]
    collapses = [[1.0, 1.0, INF]] * 10
    assert order([helpful, dangerous, *collapses], [1.0] * 12, 2)[0] == 1


def test_calm_snapshots_need_no_coverage():
    loadings = [[0.5, 0.3, 0.5], [1.0, 1.0, 0.9]]
    assert order(loadings, [0.5, 1.0], 1)[0] == 2


def test_an_illegal_action_does_nothing():
    loadings = [[1.0, 0.5, 0.9]]
    assert order(loadings, [1.0], 0, legal=[[True, False, True]]) == [2, 1]
    assert order(loadings, [1.0], 1, legal=[[True, False, True]]) == [2, 1]


def test_only_the_pool_is_chosen_for_coverage():
    loadings = [[1.0, 0.5, 0.9, 0.8]]
    assert order(loadings, [1.0], 1, pool=[0, 2, 3]) == [3, 1, 2]


def test_every_action_but_do_nothing_is_ranked_once():
    rng = np.random.default_rng(0)
    loadings = rng.uniform(0.5, 1.5, (20, 60))
    loadings[rng.random(loadings.shape) < 0.1] = INF
    assert sorted(order(loadings, rng.uniform(0.8, 1.2, 20), 10)) == list(range(1, 60))
    assert len(order(loadings, rng.uniform(0.8, 1.2, 20), 10, n_ranked=30)) == 30


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ranking")
    return run_ranking("bus14", states=8, seed=3, output=folder, work=folder / "work")


def test_a_run_writes_a_ranking(finished):
    with np.load(finished) as arrays:
        ids, metadata = arrays["ids"], json.loads(str(arrays["metadata"]))
    assert ids.dtype == np.int32
    assert sorted(ids.tolist()) == list(range(1, 209))
    assert metadata["version"] == ranking.VERSION
    assert metadata["command"] == "rl2grid rank bus14 --provisional --states 8 --seed 3 --pool 2000"
    assert sum(metadata["states"].values()) == 8
    assert metadata["states"]["stressed"] >= 4


def test_an_interrupted_run_continues_and_repeats_the_result(finished, tmp_path, monkeypatch):
    options = {"states": 8, "seed": 3, "output": tmp_path, "work": tmp_path / "work"}
    check = ranking._Laboratory.check
    calls, stop_at = [], 5

    def interrupted(self, snapshot, ids):
        if len(ids) > 100:  # not the policy's
            calls.append(len(ids))
        if len(calls) == stop_at:
            raise KeyboardInterrupt
        return check(self, snapshot, ids)

    monkeypatch.setattr(ranking._Laboratory, "check", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_ranking("bus14", **options)
    assert not list(tmp_path.glob("*.npz"))
    calls, stop_at = [], None
    monkeypatch.setattr(ranking, "_play", None)  # every episode was saved
    assert run_ranking("bus14", **options).read_bytes() == finished.read_bytes()
    assert len(calls) == 8 - 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"grid_id": "bus15"}, "choose one of bus14"),
        ({"grid_id": "bus14", "states": 0}, "states=0 is not allowed"),
        ({"grid_id": "bus14", "pool": -1}, "pool=-1 is not allowed"),
        ({"grid_id": "bus14", "seed": -1}, "seed=-1 is not allowed"),
    ],
)
def test_bad_arguments_are_refused(arguments, message, tmp_path):
    with pytest.raises(UsageError, match=message):
        run_ranking(**arguments, output=tmp_path / "out", work=tmp_path / "work")
    assert not list(tmp_path.iterdir())
