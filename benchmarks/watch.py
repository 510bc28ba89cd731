"""How fast an episode is drawn, as ``rl2grid watch`` draws it for an animation, and how large its page is.

``python benchmarks/watch.py [GRID] [--frames N]`` records steps of a validation month of bus118-MOB-v0 (doing nothing),
draws 1,000 pictures of 1280 by 720 pixels, and writes ``benchmarks/results/watch.json``: seconds on the clock, seconds
of processor time (what the drawing itself takes, however busy the machine is), and the load of the machine before it.
``--pages`` instead plays the first validation month of bus14 and of bus118-MOB-v0 with greedy and the careful
heuristic, writes their pages, and notes steps, bytes, and seconds of processor time for playing and for writing.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import tempfile
import time
from itertools import islice
from pathlib import Path
from typing import Any

import matplotlib

from rl2grid.analysis import animation
from rl2grid.analysis.watch_page import write_watch_page
from rl2grid.envs.tasks import find_task
from rl2grid.evaluation.watching import play_to_watch
from rl2grid.grids import load_grid
from rl2grid.records.recordings import Recording
from rl2grid.scenarios.library import list_scenarios

PAGES = ("bus14-T0", "bus118-MOB-v0-T1")
RESULTS = Path(__file__).resolve().parent / "results" / "watch.json"


def longest_recording(grid_id: str, steps: int) -> Recording:
    """The first validation month that doing nothing survives for ``steps`` steps, or the longest of them."""
    longest: Recording | None = None
    for scenario in list_scenarios(grid_id, "validation"):
        recording = play_to_watch("do-nothing", f"{grid_id}-T0", scenario=scenario, steps=steps)
        if longest is None or len(recording.rho) > len(longest.rho):
            longest = recording
        if len(recording.rho) >= steps:
            break
    assert longest is not None
    return longest


def measure(grid_id: str, n_frames: int) -> dict[str, Any]:
    """Draw ``n_frames`` steps of a recording, beginning again at its end."""
    recording = longest_recording(grid_id, n_frames)
    steps = [k % len(recording.rho) for k in range(n_frames)]
    load = os.getloadavg()[0]
    clock, processor = time.perf_counter(), time.process_time()
    pictures = animation.frames(load_grid(grid_id), recording, steps)
    first = next(pictures)
    drawn = 1 + sum(1 for _ in islice(pictures, n_frames))
    seconds, cpu_seconds = time.perf_counter() - clock, time.process_time() - processor
    return {
        "frames": drawn,
        "size": [first.shape[1], first.shape[0]],
        "scenario": recording.scenario,
        "seconds": round(seconds, 1),
        "frames_per_second": round(drawn / seconds, 1),
        "processor_seconds": round(cpu_seconds, 1),
        "frames_per_processor_second": round(drawn / cpu_seconds, 1),
        "load_before": round(load, 1),
    }


def measure_page(task: str) -> dict[str, Any]:
    """Play the first validation month with greedy, as long as it lives, and write its page."""
    begin = time.process_time()
    recording = play_to_watch("greedy", task, heuristic="careful")
    played = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "page.html"
        write_watch_page(path, find_task(task).grid, [recording])
        written, size = time.process_time(), path.stat().st_size
    return {
        "scenario": recording.scenario,
        "steps": recording.n_steps,
        "decisions_explained": len(recording.reasons),
        "cascades": len(recording.cascades),
        "bytes": size,
        "bytes_per_step": round(size / recording.n_steps, 1),
        "playing_processor_seconds": round(played - begin, 1),
        "writing_processor_seconds": round(written - played, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("grid", nargs="?", default="bus118-MOB-v0")
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--pages", action="store_true", help="measure pages")
    arguments = parser.parse_args()
    results = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
    if arguments.pages:
        results["pages"] = {task: measure_page(task) for task in PAGES}
        print(results["pages"])
    else:
        results[arguments.grid] = measure(arguments.grid, arguments.frames)
        print(results[arguments.grid])
    results |= {
        "command": "python benchmarks/watch.py",
        "python": platform.python_version(),
        "processor": platform.machine(),
        "matplotlib": matplotlib.__version__,
    }
    RESULTS.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
