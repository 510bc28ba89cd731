"""Runs that begin with the policy of another run, and stay near it at first."""

from __future__ import annotations

import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from labelled_toys import NothingToPlay, write
from toy_grid import ToyGrid
from toy_runs import LAYERS, SIZES, SMALL, assert_same, assert_same_run, falling, request, table, toy_envs, toy_run

from rl2grid.algorithms import imitation, ppo, sac
from rl2grid.algorithms.checkpoint import load_checkpoint, save_checkpoint
from rl2grid.algorithms.dqn import DQN
from rl2grid.algorithms.on_policy import ActorCritic, divergences
from rl2grid.algorithms.policy_agent import PolicyAgent, load_agent
from rl2grid.algorithms.ppo import PPO
from rl2grid.algorithms.registry import find_algorithm
from rl2grid.algorithms.starting import read_starting_policy
from rl2grid.algorithms.teacher import TeacherArgs, categorical_divergences, gaussian_divergences
from rl2grid.errors import UsageError
from rl2grid.records.trainings import read_training_run
from rl2grid.training.limits import TimeLimit
from rl2grid.training.request import hyperparameters
from rl2grid.training.runs import is_finished, resume, train

BOTH = pytest.mark.parametrize("task", ["bus14-T0", "bus14-R"])


def learner(algorithm: str, task: str, **changes: Any) -> Any:
    """A trainer on toy grids, as :func:`toy_run` asks for it."""
    args = toy_run(Path("unused"), algorithm, task, **changes).hyperparameters
    if algorithm == "ppo":
        args = replace(args, mask_actions=task == "bus14-T0")
    return find_algorithm(algorithm).trainer(args, ToyGrid(4, gamma=0.9, continuous=task == "bus14-R"))


def saved(path: Path, trainer: Any, algorithm: str, task: str = "bus14-T0") -> str:
    """A checkpoint of what a trainer has learned."""
    contents = {
        "algorithm": algorithm,
        "task": f"rl2grid/{task}-v0",
        "env_keywords": {"heuristic": "idle"},
        "hyperparameters": asdict(trainer.args),
        "identity": {},
        "decisions": trainer.decisions,
        "policy": trainer.policy_state(),
    }
    save_checkpoint(path, contents)
    return str(path)


def trained(path: Path, algorithm: str, task: str = "bus14-T0") -> str:
    """A checkpoint of a policy after a few iterations."""
    trainer = learner(algorithm, task)
    for _ in range(3):
        trainer.iterate()
    return saved(path, trainer, algorithm, task)


# --- The beginning --------------------------------------------------------------------------------------------------


@BOTH
def test_ppo_begins_with_exactly_the_policy_that_it_is_given(tmp_path: Path, task: str):
    path = trained(tmp_path / "first.pt", "ppo", task)
    mine = learner("ppo", task, start_from=path)
    mine.begin_as_asked()
    theirs = read_starting_policy(path).network()
    assert isinstance(theirs, ActorCritic)
    for name, tensor in theirs.state_dict().items():
        assert torch.equal(tensor, mine.network.state_dict()[name]), name
    before = load_checkpoint(Path(path))["policy"]["normalizer"]
    mine.iterate()
    assert_same(mine.normalizer_state(), before)  # frozen
    agent = load_agent(Path(path))
    assert mine.identity() == {
        "start": {
            "path": path,
            "algorithm": "ppo",
            "decisions": 96,
            "policy_hash": agent.identity["policy_hash"],
            "budget": mine.args.total_timesteps,
        }
    }


@pytest.mark.parametrize("policy", ["ppo", "sac"])
@pytest.mark.parametrize("task", ["bus14-T0", "bus14-R", "bus14-H0"])
def test_what_was_imitated_is_gone_on_with(tmp_path: Path, task: str, policy: str):
    labels = write(tmp_path / "labels", task, months=2, n=10)
    sizes: dict[str, Any] = {"total_timesteps": 40, "num_steps": 40, "gamma": 0.99, "actor_layers": (8,)}
    masked = task == "bus14-T0"
    args = imitation.Args(**sizes, labels=(labels,), policy=policy, critic_layers=(8,), mask_actions=masked)
    pupil = imitation.Imitation(args, NothingToPlay(task))
    pupil.iterate()
    path = saved(tmp_path / "pupil.pt", pupil, "imitation", task)
    contents = load_checkpoint(Path(path))
    save_checkpoint(Path(path), {**contents, "env_keywords": {"heuristic": None}})
    sizes |= {"num_envs": 1, "mask_actions": masked, "start_from": path, "critic_layers": (8,)}
    make = {
        "ppo": lambda: PPO(ppo.Args(**sizes), NothingToPlay(task)),
        "sac": lambda: sac.SAC(sac.Args(**sizes), NothingToPlay(task)),
    }
    mine: Any = make[policy]()
    mine.begin_as_asked()
    network = mine.network if policy == "ppo" else mine.actor
    for name, tensor in pupil.network.state_dict().items():
        assert torch.equal(tensor, network.state_dict()[name]), name
    observations = pupil.examples.rows(np.arange(5)).observations
    assert torch.equal(network.act(observations, None, None), pupil.network.act(observations, None, None))


def test_the_critic_begins_anew_where_it_would_judge_otherwise(tmp_path: Path):
    path = trained(tmp_path / "first.pt", "ppo")
    theirs = read_starting_policy(path).network()
    assert isinstance(theirs, ActorCritic)
    mine = learner("ppo", "bus14-T0", start_from=path, reward_scale=0.5)
    before = {name: tensor.clone() for name, tensor in mine.network.critic.state_dict().items()}
    mine.begin_as_asked()
    assert_same(dict(mine.network.critic.state_dict()), before)
    assert_same(dict(mine.network.actor.state_dict()), dict(theirs.actor.state_dict()))


def test_dqn_goes_on_with_its_own_values(tmp_path: Path):
    path = trained(tmp_path / "first.pt", "dqn")
    mine = learner("dqn", "bus14-T0", start_from=path)
    assert isinstance(mine, DQN)
    mine.begin_as_asked()
    theirs = read_starting_policy(path).network().state_dict()
    assert_same(dict(mine.network.state_dict()), dict(theirs))
    assert_same(dict(mine.target.state_dict()), dict(theirs))


def test_every_seed_may_begin_with_a_policy_of_its_own(tmp_path: Path):
    trained(tmp_path / "first-5.pt", "ppo")
    mine = learner("ppo", "bus14-T0", start_from=str(tmp_path / "first-{seed}.pt"))
    mine.begin_as_asked()
    assert mine.identity()["start"]["path"] == str(tmp_path / "first-5.pt")
    with pytest.raises(UsageError, match="first-6"):
        learner("ppo", "bus14-T0", start_from=str(tmp_path / "first-{seed}.pt"), seed=6).begin_as_asked()


def shortlisted(task: str, size: int | None, **changes: Any) -> Any:
    """A learner on a task of the benchmark that chooses among the ``size`` best actions."""
    sizes: dict[str, Any] = {"total_timesteps": 64, "num_envs": 1, "actor_layers": (8,), "critic_layers": (8,)}
    return PPO(ppo.Args(**sizes | changes, shortlist=size), NothingToPlay(task))


@pytest.mark.parametrize(
    ("first", "size", "then"),
    [("bus36-M-T1", 20, "bus36-M-T0"), ("bus36-M-T0", 20, "bus36-M-T2"), ("bus36-M-T0", None, "bus36-M-T1")],
)
def test_a_policy_plays_on_at_another_level(tmp_path: Path, first: str, size: int | None, then: str):
    path = saved(tmp_path / "first.pt", shortlisted(first, size), "ppo", first)
    contents = {**load_checkpoint(Path(path)), "env_keywords": {"heuristic": None}}
    save_checkpoint(Path(path), contents)
    if size is None:
        with pytest.raises(UsageError, match="its shortlist is 50: set shortlist to the same"):
            shortlisted(then, None, start_from=path).begin_as_asked()
    mine = shortlisted(then, size or 50, start_from=path)
    mine.begin_as_asked()
    played: dict[str, list[int]] = {}
    for task, policy in ((first, contents["policy"]), (then, mine.policy_state())):
        env = gymnasium.make(f"rl2grid/{task}-v0", split="bundled", disable_env_checker=True)
        agent = PolicyAgent({**contents, "task": f"rl2grid/{task}-v0", "policy": policy}, deterministic=False)
        agent.bind(env)
        agent.seed_episode(3, 0)
        observation, info = env.reset(seed=0)
        played[task], over = [], False
        while not over and len(played[task]) < 50:
            played[task].append(int(agent.act(observation, info)))
            observation, _, terminated, truncated, info = env.step(played[task][-1])
            over = terminated or truncated
        env.close()
    assert played[first] == played[then]
    assert len(set(played[first])) > 3


@pytest.mark.parametrize(
    ("first", "then", "size"),
    [("bus14-T0", "bus14-T1", None), ("bus14-T0", "bus36-M-T0", 20), ("bus14-T0", "bus14-T1", 20)],
)
def test_a_policy_plays_on_in_no_other_task(tmp_path: Path, first: str, then: str, size: int | None):
    path = saved(tmp_path / "first.pt", shortlisted(first, size), "ppo", first)
    with pytest.raises(UsageError, match=f"it is of task rl2grid/{first}-v0, not rl2grid/{then}-v0, and only one of"):
        shortlisted(then, size, start_from=path).begin_as_asked()


# --- Near the teacher -----------------------------------------------------------------------------------------------


def test_divergences_are_those_of_torch():
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn(2, 5, 4, generator=generator)
    theirs, mine = (torch.distributions.Categorical(logits=each) for each in logits)
    expected = torch.distributions.kl_divergence(theirs, mine)
    torch.testing.assert_close(categorical_divergences(*logits.log_softmax(dim=-1)), expected)
    numbers = torch.randn(4, 5, 3, generator=generator)
    normals = [torch.distributions.Normal(numbers[k], numbers[k + 1].exp()) for k in (0, 2)]
    expected = torch.distributions.kl_divergence(*normals).sum(dim=-1)
    found = gaussian_divergences((numbers[0], numbers[1]), (numbers[2], numbers[3]))
    torch.testing.assert_close(found, expected)


@BOTH
def test_a_policy_is_not_away_from_its_teacher_at_the_beginning(tmp_path: Path, task: str):
    mine = learner("ppo", task, start_from=trained(tmp_path / "first.pt", "ppo", task))
    mine.begin_as_asked()
    observations = torch.randn(6, 4, generator=torch.Generator().manual_seed(0))
    masks = None if task == "bus14-R" else torch.tensor([[True, False, True]] * 6)
    said = mine.teacher.distribution(observations, masks)
    assert divergences(said, mine.network.distribution(observations, masks)).tolist() == [0.0] * 6
    before = {name: tensor.clone() for name, tensor in mine.teacher.state_dict().items()}
    first = mine.iterate()
    assert first["charts/teacher_coefficient"] == pytest.approx(1.0 - 32 / 192)
    assert 0.0 < first["losses/teacher_kl"] < 0.1
    assert_same(dict(mine.teacher.state_dict()), before)
    while not mine.finished:
        last = mine.iterate()
    assert last["charts/teacher_coefficient"] == 0.0
    assert "losses/teacher_kl" not in last


def test_a_strong_teacher_keeps_a_learner_near(tmp_path: Path):
    path = trained(tmp_path / "first.pt", "ppo")
    kept = {}
    for coefficient in (0.0, 100.0):
        mine = learner("ppo", "bus14-T0", start_from=path, teacher_coefficient=coefficient, teacher_fraction=1.0)
        for _ in range(6):
            mine.iterate()
        observations = torch.randn(50, 4, generator=torch.Generator().manual_seed(0))
        said = mine.teacher.distribution(observations, None)
        kept[coefficient] = divergences(said, mine.network.distribution(observations, None)).mean().item()
    assert kept[100.0] < 0.2 * kept[0.0]


@BOTH
def test_sac_stays_near_its_teacher_and_waits_for_its_critics(tmp_path: Path, task: str):
    path = trained(tmp_path / "first.pt", "sac", task)
    mine = learner("sac", task, start_from=path, actor_starts=100, learning_starts=10)
    mine.begin_as_asked()
    before = {name: tensor.clone() for name, tensor in mine.actor.state_dict().items()}
    seen = [mine.iterate() for _ in range(3)]
    assert_same(dict(mine.actor.state_dict()), before)  # 96 decisions
    assert "losses/qf_loss" in seen[-1]
    assert "losses/teacher_kl" not in seen[-1]
    metrics = mine.iterate()
    assert not torch.equal(next(iter(before.values())), next(iter(mine.actor.state_dict().values())))
    assert 0.0 <= metrics["losses/teacher_kl"] < 0.1
    assert metrics["charts/teacher_coefficient"] == pytest.approx(1.0 - 128 / 192)


def test_ppo_may_wait_for_its_critic(tmp_path: Path):
    mine = learner("ppo", "bus14-T0", start_from=trained(tmp_path / "first.pt", "ppo"), actor_starts=64)
    mine.begin_as_asked()
    before = {name: tensor.clone() for name, tensor in mine.network.state_dict().items()}
    mine.iterate()
    mine.iterate()
    after = mine.network.state_dict()
    assert {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])} == {"critic"}
    mine.iterate()
    assert not torch.equal(before["actor.0.weight"], mine.network.state_dict()["actor.0.weight"])


def test_the_weight_of_a_teacher_falls_to_zero():
    args = replace(SMALL, teacher_coefficient=2.0, teacher_fraction=0.25)
    assert isinstance(args, TeacherArgs)
    assert [args.teacher_coefficient_at(decisions) for decisions in (0, 48, 96, 384)] == [2.0, 1.0, 0.0, 0.0]
    assert replace(args, teacher_fraction=0.0).teacher_coefficient_at(0) == 0.0
    with pytest.raises(UsageError, match="needs teacher_fraction between 0 and 1"):
        replace(SMALL, teacher_fraction=2.0)
    with pytest.raises(UsageError, match="needs teacher_coefficient of at least 0"):
        replace(SMALL, teacher_coefficient=-1.0)


def test_a_policy_that_would_never_be_changed_is_refused():
    with pytest.raises(UsageError, match="the policy would never be changed"):
        replace(SMALL, actor_starts=SMALL.total_timesteps)


# --- Runs -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_a_run_goes_on_when_what_it_began_with_is_gone(tmp_path: Path, algorithm: str):
    first = train(toy_run(tmp_path / "first", algorithm, "bus14-T0"), evaluate=falling, make_envs=toy_envs)
    asked = toy_run(tmp_path / "straight", algorithm, "bus14-T0", start_from=str(first))
    straight = train(asked, evaluate=falling, make_envs=toy_envs)
    run = replace(asked, folder=tmp_path / "run")
    folder = train(run, evaluate=falling, limit=TimeLimit(1e-9), make_envs=toy_envs)
    begun = train(replace(asked, folder=tmp_path / "begun"), limit=TimeLimit(1e-9), make_envs=toy_envs)
    _only_begun(begun)
    shutil.rmtree(first)
    for each in (folder, begun):
        resume(each, evaluate=falling, make_envs=toy_envs)
        assert is_finished(each)
        assert_same(*(load_checkpoint(one / "checkpoint.pt")["training"] for one in (each, straight)))
    assert_same_run(folder, straight)
    start = load_checkpoint(folder / "best.pt")["identity"]["start"]
    assert (start["path"], start["algorithm"], start["decisions"]) == (str(first), algorithm, 96)
    assert "charts/teacher_coefficient" in set(table(folder)["name"])
    settings = read_training_run(folder).settings
    assert settings["started from"] == algorithm
    assert "start_from" not in settings


def _only_begun(folder: Path) -> None:
    """Make a run one of which nothing but the beginning was written."""
    contents = load_checkpoint(folder / "checkpoint.pt")
    progress = {**contents["run"], "best_score": None, "wall_time": 0.0}
    begun_with = contents["training"]["start"]
    kept = {name: value for name, value in contents.items() if name not in ("training", "policy")}
    save_checkpoint(folder / "checkpoint.pt", {**kept, "decisions": 0, "run": progress, "start": begun_with})
    (folder / "metrics.csv").unlink()


def test_the_checkpoint_of_the_beginning_has_the_policy_that_it_begins_with(tmp_path: Path):
    first = train(toy_run(tmp_path / "first", "ppo", "bus14-T0"), make_envs=toy_envs)

    def end(args: Any) -> Any:
        envs = toy_envs(args)
        envs.step = lambda actions: 1 / 0  # type: ignore[method-assign]
        return envs

    with pytest.raises(ZeroDivisionError):
        train(toy_run(tmp_path / "run", "ppo", "bus14-T0", start_from=str(first)), make_envs=end)
    shutil.rmtree(first)
    assert is_finished(resume(tmp_path / "run", make_envs=toy_envs))


# --- Refusals -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("algorithm", "changes", "message"),
    [
        ("ppo", {"actor_layers": (9,)}, "cannot be begun with: its actor_layers are 8: set them to the same"),
        ("ppo", {"normalize_observations": False}, "normalize_observations is True there: set it to the same"),
        ("sac", {}, "SAC goes on with those of sac, or imitation with policy sac"),
        ("dqn", {"layers": (8,)}, "DQN has values and no policy, and goes on with those of dqn alone"),
    ],
)
def test_a_policy_that_does_not_fit_is_refused(tmp_path: Path, algorithm: str, changes: dict[str, Any], message: str):
    path = trained(tmp_path / "first.pt", "ppo")
    mine = learner(algorithm, "bus14-T0", **changes, start_from=path)
    with pytest.raises(UsageError, match=message):
        mine.begin_as_asked()
    assert mine.identity() == {}


def test_what_is_of_another_task_or_plays_otherwise_is_refused(tmp_path: Path):
    path = trained(tmp_path / "first.pt", "ppo")
    start = read_starting_policy(path)
    mine = learner("ppo", "bus14-R")
    with pytest.raises(UsageError, match="it has continuous=False actions, here are continuous=True actions"):
        mine.begin_with(start)
    mine = learner("ppo", "bus14-T0")
    mine.options = NothingToPlay("bus14-T0").options
    with pytest.raises(UsageError, match="it was learned with heuristic idle, not None: train with the former"):
        mine.begin_with(start)
    with pytest.raises(UsageError, match="does not exist"):
        learner("ppo", "bus14-T0", start_from=str(tmp_path / "nothing")).begin_as_asked()


def test_td3_begins_with_nothing_else(tmp_path: Path):
    path = trained(tmp_path / "first.pt", "td3", "bus14-R")
    with pytest.raises(UsageError, match="TD3 cannot begin with the policy of another run: leave start_from out"):
        learner("td3", "bus14-R", start_from=path).begin_as_asked()


def test_a_request_with_a_policy_that_does_not_fit_leaves_nothing(tmp_path: Path):
    path = trained(tmp_path / "first.pt", "ppo")
    args = hyperparameters("sac", "bus14-T0", **SIZES, **LAYERS["sac"], start_from=path)
    asked = request(tmp_path / "run", algorithm="sac", hyperparameters=args)
    with pytest.raises(UsageError, match="SAC goes on with"):
        train(asked, make_envs=toy_envs)
    assert not (tmp_path / "run").exists()
