"""What names the values of a series, whatever stores them."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

_HASHED = ("load_p", "load_q", "prod_p")


def hash_of_series(load_p: NDArray[Any], load_q: NDArray[Any], prod_p: NDArray[Any]) -> str:
    """SHA-256 of series as integers of 0.1 MW and 0.1 MVAr, which no floating-point unit has a say in.

    Args:
        load_p: demand, [row, load]: float32 in MW, or int16 in 0.1 MW.
        load_q: reactive demand, likewise.
        prod_p: scheduled generation, [row, gen], likewise.
    """
    digest = hashlib.sha256()
    for name, array in zip(_HASHED, (load_p, load_q, prod_p), strict=True):
        integers = array if array.dtype == np.int16 else np.rint(10 * array)
        digest.update(f"{name} {integers.shape}".encode())
        digest.update(np.ascontiguousarray(integers, "<i2").data)
    return digest.hexdigest()
