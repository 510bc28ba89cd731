"""Networks on another device than the environments, where there is no GPU.

They are put on PyTorch's device ``meta``. It knows shapes and no numbers, but refuses to compute with tensors of two
devices, as a GPU does. What comes back from it is made up: ones, zeros and "no". Tests with a GPU are in the
algorithms' own files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
import toy_grid
from test_lagrangian_ppo import SMALL as SMALL_LAGRANGIAN
from test_lagrangian_ppo import CostlyToyGrid
from torch import Tensor
from torch.fx.experimental import _config as shapes

from rl2grid.algorithms import dqn, lagrangian_ppo, off_policy, ppo, sac, td3

SIZES: dict[str, Any] = {"total_timesteps": 4 * 16 * 4, "num_envs": 4, "num_steps": 16}
OFF_POLICY: dict[str, Any] = {**SIZES, "learning_starts": 40, "batch_size": 16}
LAYERS: dict[str, Any] = {"actor_layers": (8,), "critic_layers": (8,)}


def discrete() -> toy_grid.ToyGrid:
    return toy_grid.ToyGrid(4)


def continuous() -> toy_grid.ToyGrid:
    return toy_grid.ToyGrid(4, continuous=True)


TRAINERS: dict[str, Callable[[], Any]] = {
    "dqn": lambda: dqn.DQN(dqn.Args(**OFF_POLICY, layers=(8,), networks=2, head="dueling"), discrete()),
    "sac-discrete": lambda: sac.SAC(sac.Args(**OFF_POLICY, **LAYERS), discrete()),
    "sac-continuous": lambda: sac.SAC(sac.Args(**OFF_POLICY, **LAYERS, mask_actions=False), continuous()),
    "td3": lambda: td3.TD3(td3.Args(**OFF_POLICY, **LAYERS), continuous()),
    "ppo-discrete": lambda: ppo.PPO(ppo.Args(**SIZES, **LAYERS), discrete()),
    "ppo-continuous": lambda: ppo.PPO(ppo.Args(**SIZES, **LAYERS, mask_actions=False), continuous()),
    "lagrangian-ppo": lambda: lagrangian_ppo.LagrangianPPO(SMALL_LAGRANGIAN, CostlyToyGrid(4)),
}


@pytest.fixture
def on_meta(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Networks live on ``meta``, and what is asked of their tensors has an answer."""

    def answer(name: str, made_up: Callable[[Tensor], Any]) -> None:
        real = getattr(Tensor, name)
        monkeypatch.setattr(Tensor, name, lambda self: made_up(self) if self.is_meta else real(self))

    def plain_adam(self: torch.optim.Adam, *arguments: Any, **keywords: Any) -> None:
        adam(self, *arguments, **{**keywords, "fused": False})

    adam = torch.optim.Adam.__init__
    monkeypatch.setattr(torch.optim.Adam, "__init__", plain_adam)
    answer("cpu", lambda tensor: torch.ones(tensor.shape, dtype=tensor.dtype))
    answer("item", lambda tensor: 0.0)
    answer("__float__", lambda tensor: 0.0)
    answer("__bool__", lambda tensor: False)
    answer("tolist", lambda tensor: torch.zeros(tensor.shape).tolist())
    for module in (off_policy, ppo, lagrangian_ppo):
        monkeypatch.setattr(module, "find_device", lambda name: torch.device("meta"))
    monkeypatch.setattr(toy_grid.Row, "mask", lambda self: np.ones(toy_grid.N_ACTIONS, np.bool_))
    with shapes.patch(meta_nonzero_assume_all_nonzero=True):
        yield


@pytest.mark.usefixtures("on_meta")
@pytest.mark.parametrize("name", TRAINERS)
def test_tensors_of_two_devices_never_meet(name: str):
    trainer = TRAINERS[name]()
    while not trainer.finished:
        metrics = trainer.iterate()
    assert any(key.startswith("losses/") for key in metrics), "nothing was learned"
    assert {parameter.device.type for parameter in parameters(trainer)} == {"meta"}


def parameters(trainer: Any) -> list[Tensor]:
    network = trainer.policy()[0] if isinstance(trainer, off_policy.OffPolicyTrainer) else trainer.network
    return list(network.parameters())
