"""What the documentation shows works: Python blocks run, commands exist with the flags that are shown.

The Python blocks of a page run one after the other, in one namespace and an empty folder. A block that cannot run
says so with ``<!-- not run: reason -->`` before it.
"""

import shlex
from pathlib import Path

import pytest
from documentation import PAGES, blocks, name_of

from rl2grid.algorithms.pretrained import cards
from rl2grid.cli import main as command_line
from rl2grid.envs.registration import own_systems, unregister_system
from rl2grid.envs.tasks import find_task
from rl2grid.evaluation.agents import AGENTS
from rl2grid.training import request, runs, validation

QUICK = (["tasks"], ["actions"], ["study", "list"], ["data", "list"])
"""Subcommands that are run as shown."""
SHOWN = [
    (block, line)
    for page in PAGES
    for block in blocks(page)
    if block.language in ("", "sh")
    for line in block.code.replace("\\\n", " ").splitlines()
    if line.startswith("rl2grid ")
]
RUN = "runs/bus14-T0-v0-ppo-1"
"""The training run that pages speak of."""
PYTHON_PAGES = [page for page in PAGES if any(block.language == "python" for block in blocks(page))]


class TrainingBeginsError(Exception):
    """The flags were accepted, and a training would begin."""


def begin(*_, **__):
    raise TrainingBeginsError


def arguments_of(line):
    return shlex.split(line, comments=True)[1:]


def train_shortly(folder):
    hyperparameters = request.hyperparameters("ppo", "bus14-T0", num_envs=2, num_steps=32, total_timesteps=64)
    keywords = {"heuristic": "idle"}
    runs.train(request.RunArgs("bus14-T0", hyperparameters, folder=folder, env_keywords=keywords, tensorboard=False))


def identify(value):
    return value if isinstance(value, str) else f"{name_of(value.page)}:{value.line}"


@pytest.mark.parametrize(("block", "line"), SHOWN, ids=identify)
def test_commands_exist_with_their_flags(block, line, monkeypatch):
    assert block.language == "sh", "a block of commands is to be marked as ```sh"
    arguments = arguments_of(line)
    if arguments[0] == "train":
        monkeypatch.setattr(runs, "train", begin)
        monkeypatch.setattr(runs, "resume", begin)
        monkeypatch.setattr(request, "read_config", lambda folder: (None, {}))
        monkeypatch.setattr(validation, "find_validator", lambda args: None)
        with pytest.raises(TrainingBeginsError):
            command_line.main(arguments)
        return
    options = command_line.make_parser().parse_args(arguments)
    if hasattr(options, "task"):
        find_task(options.task)
    if getattr(options, "agent", None) is not None:
        named = (*AGENTS, *(f"pretrained/{card.name}" for card in cards()))
        assert options.agent in named or options.agent.startswith(("runs/", "examples/"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "line", sorted({line for _, line in SHOWN if any(arguments_of(line)[: len(quick)] == quick for quick in QUICK)})
)
def test_quick_commands_run(line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert command_line.main(arguments_of(line)) == 0


@pytest.fixture
def systems_are_forgotten():
    """What a page registers is not there for the tests that follow."""
    before = {system.id for system in own_systems()}
    yield
    for name in {system.id for system in own_systems()} - before:
        unregister_system(name)


@pytest.mark.slow
@pytest.mark.usefixtures("systems_are_forgotten")
@pytest.mark.parametrize("page", PYTHON_PAGES, ids=name_of)
def test_python_blocks_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": "documentation"}
    chosen = [block for block in blocks(page) if block.language == "python" and not block.not_run]
    if any(RUN in block.code for block in chosen):
        train_shortly(Path(RUN))
    for block in chosen:
        # The number of the line of the page, in tracebacks.
        code = compile("\n" * (block.line - 1) + block.code, str(page), "exec")
        exec(code, namespace)
