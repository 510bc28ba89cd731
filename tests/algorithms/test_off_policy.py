"""What DQN, SAC and TD3 share: what they remember, when they learn, and that nothing depends on interruptions."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from specs import networks
from toy_grid import SingleToyGrid, ToyGrid

from rl2grid.agents.agent import Agent
from rl2grid.algorithms import dqn, sac, td3
from rl2grid.algorithms.checkpoint import load_checkpoint, save_checkpoint
from rl2grid.algorithms.descent import Adam
from rl2grid.algorithms.networks import PER_ACTION
from rl2grid.algorithms.off_policy import OffPolicyTrainer, follow, held, random_legal_actions
from rl2grid.algorithms.policy_agent import PolicyAgent, load_agent
from rl2grid.algorithms.replay import ReplayMemory
from rl2grid.errors import UsageError

SIZES: dict[str, Any] = {
    "seed": 3,
    "total_timesteps": 4 * 16 * 6,
    "num_envs": 4,
    "num_steps": 16,
    "learning_starts": 40,
    "batch_size": 16,
    "gamma": 0.9,
}
SMALL_LAYERS: dict[str, Any] = {"actor_layers": (8,), "critic_layers": (8,)}
MADE: dict[str, tuple[Any, Any, bool]] = {
    "dqn": (dqn.DQN, dqn.Args(**SIZES, layers=(8,), target_frequency=50), False),
    "sac-discrete": (sac.SAC, sac.Args(**SIZES, **SMALL_LAYERS, policy_frequency=2), False),
    "sac-continuous": (sac.SAC, sac.Args(**SIZES, **SMALL_LAYERS, mask_actions=False), True),
    "td3": (td3.TD3, td3.Args(**SIZES, **SMALL_LAYERS), True),
}
ALL = pytest.mark.parametrize("kind", MADE)
TASKS = {False: "rl2grid/bus14-T0-v0", True: "rl2grid/bus14-R-v0"}


class Recording(ToyGrid):
    """Keeps every step, as it was asked for and answered."""

    def __init__(self, num_envs: int, **keywords: Any) -> None:
        super().__init__(num_envs, **keywords)
        self.actions: list[Any] = []
        self.masks: list[Any] = []
        self.answers: list[Any] = []

    def step(self, actions: Any) -> Any:
        self.actions.append(actions.copy())
        self.masks.append(self.action_masks())
        self.answers.append(super().step(actions))
        return self.answers[-1]


def trainer(kind: str, envs: Any = None, **changes: Any) -> Any:
    made, args, continuous = MADE[kind]
    args = replace(args, **changes)
    return made(args, envs or Recording(args.num_envs, continuous=continuous))


def learned(one: OffPolicyTrainer) -> dict[str, Any]:
    return {name: part.state_dict() for name, part in one.learned().items()}


def assert_same(mine: Any, theirs: Any, where: str = "") -> None:
    if isinstance(mine, dict):
        assert mine.keys() == theirs.keys(), where
        for key in mine:
            assert_same(mine[key], theirs[key], f"{where}/{key}")
    elif isinstance(mine, list | tuple):
        for k, (one, other) in enumerate(zip(mine, theirs, strict=True)):
            assert_same(one, other, f"{where}/{k}")
    elif isinstance(mine, torch.Tensor):
        assert torch.equal(mine, theirs), where
    else:
        assert mine == theirs, where


# --- What is remembered ---------------------------------------------------------------------------------------------


@ALL
def test_transitions_are_those_that_the_environment_played(kind: str):
    """Rewards of all grid steps, gamma to the power of their number, nothing behind a game over."""
    one = trainer(kind, learning_starts=10**6, num_steps=90, total_timesteps=360, normalize_observations=False)
    one.iterate()
    envs = one.envs
    batch = one.memory.draw(3000)
    counts = {"terminated": 0, "truncated": 0, "running": 0, "several": 0}
    observations = [envs.reset(seed=12)[0], *(answer[0] for answer in envs.answers)]
    index = {observation.tobytes(): (k, i) for k, row in enumerate(observations) for i, observation in enumerate(row)}
    for m in range(3000):
        k, i = index[batch.observations[m].tobytes()]
        shown, _, terminated, truncated, infos = envs.answers[k]
        info = infos["final_info"] if terminated[i] or truncated[i] else infos
        assert batch.rewards[m] == pytest.approx(0.1 * float(info["discounted_reward"][i]), rel=1e-6)
        n_steps = int(info["n_steps"][i])
        counts["several"] += n_steps > 1
        np.testing.assert_allclose(batch.actions[m], envs.actions[k][i])
        if terminated[i]:
            counts["terminated"] += 1
            assert batch.discounts[m] == 0.0
            continue
        counts["truncated" if truncated[i] else "running"] += 1
        assert batch.discounts[m] == pytest.approx(0.9**n_steps, rel=1e-6)
        np.testing.assert_array_equal(batch.next_observations[m], infos["final_obs"][i] if truncated[i] else shown[i])
        if batch.masks is not None:
            np.testing.assert_array_equal(batch.masks[m], envs.masks[k][i])
            following = envs.masks[k] if truncated[i] else envs.masks[k + 1]
            np.testing.assert_array_equal(batch.next_masks[m], following[i])
    assert min(counts.values()) > 20


@ALL
def test_an_episode_both_completed_and_lost_is_lost(kind: str):
    class Both(ToyGrid):
        def step(self, actions: Any) -> Any:
            observations, rewards, terminated, truncated, infos = super().step(actions)
            return observations, rewards, terminated, truncated | terminated, infos

    one = trainer(kind, Both(4, continuous=MADE[kind][2]))
    one.iterate()
    records = np.concatenate([segment.data for segment in one.memory._segments.values()])[: one.memory.rows]
    assert (records["ended"] & (records["discount"] == 0.0)).any()


@ALL
def test_transitions_that_no_decision_began_are_never_drawn(kind: str):
    one = trainer(kind, learning_starts=10**6, num_steps=90, total_timesteps=360, normalize_observations=False)
    one.iterate()
    played_over = [answer[4]["over"] for answer in one.envs.answers[:88]]
    over = np.stack([one.envs.reset(seed=12)[1]["over"], *played_over])  # before rows 0 to 88; 89 waits
    assert over.any()
    assert len(one.memory) == (~over).sum()
    # An episode that ended inside reset shows a point far outside.
    assert (np.abs(one.memory.draw(3000).observations[:, 0]) <= 1.5).all()


@ALL
def test_observations_are_scaled_by_the_statistics_of_the_moment_of_use(kind: str):
    one = trainer(kind, learning_starts=10**6)
    one.iterate()
    one.iterate()
    assert one.normalizer.count == 4 * (2 * 16 + 1)
    drawn = one.memory.draw(16)
    one.memory.batches -= 1
    batch = one.minibatch()
    for used, given in (
        (batch.observations, drawn.observations),
        (batch.next_observations, drawn.next_observations),
    ):  # scaled in float32, where the normaliser computes in float64
        np.testing.assert_allclose(used, one.normalizer.normalize(given), rtol=1e-5, atol=1e-6)


def test_steps_without_their_discounted_reward_are_refused():
    with pytest.raises(UsageError, match=r"make it with gamma=0\.9\."):
        trainer("dqn", ToyGrid(4, gamma=None)).iterate()


@ALL
def test_the_reward_scale_is_one_minus_gamma_or_what_is_asked_for(kind: str):
    rewards = []
    for scale in (None, 1.0):
        one = trainer(kind, learning_starts=10**6, reward_scale=scale)
        one.iterate()
        rewards.append(one.memory.draw(50).rewards)
    np.testing.assert_allclose(rewards[0], 0.1 * rewards[1], rtol=1e-6)


# --- What is played -------------------------------------------------------------------------------------------------


@ALL
def test_actions_are_legal_and_within_bounds(kind: str):
    """The toy grid refuses others; here it is seen that all legal ones are tried, ended by no rounding."""
    one = trainer(kind, total_timesteps=4 * 16 * 6)
    while not one.finished:
        one.iterate()
    actions = np.stack(one.envs.actions)
    if one.continuous:
        assert actions.dtype == np.float32
        assert np.abs(actions).max() <= 1.0
        assert len(np.unique(actions)) > 200
    else:
        masks = np.stack(one.envs.masks)
        assert np.take_along_axis(masks, actions[..., None], -1).all()
        assert set(np.unique(actions)) == {0, 1, 2}


def test_random_actions_are_uniform_among_the_legal_ones():
    generator = torch.Generator().manual_seed(0)
    masks = torch.tensor([[True, False, True, True]]).expand(30_000, 4)
    shares = random_legal_actions(30_000, 4, masks, generator).bincount(minlength=4) / 30_000
    np.testing.assert_allclose(shares, [1 / 3, 0, 1 / 3, 1 / 3], atol=0.012)
    shares = random_legal_actions(30_000, 4, masks, generator, do_nothing=0.4).bincount(minlength=4) / 30_000
    np.testing.assert_allclose(shares, [0.6, 0, 0.2, 0.2], atol=0.012)
    shares = random_legal_actions(30_000, 4, None, generator).bincount(minlength=4) / 30_000
    np.testing.assert_allclose(shares, np.full(4, 0.25), atol=0.012)


# --- When it learns -------------------------------------------------------------------------------------------------


@ALL
@pytest.mark.parametrize(("frequency", "starts"), [(1, 40), (3, 40), (4, 0), (10, 100)])
def test_updates_are_counted_in_decisions(kind: str, frequency: int, starts: int):
    one = trainer(kind, train_frequency=frequency, learning_starts=starts)
    for k in range(1, 4):
        assert one.iterate()["charts/updates"] == max(0, 64 * k - starts) // frequency
        assert one.decisions == 64 * k


@ALL
def test_step_sizes_fall_linearly_to_the_share_asked_for(kind: str):
    steady, falling = trainer(kind), trainer(kind, last_learning_rate_share=0.2)
    for iteration in range(falling.num_iterations):
        falling.iterate()
        share = 1.0 - 0.8 * 64 * iteration / falling.args.total_timesteps
        assert step_sizes(falling) == pytest.approx([share * size for size in step_sizes(steady)])


def step_sizes(one: OffPolicyTrainer) -> list[float]:
    """Of all optimisers."""
    learned = one.learned().values()
    return [part.param_groups[0]["lr"] for part in learned if isinstance(part, torch.optim.Optimizer)]


@ALL
def test_the_budget_is_never_exceeded(kind: str):
    one = trainer(kind, total_timesteps=4 * 16 * 3 - 1)
    while not one.finished:
        one.iterate()
    assert one.decisions == 4 * 16 * 2
    assert len(one.envs.actions) == 16 * 2


@ALL
def test_all_layers_are_trained_saved_and_followed(kind: str, tmp_path: Path):
    """No layer may be hidden from the optimiser, the checkpoint or the slow copy."""
    one = trainer(kind, tau=1.0) if kind != "dqn" else trainer(kind, target_frequency=4)
    one.iterate()
    before = {name: part.state_dict() for name, part in one.learned().items() if isinstance(part, torch.nn.Module)}
    before = {name: {key: value.clone() for key, value in state.items()} for name, state in before.items()}
    one.iterate()
    for name, state in before.items():
        after = one.learned()[name].state_dict()
        if name != "temperature":
            assert len(state) >= 4  # weights and biases of a hidden and an output layer
        for key in state:
            assert not torch.equal(state[key], after[key]), f"{name}.{key}"
    pairs = {"dqn": [("network", "target")], "td3": [("actor", "slow_actor"), ("critics", "slow_critics")]}
    for online, slow in pairs.get(kind, [("critics", "slow")]):
        assert_same(one.learned()[online].state_dict(), one.learned()[slow].state_dict())
    save_checkpoint(tmp_path / "c.pt", {"task": "t", "policy": one.policy_state()})
    load = {"dqn": dqn.load_policy, "td3": td3.load_policy}.get(kind, sac.load_policy)
    loaded = load(load_checkpoint(tmp_path / "c.pt")["policy"])
    assert_same(dict(loaded.state_dict()), dict(one.policy()[0].state_dict()))


def test_slow_copies_move_by_tau():
    made = networks(3, 2)
    online, target = (made.make(PER_ACTION, (4,)) for _ in range(2))
    expected = [
        0.9 * mine + 0.1 * theirs for mine, theirs in zip(target.parameters(), online.parameters(), strict=True)
    ]
    follow(target, online, 0.1)
    for mine, theirs in zip(target.parameters(), expected, strict=True):
        torch.testing.assert_close(mine.detach(), theirs.detach())


def test_networks_are_relu_networks_that_begin_like_those_of_torch():
    network = networks(400, 5).make(PER_ACTION, (300, 200))
    kinds = [type(module).__name__ for module in network]
    assert kinds == ["Linear", "ReLU", "Linear", "ReLU", "Linear"]
    theirs = torch.nn.Linear(400, 300)
    for mine, reference in zip(network[0].parameters(), theirs.parameters(), strict=True):
        assert float(mine.detach().abs().max()) <= 0.05
        assert float(mine.detach().std()) == pytest.approx(float(reference.detach().std()), rel=0.15)


@ALL
def test_gradients_are_scaled_down_to_the_norm_asked_for(kind: str, monkeypatch: pytest.MonkeyPatch):
    norms = []
    step = Adam.step

    def spy(optimizer: Adam) -> Any:
        for group in optimizer.param_groups:
            norms.append(float(torch.stack([p.grad.norm() for p in group["params"] if p.grad is not None]).norm()))
        return step(optimizer)

    monkeypatch.setattr(Adam, "step", spy)
    trainer(kind, max_grad_norm=1e-4).iterate()
    assert norms
    assert max(norms) <= 1e-4 * (1 + 1e-3)


# --- Reproducibility ------------------------------------------------------------------------------------------------


@ALL
def test_the_same_seed_gives_the_same_weights_whatever_the_global_random_state(kind: str):
    results = []
    for noise in (0, 1):
        torch.manual_seed(noise)
        np.random.seed(noise)  # noqa: NPY002 - the global state is what must not matter
        one = trainer(kind)
        before = torch.get_rng_state()
        metrics = [one.iterate() for _ in range(4)]
        assert torch.equal(torch.get_rng_state(), before)
        del metrics[-1]["charts/environment_share"]
        results.append((learned(one), metrics[-1]))
    assert_same(results[0], results[1])


@ALL
def test_another_seed_gives_other_weights_and_episodes(kind: str):
    one, other = trainer(kind), trainer(kind, seed=4)
    mine, theirs = one.policy()[0].state_dict(), other.policy()[0].state_dict()
    assert not any(torch.equal(mine[key], theirs[key]) for key in mine)
    one.iterate()
    other.iterate()
    assert not {row.seed for row in one.envs.rows} & {row.seed for row in other.envs.rows}


@ALL
@pytest.mark.parametrize("threads", [1, 2])
def test_with_a_lag_the_policy_that_plays_is_a_step_behind_whoever_is_faster(kind: str, threads: int):
    class Threaded(Recording):
        num_threads = threads

        def step(self, actions: Any) -> Any:
            time.sleep(0.001 * (len(self.actions) % 3))
            return super().step(actions)

    one, plain = trainer(kind, Threaded(4, continuous=MADE[kind][2]), lag=1), trainer(kind)
    seen: list[tuple[int, int]] = []
    explore = one.explore
    one.explore = lambda *given: (seen.append((one.decisions, one.updates)), explore(*given))[1]
    while not one.finished:
        one.iterate()
        plain.iterate()
    due = [max((decisions - 40) // 4, 0) for decisions, _ in seen]
    assert [updates for _, updates in seen] == [0, *due[:-1]]
    assert one.updates == plain.updates  # the last ones are made when nothing is played any more
    assert_same(learned(one), _learned_in_turn(kind))


@functools.cache
def _learned_in_turn(kind: str) -> dict[str, Any]:
    """What is learned with a lag where nothing happens at once."""
    one = trainer(kind, lag=1)
    while not one.finished:
        one.iterate()
    return learned(one)


@ALL
@pytest.mark.parametrize(("in_files", "lag"), [(False, 0), (True, 0), (True, 1)], ids=["state", "files", "lag"])
def test_a_resumed_run_ends_with_the_weights_of_one_that_was_not_interrupted(
    kind: str, in_files: bool, lag: int, tmp_path: Path
):
    changes = {"buffer_size": 150, "last_learning_rate_share": 0.1, "lag": lag}  # forgets on the way
    straight = trainer(kind, **changes)
    metrics = [straight.iterate() for _ in range(straight.num_iterations)][-1]
    for stop in (1, 4):
        begun = trainer(kind, **changes)
        if in_files:
            begun.store_in(tmp_path / f"replay{stop}")
        for _ in range(stop):
            begun.iterate()
        save_checkpoint(tmp_path / "c.pt", {"task": "t", "training": begun.state_dict()})
        if not begun.finished:
            begun.iterate()  # the process lived on after its checkpoint, and was killed then
        del begun
        resumed = trainer(kind, **changes)
        if in_files:
            resumed.store_in(tmp_path / f"replay{stop}")
        resumed.load_state_dict(load_checkpoint(tmp_path / "c.pt")["training"])
        while not resumed.finished:
            last = resumed.iterate()
        assert_same(learned(resumed), learned(straight))
        assert resumed.grid_steps == straight.grid_steps
        assert resumed.normalizer.normaliser_hash == straight.normalizer.normaliser_hash
        for name in metrics.keys() - {"charts/environment_share"}:
            assert metrics[name] == last[name], name


def test_a_run_is_not_resumed_in_other_environments():
    begun = trainer("dqn")
    begun.iterate()
    state = begun.state_dict()
    state["envs"]["rows"][0]["seed"] += 1
    with pytest.raises(UsageError, match="do not come back"):
        trainer("dqn").load_state_dict(state)


def test_a_finished_run_keeps_no_memory():
    one = trainer("dqn", total_timesteps=64)
    one.iterate()
    state = one.state_dict()
    assert state["memory"] is None
    trainer("dqn", total_timesteps=64).load_state_dict(state)


# --- Metrics --------------------------------------------------------------------------------------------------------


@ALL
def test_metrics_of_episodes_are_those_of_the_episodes(kind: str):
    one = trainer(kind)
    returns = np.zeros(4)
    for _ in range(6):
        begin = len(one.envs.answers)
        metrics = one.iterate()
        finished, survival = [], []
        n_steps = 0
        for _, rewards, terminated, truncated, infos in one.envs.answers[begin:]:
            returns += rewards
            ended = terminated | truncated
            for i in range(4):
                n_steps += int((infos["final_info"] if ended[i] else infos)["n_steps"][i])
            for i in np.flatnonzero(ended):
                finished.append(returns[i])
                survival.append(infos["final_info"]["survival"][i])
                returns[i] = 0.0
        assert metrics["charts/episodes"] == len(finished)
        assert metrics["charts/n_steps_per_decision"] == n_steps / 64
        assert metrics["charts/episodic_return"] == pytest.approx(np.mean(finished))
        assert metrics["charts/survival"] == pytest.approx(np.mean(survival))
    assert all(math.isfinite(value) for value in metrics.values())
    assert {"losses/qf_loss", "losses/qf_values", "charts/updates", "charts/replay_transitions"} <= metrics.keys()
    assert one.decisions == 6 * 64


# --- Requests -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"num_envs": 0}, "num_envs of at least 1"),
        ({"train_frequency": 0}, "train_frequency of at least 1"),
        ({"batch_size": 0}, "batch_size of at least 1"),
        ({"learning_starts": -1}, "learning_starts of at least 0"),
        ({"gamma": math.nan}, "gamma between 0 and 1"),
        ({"gamma": 1.0}, "reward_scale"),
        ({"seed": -1}, "seed of at least 0"),
        ({"lag": 2}, "lag of 0 or 1, not 2"),
        ({"device": "gpu"}, "choose one of auto, cpu, cuda"),
        ({"total_timesteps": 63}, "at least num_envs . num_steps = 64, not 63"),
    ],
)
@ALL
def test_values_that_cannot_work_are_refused(kind: str, changes: dict[str, Any], sentence: str):
    with pytest.raises(UsageError, match=sentence):
        replace(MADE[kind][1], **changes)


@ALL
def test_environments_that_cannot_be_learned_are_refused(kind: str):
    continuous = MADE[kind][2]
    with pytest.raises(UsageError, match="was to play 4 environments, but was given 3"):
        trainer(kind, ToyGrid(3, continuous=continuous))
    other = ToyGrid(4, continuous=continuous)
    other.single_action_space = gymnasium.spaces.MultiDiscrete([2, 2])
    with pytest.raises(UsageError, match="not MultiDiscrete"):
        trainer(kind, other)
    late = ToyGrid(4, continuous=continuous)
    late.metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}
    with pytest.raises(UsageError, match="SAME_STEP"):
        trainer(kind, late)
    with pytest.raises(UsageError, match="Only discrete actions can be masked"):
        trainer(kind, ToyGrid(4, continuous=True), mask_actions=True)


def test_impossible_pairs_are_refused_early():
    with pytest.raises(UsageError, match="TD3 plays continuous actions"):
        td3.TD3(MADE["td3"][1], ToyGrid(4))
    with pytest.raises(UsageError, match="DQN chooses among discrete actions"):
        dqn.DQN(replace(MADE["dqn"][1], mask_actions=False), ToyGrid(4, continuous=True))
    for module, continuous in ((td3, False), (dqn, True)):
        for name in ("default", "paper"):
            with pytest.raises(UsageError, match="cannot"):
                module.preset(name, continuous=continuous)


def test_a_gpu_is_taken_if_there_is_one_and_refused_if_not(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert trainer("dqn", device="auto").device.type == "cpu"
    with pytest.raises(UsageError, match="finds no CUDA device"):
        trainer("dqn", device="cuda")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@ALL
def test_networks_learn_on_a_gpu(kind: str):
    on_gpu, on_cpu = trainer(kind, device="cuda"), trainer(kind)
    for _ in range(3):
        gpu_metrics, cpu_metrics = on_gpu.iterate(), on_cpu.iterate()
    assert next(on_gpu.policy()[0].parameters()).is_cuda
    assert math.isfinite(gpu_metrics["losses/qf_loss"])
    assert gpu_metrics["charts/updates"] == cpu_metrics["charts/updates"]


@pytest.mark.parametrize("module", [dqn, sac, td3])
def test_the_papers_grid_search_holds_the_papers_values(module: Any):
    args = module.preset("paper", continuous=module is td3)
    assert args.num_envs == 50
    assert args.learning_starts == 20_000
    assert args.max_grad_norm == 10.0
    assert args.gamma == 0.9
    assert args.batch_size == 128
    for name, values in module.SEARCH_SPACE.items():
        if (module, name) == (sac, "critic_learning_rate"):  # the table prints one of three values twice
            continue
        assert getattr(args, name) in values, name
    memory_bytes = 1700 * 4 * args.buffer_size
    assert memory_bytes < args.buffer_bytes


@pytest.mark.parametrize("kind", MADE)
def test_a_default_memory_on_the_largest_grid_takes_4_gb(kind: str):
    """A million transitions of its 2,125 features would take 8.6 GB, and twice that with both observations of each."""
    module, continuous = {"dqn": dqn, "td3": td3}.get(kind, sac), MADE[kind][2]
    args = module.preset("default", continuous=continuous)
    memory = ReplayMemory(
        num_envs=args.num_envs,
        observation_size=2125,
        action_dimensions=69 if continuous else None,
        masked_actions=50 if args.mask_actions else None,
        max_transitions=args.buffer_size,
        max_bytes=args.buffer_bytes,
        memory_bytes=0,
        seed=0,
    )
    assert memory.capacity * memory.record.itemsize <= 4 * 1024**3
    assert memory.capacity > 400_000


def test_unknown_presets_are_refused_and_presets_can_be_changed():
    for module, continuous in ((dqn, False), (sac, False), (sac, True), (td3, True)):
        assert module.preset("default", continuous=continuous, seed=9).seed == 9
        assert module.preset("default", continuous=continuous).mask_actions is not continuous
        with pytest.raises(UsageError, match="choose one of default, paper"):
            module.preset("papers", continuous=continuous)


# --- As agents ------------------------------------------------------------------------------------------------------


def contents(one: Any, kind: str) -> dict[str, Any]:
    return {
        "algorithm": kind.split("-")[0],
        "task": TASKS[one.continuous],
        "env_keywords": {"heuristic": "idle"},
        "identity": {"seed": 1},
        "decisions": one.decisions,
        "policy": one.policy_state(),
    }


def test_a_policy_of_another_version_is_refused(tmp_path: Path):
    one = trainer("dqn")
    stored = contents(one, "dqn")
    del stored["policy"]["networks"]
    save_checkpoint(tmp_path / "best.pt", stored)
    with pytest.raises(UsageError, match="lacks 'networks': another version of rl2grid wrote it"):
        load_agent(tmp_path)


def _expected(kind: str, one: Any) -> Callable[[torch.Tensor, torch.Tensor], Any]:
    """The deterministic policy, said differently."""

    def act(observation: torch.Tensor, mask: torch.Tensor) -> Any:
        if kind == "td3":
            return one.actor.network(observation).tanh()
        if kind == "sac-continuous":
            return one.actor.network(observation)[:2].tanh()
        policy = one.policy()[0]
        outputs = policy.networks[0](observation) if kind == "dqn" else policy.network(observation)
        legal = mask.nonzero().squeeze(-1)
        return int(legal[outputs[legal].argmax()])

    return act


@ALL
def test_a_checkpoint_plays_the_deterministic_policy(kind: str, tmp_path: Path):
    one = trainer(kind)
    for _ in range(3):
        one.iterate()
    save_checkpoint(tmp_path / "best.pt", contents(one, kind))
    agent = load_agent(tmp_path, TASKS[one.continuous])
    assert isinstance(agent, Agent)
    assert agent.identity["normaliser_hash"] == one.normalizer.normaliser_hash
    env = SingleToyGrid(TASKS[one.continuous])
    agent.bind(env)
    expected = _expected(kind, one)
    for position in np.linspace(-0.9, 0.9, 9):
        env._row.position = float(position)
        observation = env._row.observation()
        with torch.no_grad():
            aim = expected(torch.as_tensor(one.normalizer.normalize(observation)), torch.as_tensor(env.action_masks()))
        action = agent.act(observation, {})
        if one.continuous:
            np.testing.assert_allclose(action, aim, rtol=0, atol=1e-6)
            assert action.dtype == np.float32
        else:
            assert action == aim
        assert np.array_equal(agent.act(observation, {}), action)


@ALL
def test_an_agent_does_not_follow_the_training_that_goes_on(kind: str):
    one = trainer(kind)
    one.iterate()
    agent = PolicyAgent(contents(one, kind))
    weights = {key: value.clone() for key, value in agent._network.state_dict().items()}
    one.iterate()
    assert_same(dict(agent._network.state_dict()), weights)
    assert PolicyAgent(contents(one, kind)).identity["policy_hash"] != agent.identity["policy_hash"]


@pytest.mark.parametrize("kind", ["sac-discrete", "sac-continuous"])
def test_samples_are_drawn_on_request_from_the_stream_named(kind: str):
    one = trainer(kind)
    one.iterate()
    agent = PolicyAgent(contents(one, kind), deterministic=False)
    env = SingleToyGrid(TASKS[one.continuous])
    agent.bind(env)
    results = []
    for seed, episode in ((1, 2), (1, 2), (1, 3), (2, 2)):
        agent.seed_episode(seed, episode)
        results.append([np.asarray(agent.act(env._row.observation(), {})).tolist() for _ in range(30)])
    assert results[0] == results[1]
    assert results[0] != results[2]
    assert results[0] != results[3]


def test_what_is_held_has_no_gradient_and_lets_others_through():
    network = torch.nn.Linear(3, 2)
    inputs = torch.randn(4, 3, requires_grad=True)
    with held(network):
        outputs = network(inputs)
    outputs.sum().backward()  # type: ignore[no-untyped-call]
    assert network.weight.grad is None
    torch.testing.assert_close(inputs.grad, network.weight.detach().sum(dim=0).expand(4, 3))
    assert all(weight.requires_grad for weight in network.parameters())
