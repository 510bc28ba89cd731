"""What vector environments return: kept from the buffers that later calls write to, and compared bit for bit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np


def copied(returned: Any) -> Any:
    """What a call returned, kept from the buffers that later calls write to; effects in words."""
    if isinstance(returned, dict):
        return {key: copied(value) for key, value in returned.items()}
    if isinstance(returned, tuple | list):
        return tuple(copied(item) for item in returned)
    if isinstance(returned, np.ndarray) and returned.dtype == object:
        return np.array([copied(item) for item in returned] + [None], object)[:-1]
    if isinstance(returned, np.ndarray):
        return returned.copy()
    if returned is None or isinstance(returned, int | float | str | np.generic):
        return returned
    return str(returned)


def assert_same(mine: Any, theirs: Any, where: str = "") -> None:
    """The same keys, types, shapes and values, bit for bit."""
    if isinstance(theirs, dict):
        assert set(mine) == set(theirs), where
        for key in theirs:
            assert_same(mine[key], theirs[key], f"{where}/{key}")
    elif isinstance(theirs, tuple):
        assert len(mine) == len(theirs), where
        for k, pair in enumerate(zip(mine, theirs, strict=True)):
            assert_same(*pair, f"{where}/{k}")
    elif isinstance(theirs, np.ndarray):
        assert mine.dtype == theirs.dtype, where
        assert mine.shape == theirs.shape, where
        if theirs.dtype == object:
            for k, pair in enumerate(zip(mine, theirs, strict=True)):
                assert_same(*pair, f"{where}/{k}")
        else:
            np.testing.assert_array_equal(mine, theirs, err_msg=where)
    else:
        assert mine == theirs, where


def put_together(infos: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Infos of single environments as Gymnasium's vector environments put them together; effects in words."""
    vector: Any = gymnasium.vector.VectorEnv()
    vector.num_envs = len(infos)
    together: dict[str, Any] = {}
    for i, info in enumerate(infos):
        vector._add_info(together, info, i)
    return copied(together)


def with_ending(begun: dict[str, Any], last_observation: Any, last_info: dict[str, Any]) -> dict[str, Any]:
    """Info of a single environment whose episode ended and whose next one began in the same step."""
    return begun | {"final_obs": last_observation, "final_info": last_info}
