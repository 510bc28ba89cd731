"""Checkpoints as agents: deterministic, frozen, and only for what they were trained on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from toy_grid import SingleToyGrid, ToyGrid

from rl2grid.agents.agent import Agent, RandomizedAgent
from rl2grid.algorithms import policy_agent
from rl2grid.algorithms.checkpoint import save_checkpoint
from rl2grid.algorithms.on_policy import ActorCritic, load_policy
from rl2grid.algorithms.policy_agent import BEST_FILE, CHECKPOINT_FILE, PolicyAgent, load_agent
from rl2grid.algorithms.ppo import PPO, Args
from rl2grid.errors import UsageError

ARGS = Args(total_timesteps=64, num_envs=4, num_steps=16, actor_layers=(8,), critic_layers=(8,))
TASKS = {False: "rl2grid/bus14-T0-v0", True: "rl2grid/bus14-R-v0"}
BOTH = pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])


def trained(continuous: bool = False, **changes: Any) -> PPO:
    args = replace(ARGS, mask_actions=not continuous, initial_log_std=0.5, **changes)
    ppo = PPO(args, ToyGrid(4, continuous=continuous, gamma=args.gamma))
    ppo.iterate()
    return ppo


def contents(ppo: PPO, **changes: Any) -> dict[str, Any]:
    return {
        "algorithm": "ppo",
        "task": TASKS[ppo.continuous],
        "env_keywords": {"heuristic": "idle"},
        "identity": {"seed": 1},
        "decisions": ppo.decisions,
        "policy": ppo.policy_state(),
        **changes,
    }


def play(agent: PolicyAgent, continuous: bool, episodes: int = 3) -> list[Any]:
    env = SingleToyGrid(TASKS[continuous])
    agent.bind(env)
    actions = []
    for _ in range(episodes):
        observation, info = env.reset()
        agent.reset(0)
        ended = False
        while not ended:
            action = agent.act(observation, info)
            actions.append(action)
            observation, _, terminated, truncated, info = env.step(
                action if isinstance(action, int) else action.tolist()
            )
            ended = terminated or truncated
    return actions


@BOTH
def test_a_loaded_policy_plays_the_deterministic_actions_of_the_trained_one(continuous: bool, tmp_path: Path):
    ppo = trained(continuous)
    save_checkpoint(tmp_path / "c.pt", contents(ppo))
    agent = load_agent(tmp_path / "c.pt", TASKS[continuous])
    assert isinstance(agent, Agent)
    env = SingleToyGrid(TASKS[continuous])
    agent.bind(env)
    normalizer = ppo.normalizer
    for position in np.linspace(-0.9, 0.9, 7):
        env._row.position = float(position)
        observation = env._row.observation()
        observations = torch.as_tensor(normalizer.normalize(observation[None]))
        with torch.no_grad():
            if continuous:
                expected = ppo.network.actor(observations)[0].clamp(-1.0, 1.0).numpy()
                action = agent.act(observation, {})
                np.testing.assert_array_equal(action, expected)
                assert action.dtype == np.float32
            else:
                logits = ppo.network.actor(observations)[0].masked_fill(~torch.as_tensor(env.action_masks()), -np.inf)
                assert agent.act(observation, {}) == int(logits.argmax())


def with_and_without(name: str, way: str) -> tuple[PolicyAgent, PolicyAgent, gymnasium.Env[Any, Any]]:
    """A policy of the package that decides in a way of its own, the same that does not, and where both are bound."""
    own, asked = (load_agent(Path(f"pretrained/{name}")) for _ in range(2))
    assert getattr(own, way)
    setattr(asked, way, False)
    env = gymnasium.make(own.task, split="validation", **own.env_keywords)
    for agent in (own, asked):
        agent.bind(env)
    return own, asked, env


@pytest.mark.parametrize("name", ["bus14-T0", "bus36-MO-v1-T0"])
@pytest.mark.parametrize("masked", [True, False])
def test_networks_without_scores_of_their_own_decide_the_same(name: str, masked: bool):
    scored, asked, env = with_and_without(name, "_has_scores")
    for agent in (scored, asked):
        agent._mask_actions &= masked
    env.action_space.seed(1)
    observation, info = env.reset(seed=3)
    for _ in range(30):
        assert scored.act(observation, info) == asked.act(observation, info)
        assert scored.explain() == asked.explain()
        (ours, order), (theirs, preferences) = (agent.best(observation, 7) for agent in (scored, asked))
        assert ours == theirs
        assert scored.preferences_of(order) == asked.preferences_of(preferences)
        observation, _, terminated, truncated, info = env.step(env.action_space.sample())
        if terminated or truncated:
            observation, info = env.reset()
    env.close()


@pytest.mark.parametrize("name", ["bus36-M-R", "bus118-MOB-v0-H1", "bus14-R"])
def test_networks_without_means_of_their_own_decide_the_same(name: str):
    told, asked, env = with_and_without(name, "_has_means")
    observation, info = env.reset(seed=3)
    for _ in range(5):
        action, expected = (agent.act(observation, info) for agent in (told, asked))
        np.testing.assert_equal(action, expected)
        assert type(action) is type(expected)
        assert getattr(action, "dtype", None) == getattr(expected, "dtype", None)
        observation, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            observation, info = env.reset()
    env.close()


@BOTH
def test_who_inherits_scores_and_means_but_acts_otherwise_acts(continuous: bool, monkeypatch: pytest.MonkeyPatch):
    asked = []

    class Counting(ActorCritic):
        def act(self, observations: Any, masks: Any, generator: Any) -> Any:
            asked.append(observations)
            return super().act(observations, masks, generator)

    def load(policy: Any) -> ActorCritic:
        network = load_policy(policy)
        network.__class__ = Counting
        return network

    ppo = trained(continuous)
    usual = play(PolicyAgent(contents(ppo)), continuous)
    monkeypatch.setattr(policy_agent, "find_algorithm", lambda name: SimpleNamespace(load_policy=load))
    np.testing.assert_array_equal(play(PolicyAgent(contents(ppo)), continuous), usual)
    assert len(asked) == len(usual)


@BOTH
def test_evaluation_repeats_itself_and_changes_nothing(continuous: bool):
    ppo = trained(continuous)
    agent = PolicyAgent(contents(ppo))
    before = dict(agent.identity)
    first, second = play(agent, continuous), play(agent, continuous)
    np.testing.assert_array_equal(first, second)
    assert PolicyAgent(contents(ppo)).identity == before
    assert agent._normalizer is not None
    assert agent._normalizer.normaliser_hash == before["normaliser_hash"]
    assert ppo.normalizer.normaliser_hash == before["normaliser_hash"]  # type: ignore[attr-defined]
    assert agent._normalizer.frozen


def test_an_agent_does_not_follow_the_training_that_goes_on():
    ppo = trained(total_timesteps=128)
    agent = PolicyAgent(contents(ppo))
    actions = play(agent, False)
    ppo.iterate()
    np.testing.assert_array_equal(play(agent, False), actions)
    assert PolicyAgent(contents(ppo)).identity["policy_hash"] != agent.identity["policy_hash"]
    assert PolicyAgent(contents(ppo)).identity["normaliser_hash"] != agent.identity["normaliser_hash"]


@BOTH
def test_samples_are_drawn_on_request_from_the_stream_named(continuous: bool):
    agent = PolicyAgent(contents(trained(continuous)), deterministic=False)
    assert isinstance(agent, RandomizedAgent)
    results = []
    for seed, episode in ((1, 2), (1, 2), (1, 3), (2, 2)):
        agent.seed_episode(seed, episode)
        results.append(np.array(play(agent, continuous, 8)).tolist())
    assert results[0] == results[1]
    assert results[0] != results[2]
    assert results[0] != results[3]


def test_a_policy_without_normalisation_reads_observations_as_they_are():
    ppo = trained(normalize_observations=False)
    agent = PolicyAgent(contents(ppo))
    assert agent.identity["normaliser_hash"] is None
    env = SingleToyGrid()
    agent.bind(env)
    observation, info = env.reset()
    with torch.no_grad():
        expected = ppo.network.act(torch.as_tensor(observation[None]), torch.as_tensor(env.action_masks()[None]), None)
    assert agent.act(observation, info) == int(expected)


def test_a_run_folder_gives_its_best_policy_else_its_latest(tmp_path: Path):
    ppo = trained()
    save_checkpoint(tmp_path / CHECKPOINT_FILE, contents(ppo, decisions=2))
    assert load_agent(tmp_path).identity["decisions"] == 2
    save_checkpoint(tmp_path / BEST_FILE, contents(ppo, decisions=1))
    assert load_agent(tmp_path, name="mine").identity["decisions"] == 1
    assert load_agent(tmp_path, name="mine").name == "mine"
    assert load_agent(tmp_path).name == "ppo"
    with pytest.raises(UsageError, match="does not exist"):
        load_agent(tmp_path / "elsewhere")


def test_another_task_is_refused_in_one_sentence(tmp_path: Path):
    save_checkpoint(tmp_path / "c.pt", contents(trained()))
    assert load_agent(tmp_path / "c.pt", "bus14-T0").task == "rl2grid/bus14-T0-v0"
    with pytest.raises(UsageError, match=r"is of task 'rl2grid/bus14-T0-v0' and cannot be used for task .*\.$"):
        load_agent(tmp_path / "c.pt", "rl2grid/bus14-T1-v0")
    with pytest.raises(UsageError, match=r"trained on task .* cannot play task 'rl2grid/bus14-T0-LSI-v0'\.$"):
        load_agent(tmp_path / "c.pt").bind(SingleToyGrid("rl2grid/bus14-T0-LSI-v0"))


def test_other_observations_and_actions_are_refused():
    agent = PolicyAgent(contents(trained()))
    with pytest.raises(UsageError, match="normalize='physical' and cannot read observations of normalize=None"):
        agent.bind(SingleToyGrid(normalize=None))
    env = SingleToyGrid()
    env.options.operator_features = "calendar"
    with pytest.raises(
        UsageError, match="operator_features=None and cannot read observations of operator_features='cal"
    ):
        agent.bind(env)
    env = SingleToyGrid()
    env.action_space.n = np.int64(7)  # type: ignore[attr-defined]
    with pytest.raises(UsageError, match="chooses among 3 actions"):
        agent.bind(env)


def test_a_policy_tells_its_best_actions():
    agent = PolicyAgent(contents(trained()))
    agent.bind(env := SingleToyGrid(TASKS[False]))
    observation, info = env.reset()
    action = agent.act(observation, info)
    considered = agent.explain()
    assert considered is not None
    assert considered.meaning == "probability"
    assert considered.actions[0] == action
    values = list(considered.values)
    assert values == sorted(values, reverse=True)
    assert sum(values) <= 1.0 + 1e-6


def test_a_continuous_policy_has_no_best_actions():
    agent = PolicyAgent(contents(trained(True)))
    agent.bind(env := SingleToyGrid(TASKS[True]))
    agent.act(*env.reset())
    assert agent.explain() is None


def test_a_policy_of_an_old_shape_is_refused_in_one_sentence(tmp_path: Path):
    ppo = trained(normalize_observations=True)
    policy = contents(ppo)["policy"]
    weights = {name: weight[:, 1:] if weight.ndim == 2 else weight for name, weight in policy["network"].items()}
    save_checkpoint(tmp_path / "weights.pt", contents(ppo, policy={**policy, "network": weights}))
    with pytest.raises(UsageError, match=r"its weights are those of another network \(size mismatch") as refusal:
        load_agent(tmp_path / "weights.pt")
    assert "\n" not in str(refusal.value)
    statistics = {**policy["normalizer"], "mean": policy["normalizer"]["mean"][1:]}
    save_checkpoint(tmp_path / "statistics.pt", contents(ppo, policy={**policy, "normalizer": statistics}))
    with pytest.raises(UsageError, match="observed features were given where"):
        load_agent(tmp_path / "statistics.pt")
