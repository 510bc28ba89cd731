"""How large generated months are on disk, how fast they are opened, and which ones were published.

::

    python benchmarks/packs.py open [grid ...]      # into benchmarks/results/packs.json
    python benchmarks/packs.py manifest [grid ...]  # into src/rl2grid/scenarios/manifest.json

``open`` measures in a data folder of its own, with compiled code and file caches warm. ``manifest`` makes the months of
validation and test in the data folder of the machine, and publishes them under the present version of the generator.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from rl2grid.grids import GRID_IDS, Grid, load_grid
from rl2grid.scenarios import cache, generated, library
from rl2grid.scenarios.episodes import plan_episode
from rl2grid.scenarios.fingerprint import VERSION
from rl2grid.scenarios.generator.month import arrays_of
from rl2grid.scenarios.library import load_scenario
from rl2grid.scenarios.making import make_packs
from rl2grid.scenarios.month_names import MONTHS, month_name, parse_months
from rl2grid.scenarios.packs import read_raw
from rl2grid.scenarios.published import MANIFEST, held_out_months, listed_hashes
from rl2grid.scenarios.splits import SPLIT_VERSION

RESULTS = Path(__file__).parent / "results" / "packs.json"
SEED = 10_000
"""Of the year that is measured."""
MEGABYTES = {"bus14": 0.2, "bus36": 0.5, "bus118": 1.5}
"""A month takes no more than this."""
OPENING = 20.0
"""Milliseconds: opening a month that was expanded takes no more than this."""
REPEATS = 9
SETTLING = 2.5
"""Seconds after which a new copy, once hashed, is not hashed again."""


def measure(grid: Grid) -> dict[str, Any]:
    """Sizes in bytes, times in milliseconds: the median of :data:`REPEATS`."""
    list(make_packs(grid, [(SEED, month) for month in range(MONTHS)], workers=1))
    packs = [generated.pack_path(grid, SEED, month) for month in range(MONTHS)]
    name = f"generated/{month_name(SEED, 7)}"
    raw = read_raw(packs[7])
    first = milliseconds(lambda: open_new(grid, name), expand_again)
    time.sleep(SETTLING)
    hashing = once(lambda: open_new(grid, name))
    opening = milliseconds(lambda: open_new(grid, name))
    plan_episode(grid, "train", 0, 0)
    sizes = [pack.stat().st_size for pack in packs]
    limit = next(limit for prefix, limit in MEGABYTES.items() if grid.id.startswith(prefix))
    return {
        "pack_bytes_mean": round(float(np.mean(sizes))),
        "pack_bytes_max": max(sizes),
        "pack_is_small": max(sizes) <= 1e6 * limit,
        "expanded_bytes": sum(path.stat().st_size for path in copies()),
        "read_pack_ms": milliseconds(lambda: read_raw(packs[7])),
        "forecasts_and_arrays_ms": milliseconds(lambda: arrays_of(grid, raw)),
        "open_first_time_ms": first,
        "open_and_hash_ms": hashing,
        "open_ms": opening,
        "open_is_fast": opening <= OPENING,
        "plan_training_episode_ms": milliseconds(lambda: plan_episode(grid, "train", 0, 0)),
    }


def open_new(grid: Grid, name: str) -> float:
    """Open a month as a new process does, and look at a value of it."""
    library._load_generated_scenario.cache_clear()
    return float(load_scenario(grid.id, name).load_p[0, 0])


def expand_again() -> None:
    for copy in copies():
        copy.unlink()


def copies() -> list[Path]:
    return list((cache.data_folder() / "series").glob(f"*/*/generated.{SEED}-*.npy"))


def milliseconds(work: Callable[[], object], before: Callable[[], None] | None = None) -> float:
    times = []
    for _ in range(REPEATS):
        if before is not None:
            before()
        times.append(once(work))
    return round(float(np.median(times)), 3)


def once(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return round(1e3 * (time.perf_counter() - began), 3)


def publish(grid: Grid, workers: int | None) -> dict[str, str]:
    """Hashes of the held-out months, which are made where they are not there."""
    months = [parse_months(name) for name in held_out_months()]
    for done in make_packs(grid, [(each.seed, each.first) for each in months], workers):
        print(f"\r{grid.id}: {done} of {len(months)} months", end="", flush=True)
    print()
    return listed_hashes(grid)


def record(path: Path, section: str, grid_id: str, value: dict[str, Any]) -> None:
    """Keep a result in a file."""
    results = json.loads(path.read_text()) if path.exists() else {}
    results.setdefault(section, {})[grid_id] = value
    path.write_text(json.dumps(results, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("open", "manifest"))
    parser.add_argument("grids", nargs="*", default=list(GRID_IDS))
    parser.add_argument("--workers", type=int, default=None, help="processes that make months (manifest)")
    arguments = parser.parse_args()
    for grid in map(load_grid, arguments.grids):
        if arguments.command == "manifest":
            path = Path(str(resources.files("rl2grid.scenarios") / MANIFEST))
            record(path, f"{VERSION} {SPLIT_VERSION}", grid.id, publish(grid, arguments.workers))
            continue
        with tempfile.TemporaryDirectory() as folder:
            os.environ["RL2GRID_DATA"] = folder
            result = measure(grid)
        record(RESULTS, "open", grid.id, result)
        print(grid.id, json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
