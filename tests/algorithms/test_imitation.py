"""Imitation: what is minimised against values computed by hand, and pupils that become like their teachers."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from labelled_toys import NothingToPlay, write
from sample_labels import write_made_up_labels

from rl2grid.algorithms.examples import Batch, factor_of_acting, held_out, weighted_statistics
from rl2grid.algorithms.imitation import (
    ALGORITHM,
    Args,
    Imitation,
    aims,
    cross_entropies,
    deviation_losses,
    gumbel_log_std,
    huber,
    load_policy,
    preset,
    said_by,
)
from rl2grid.algorithms.on_policy import ActorCritic
from rl2grid.algorithms.registry import find_algorithm
from rl2grid.algorithms.sac import CategoricalActor, GaussianActor
from rl2grid.envs.normalization import ObservationNormalizer
from rl2grid.envs.spec import task_spec
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError
from rl2grid.mdp.actions import continuous_layout
from rl2grid.records.labels import Labels

SMALL: dict[str, Any] = {
    "seed": 3,
    "total_timesteps": 40_000,
    "num_steps": 2_000,
    "batch_size": 100,
    "gamma": 0.99,
    "actor_learning_rate": 1e-2,
    "critic_learning_rate": 1e-2,
    "actor_layers": (16,),
    "critic_layers": (16,),
}


def learner(folder: str, task: str, **changes: Any) -> Imitation:
    args = Args(**{**SMALL, "labels": (folder,), "mask_actions": not find_task(task).injects, **changes})
    return Imitation(args, NothingToPlay(task))


def learned(imitation: Imitation) -> dict[str, float]:
    """The last metrics."""
    metrics: dict[str, float] = {}
    while not imitation.finished:
        metrics = imitation.iterate()
    return metrics


def of_largest_feature(labels: Labels) -> Labels:
    """The teacher's action is a function of what is observed: it is that of the largest of three features."""
    assert labels.masks is not None
    masks = labels.masks.copy()
    masks[:, :3] = True
    right = labels.observations[:, :3].argmax(axis=1).astype(np.int64)
    candidates = np.tile(right[:, None], (1, labels.candidates.shape[1]))
    return replace(labels, masks=masks, topology=right, candidates=candidates)


def of_two_features(labels: Labels) -> Labels:
    """The teacher moves the first control as one feature says, and no other."""
    assert labels.injection is not None
    injection = np.zeros_like(labels.injection)
    injection[:, 0] = np.tanh(labels.observations[:, 0])
    return replace(labels, injection=injection, returns=labels.observations[:, 1].astype(np.float64))


# --- Pupils ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", ["ppo", "sac"])
def test_a_teacher_whose_action_is_a_function_of_the_observation_is_imitated(tmp_path: Path, policy: str):
    folder = write(tmp_path / "labels", "bus14-T0", of_largest_feature, months=20)
    metrics = learned(learner(folder, "bus14-T0", policy=policy, total_timesteps=30_000))
    assert metrics["charts/agreement"] > 0.95
    assert metrics["charts/holdout_agreement"] > 0.9
    assert metrics["charts/holdout_agreement_acting"] > 0.9
    assert metrics["charts/epochs"] == pytest.approx(30_000 / (18 * 40))


def of_loads(labels: Labels) -> Labels:
    """The teacher wants the first unit where one feature says, many steps away, and asks for a whole ramp meanwhile."""
    spec = task_spec(find_task("bus14-R"))
    assert labels.injection is not None
    assert spec.grid is not None
    gens = continuous_layout(spec.grid).redispatch
    observations = labels.observations.copy()
    load = np.random.default_rng(int(1e6 * observations[0, 0] ** 2)).random(len(labels)).astype(np.float32)
    observations[:, spec.feature("load_p").begin] = load
    wanted = 0.4 * spec.grid.gen_pmax[gens[0]] * (load - 0.5)
    ramp = np.where(wanted > 0.0, spec.grid.gen_max_ramp_up[gens[0]], spec.grid.gen_max_ramp_down[gens[0]])
    aim = np.zeros_like(labels.injection)
    aim[:, 0] = wanted / ramp
    return replace(labels, observations=observations, injection=aim.clip(-1.0, 1.0), aim=aim)


def test_a_network_of_set_points_learns_where_units_should_be(tmp_path: Path):
    folder = write(tmp_path / "labels", "bus14-R", of_loads, months=20)
    changes = {"network": "set-point", "normalize_observations": False, "huber_delta": 1.0}
    imitation = learner(folder, "bus14-R", total_timesteps=30_000, **changes)
    learned(imitation)
    assert isinstance(imitation.network, ActorCritic)
    batch = next(imitation.aside.batches(1000))
    assert batch.aim is not None
    assert float(batch.aim[:, 0].abs().max()) > 3.0
    said = said_by(imitation.network, batch.observations)
    assert said.aim is not None
    error = (said.aim[:, 0] - batch.aim[:, 0]).abs().mean()
    assert float(error.detach()) < 0.15 * float(batch.aim[:, 0].abs().mean())
    assert float(said.outputs.detach().abs().max()) <= 1.0


@pytest.mark.parametrize("policy", ["ppo", "sac"])
def test_a_teacher_of_continuous_actions_is_imitated(tmp_path: Path, policy: str):
    folder = write(tmp_path / "labels", "bus14-R", of_two_features, months=20)
    imitation = learner(folder, "bus14-R", policy=policy, total_timesteps=30_000)
    metrics = learned(imitation)
    assert metrics["charts/holdout_agreement"] > 0.9
    network = imitation.network
    if isinstance(network, ActorCritic):
        low, high = imitation.args.log_std_range
        assert ((network.log_std >= low) & (network.log_std <= high)).all()
        assert metrics["charts/action_std"] < 0.15
        assert metrics["losses/explained_variance"] > 0.8


@pytest.mark.parametrize("policy", ["ppo", "sac"])
def test_a_teacher_of_joint_actions_is_imitated_within_the_box(tmp_path: Path, policy: str):
    def both(labels: Labels) -> Labels:
        return of_two_features(of_largest_feature(labels))

    folder = write(tmp_path / "labels", "bus14-H0", both, months=20)
    imitation = learner(folder, "bus14-H0", policy=policy, total_timesteps=30_000)
    metrics = learned(imitation)
    assert metrics["charts/agreement"] > 0.75
    batch = imitation.examples.rows(np.arange(200))
    entries = imitation.network.act(batch.observations, None, None).detach()
    assert (entries.abs() <= 1.0).float().mean() > 0.97
    played = entries.clamp(-1.0, 1.0)[:, : find_task("bus14-H0").n_topology_actions].argmax(dim=1)
    assert (played == batch.topology).float().mean() > 0.95


def test_a_critic_learns_the_scaled_returns(tmp_path: Path):
    def paying(labels: Labels) -> Labels:
        return replace(labels, returns=200.0 * (labels.observations[:, 0] > 0))

    imitation = learner(write(tmp_path / "labels", "bus14-T0", paying, months=20), "bus14-T0", total_timesteps=30_000)
    metrics = learned(imitation)
    batch = imitation.examples.rows(np.arange(300))
    assert isinstance(imitation.network, ActorCritic)
    assert float(batch.returns.max()) == pytest.approx(2.0)  # (1 - gamma) 200
    assert float((imitation.network.value(batch.observations).detach() - batch.returns).abs().mean()) < 0.3
    assert metrics["losses/explained_variance"] > 0.7


def test_networks_that_read_grids_imitate_as_well(tmp_path: Path):
    folder = write(tmp_path / "labels", "bus14-T0", of_largest_feature, months=2)
    for network in ("action-embedding", "gnn"):
        imitation = learner(
            folder, "bus14-T0", network=network, normalize_observations=False, num_steps=200, total_timesteps=400
        )
        first, second = imitation.iterate(), imitation.iterate()
        assert second["losses/imitation_loss"] < first["losses/imitation_loss"]
        assert load_policy(imitation.policy_state()).act(torch.zeros(1, imitation.observation_size), None, None) >= 0


# --- Resuming -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", ["bus14-T0", "bus14-R"])
def test_a_run_that_goes_on_is_the_same_bit_for_bit(tmp_path: Path, task: str):
    folder = write(tmp_path / "labels", task)
    straight, first = (learner(folder, task, total_timesteps=8_000) for _ in range(2))
    learned(straight)
    first.iterate()
    state = first.state_dict()
    again = learner(folder, task, total_timesteps=8_000)
    again.load_state_dict(state)
    learned(again)
    assert again.decisions == straight.decisions == 8_000
    for name, tensor in straight.network.state_dict().items():
        assert torch.equal(tensor, again.network.state_dict()[name]), name


def test_every_epoch_has_all_labels_once(tmp_path: Path):
    imitation = learner(write(tmp_path / "labels", "bus14-T0", months=3), "bus14-T0", holdout=0.0)
    seen = np.concatenate([imitation._next(50) for _ in range(12)])
    for epoch in range(5):
        np.testing.assert_array_equal(np.sort(seen[120 * epoch : 120 * (epoch + 1)]), np.arange(120))
    assert not np.array_equal(seen[:120], seen[120:240])


def test_policies_come_back_from_a_checkpoint(tmp_path: Path):
    cases = [("bus14-T0", "ppo", ActorCritic), ("bus14-T0", "sac", CategoricalActor), ("bus14-R", "sac", GaussianActor)]
    for task, policy, kind in cases:
        imitation = learner(write(tmp_path / f"{task}-{policy}", task, months=2), task, policy=policy)
        network = load_policy(imitation.policy_state())
        assert type(network) is kind
        for name, tensor in imitation.network.state_dict().items():
            assert torch.equal(tensor, network.state_dict()[name])


# --- What is minimised ----------------------------------------------------------------------------------------------


def batch(**changes: Any) -> Batch:
    """Two labels with three topology actions."""
    given = {
        "observations": torch.zeros(2, 1),
        "masks": torch.tensor([[True, True, False], [True, True, True]]),
        "topology": torch.tensor([1, 2]),
        "injection": None,
        "aim": None,
        "candidates": torch.tensor([[1, 0], [-1, -1]]),
        "values": torch.tensor([[0.3, 0.1], [0.0, 0.0]]),
        "stands_for": torch.ones(2),
        "weights": torch.ones(2),
        "acts": torch.ones(2, dtype=torch.bool),
        "returns": torch.zeros(2),
    }
    return Batch(**{**given, **changes})


def test_aims_mix_the_action_the_values_and_smoothing():
    args = Args(soft_share=0.5, soft_temperature=0.1, label_smoothing=0.1)
    aim = aims(batch(), batch().masks, 3, args)
    liked = math.exp(3.0) / (math.exp(3.0) + math.exp(1.0))
    first = [0.9 * 0.5 * (1 - liked) + 0.05, 0.9 * (0.5 + 0.5 * liked) + 0.05, 0.0]
    assert aim[0].tolist() == pytest.approx(first)
    assert aim[1].tolist() == pytest.approx([0.1 / 3, 0.1 / 3, 0.9 + 0.1 / 3])  # no values: the action has their share
    torch.testing.assert_close(aim.sum(dim=1), torch.ones(2))


def test_cross_entropies_are_those_of_the_legal_actions():
    logits = torch.tensor([[0.0, 1.0, 50.0], [0.0, 0.0, 2.0]])
    aim = torch.tensor([[0.25, 0.75, 0.0], [0.0, 0.0, 1.0]])
    first = -0.25 * math.log(1 / (1 + math.e)) - 0.75 * math.log(math.e / (1 + math.e))
    second = -math.log(math.exp(2.0) / (2 + math.exp(2.0)))
    losses = cross_entropies(logits, aim, batch().masks)
    assert losses.tolist() == pytest.approx([first, second], rel=1e-5)


def test_errors_of_continuous_actions_by_hand():
    errors = torch.tensor([[0.05, -0.3]])
    assert huber(errors, 0.1).item() == pytest.approx(0.5 * 0.05**2 + 0.1 * (0.3 - 0.05))
    log_stds = torch.tensor([-1.0, 0.5], requires_grad=True)
    loss = deviation_losses(torch.tensor([[0.2, -1.0]]), log_stds)
    assert loss.item() == pytest.approx(0.5 * (0.2 / math.exp(-1)) ** 2 - 1.0 + 0.5 * math.exp(-1.0) + 0.5)
    deviation_losses(torch.tensor([[0.2, math.exp(0.5)]]), log_stds).sum().backward()
    assert log_stds.grad is not None
    assert log_stds.grad[1].item() == pytest.approx(0.0, abs=1e-6)  # as wide as what it meets


def test_noise_on_joint_entries_draws_as_their_logits_say():
    entries = torch.tensor([0.3, 0.1, 0.0])
    noise = torch.randn(20_000, 3, generator=torch.Generator().manual_seed(0)) * math.exp(gumbel_log_std(Args()))
    shares = (entries + noise).argmax(dim=1).bincount(minlength=3) / 20_000
    torch.testing.assert_close(shares, (10 * entries).softmax(dim=0), rtol=0, atol=0.06)


def test_acting_counts_as_much_as_makes_it_a_quarter():
    weights, acts = np.array([9.0, 9.0, 2.0], np.float32), np.array([False, False, True])
    assert factor_of_acting(weights, acts, None) == pytest.approx(3.0)  # 6 of 24
    assert factor_of_acting(weights, ~acts, None) == 1.0
    assert factor_of_acting(weights, np.zeros(3, np.bool_), None) == 1.0
    assert factor_of_acting(np.array([1e6, 1.0], np.float32), np.array([False, True]), None) == 20.0
    assert factor_of_acting(weights, acts, 7.0) == 7.0


def test_weights_are_one_in_the_mean(tmp_path: Path):
    def thinned(labels: Labels) -> Labels:
        topology = np.zeros_like(labels.topology)
        topology[0] = labels.topology[0]  # type: ignore[index]
        return replace(labels, topology=topology, weights=np.full(len(labels), 3.0, np.float32))

    imitation = learner(write(tmp_path / "labels", "bus14-T0", thinned), "bus14-T0", acting_weight=5.0)
    rows = imitation.examples.rows(np.arange(len(imitation.examples)))
    assert float(rows.weights.mean()) == pytest.approx(1.0, rel=1e-5)
    if rows.acts.any():
        assert float(rows.weights[rows.acts][0] / rows.weights[~rows.acts][0]) == pytest.approx(5.0)


def test_statistics_count_an_observation_as_often_as_it_stands_for():
    observations = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    weights = np.arange(1, 51, dtype=np.float32)
    weighted, repeated = ObservationNormalizer(3), ObservationNormalizer(3)
    weighted.load_state_dict(weighted_statistics(observations, weights))
    repeated.update(np.repeat(observations, np.arange(1, 51), axis=0))
    assert weighted.count == repeated.count
    np.testing.assert_allclose(weighted.mean, repeated.mean, rtol=1e-9)
    np.testing.assert_allclose(weighted.variance, repeated.variance, rtol=1e-9)


def test_a_policy_with_a_shortlist_learns_of_the_actions_on_it(tmp_path: Path):
    folder = write(tmp_path / "labels", "bus14-T0", months=4)
    imitation = learner(folder, "bus14-T0", shortlist=10, total_timesteps=4_000)
    rows = imitation.examples.rows(np.arange(len(imitation.examples)))
    assert rows.masks is not None
    assert rows.topology is not None
    assert imitation.shortlisted is not None
    on_it = torch.as_tensor(imitation.shortlisted)
    assert not (rows.masks & ~on_it).any()
    assert ((rows.weights > 0) == on_it[rows.topology]).all()
    assert on_it[rows.candidates[rows.candidates >= 0]].all()
    metrics = learned(imitation)
    assert metrics["losses/imitation_loss"] < 10.0
    assert metrics["charts/agreement"] < 0.9  # what is not on it cannot be agreed with


# --- What is held out -----------------------------------------------------------------------------------------------


def test_held_out_months_do_not_depend_on_the_order_and_are_never_all():
    months = [f"generated/{k}" for k in range(20)]
    assert held_out(months, 0.1) == held_out([*months[::-1], *months], 0.1)
    assert len(held_out(months, 0.1)) == 2
    assert held_out(months, 0.0) == frozenset()
    assert len(held_out(months, 0.001)) == 1
    assert len(held_out(months, 0.99)) == 19
    assert held_out(["a"], 0.5) == frozenset()


def test_held_out_labels_are_not_learned_from(tmp_path: Path):
    imitation = learner(write(tmp_path / "labels", "bus14-T0"), "bus14-T0", holdout=0.3)
    assert (len(imitation.examples), len(imitation.aside)) == (7 * 40, 3 * 40)
    one = {tuple(row) for row in imitation.examples.rows(np.arange(280)).observations[:, :3].tolist()}
    other = {tuple(row) for row in imitation.aside.rows(np.arange(120)).observations[:, :3].tolist()}
    assert not one & other


# --- Refusals -------------------------------------------------------------------------------------------------------


def test_what_cannot_be_learned_from_is_refused(tmp_path: Path):
    folder = write(tmp_path / "labels", "bus14-T0", months=2, n=5)
    cases: list[tuple[dict[str, Any], dict[str, Any], str]] = [
        ({"labels": ()}, {}, "needs labels: give a folder that 'rl2grid teach' wrote"),
        ({"labels": (str(tmp_path),)}, {}, "holds no labels"),
        ({"gamma": 0.9}, {}, r"discounted by gamma=0\.99, not 0\.9: set gamma to the former"),
        ({}, {"heuristic": "idle"}, "of environments with heuristic=None, not idle"),
        ({}, {"normalize": None}, "of environments with normalize=physical, not None"),
        ({}, {"operator_features": "trips"}, "of environments with operator_features=None, not trips"),
    ]
    for changes, keywords, message in cases:
        args = replace(Args(**SMALL, labels=(folder,)), **changes)
        with pytest.raises(UsageError, match=message):
            Imitation(args, NothingToPlay("bus14-T0", **keywords))
    with pytest.raises(UsageError, match="holds labels of rl2grid/bus14-T0-v0, not of rl2grid/bus14-R-v0"):
        learner(folder, "bus14-R")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_envs": 4}, "plays no environments: leave num_envs at 1 instead of 4"),
        ({"policy": "dqn"}, "choose one of ppo, sac"),
        ({"holdout": 1.0}, "no month would be left"),
        ({"soft_temperature": 0.0}, "positive soft_temperature"),
        ({"log_std_range": (1.0, 0.0)}, "needs a log_std_range within -10 and 2"),
        ({"acting_weight": -1.0}, "positive acting_weight"),
    ],
)
def test_values_that_cannot_work_are_refused(changes: dict[str, Any], message: str):
    with pytest.raises(UsageError, match=message):
        preset("default", continuous=False, **changes)


def test_joint_tasks_are_learned_with_continuous_actions():
    assert find_algorithm("imitation") is ALGORITHM
    assert ALGORITHM.plays_continuous("H")
    assert not ALGORITHM.plays_continuous("T")
    assert not preset("default", continuous=True).mask_actions


def test_labels_in_months_of_one_scenario_are_all_learned_from(tmp_path: Path):
    write_made_up_labels(tmp_path / "labels", "bus14-T0")
    imitation = learner(str(tmp_path / "labels"), "bus14-T0")
    assert (len(imitation.examples), len(imitation.aside)) == (40, 0)
    assert "losses/holdout_loss" not in imitation.iterate()
