"""What a command imports before it has something to do: help and versions are there at once."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = ("torch", "numba", "grid2op", "lightsim2grid", "matplotlib", "pandas", "scipy", "rich", "tyro")


@pytest.mark.parametrize("words", [["--help"], ["--version"], ["analyse", "--help"], ["study"], ["tasks"]])
def test_help_and_tasks_are_shown_without_what_other_commands_need(words: list[str]):
    code = (
        "import sys, contextlib, io\n"
        "from rl2grid.cli.main import main\n"
        "with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):\n"
        f"    main({words!r})\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
