"""Rankings with made-up trials, read by the real loader from a folder of the test."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rl2grid.grids import load_grid, rankings


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
    monkeypatch.setattr(rankings, "resources", SimpleNamespace(files=lambda _: folder))
    # Fresh caches: those of the real rankings come back unharmed.
    for name in ("_load", "_load_trials"):
        monkeypatch.setattr(rankings, name, getattr(rankings, name).__wrapped__)
