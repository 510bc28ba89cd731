"""``rl2grid actions``: what it prints and writes, and how it refuses."""

import csv
import io

import pytest
from made_up_ranking import made_up_arrays, use_ranking

from rl2grid.cli.main import main
from rl2grid.grids import load_grid
from rl2grid.mdp.actions import describe, full_catalogue

BUS14 = load_grid("bus14")


@pytest.fixture(autouse=True)
def arrays(tmp_path, monkeypatch):
    made_up = made_up_arrays("bus14")
    use_ranking(monkeypatch, tmp_path, "bus14", made_up)
    monkeypatch.chdir(tmp_path)
    return made_up


def printed(capsys, *command_line):
    assert main(["actions", *command_line]) == 0
    return capsys.readouterr().out


def refused(capsys, *command_line):
    """The one sentence with which a command line is refused."""
    assert main(["actions", *command_line]) == 2
    (sentence,) = capsys.readouterr().err.strip().splitlines()
    assert sentence.startswith("rl2grid: ")
    assert sentence.endswith(".")
    return sentence


def test_the_actions_of_a_level_are_listed(capsys, arrays):
    output = printed(capsys, "bus14")
    assert "Level 0 of bus14: 50 actions" in output
    assert "do nothing" in output
    for rank, k in enumerate(arrays["ids"][:49].tolist(), start=1):
        row = next(line for line in output.splitlines() if line.split()[:3] == [str(rank), str(k), str(rank)])
        assert row.rstrip().endswith(describe(BUS14, full_catalogue(BUS14)[k]))
        assert f"{100 * arrays['survived'][k] / arrays['trials'][k]:.1f}%" in row
        assert f"{arrays['margin'][k]:+.3f}" in row


def test_long_lists_are_cut_unless_all_is_asked_for(capsys):
    short, long = printed(capsys, "bus14", "--level", "1"), printed(capsys, "bus14", "--level", "1", "--all")
    assert "50 of 209 are shown; --all shows every one." in short
    assert "switch line 19" not in short
    assert "switch line 19" in long
    assert "are shown" not in long


def test_lists_are_filtered(capsys):
    output = printed(capsys, "bus14", "--level", "1", "--substation", "12", "--line", "13", "--all")
    rows = [line for line in output.splitlines() if "substation 12: " in line]
    assert f"{len(rows)} of 209 actions" in output
    assert len(rows) == 4
    assert "switch" not in output


def test_csv_holds_every_action(capsys, arrays):
    rows = list(csv.DictReader(io.StringIO(printed(capsys, "bus14", "--level", "1", "--format", "csv"))))
    assert [int(row["catalogue"]) for row in rows] == list(range(209))
    assert [int(row["trials"]) for row in rows] == arrays["trials"].tolist()
    assert rows[190]["words"] == "switch line 1 (0_4_1)"


def test_an_action_is_explained_and_drawn(capsys, tmp_path):
    output = printed(capsys, "bus14", "--level", "1", "--explain", "93", "--draw", "drawings/here.svg")
    assert "Action 93 of level 1 of bus14: substation 5: move generators 2 and 3 to the other busbar" in output
    lines = [" ".join(line.split()) for line in output.splitlines()]
    assert "generator 2 busbar 1 busbar 2" in lines
    assert "load 4 busbar 1 busbar 1" in lines
    assert "Cut off: generator 2, generator 3. This ends the episode." in lines
    assert (tmp_path / "drawings" / "here.svg").read_text().lstrip().startswith("<?xml")


def test_figures_are_written(capsys, tmp_path):
    output = printed(capsys, "bus14", "--figures", "here")
    names = {f"bus14-{name}.{suffix}" for name in ("shares", "trials", "ranking") for suffix in ("png", "pdf")}
    assert {path.name for path in (tmp_path / "here").iterdir()} == names
    assert all(name in output for name in names)


@pytest.mark.parametrize(
    ("command_line", "words"),
    [
        (["bus15"], "Grid 'bus15' does not exist: choose one of bus14"),
        (["bus14", "--level", "2"], "Level 2 of bus14 does not exist"),
        (["bus14", "--substation", "14"], "Substation 14 of bus14 does not exist: choose from 0 to 13"),
        (["bus14", "--line", "20"], "Line 20 of bus14 does not exist: choose from 0 to 19"),
        (["bus14", "--explain", "50"], "Action 50 of level 0 of bus14 does not exist: choose from 0 to 49"),
        (["bus14", "--explain", "-1"], "Action -1 of level 0 of bus14 does not exist"),
        (["bus14", "--draw", "a.png"], "--draw needs an action"),
        (["bus14", "--explain", "1", "--draw", "a.gif"], "end its name with .png, .pdf or .svg"),
        (["bus14", "--explain", "0", "--draw", "a.png"], "there is nothing to draw"),
        (["bus14", "--figures", "taken"], "Folder taken cannot be made"),
        (["bus14", "--format", "xml"], "invalid choice: 'xml'"),
    ],
)
def test_bad_requests_are_refused_with_one_sentence(capsys, tmp_path, command_line, words):
    (tmp_path / "taken").write_text("")
    assert words in refused(capsys, *command_line)
    assert not list(tmp_path.glob("a.*"))
