"""What the table of episodes embeds."""

from __future__ import annotations

import json

import pytest
from sample_results import episode, result

from rl2grid.analysis.explorer import explorer_data, explorer_html
from rl2grid.mdp.termination import GAME_OVER_TEXT, GameOver
from rl2grid.records.evaluations import Evaluation


def column(data, name):
    """Its values, and whether they are numbers."""
    (found,) = [one for one in data["columns"] if one["name"] == name]
    if "numbers" in found:
        return found["numbers"]
    return [found["words"][place] for place in found["places"]]


RESULTS = [result("ppo", [[1.0, 1 / 3]], "idle"), result("do-nothing", [[0.25, 0.5]])]


def test_every_episode_is_a_row_of_every_column():
    data = explorer_data(RESULTS, ["e1", "e2"])
    assert data["rows"] == 4
    assert {len(one.get("numbers", one.get("places"))) for one in data["columns"]} == {4}
    assert column(data, "method") == ["ppo + idle", "ppo + idle", "do-nothing", "do-nothing"]
    assert column(data, "survival") == [1, 0.333333, 0.25, 0.5]
    assert column(data, "seed") == [0, 1, 0, 1]
    assert column(data, "ended") == ["completed", *[GAME_OVER_TEXT[GameOver.DIVERGENCE]] * 3]
    assert column(data, "overloads") == ["", "3 17", "3 17", "3 17"]
    assert column(data, "made") == ["e1", "e1", "e2", "e2"]


def test_columns_with_one_value_alone_are_left_out_where_they_often_are():
    names = [one["name"] for one in explorer_data(RESULTS, ["e1", "e2"])["columns"]]
    assert "split" not in names
    other = Evaluation((episode(split="test"),), {"task": "a task"}, "a command")
    assert "split" in [one["name"] for one in explorer_data([*RESULTS, other], ["e1", "e2", "e3"])["columns"]]


def test_the_seed_of_the_training_is_shown_where_there_are_several():
    trained = [result("ppo", [[0.5]], agent_identity={"trained_with": {"seed": seed}}) for seed in (1, 2)]
    assert column(explorer_data([*trained, RESULTS[1]], ["e1", "e2", "e3"]), "training") == ["1", "2", "", ""]
    names = [one["name"] for one in explorer_data([trained[0]], ["e1"])["columns"]]
    assert "training" not in names


def test_rows_are_a_few_bytes_each():
    many = [result("ppo", [[k / 7919] * 10 for k in range(300)])]
    assert len(json.dumps(explorer_data(many, ["e1"]), separators=(",", ":"))) < 100 * 3000


@pytest.mark.parametrize("words", ["</script><b>", "{script}", "{data}"])
def test_names_cannot_end_the_script(words):
    page = explorer_html([result(words, [[0.5]])], ["e1"])
    assert page.count("</script>") == 2
    begin = page.index("id=rows>") + len("id=rows>")
    data = json.loads(page[begin : page.index("</script>", begin)])
    assert column(data, "method") == [words]
