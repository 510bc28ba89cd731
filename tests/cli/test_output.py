"""How commands speak: JSON for programs, results alone on demand, one line per row where nobody looks."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from rl2grid.analysis.table import Cell, Column, ResultTable, table_records
from rl2grid.cli import train as training
from rl2grid.cli.keywords import AGENT_HELP
from rl2grid.cli.main import COMMANDS, Parser, main, make_parser, subparsers
from rl2grid.cli.output import Output
from rl2grid.evaluation.agents import AGENTS
from rl2grid.records.statistics import Estimate

TABLE = ResultTable(
    "animals",
    "Of a farm.",
    (Column("name", words=True), Column("weight"), Column("opinion of the farm", words=True)),
    (
        (Cell("cow"), Cell("600 [500, 700]", Estimate(600.0, 500.0, 700.0)), Cell("so " * 60 + "so", best=True)),
        (Cell("hen"), Cell("2"), Cell("-")),
    ),
)


def leaves(parser: Parser) -> list[Parser]:
    parser.complete()
    below = subparsers(parser)
    return [leaf for each in below.values() for leaf in leaves(each)] if below else [parser]


def test_every_command_says_results_as_json_or_alone():
    ends = [leaf for leaf in leaves(make_parser()) if leaf.prog != "rl2grid train"]
    assert len(ends) > len(COMMANDS)
    for leaf in ends:
        known = {flag for action in leaf._actions for flag in action.option_strings}
        assert {"--json", "--quiet"} <= known, leaf.prog
    for flags in (training.TrainFlags, training.ResumeFlags):
        assert {"json", "quiet"} <= set(flags.__dataclass_fields__)


def test_a_pipe_gets_one_line_per_row(capsys):
    Output().table(TABLE, title="Animals")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "Animals"
    assert lines[1].split() == ["name", "weight", "opinion", "of", "the", "farm"]
    assert lines[2].startswith("cow   600 [500, 700]  so so")
    assert lines[2].endswith("so so")
    assert lines[3] == "hen                2  -"
    assert lines[4:] == ["Of a farm."]


def test_json_is_all_that_is_printed(capsys):
    output = Output(json=True)
    output.remark("A remark.")
    output.text("A sentence.")
    output.table(TABLE)
    output.results(path=Path("a") / "b", numbers=np.arange(2), none=math.nan, flag=np.bool_(True))
    output.close()
    captured = capsys.readouterr()
    shown = json.loads(captured.out)
    assert captured.err == ""
    assert shown["animals"][0]["weight"] == {"value": 600.0, "low": 500.0, "high": 700.0}
    assert shown["animals"][1]["weight"] == "2"
    assert shown == {"animals": table_records(TABLE), "path": "a/b", "numbers": [0, 1], "none": None, "flag": True}


def test_quiet_keeps_results_and_drops_remarks(capsys):
    output = Output(quiet=True)
    output.remark("A remark.")
    output.text("A sentence.")
    with output.progress() as bar:
        bar.add_task("Working", total=3)
    output.close()
    captured = capsys.readouterr()
    assert captured.out == "A sentence.\n"
    assert captured.err == ""


def test_tasks_as_json(capsys):
    assert main(["tasks", "--json"]) == 0
    tasks = {task["id"]: task for task in json.loads(capsys.readouterr().out)["tasks"]}
    assert len(tasks) == 199
    assert tasks["rl2grid/bus118-MOB-v1-T4-TLO-v0"]["actions"] == 73357
    assert tasks["rl2grid/bus14-R-v0"] == {
        "id": "rl2grid/bus14-R-v0",
        "grid": "bus14",
        "kind": "R",
        "level": None,
        "substations": 14,
        "lines": 20,
        "generators": 6,
        "loads": 11,
        "storages": 0,
        "observation": 157,
        "actions": 6,
        "topology_actions": 0,
        "continuous_actions": 6,
        "opponent": None,
        "constraint": None,
    }


def test_actions_of_a_pipe_are_lines_and_have_all_digits_as_json(capsys):
    assert main(["actions", "bus14", "--quiet"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 + 50
    assert main(["actions", "bus14", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["actions"]
    assert len(rows) == 50
    assert rows[0]["action"] == 0
    assert 0.0 <= rows[9]["survival_low"] < rows[9]["survival"] <= rows[9]["survival_high"] <= 1.0


def test_an_evaluation_as_json_and_quiet(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["evaluate", "do-nothing", "bus14-T0", "--months", "1"]
    assert main([*words, "--json"]) == 0
    captured = capsys.readouterr()
    (summary,) = json.loads(captured.out)["summaries"]
    assert captured.err == ""
    assert (summary["agent"], summary["episodes"], summary["foresight"]) == ("do-nothing", 1, False)
    assert 0.0 < summary["survival"]["value"] <= 1.0
    assert (Path(summary["folder"]) / "episodes.csv").is_file()
    assert main([*words, "--quiet"]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    title, head, row = captured.out.splitlines()
    assert title == "rl2grid/bus14-T0-v0, validation scenarios"
    assert head.split() == [
        "agent",
        "survival",
        "done",
        "return",
        "LSI",
        "cost",
        "safe",
        "LSI",
        "TLO",
        "cost",
        "safe",
        "TLO",
    ]
    assert row.startswith("do-nothing  0.")


def test_a_training_as_json(capsys, monkeypatch):
    monkeypatch.setattr("rl2grid.training.runs.train", lambda args, **_: Path("run"))
    monkeypatch.setattr("rl2grid.training.runs.is_finished", lambda folder: True)
    assert main(["train", "ppo", "bus14-T0", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"run": "run", "finished": True}


def test_the_studies_and_the_data_as_json(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path))
    assert main(["study", "list", "--json"]) == 0
    studies = json.loads(capsys.readouterr().out)["studies"]
    assert {"study": "paper", "scale": "quick"}.items() <= next(
        each for each in studies if (each["study"], each["scale"]) == ("paper", "quick")
    ).items()
    assert main(["data", "list", "bus14", "--json"]) == 0
    stored = json.loads(capsys.readouterr().out)
    assert {row["grid"] for row in stored["scenarios"]} == {"bus14"}
    assert stored["caches_size"] >= 0


@pytest.mark.parametrize("name", AGENTS)
def test_help_names_every_agent(name: str):
    assert name in AGENT_HELP.replace(",", "").split()


def test_the_words_of_training_are_those_of_other_commands(capsys):
    for old, new in (("--total-timesteps", "--decisions"), ("--num-threads", "--threads"), ("--folder", "--output")):
        assert main(["train", "ppo", "bus14-T0", old, "3"]) == 2
        assert f"Flag {old} does not exist" in capsys.readouterr().err
        with pytest.raises(SystemExit):
            main(["train", "ppo", "bus14-T0", "--help"])
        assert new in capsys.readouterr().out
