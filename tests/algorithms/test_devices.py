"""Devices: found by name, refused where there are none."""

from __future__ import annotations

import os

import pytest
import torch

from rl2grid.algorithms.devices import find_device
from rl2grid.errors import UsageError


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
