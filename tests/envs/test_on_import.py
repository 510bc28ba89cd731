"""Gymnasium knows the tasks, in whatever order the two are imported, in every process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import rl2grid

COUNT = "print(sum(each.startswith('rl2grid/') for each in gymnasium.registry))"
WORKERS = """
import functools
import rl2grid
import gymnasium

if __name__ == "__main__":
    make = functools.partial(gymnasium.make, "rl2grid/bus14-T0-v0", split="bundled")
    envs = gymnasium.vector.AsyncVectorEnv([make, make], context="spawn")
    print(envs.reset(seed=0)[0].shape)
    envs.close()
"""


def run(*arguments: str) -> str:
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=True).stdout.strip()


@pytest.mark.parametrize(
    "imports",
    [
        "import gymnasium, rl2grid",
        "import rl2grid, gymnasium",
        "import rl2grid; from gymnasium.envs.registration import registry; import gymnasium",
        "from rl2grid.envs.grid_env import PowerGridEnv; import gymnasium",
        "import rl2grid.envs.registration, gymnasium",
        "import rl2grid; rl2grid.tasks(); import gymnasium",
        "import gymnasium; gymnasium.make('rl2grid:rl2grid/bus14-T0-v0')",
        "import importlib, rl2grid; importlib.reload(rl2grid); import gymnasium",
    ],
)
def test_gymnasium_knows_the_tasks(imports: str):
    assert run("-c", f"{imports}\n{COUNT}") == "199"


def test_gymnasium_is_not_needed_to_list_tasks():
    code = "import sys, rl2grid; print(len(rl2grid.tasks()), 'gymnasium' in sys.modules)"
    assert run("-c", code) == "199 False"


def test_without_gymnasium_the_package_is_imported():
    code = "import sys; sys.modules['gymnasium'] = None; import rl2grid; print(rl2grid.__version__)"
    assert run("-c", code) == rl2grid.__version__


@pytest.mark.slow
def test_workers_know_the_tasks(tmp_path: Path):
    script = tmp_path / "workers.py"
    script.write_text(WORKERS)
    assert run(str(script)) == "(2, 226)"
