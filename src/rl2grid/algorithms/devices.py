"""Where networks live."""

from __future__ import annotations

import os

import torch

from rl2grid.errors import UsageError


def find_device(name: str) -> torch.device:
    """The device called ``name`` (``auto``, ``cpu``, ``cuda``), set up so that PyTorch computes the same every time.

    Raises:
        UsageError: a GPU is asked for and PyTorch finds none.
    """
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise UsageError("PyTorch finds no CUDA device here: set device to cpu or auto.")
    if name == "cpu" or not available:
        return torch.device("cpu")
    # Without it, cuBLAS is refused by deterministic algorithms.
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    return torch.device("cuda")
