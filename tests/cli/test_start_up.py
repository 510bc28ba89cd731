"""What a command imports before it has something to do: help and versions are there at once."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = ("torch", "numba", "grid2op", "lightsim2grid", "matplotlib", "pandas", "scipy", "rich", "tyro")
NUMERICAL = ("numpy", "gymnasium", "importlib.metadata", "concurrent.futures", "multiprocessing")


def imported(code: str, names: tuple[str, ...]) -> str:
    """Which of the modules are there after some code, as a list in words."""
    script = f"{code}\nimport sys\nprint([name for name in {names!r} if name in sys.modules])"
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.strip()


def running(words: list[str]) -> str:
    return (
        "import contextlib, io\n"
        "from rl2grid.cli.main import main\n"
        "with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):\n"
        f"    main({words!r})"
    )


@pytest.mark.parametrize("words", [["analyse", "--help"], ["study"]])
def test_help_is_shown_without_what_other_commands_need(words: list[str]):
    assert imported(running(words), HEAVY) == "[]"


@pytest.mark.parametrize(
    "words", [[], ["--help"], ["--version"], ["tasks"], ["tasks", "--grid", "bus14", "--json"], ["demo", "--help"]]
)
def test_help_and_tasks_are_shown_without_what_calculates(words: list[str]):
    assert imported(running(words), HEAVY + NUMERICAL) == "[]"


def test_the_package_is_imported_without_what_calculates():
    assert imported("import rl2grid", HEAVY + NUMERICAL) == "[]"


def test_evaluations_load_what_their_agent_needs_and_no_more():
    """Every worker process of an evaluation imports the same, before it plays its first month."""
    words = ["evaluate", "do-nothing", "bus14-T0", "--split", "bundled", "--months", "1", "--episode-length", "2"]
    heavy = ("torch", "scipy.sparse", "scipy.optimize", "grid2op", "lightsim2grid", "matplotlib", "pandas")
    assert imported(running(words), heavy) == "[]"
