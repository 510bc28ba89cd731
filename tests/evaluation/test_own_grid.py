"""A grid of one's own from registration to evaluation, ranking, listing and pages."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from own_grid import own_system, registered

from rl2grid.cli.main import main
from rl2grid.evaluation.protocol import evaluate
from rl2grid.evaluation.ranking import run_ranking
from rl2grid.grids.rankings import read_ranking
from rl2grid.mdp.actions import level_ids


@pytest.fixture
def mine():
    with registered(own_system()) as system:
        yield system


@pytest.mark.parametrize("agent", ["do-nothing", "greedy"])
def test_agents_are_evaluated_as_on_the_grid_that_it_is_a_copy_of(mine, agent):
    keywords = {"heuristic": "idle", "maintenance": False, "split": "bundled"}
    ours = evaluate(agent, "mine-T0", scenarios=["recorded/second"], **keywords)
    theirs = evaluate(agent, "bus14-T1", scenarios=["bundled/0000[287:576]"], **keywords)
    (one,), (other,) = ours.episodes, theirs.episodes
    assert one.scenario == "recorded/second"
    assert one.grid_steps == 288
    for name in ("survival", "episode_return", "grid_steps", "decisions", "cost_tlo"):
        assert getattr(one, name) == getattr(other, name), name
    assert ours.identity["grid_hash"] == mine.hash
    assert ours.identity["generator_version"] is None


def test_workers_know_it_and_change_nothing(mine):
    keywords = {"scenarios": ["recorded/second[0:60]"], "heuristic": "idle"}
    here, there = (evaluate("do-nothing", "mine-T0", workers=workers, **keywords) for workers in (0, 1))
    for one, other in zip(here.episodes, there.episodes, strict=True):
        assert replace(one, wall_time_s=0.0) == replace(other, wall_time_s=0.0)


def test_it_is_ranked_and_then_has_levels(tmp_path):
    with registered(own_system()) as mine:
        file = run_ranking("mine", states=4, output=tmp_path, work=tmp_path / "work", num_threads=1)
    assert file == tmp_path / "mine.ranking.npz"
    ranking = read_ranking("mine", file)
    assert ranking.metadata["grid_hash"] == mine.hash
    assert sorted(ranking.ids) == list(range(1, 209))
    assert ranking.trials is not None
    assert ranking.trials.trials.shape == (209,)
    np.testing.assert_array_equal(level_ids(mine.grid, 0), np.arange(209))
    with registered(mine.ranked(ranking, 30)) as levelled:
        np.testing.assert_array_equal(level_ids(levelled.grid, 0), [0, *ranking.ids[:29]])


def test_its_actions_are_listed_without_a_ranking(mine, capsys):
    assert main(["actions", "mine", "--format", "csv"]) == 0
    rows = list(csv.DictReader(capsys.readouterr().out.splitlines()))
    assert len(rows) == 209
    assert {row["trials"] for row in rows} == {"0"}
    assert {row["rank"] for row in rows} == {""}
    assert main(["actions", "mine", "--explain", "17"]) == 0
    assert "not ranked" in capsys.readouterr().out
    assert main(["actions", "mine", "--figures", "figures"]) == 2
    assert "The ranking of mine is missing: make it with `rl2grid rank mine`" in capsys.readouterr().err


def test_commands_about_its_series(mine, capsys, tmp_path):
    assert main(["tasks", "--grid", "mine"]) == 0
    assert "rl2grid/mine-T0-TLO-v0" in capsys.readouterr().out
    assert main(["data", "list", "mine"]) == 0
    assert "Scenarios on this machine" in capsys.readouterr().out
    for command in (["data", "make", "mine", "--seed", "3"], ["data", "check", "mine"]):
        assert main(command) == 2
        assert "No months of mine can be generated" in capsys.readouterr().err
    assert main(["data", "export", "mine", "recorded/first[0:5]", str(tmp_path / "five")]) == 0
    assert main(["data", "import", "mine", str(tmp_path / "five")]) == 0
    assert "Imported folder/five: 5 rows" in capsys.readouterr().out


def test_a_stored_evaluation_becomes_a_page(mine, tmp_path):
    evaluate("do-nothing", "mine-T0", scenarios=["recorded/second[0:60]"], output=tmp_path / "evaluation")
    assert main(["report", str(tmp_path / "evaluation"), "--output", str(tmp_path / "page")]) == 0
    assert "mine-T0" in next((tmp_path / "page").glob("*.html")).read_text()
