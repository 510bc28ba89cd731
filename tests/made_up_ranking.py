"""Rankings with made-up trials, read by the real loader from a folder of the test."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rl2grid.grids import find_system, load_grid, system_ids, systems
from rl2grid.grids.rankings import read_ranking


def made_up_arrays(grid_id: str, mean_trials: int = 400) -> dict[str, Any]:
    """All actions of a grid tried about equally often, with survival from 40% to 99%, ranked by it."""
    n_actions = load_grid(grid_id).level_sizes[-1]
    rng = np.random.default_rng(5)
    tried = rng.poisson(mean_trials, n_actions).astype(np.uint32)
    chance = rng.uniform(0.4, 0.99, n_actions)
    survived = rng.binomial(tried, chance).astype(np.uint32)
    margin = (0.5 * chance - 0.1).astype(np.float32)
    order = np.argsort(-(survived / tried), kind="stable").astype(np.int32)
    return {"ids": order[order > 0], "trials": tried, "survived": survived, "margin": margin}


def use_ranking(monkeypatch: pytest.MonkeyPatch, folder: Path, grid_id: str, arrays: dict[str, Any]) -> None:
    """Let the ranking of ``grid_id``, and no other, be what ``arrays`` say, until the test is over."""
    (folder / "data").mkdir(exist_ok=True)
    metadata = np.array(json.dumps({"version": "made-up"}))
    np.savez(folder / "data" / f"{grid_id}.ranking.npz", **arrays, metadata=metadata)
    made_up = read_ranking(grid_id, folder / "data" / f"{grid_id}.ranking.npz")
    for each in system_ids():
        system = replace(find_system(each), ranking=made_up if each == grid_id else None)
        monkeypatch.setitem(systems._SYSTEMS, each, system)
