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


def trained(folder: Path, task: str, algorithm: str = "ppo", **changes: Any) -> Path:
    """A policy that has hardly learned anything, and therefore tries many actions."""
    chosen = request.hyperparameters(algorithm, task, total_timesteps=64, num_envs=4, num_steps=16, **changes)
    return runs.train(
        request.RunArgs(task, chosen, algorithm, folder, validation_months=0, tensorboard=False, progress=False)
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(tmp_path_factory.mktemp("top-k") / "run", "bus14-T0", initial_do_nothing=None)


@pytest.fixture(scope="module")
def continuous_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(tmp_path_factory.mktemp("top-k") / "continuous", "bus14-R")


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
    agent = TopK(policy, 12)
    agent.bind(env)
    base: Any = env.unwrapped
    chosen_places = set()
    for seed in range(25):
        observation, info = env.reset(seed=seed)
        if info["over"]:
            continue
        agent.reset(0)
        candidates, order = policy.best(observation, 12)
        preferences = policy.preferences_of(order)
        assert len(set(candidates)) == 12
        assert preferences == sorted(preferences, reverse=True)
        assert base.action_masks()[candidates].all()
        loading = base.what_if(candidates).worst_loading
        safe = [k for k in range(12) if loading[k] < SAFE_RHO]
        expected = safe[0] if safe else int(np.argmin(loading))
        assert agent.act(observation, info) == candidates[expected]
        considered = agent.explain()
        assert considered is not None
        assert list(considered.actions) == candidates
        chosen_places.add(expected)
    env.close()
    assert len(chosen_places) > 1, "the what-if never changed anything"
    assert max(chosen_places) > 3, "one of the best was always safe"


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


def foreseen(env: Any, action: Any) -> float:
    """The worst loading in the next step; infinite where the game would be lost, or the action refused."""
    result = env.unwrapped.simulate(action)
    if result.terminated or result.info["illegal"]:
        return np.inf
    return float(result.observation[env.unwrapped.observation_slices["rho"]].max())


def test_continuous_actions_are_drawn_where_the_most_probable_one_is_not_safe(continuous_run: Path):
    register_all()
    env = gymnasium.make("rl2grid/bus14-R-v0", heuristic="idle")
    policy, agent = load_agent(continuous_run), TopK(load_agent(continuous_run), 6)
    for each in (policy, agent):
        each.bind(env)
        each.seed_episode(0, 7)
    places = []
    for seed in range(12):
        observation, info = env.reset(seed=seed)
        for _ in range(4):
            if info["over"]:
                break
            first = policy.act(observation, info)
            candidates = [first]
            loading = [foreseen(env, first)]
            if loading[0] >= SAFE_RHO:
                candidates += policy.draws(observation, 5)
                loading += [foreseen(env, each) for each in candidates[1:]]
            safe = [k for k, each in enumerate(loading) if each < SAFE_RHO]
            expected = safe[0] if safe else int(np.argmin(loading))
            np.testing.assert_array_equal(agent.act(observation, info), candidates[expected])
            considered = agent.explain()
            assert considered is not None
            tried = expected + 1 if safe else len(loading)  # nothing is looked for behind the first that is safe
            assert list(considered.values) == sorted(loading[:tried])
            assert all(np.abs(each).max() <= 1.0 for each in candidates)
            places.append(expected)
            observation, _, terminated, truncated, info = env.step(candidates[expected])
            if terminated or truncated:
                break
    env.close()
    assert len(set(places)) > 2, "the draws never changed anything"


def test_what_is_drawn_follows_from_the_episode_alone(continuous_run: Path):
    months = ["generated/710000-00", "generated/710001-07"]

    def returns(scenarios: list[str]) -> dict[str, float]:
        agent = make_agent(continuous_run, top_k=4)
        result = rl2grid.evaluate(agent, "bus14-R", scenarios=scenarios, episode_length=300, heuristic="idle")
        return {each.scenario: each.episode_return for each in result.episodes}

    assert returns(months) == returns(months[::-1])


def test_of_continuous_actions_the_best_of_one_is_the_policy(continuous_run: Path):
    env = gymnasium.make("rl2grid/bus14-R-v0", heuristic="idle")
    policy, agent = load_agent(continuous_run), make_agent(continuous_run, top_k=1)
    observation, info = env.reset(seed=5)
    for each in (policy, agent):
        each.bind(env)
    np.testing.assert_array_equal(agent.act(observation, info), policy.act(observation, info))
    env.close()


def test_what_has_no_other_actions_to_compare_is_refused(run: Path, tmp_path: Path):
    with pytest.raises(UsageError, match="top_k=0 is not allowed: give a number of actions, at least 1"):
        make_agent(run, top_k=0)
    with pytest.raises(UsageError, match="leave it out for greedy"):
        make_agent("greedy", top_k=3)
    with pytest.raises(UsageError, match="TD3's policy draws no other actions"):  # before others have played
        make_agent(trained(tmp_path / "run", "bus14-R", "td3"), top_k=2)
