"""``rl2grid leaderboard``: writing, verifying and ranking entries."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from rl2grid.cli.main import main
from rl2grid.evaluation.protocol import evaluate
from rl2grid.records.entries import episode_hash
from rl2grid.records.episodes import FACTS, OPERATION

MONTH = "generated/710000-00"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two evaluations of a month, one of their entries with a forged survival."""
    folder = tmp_path_factory.mktemp("entries")
    for agent in ("do-nothing", "random"):
        evaluate(agent, "bus14-T0", scenarios=[MONTH], heuristic="idle", output=folder / agent)
        assert main(["leaderboard", "entry", str(folder / agent), "--output", str(folder / f"{agent}.json")]) == 0
    contents = json.loads((folder / "random.json").read_text())
    (episode,) = contents["episodes"]
    episode["survival"] = 0.999
    episode["hash"] = episode_hash({column.name: episode[column.name] for column in (*FACTS, *OPERATION)})
    del contents["checksum"]
    (folder / "forged.json").write_text(json.dumps(contents))
    return folder


def test_an_entry_says_how_large_it_is(folder, capsys):
    words = ["leaderboard", "entry", str(folder / "random"), "--output", str(folder / "dice.json"), "--label", "dice"]
    assert main(words) == 0
    output = capsys.readouterr().out
    assert "1 of 1 episodes played as in the evaluation" in output
    assert f"Written: {folder / 'dice.json'} (" in output
    assert not list(folder.glob("*.tmp"))


def test_honest_entries_are_verified(folder, capsys):
    assert main(["leaderboard", "verify", str(folder / "random.json"), str(folder / "do-nothing.json")]) == 0
    output = capsys.readouterr().out
    assert f"{folder / 'random.json'} is verified: survival 0." in output
    assert output.count("exactly as stored") == 2


def test_a_forged_entry_is_named_and_the_others_go_on(folder, capsys):
    assert main(["leaderboard", "verify", str(folder / "forged.json"), str(folder / "random.json")]) == 1
    captured = capsys.readouterr()
    (sentence,) = captured.err.strip().splitlines()
    assert f"{folder / 'forged.json'} is not verified: Episode {MONTH}, seed 0 differs" in sentence
    assert "survival is stored as 0.999" in sentence
    assert f"{folder / 'random.json'} is verified" in captured.out


def test_entries_are_ranked_by_survival(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    files = [f"{name}.json" for name in ("do-nothing", "forged", "random")]
    assert main(["leaderboard", "table", *files]) == 0
    output = capsys.readouterr().out
    assert "bus14-T0-v0" in output
    survivals = [float(re.findall(r" (\d\.\d{3}) ", line)[0]) for line in output.splitlines() if ".json" in line]
    assert len(survivals) == 3
    assert survivals == sorted(survivals, reverse=True)
    assert survivals[0] == 0.999
    assert main(["leaderboard", "table", *files, "--json"]) == 0
    ((task, rows),) = json.loads(capsys.readouterr().out)["entries"].items()
    assert task == "rl2grid/bus14-T0-v0"
    assert [round(row["Survival"]["value"], 3) for row in rows] == survivals


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["entry", "{}", "--output", "{}/x.json"], "holds no evaluation on validation"),
        (["entry", "{}/random", "--output", "{}/nowhere/x.json"], "of the output does not exist"),
        (["entry", "{}/random"], "--output"),
        (["verify", "{}/missing.json"], "cannot be read as an entry"),
        (["verify", "{}/random.json", "{}/random/evaluation.json"], "is no entry of a leaderboard"),
        (["table", "{}/random.json", "{}/random.json"], "was given twice"),
        (["table", "{}/random.json", "{}/two.json"], "different scenarios or seeds"),
        (["table", "{}/random.json", "--to", "greedy"], "--to is for the rows of a --ledger"),
        (["table", "{}/random.json", "--task", "bus14-T0"], "--task is for the rows of a --ledger"),
        (["table", "{}/random.json", "--best"], "--best is for the rows of a --ledger"),
        (["table", "--ledger", "{}/random.json", "--best", "--to", "greedy"], "leave out --task and --to"),
        (["table", "{}/random.json", "--learned"], "--learned is for the rows of a --ledger"),
        (["table", "--ledger", "{}/random.json", "--learned", "--task", "bus14-T0"], "leave out --task and --to"),
        (["table", "--ledger", "{}/random.json", "--learned", "--best"], "--best and --learned are different tables"),
        (["table", "{}/random.json", "--untrained"], "--untrained is for the rows of a --ledger"),
        (["table", "--ledger", "{}/random.json", "--untrained", "--to", "greedy"], "leave out --task and --to"),
        (["table", "{}/random.json", "--heuristics"], "--heuristics is for the rows of a --ledger"),
        (["table", "{}/random.json", "--ledger", "{}/ledger.json"], "do not belong into one table"),
        (["table", "--ledger", "{}/ledger.json", "--l2rpn"], "a ledger does not keep what its episodes cost"),
        (["table", "--ledger", "{}/ledger.json"], "There is no ledger"),
    ],
)
def test_refusals_are_one_sentence(folder, tmp_path, capsys, words, part):
    if "{}/two.json" in words:
        evaluate("random", "bus14-T0", scenarios=[MONTH], seeds=[0, 1], heuristic="idle", output=tmp_path / "two")
        main(["leaderboard", "entry", str(tmp_path / "two"), "--output", str(folder / "two.json")])
    capsys.readouterr()
    assert main(["leaderboard", *(word.format(folder) for word in words)]) == 2
    captured = capsys.readouterr()
    (sentence,) = captured.err.strip().splitlines()
    assert part in sentence
    assert "verified" not in captured.out


@pytest.mark.parametrize(
    ("contents", "why"),
    [
        (b"# A page\n", "line 1 is no JSON; "),
        (b"", "it is empty; "),
        (b"{", "line 1 is no JSON; "),
        (b"\xff\xfe", "byte 0 is no UTF-8; "),
        (b"{}", ""),
        (b"[]", ""),
        (100_000 * b"[", "it is nested too deeply; "),
    ],
)
def test_a_file_that_is_something_else_is_refused_in_one_sentence(tmp_path, capsys, contents, why):
    page = tmp_path / "README.md"
    page.write_bytes(contents)
    for words in (["verify", str(page)], ["table", str(page)]):
        assert main(["leaderboard", *words]) == 2
        assert capsys.readouterr().err == (
            f"rl2grid: {page} is no entry of a leaderboard: {why}give files that 'rl2grid leaderboard entry' wrote, or "
            "a ledger of test results as --ledger.\n"
        )
    if contents == b"{}":  # an empty ledger
        return
    for words in (["table"], ["verify", "greedy@bus14-T0"], ["test", "greedy@bus14-T0"]):
        assert main(["leaderboard", *words, "--ledger", str(page)]) == 2
        assert capsys.readouterr().err == (
            f"rl2grid: {page} is no ledger of test results: {why or 'what it holds is []; '}give a file that 'rl2grid "
            "leaderboard test' wrote, or one that does not exist yet.\n"
        )
    assert page.read_bytes() == contents


def test_a_file_is_no_run_whose_test_could_be_verified(tmp_path, capsys):
    page = tmp_path / "README.md"
    page.write_text("# A page")
    assert main(["leaderboard", "verify", str(page), "--ledger", str(tmp_path / "ledger.json")]) == 2
    assert capsys.readouterr().err == (
        f"rl2grid: '{page}' holds no run: there is no config.json in it; give a folder that 'rl2grid train' wrote.\n"
    )
