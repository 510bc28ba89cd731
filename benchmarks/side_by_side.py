"""What it gains to play the episodes of an evaluation side by side: the same months one after the other, in one run.

``python benchmarks/side_by_side.py [--rounds 3]`` evaluates do-nothing and policies both ways in turn, in this process,
and stops if a row of an episode differs in anything but the time it took. It writes
``benchmarks/results/side_by_side.json``: decisions and grid steps of the months, seconds of the clock of each way
(medians of the rounds; what the first evaluation of both loads is not counted), and how many times faster it is side by
side. Pin it (``taskset -c 0``) for what one core does.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from rl2grid.envs.tasks import find_task
from rl2grid.evaluation import protocol
from rl2grid.evaluation.agents import make_agent
from rl2grid.evaluation.crew import Crew, make_crew
from rl2grid.evaluation.setting import Setting
from rl2grid.records.episodes import Episode
from rl2grid.records.evaluations import Evaluation
from rl2grid.records.files import write_json
from rl2grid.records.versions import processor

RESULTS = Path(__file__).resolve().parent / "results" / "side_by_side.json"


class Case(NamedTuple):
    """What is evaluated."""

    agent: str
    task: str
    heuristic: str | None
    months: int

    def name(self) -> str:
        """Its row."""
        return f"{self.task}, {self.agent}, {self.heuristic or 'none'}"


CASES = (
    Case("do-nothing", "bus14-T0", None, 20),
    Case("pretrained/bus14-T0", "bus14-T0", None, 8),
    Case("pretrained/bus14-R", "bus14-R", None, 8),
    Case("do-nothing", "bus36-M-R", None, 16),
    Case("pretrained/bus118-MOB-v0-T1", "bus118-MOB-v0-T1", None, 16),
    Case("pretrained/bus14-T0-idle", "bus14-T0", "idle", 32),
    Case("pretrained/bus36-M-T1", "bus36-M-T1", "careful", 32),
    Case("pretrained/bus36-M-R", "bus36-M-R", "secure", 8),
    Case("pretrained/bus118-MOB-v0-T1", "bus118-MOB-v0-T1", "idle", 32),
)


def one_after_the_other(setting: Setting, workers: int) -> Crew[Episode]:
    """As agents that decide for one environment are played."""
    return make_crew(replace(setting, abreast=1), workers)


def play(case: Case) -> Evaluation:
    """Evaluate in this process."""
    agent = make_agent(case.agent, find_task(case.task))
    return protocol.evaluate(agent, case.task, months=case.months, heuristic=case.heuristic, workers=0)


def measure(case: Case, rounds: int) -> dict[str, Any]:
    """Both ways in turn."""
    ways = {"alone": one_after_the_other, "side by side": make_crew}
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    rows: dict[str, list[Episode]] = {}
    for number in range(rounds + 1):
        for name, way in ways.items():
            protocol.make_crew = way
            began = time.perf_counter()
            episodes = play(case).episodes
            if number:
                seconds[name].append(time.perf_counter() - began)
            rows[name] = [replace(episode, wall_time_s=0.0) for episode in episodes]
        if rows["alone"] != rows["side by side"]:
            raise SystemExit(f"{case.name()}: the rows differ.")
    medians = {name: statistics.median(each) for name, each in seconds.items()}
    return {
        "months": case.months,
        "decisions": sum(episode.decisions for episode in rows["alone"]),
        "grid_steps": sum(episode.grid_steps for episode in rows["alone"]),
        "seconds": {name: round(each, 2) for name, each in medians.items()},
        "times_faster": round(medians["alone"] / medians["side by side"], 1),
    }


def main() -> None:
    """Measure, and write what was measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    rounds = parser.parse_args().rounds
    results: dict[str, Any] = {"processor": processor(), "cores": len(os.sched_getaffinity(0)), "rows": {}}
    for case in CASES:
        results["rows"][case.name()] = row = measure(case, rounds)
        print(case.name(), row, flush=True)
        write_json(RESULTS, results, indent=1)


if __name__ == "__main__":
    main()
