"""The ranking rule on hand-made cases, and a small ranking run from end to end."""

import json

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.evaluation import ranking
from rl2grid.evaluation.ranking import Shape, Trials, rank, run_ranking, score
from rl2grid.grids import load_grid
from rl2grid.mdp.actions import ActionKind, full_catalogue
from rl2grid.streams import Purpose, Stream

INF, NAN = np.inf, np.nan


def trials(loadings, base) -> Trials:
    return Trials(np.array(loadings, np.float32), np.array(base, float))


def order(loadings, base, n_covered=0, n_first=0, reserved=()):
    tried = trials(loadings, base)
    return rank(tried, score(tried), Shape(n_covered, n_first, np.array(reserved, np.int32))).tolist()


def test_scores_count_what_was_tried():
    scores = score(trials([[1.0, INF, 0.7, NAN], [0.8, 0.9, NAN, NAN]], [1.0, 0.8]))
    assert scores.trials.tolist() == [2, 2, 1, 0]
    assert scores.survived.tolist() == [2, 1, 1, 0]
    np.testing.assert_allclose(scores.margin, [0.1, 0.1, 0.3, 0.0], atol=1e-6)
    np.testing.assert_allclose(scores.relief, [0.0, (-1 - 0.1) / 2, 0.15, 0.0], atol=1e-6)


def test_margins_are_clipped():
    scores = score(trials([[1.0, 7.0]], [1.0]))
    assert scores.margin[1] == -1.0
    assert scores.relief[1] == -1.0


def test_equals_follow_by_mean_relief():
    assert order([[1.0, 0.9, 0.7, 1.2], [1.0, 0.9, 0.8, 1.0]], [1.0, 1.0]) == [2, 1, 3]


def test_survival_comes_before_margin():
    assert order([[1.0, INF, 1.9]], [1.0]) == [2, 1]
    assert order([[1.0, INF, 0.99], [1.0, 0.1, 0.99]], [1.0, 1.0]) == [2, 1]


def test_survival_rates_count_to_the_percent():
    """One collapse in 300 is noise, two in 100 are not."""
    helpful, idle = [0.5] * 299, [1.0] * 300
    assert order(np.stack([idle, [*helpful, INF], idle]).T, np.ones(300)) == [1, 2]
    assert order(np.stack([idle[:100], [*helpful[:98], INF, INF], idle[:100]]).T, np.ones(100)) == [2, 1]


def test_an_action_that_was_never_tried_comes_last():
    assert order([[1.0, NAN, INF, 1.5]], [1.0]) == [3, 2, 1]


def test_the_second_choice_helps_where_the_first_does_not():
    # Actions 1 and 2 are best in the first two operating points, action 3 in the last one only.
    loadings = [[1.0, 0.70, 0.71, 1.0], [1.0, 0.70, 0.71, 1.0], [1.0, 1.0, 1.0, 0.70]]
    assert order(loadings, [1.0] * 3, 0) == [1, 2, 3]
    assert order(loadings, [1.0] * 3, 2) == [1, 3, 2]


def test_coverage_does_not_buy_a_dangerous_action():
    helpful, dangerous = [1.0, 0.9, 1.0], [1.0, 1.0, 0.5]
    collapses = [[1.0, 1.0, INF]] * 10
    assert order([helpful, dangerous, *collapses], [1.0] * 12, 2)[0] == 1


def test_coverage_goes_on_with_the_next_survival_rate():
    assert order([[1.0, INF, 0.9], [1.0, 0.5, 0.9]], [1.0, 1.0], 2) == [2, 1]


def test_calm_points_need_no_coverage():
    loadings = [[0.5, 0.3, 0.5], [1.0, 1.0, 0.9]]
    assert order(loadings, [0.5, 1.0], 1)[0] == 2


def test_level_0_holds_what_is_reserved_whatever_its_trials_say():
    loadings = [[1.0, 0.9, 0.8, INF, INF], [1.0, 0.9, 0.8, 0.7, INF]]
    assert order(loadings, [1.0, 1.0]) == [2, 1, 3, 4]
    assert order(loadings, [1.0, 1.0], n_first=3, reserved=[4]) == [2, 1, 4, 3]
    assert order(loadings, [1.0, 1.0], n_first=3, reserved=[3, 4]) == [2, 3, 4, 1]
    assert order(loadings, [1.0, 1.0], n_first=2, reserved=[4, 3]) == [3, 4, 2, 1], "the more helpful one first"


def test_what_is_reserved_covers_operating_points_before_others_are_chosen():
    # Action 3 helps where 1 does, action 2 elsewhere, less.
    loadings = [[1.0, 0.6, 1.0, 0.6], [1.0, 1.0, 0.9, 1.0]]
    assert order(loadings, [1.0, 1.0], 2) == [1, 2, 3]
    assert order(loadings, [1.0, 1.0], 2, n_first=2, reserved=[3]) == [2, 3, 1]


def test_each_step_has_the_same_chance_to_be_kept():
    counts = np.zeros(12)
    for episode in range(600):
        kept, choices = [], Stream(0, episode, Purpose.START)
        for step in range(12):
            ranking._draw_one(kept, lambda step=step: step, step + 1, 3, choices)
        assert len(kept) == 3
        counts[kept] += 1
    # Five standard deviations of a count of 600 with a chance of a quarter.
    assert np.abs(counts - 150).max() < 5 * np.sqrt(600 * 0.25 * 0.75)


@pytest.mark.parametrize(("grid_id", "n_known"), [("bus14", 5), ("bus36-MO-v0", 10), ("bus118-MOB-v1", 23)])
def test_lines_to_close_are_those_that_others_open(grid_id, n_known):
    grid = load_grid(grid_id)
    tripped = np.zeros(grid.n_line, np.int32)
    known, left_out = ranking._lines_to_close(grid, tripped)
    assert len(known) == n_known
    assert left_out == {}
    tripped[:] = np.arange(grid.n_line)
    tripped[known[0]] = 1000
    closed, left_out = ranking._lines_to_close(grid, tripped)
    assert len(closed) == min(24, grid.n_line)
    assert set(known) < set(closed)
    assert max(left_out.values(), default=0) < min(tripped[line] for line in closed if line not in known)
    switches = ranking._switches(full_catalogue(grid), closed)
    taken = full_catalogue(grid).take(switches)
    assert taken.target.tolist() == closed
    assert (taken.kind == ActionKind.SWITCH).all()


def test_an_action_that_is_not_allowed_does_nothing():
    assert order([[1.0, NAN, 0.9], [1.0, 0.99, 0.99]], [1.0, 1.0]) == [2, 1]


def test_every_action_but_do_nothing_is_ranked_once():
    rng = np.random.default_rng(0)
    loadings = rng.uniform(0.5, 1.5, (20, 60))
    loadings[rng.random(loadings.shape) < 0.1] = INF
    assert sorted(order(loadings, rng.uniform(0.8, 1.2, 20), 10)) == list(range(1, 60))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ranking")
    return run_ranking("bus14", states=8, seed=3, output=folder, work=folder / "work")


def test_a_run_writes_a_ranking(finished):
    with np.load(finished) as arrays:
        ids, counts, metadata = arrays["ids"], arrays["trials"], json.loads(str(arrays["metadata"]))
        assert (arrays["survived"] <= counts).all()
        assert (np.abs(arrays["margin"]) <= 1).all()
    assert ids.dtype == np.int32
    assert sorted(ids.tolist()) == list(range(1, 209))
    assert counts[0] == 8
    assert counts.max() <= 8
    assert metadata["version"] == ranking.VERSION
    assert metadata["command"] == "rl2grid rank bus14 --states 8 --seed 3 --sampling exhaustive"
    assert sum(metadata["states"].values()) == 8
    assert metadata["closable"].keys() == metadata["states"].keys()
    switches = ranking._switches(full_catalogue(load_grid("bus14")), metadata["closed_in_level_0"])
    assert set(load_grid("bus14").maintenance.lines) <= set(metadata["closed_in_level_0"])
    assert set(switches) <= set(ids[:49])
    assert metadata["trials"] == counts.sum()
    assert metadata["levels_shared_by_halves"].keys() == {"50"}


def test_a_run_that_was_interrupted_gives_the_same_with_any_number_of_threads(finished, monkeypatch, tmp_path):
    work = finished.parent / "work"
    (saved,) = work.iterdir()
    for file in [*sorted(saved.glob("trials_*"))[3:], *sorted(saved.glob("episode_*"))[1:]]:
        file.unlink()
    again = run_ranking("bus14", states=8, seed=3, output=tmp_path, work=work, num_threads=2)
    assert again.read_bytes() == finished.read_bytes()


def test_what_is_there_is_not_tried_again(finished, monkeypatch, tmp_path):
    monkeypatch.setattr(ranking._Laboratory, "loadings", None)
    run_ranking("bus14", states=8, seed=3, output=tmp_path, work=finished.parent / "work")


def test_a_ranking_of_another_kind_is_not_replaced(finished):
    before = finished.read_bytes()
    with pytest.raises(UsageError, match="made by 'rl2grid rank bus14 --states 8 --seed 3 --sampling exhaustive'"):
        run_ranking("bus14", states=8, seed=4, output=finished.parent, work=finished.parent / "work")
    assert finished.read_bytes() == before


def test_uniform_sampling_tries_a_tenth(tmp_path):
    with np.load(run_ranking("bus14", 12, 3, "uniform", tmp_path, tmp_path / "work")) as arrays:
        share = arrays["trials"].sum() / (12 * 209)
    # Five standard deviations of a share of a tenth of 2508.
    assert abs(share - 0.1) < 5 * np.sqrt(0.09 / 2508)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"grid_id": "bus15"}, "choose one of bus14"),
        ({"grid_id": "bus14", "states": 1}, "give at least 2"),
        ({"grid_id": "bus14", "seed": -1}, "give 0 or more"),
        ({"grid_id": "bus14", "sampling": "lucky"}, "choose one of exhaustive, uniform"),
    ],
)
def test_bad_requests_are_refused(arguments, message):
    with pytest.raises(UsageError, match=message):
        run_ranking(**arguments)
