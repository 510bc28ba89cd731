"""Agents of a user's own, by the file or module in which they are written."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from rl2grid.agents.agent import Agent
from rl2grid.cli.main import main
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import make_agent
from rl2grid.evaluation.protocol import evaluate
from rl2grid.records.evaluations import load_evaluation

MONTH = "generated/710000-00"
AGENT = '''
from beside import ACTION


class Constant:
    """Plays one action."""

    name = "constant: 0"

    def bind(self, env):
        pass

    def reset(self, i):
        pass

    def act(self, observation, info):
        return ACTION


class Helper:
    pass


def ready():
    return Constant()


def needs(name):
    return Constant()


class Nameless(Constant):
    name = None


def broken():
    raise ZeroDivisionError("no way")


an_instance = Constant()
'''


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The working folder, with files of agents; what was imported of it is forgotten."""
    (tmp_path / "beside.py").write_text("ACTION = 0\n")
    (tmp_path / "constant_agent.py").write_text(AGENT.replace("class Nameless(Constant):\n    name = None\n", ""))
    (tmp_path / "pack").mkdir()
    (tmp_path / "pack" / "__init__.py").write_text("")
    (tmp_path / "pack" / "agents.py").write_text(AGENT)
    (tmp_path / "empty.py").write_text("")
    (tmp_path / "wrong.py").write_text("x = 1\n\n\nif x:\nprint(x)\n")
    (tmp_path / "fails.py").write_text("x = 1\n\nraise RuntimeError('out of coffee.')\n")
    (tmp_path / "lost.py").write_text("import no_such_library\n")
    (tmp_path / "json.py").write_text(AGENT)
    (tmp_path / "my-agent.py").write_text(AGENT)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    known = set(sys.modules)

    yield tmp_path
    for name in set(sys.modules) - known:
        file = getattr(sys.modules[name], "__file__", None)
        if file is not None and Path(file).is_relative_to(tmp_path):
            del sys.modules[name]


@pytest.mark.parametrize(
    "spec",
    [
        "constant_agent.py",
        "./constant_agent.py",
        "./constant_agent.py:Constant",
        "constant_agent.py:ready",
        "constant_agent:an_instance",
        "constant_agent:Constant",
        "pack.agents:Constant",
        "pack/agents.py:Constant",
    ],
)
def test_an_agent_is_found_by_where_it_is_written(folder: Path, spec: str):
    agent = make_agent(spec)
    assert isinstance(agent, Agent)
    assert agent.name == "constant: 0"
    assert agent.act(None, {}) == 0


@pytest.mark.parametrize(
    ("spec", "part"),
    [
        ("nowhere.py", "There is no file 'nowhere.py'"),
        ("no.such.module:Agent", "There is no module 'no.such.module'"),
        ("pack.nothing:Agent", "There is no module 'pack.nothing'"),
        ("empty.py", "does not hold exactly one agent: it has none, and an agent has a name and the methods bind(env)"),
        ("pack/agents.py", "it has Constant, Nameless; name it as pack/agents.py:NAME"),
        ("constant_agent:Constnat", "constant_agent has no 'Constnat': choose one of Constant"),
        ("constant_agent:Helper", "constant_agent:Helper has no bind and no reset and no act"),
        ("constant_agent:needs", "cannot be made without arguments: missing a required argument: 'name'"),
        ("constant_agent:broken", "cannot be made: ZeroDivisionError in line"),
        ("pack.agents:Nameless", "has no name"),
        ("wrong.py", "wrong cannot be imported: IndentationError in line 5 of wrong.py"),
        ("fails.py", "fails cannot be imported: RuntimeError in line 3 of fails.py: out of coffee"),
        ("lost.py", "lost cannot be imported: No module named 'no_such_library'"),
        ("json.py", "has the name of another module, json: give the file another name"),
        ("my-agent.py", "my-agent.py cannot be imported: use letters, digits and '_' only"),
        ("frobnicate", "package.module:Agent, ./agent.py"),
    ],
)
def test_what_does_not_fit_is_said_in_one_sentence(folder: Path, capsys, spec: str, part: str):
    assert main(["evaluate", spec, "bus14-T0", "--months", "1"]) == 2
    (sentence,) = capsys.readouterr().err.splitlines()
    assert part in sentence
    assert sentence.endswith(".")
    assert not (folder / "runs").exists()


def test_an_own_agent_is_evaluated_and_an_edited_one_anew(folder: Path, capsys):
    assert main(["evaluate", "./constant_agent.py", "do-nothing", "bus14-T0", "--months", "1", "--quiet"]) == 0
    shown = capsys.readouterr().out
    assert "constant: 0" in shown
    assert "+0.000" in shown
    (found,) = (folder / "runs").glob("bus14-T0-v0-constant-0-*/evaluation/validation-1-months")
    result = load_evaluation(found)
    assert result.command == "rl2grid evaluate ./constant_agent.py bus14-T0 --split validation --seeds 1 --months 1"
    assert found.parent.parent.name.endswith(result.identity["agent_identity"]["source_hash"][:8])
    with pytest.raises(UsageError, match="holds another evaluation"):
        evaluate("do-nothing", "bus14-T0", scenarios=[MONTH], output=found, name="constant: 0")


def test_worker_processes_know_it_too(folder: Path):
    played = evaluate("constant_agent.py", "bus14-T0", scenarios=[MONTH], workers=1)
    assert played.summary.agent == "constant: 0"
    assert played.episodes[0].survival == evaluate("do-nothing", "bus14-T0", scenarios=[MONTH]).episodes[0].survival


def test_an_own_agent_is_watched(folder: Path, capsys):
    assert main(["watch", "constant_agent.py", "bus14-T0", "--steps", "3", "--format", "html"]) == 0
    assert "3 of 8,064 steps" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["../elsewhere/x", "<!--<script>{data}", r"\x1b[31m red", "n" * 300])
def test_any_name_of_an_agent_can_be_watched(folder: Path, name: str):
    (folder / "named.py").write_text(AGENT.replace('"constant: 0"', f'"{name}"'))
    assert main(["watch", "named.py:Constant", "bus14-T0", "--steps", "2", "--format", "html"]) == 0
    (page,) = (folder / "watched").iterdir()
    assert page.name.isprintable()
    assert not set(page.name) & set("/<>{}[ ")


def test_an_agent_that_says_its_version_keeps_it(folder: Path):
    (folder / "versioned.py").write_text(
        AGENT.replace('    name = "constant: 0"', '    name, identity = "v", {"version": 2}')
    )
    assert make_agent("versioned.py:Constant").identity == {"version": 2}  # type: ignore[attr-defined]
