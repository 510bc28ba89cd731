"""Numbers that tell how an update went."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor


def explained_variance(values: Tensor, returns: Tensor) -> float:
    """1 - Var(returns - values) / Var(returns): 1 is a perfect critic, 0 one no better than a constant.

    NaN where the returns are all the same.
    """
    variance = returns.var(correction=0)
    if variance == 0:
        return math.nan
    return float(1.0 - (returns - values).var(correction=0) / variance)


def mean(scalars: Iterable[Tensor]) -> float:
    """Mean of scalars, NaN if there are none."""
    values = list(scalars)
    return float(np.mean(torch.stack(values).tolist())) if values else math.nan
