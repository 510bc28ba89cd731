"""Looking before acting: the policy's best actions and what the forecast says of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import rl2grid
from rl2grid.algorithms.policy_agent import PolicyAgent, load_agent
from rl2grid.algorithms.top_k import TopK
from rl2grid.envs.registration import register_all
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import make_agent
from rl2grid.mdp.heuristics import SAFE_RHO
from rl2grid.training import request, runs


def trained(folder: Path, task: str) -> Path:
    """A policy that has hardly learned anything, and therefore tries many actions."""
    chosen = request.hyperparameters(
        "ppo",
        task,
        total_timesteps=64,
        num_envs=4,
        num_steps=16,
        **({"initial_do_nothing": None} if "T" in task else {}),
    )
    return runs.train(
        request.RunArgs(task, chosen, "ppo", folder, validation_months=0, tensorboard=False, progress=False)
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(tmp_path_factory.mktemp("top-k") / "run", "bus14-T0")


def played(agent: Any, decisions: int, engine: str = "native") -> list[tuple[int, Any, Any]]:
    """Decisions of an agent: step, action, and what it says of it."""
    register_all()
    env = gymnasium.make("rl2grid/bus14-T0-v0", engine=engine)
    agent.bind(env)
    observation, info = env.reset(seed=11)
    agent.reset(0)
    history = []
    for _ in range(decisions):
        action = agent.act(observation, info)
        history.append((info["step"], action, agent.explain()))
        observation, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            observation, info = env.reset()
            agent.reset(0)
    env.close()
    return history


def test_the_best_of_one_is_the_policy(run: Path):
    policy, looking = load_agent(run), TopK(load_agent(run), 1)
    assert [row[:2] for row in played(policy, 30)] == [row[:2] for row in played(looking, 30)]


def test_of_the_best_actions_the_first_that_is_safe_is_played_else_the_least_loaded(run: Path):
    register_all()
    env = gymnasium.make("rl2grid/bus14-T0-v0", heuristic="idle")
    policy = load_agent(run)
    agent = TopK(policy, 5)
    agent.bind(env)
    base: Any = env.unwrapped
    chosen_places = set()
    for seed in range(25):
        observation, info = env.reset(seed=seed)
        if info["over"]:
            continue
        agent.reset(0)
        candidates, preferences = policy.best(observation, 5)
        assert len(set(candidates)) == 5
        assert preferences == sorted(preferences, reverse=True)
        assert base.action_masks()[candidates].all()
        loading = base.what_if(candidates).worst_loading
        safe = [k for k in range(5) if loading[k] < SAFE_RHO]
        expected = safe[0] if safe else int(np.argmin(loading))
        assert agent.act(observation, info) == candidates[expected]
        considered = agent.explain()
        assert considered is not None
        assert list(considered.actions) == candidates
        chosen_places.add(expected)
    env.close()
    assert len(chosen_places) > 1, "the what-if never changed anything"


def test_the_reference_engine_is_asked_by_simulate(run: Path):
    ours, theirs = (played(TopK(load_agent(run), 3), 8, engine) for engine in ("native", "reference"))
    assert [row[:2] for row in ours] == [row[:2] for row in theirs]


def test_it_is_named_identified_and_made_by_its_run(run: Path):
    agent = make_agent(run, top_k=4)
    assert isinstance(agent, TopK)
    assert agent.name == "ppo, best of 4"
    policy = make_agent(run)
    assert isinstance(policy, PolicyAgent)
    assert agent.identity == {**policy.identity, "top_k": 4}
    result = rl2grid.evaluate(agent, "bus14-T0", scenarios=["generated/710000-00"], episode_length=20)
    assert result.summary.agent == "ppo, best of 4"


def test_what_has_no_best_few_actions_is_refused(run: Path, tmp_path: Path):
    with pytest.raises(UsageError, match="top_k=0 is not allowed: give a number of actions, at least 1"):
        make_agent(run, top_k=0)
    with pytest.raises(UsageError, match="leave it out for greedy"):
        make_agent("greedy", top_k=3)
    with pytest.raises(UsageError, match="continuous actions has no best few"):  # before others have played
        make_agent(trained(tmp_path / "run", "bus14-R"), top_k=2)
