"""What saving, restoring and imagining an environment of the native engine costs, and how large a world is.

``python benchmarks/worlds.py`` writes ``benchmarks/results/worlds.json``: medians of many single calls, as a planner
makes them, from and into other rows in turn, so that nothing stays in the cache of the processor but what would.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numba

from rl2grid.engines.native.engine import NativeEngine
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.mdp.actions import DO_NOTHING
from rl2grid.scenarios.episodes import plan_episode

_ROWS = 8
"""Environments that are saved and restored in turn."""
_STEPS = 20
"""Played before anything is saved: flows are warm then."""


def measured(grid_id: str, calls: int) -> dict[str, Any]:
    """Bytes and microseconds of one grid."""
    grid = load_grid(grid_id)
    engine = NativeEngine(grid, _ROWS)
    for i in range(_ROWS):
        engine.reset(i, plan_episode(grid, "bundled", i, 0))
        for _ in range(_STEPS):
            engine.step(i, DO_NOTHING)
    worlds = [engine.save(i) for i in range(_ROWS)]

    def step(k: int) -> None:
        engine.step(k % _ROWS, DO_NOTHING)

    def restore(k: int) -> None:
        engine.restore(k % _ROWS, worlds[(k + 1) % _ROWS])

    return {
        "bytes": max(world.nbytes for world in worlds),
        "pickle_bytes": max(len(pickle.dumps(world)) for world in worlds),
        "imagined_bytes": engine.imagine(0, 0).nbytes,
        "save_us": median_us(lambda k: engine.save(k % _ROWS), calls),
        "restore_us": median_us(restore, calls),
        "imagine_us": median_us(lambda k: engine.imagine(k % _ROWS, k), calls // 10),
        "step_us": median_us(step, 20 * _ROWS),
    }


def median_us(call: Callable[[int], Any], calls: int) -> float:
    """Median time of single calls, in microseconds."""
    samples = []
    for k in range(calls):
        began = time.perf_counter()
        call(k)
        samples.append(1e6 * (time.perf_counter() - began))
    return round(statistics.median(samples), 2)


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", type=int, default=5000)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "worlds.json")
    options = parser.parse_args()
    result: dict[str, Any] = {
        "command": "python benchmarks/worlds.py",
        "python": platform.python_version(),
        "numba": numba.__version__,
        "processor": platform.processor() or platform.machine(),
    }
    for grid_id in GRID_IDS:
        result[grid_id] = measured(grid_id, options.calls)
        print(grid_id, result[grid_id])
    options.output.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
