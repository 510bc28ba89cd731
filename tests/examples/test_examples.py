"""The scripts under ``examples/`` train unchanged ids with other libraries, run as a user runs them."""

import ast
import importlib.util
import json
import os
import re
import runpy
import secrets
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.cli.main import main
from rl2grid.errors import UsageError

EXAMPLES = Path(__file__).parents[2] / "examples"
NEEDS = {
    "stable_baselines3_ppo": "stable_baselines3",
    "stable_baselines3_sac": "stable_baselines3",
    "stable_baselines3_vector": "stable_baselines3",
    "maskable_ppo": "sb3_contrib",
    "torchrl_ppo": "torchrl",
    "rllib_ppo": "ray",
    "cleanrl_ppo": "torch",
}
QUICK = ("stable_baselines3_ppo", "stable_baselines3_sac", "stable_baselines3_vector", "maskable_ppo", "cleanrl_ppo")


def play(name, arguments, monkeypatch, capsys):
    """What the script writes to its standard output, in this process: each that loads PyTorch anew takes seconds."""
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments])
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    return capsys.readouterr().out


def run(name, *arguments):
    """What the script writes to its standard output, in a process of its own."""
    # Without a token of its own Ray would leave one in the home directory.
    environment = os.environ | {"OMP_NUM_THREADS": "1", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    script = [sys.executable, EXAMPLES / f"{name}.py", *arguments]
    done = subprocess.run(script, capture_output=True, text=True, env=environment, timeout=540, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def assert_survived(said):
    found = re.search(r"^survival .*: (\d\.\d{3})$", said, re.MULTILINE)
    assert found, said
    assert 0 < float(found[1]) <= 1


@pytest.mark.parametrize("name", QUICK)
def test_trains_quickly(name, monkeypatch, capsys):
    pytest.importorskip(NEEDS[name])
    assert_survived(play(name, ["--steps", "200"], monkeypatch, capsys))


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in NEEDS if name not in QUICK])
def test_trains_with_larger_libraries(name):
    pytest.importorskip(NEEDS[name])
    assert_survived(run(name, "--steps", "600"))


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_is_short_and_says_how_to_install(path):
    text = path.read_text()
    assert len(text.splitlines()) < 80
    assert 'pip install -e ".[examples]"' in (ast.get_docstring(ast.parse(text)) or "")


def test_every_example_is_run():
    ran = {*NEEDS, "graph_observations", "lowest_loading", "optim_cvxpy"}
    assert {path.stem for path in EXAMPLES.glob("*.py")} == ran


def test_an_agent_in_a_file_is_played(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    words = [
        "evaluate",
        str(EXAMPLES / "lowest_loading.py"),
        "bus14-T0",
        "--months",
        "1",
        "--heuristic",
        "idle",
        "--json",
    ]
    assert main(words) == 0
    (summary,) = json.loads(capsys.readouterr().out)["summaries"]
    assert summary["agent"] == "lowest-loading"
    assert summary["survival"]["value"] > 0.5


def test_a_published_agent_says_what_it_needs():
    if importlib.util.find_spec("l2rpn_baselines"):
        pytest.skip("it is installed")
    words = ["evaluate", str(EXAMPLES / "optim_cvxpy.py"), "bus14-R", "--engine", "reference", "--months", "1"]
    assert main(words) == 2


def test_a_published_agent_plays_what_it_asks_grid2op_for(monkeypatch):
    """With an agent in the place of the published one, which needs an environment of its own."""
    spec = importlib.util.spec_from_file_location("optim_cvxpy", EXAMPLES / "optim_cvxpy.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    asked = {"redispatch": [(0, 2.0), (1, -3.0)], "curtail": [(3, 0.4)]}

    class Published:
        def __init__(self, action_space, environment):
            self._action_space = action_space

        def reset(self, seen):
            assert seen.current_step == 0

        def act(self, seen, reward, done):
            return self._action_space(asked)

    agent = script.OptimCVXPY()
    monkeypatch.setattr(script, "published_agent", lambda: Published)
    with gymnasium.make("rl2grid/bus14-R-v0", engine="reference", split="bundled") as env:
        agent.bind(env)
        observation, info = env.reset(seed=0)
        agent.reset(0)
        env.step(agent.act(observation, info))
        state = env.unwrapped.state
        assert state.target_dispatch[0, :2].tolist() == pytest.approx([2.0, -3.0], abs=1e-5)
        assert state.curtailment_limit[0, 3] == pytest.approx(0.4, abs=1e-6)
        assert (np.delete(state.curtailment_limit[0], 3) == 1).all()
    with gymnasium.make("rl2grid/bus14-R-v0") as env, pytest.raises(UsageError, match="add --engine reference"):
        agent.bind(env)


def test_graph_observations_without_pytorch_geometric(monkeypatch, capsys):
    said = play("graph_observations", ["--steps", "3"], monkeypatch, capsys)
    assert "edge_index" in said
    assert ("Data(" in said) == (importlib.util.find_spec("torch_geometric") is not None)


def test_the_blocks_of_the_page_run():
    pytest.importorskip("stable_baselines3")
    page = (EXAMPLES.parent / "docs" / "interfaces.md").read_text()
    names = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(block, names)
    assert names["graphs"]["nodes"].shape[0] == 8
    assert names["costs"].shape == (8,)
