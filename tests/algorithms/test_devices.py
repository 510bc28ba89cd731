"""Which device is taken, and networks on another one than the environments, where there is no GPU.

Networks are put on PyTorch's device ``meta``. It knows shapes and no numbers, but refuses to compute with tensors of
two devices, as a GPU does. What comes back from it is made up: ones, zeros and "no". Tests with a GPU are in the
algorithms' own files.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import test_imitation
import test_lagrangian_ppo
import test_off_policy
import test_ppo
import test_starting
import torch
import toy_grid
from labelled_toys import write
from torch import Tensor
from torch.fx.experimental import _config as shapes

from rl2grid.algorithms import trainer
from rl2grid.algorithms.devices import find_device
from rl2grid.errors import UsageError

TRAINERS: dict[str, Callable[[], Any]] = {
    **{kind: partial(test_off_policy.trainer, kind) for kind in test_off_policy.MADE},
    "dqn-dueling": partial(test_off_policy.trainer, "dqn", networks=2, head="dueling"),
    "ppo-discrete": test_ppo.trainer,
    "ppo-continuous": partial(test_ppo.trainer, continuous=True),
    "lagrangian-ppo-discrete": test_lagrangian_ppo.trainer,
    "lagrangian-ppo-continuous": partial(test_lagrangian_ppo.trainer, continuous=True),
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
    monkeypatch.setattr(trainer, "find_device", lambda name: torch.device("meta"))
    monkeypatch.setattr(toy_grid.Row, "mask", lambda self: np.ones(toy_grid.N_ACTIONS, np.bool_))
    with shapes.patch(meta_nonzero_assume_all_nonzero=True):
        yield


@pytest.mark.usefixtures("on_meta")
@pytest.mark.parametrize("name", TRAINERS)
def test_tensors_of_two_devices_never_meet(name: str):
    learner = TRAINERS[name]()
    learned = 0
    while not learner.finished and learned < 2:  # the second time with what the first has changed
        learned += any(key.startswith("losses/") for key in learner.iterate())
    assert learned, "nothing was learned"
    assert {parameter.device.type for parameter in parameters(learner)} == {"meta"}


@pytest.mark.usefixtures("on_meta")
@pytest.mark.parametrize(("task", "policy"), [("bus14-T0", "ppo"), ("bus14-R", "ppo"), ("bus14-H0", "sac")])
def test_tensors_of_two_devices_never_meet_in_imitation(tmp_path: Path, task: str, policy: str):
    folder = write(tmp_path / "labels", task, months=3, n=5)
    learner = test_imitation.learner(folder, task, policy=policy, num_steps=20, batch_size=8, total_timesteps=40)
    while not learner.finished:
        assert "losses/holdout_loss" in learner.iterate()
    assert {parameter.device.type for parameter in parameters(learner)} == {"meta"}


@pytest.mark.filterwarnings("ignore:for .* copying from a non-meta parameter")
@pytest.mark.parametrize(("algorithm", "task"), [("ppo", "bus14-T0"), ("ppo", "bus14-R"), ("sac", "bus14-T0")])
def test_tensors_of_two_devices_never_meet_near_a_teacher(
    tmp_path: Path, request: pytest.FixtureRequest, algorithm: str, task: str
):
    path = test_starting.trained(tmp_path / "first.pt", algorithm, task)
    request.getfixturevalue("on_meta")
    learner = test_starting.learner(algorithm, task, start_from=path, actor_starts=0)
    learned: set[str] = set()
    while not learner.finished and "losses/teacher_kl" not in learned:
        learned |= learner.iterate().keys()
    assert "losses/teacher_kl" in learned


def parameters(learner: Any) -> list[Tensor]:
    return list(learner.policy()[0].parameters())


def test_a_gpu_is_taken_if_there_is_one_and_refused_if_not(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("CUBLAS_WORKSPACE_CONFIG", raising=False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert find_device("auto").type == find_device("cpu").type == "cpu"
    with pytest.raises(UsageError, match="finds no CUDA device here: set device to cpu or auto"):
        find_device("cuda")
    assert "CUBLAS_WORKSPACE_CONFIG" not in os.environ
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert find_device("cpu").type == "cpu"
    for name in ("auto", "cuda"):
        monkeypatch.delenv("CUBLAS_WORKSPACE_CONFIG", raising=False)
        assert find_device(name).type == "cuda"
        assert os.environ["CUBLAS_WORKSPACE_CONFIG"] == ":4096:8"  # what deterministic cuBLAS asks for
