"""What PyTorch computes for the algorithms is the same on processors of different makers."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from llvmlite.binding import get_host_cpu_features

COMPUTE = """
import hashlib
import numpy as np
import rl2grid.algorithms
import torch
torch.set_num_threads(1)
shares = np.arange(1, 70001, dtype=np.float64) * 0.6180339887498949 % 1.0
any_sign, positive = (torch.from_numpy(x.astype(np.float32)) for x in (shares * 8 - 4, shares * 4 + 1e-3))
product = any_sign[: 64 * 128].reshape(64, 128) @ positive[: 128 * 128].reshape(128, 128)
found = any_sign[:4096].exp(), positive[:4096].log(), any_sign[:4096].tanh(), product
print(*(hashlib.sha256(np.ascontiguousarray(each.numpy()).tobytes()).hexdigest()[:10] for each in found))
"""
AS_COMPUTED = ["a58f6c8cb8", "5152d8603b", "5507ac8659", "796a1a2441"]
"""Of exponentials, logarithms, hyperbolic tangents and a product, on an AMD (Zen 5) and an Intel (Emerald Rapids)."""


@pytest.mark.skipif(not get_host_cpu_features().get("avx2"), reason="the same bits are promised with AVX2")
def test_functions_and_products_of_pytorch_have_the_bits_that_two_makers_processors_gave():
    environment = {name: value for name, value in os.environ.items() if name not in ("MKL_CBWR", "ATEN_CPU_CAPABILITY")}
    output = subprocess.run([sys.executable, "-c", COMPUTE], env=environment, stdout=subprocess.PIPE, check=True).stdout
    assert output.decode().split() == AS_COMPUTED
