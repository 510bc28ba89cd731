"""A shell completes what there is to be typed."""

from __future__ import annotations

import shutil
import subprocess

import pytest

from rl2grid.cli.main import COMMANDS, main


@pytest.fixture(scope="module")
def script() -> str:
    import contextlib
    import io

    with contextlib.redirect_stdout(io.StringIO()) as shown:
        assert main(["completion", "bash"]) == 0
    return shown.getvalue()


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("ev", {"evaluate"}),
        ("study s", {"status"}),
        ("evaluate do", {"do-nothing"}),
        ("evaluate greedy bus14-R", {"bus14-R"}),
        ("evaluate greedy bus14-T0 --split v", {"validation"}),
        ("train ppo bus14-T0 --dec", {"--decisions"}),
        ("train ppo bus14-T0 --heuristic i", {"idle"}),
        ("tasks --g", {"--grid"}),
        ("tasks --q", {"--quiet"}),
        ("frobnicate", set()),
    ],
)
def test_what_begins_like_that_is_offered(script: str, typed: str, offered: set[str]):
    shell = shutil.which("bash")
    if shell is None:
        pytest.skip("no bash here")
    words = ["rl2grid", *typed.split(" ")]
    asked = (
        f"COMP_WORDS=({' '.join(words)}); COMP_CWORD={len(words) - 1}; _rl2grid; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    )
    shown = subprocess.run([shell, "-c", f"{script}\n{asked}"], capture_output=True, text=True, check=True)
    assert shown.stderr == ""
    assert set(shown.stdout.split()) == offered


def test_all_commands_are_in_it(script: str):
    first = next(line for line in script.splitlines() if line.strip().startswith("'')"))
    assert set(COMMANDS) <= set(first.split("words=")[1].split(";")[0].strip("' ").split())
