"""What a decision costs, and how many there are in a month: agents on the same validation months, one thread.

``python benchmarks/decision_time.py TASK AGENT[:HEURISTIC] ... [--top-k K] [--rehearse STEPS]`` plays validation
months of a task, by default ten behind those by which policies were picked, with each agent: ``planner``,
``greedy:careful``, a run folder or ``pretrained/NAME`` (with the heuristic of its training), and, with ``--top-k`` or
``--rehearse``, every policy once more looking so before it acts. It writes to
``benchmarks/results/decision_time.json`` a row for each: survival, decisions a month, milliseconds of processor time
of a decision (mean, median, 99 of 100) and seconds of them in a month of 8,064 steps that were played. Each agent plays
the first month once before, untimed: loading compiled code takes a tenth of a second, once per process. With
``--rounds`` they play the months in turn so many times, and of each decision, which is the same every time, the median
counts: on a processor with other work to do some take several times as long as others.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
from gains import CHOSEN_ON, validation_months
from timed import Timed

from rl2grid.agents.agent import Agent
from rl2grid.cli.keywords import add_looking, looking
from rl2grid.envs.tasks import Task, find_task, short_id
from rl2grid.evaluation.agents import AGENTS, make_agent
from rl2grid.evaluation.protocol import AS_TRAINED, evaluate
from rl2grid.records.evaluations import Evaluation
from rl2grid.records.files import write_json
from rl2grid.records.ledger import looking_of
from rl2grid.records.versions import processor
from rl2grid.scenarios.episodes import MAX_STEPS

RESULTS = Path(__file__).resolve().parent / "results" / "decision_time.json"


def play(agent: Agent, task: Task, heuristic: str | None, months: tuple[str, ...]) -> tuple[Evaluation, list[float]]:
    """Play, and the seconds of each decision."""
    timed = Timed(agent)
    return evaluate(timed, task, scenarios=months, heuristic=heuristic, workers=0, progress=True), timed.seconds


def row_of(rounds: list[tuple[Evaluation, list[float]]]) -> dict[str, Any]:
    """What decisions took, each the median of its rounds."""
    milliseconds = 1e3 * np.median([seconds for _, seconds in rounds], axis=0)
    played = rounds[0][0]
    per_month = MAX_STEPS / sum(episode.grid_steps for episode in played.episodes)
    return {
        "survival": round(played.summary.survival.value, 4),
        "decisions_a_month": round(len(milliseconds) * per_month, 1),
        "milliseconds": [
            round(float(each), 3)
            for each in (milliseconds.mean(), np.median(milliseconds), np.quantile(milliseconds, 0.99))
        ],
        "seconds_a_month": round(float(milliseconds.sum()) / 1e3 * per_month, 3),
    }


def players(words: list[str], task: Task, look: dict[str, int]) -> dict[str, tuple[Agent, str | None]]:
    """Agents and heuristics by the names of their rows."""
    found: dict[str, tuple[Agent, str | None]] = {}
    for word in words:
        name, _, heuristic = word.partition(":")
        if name in AGENTS:
            found[word] = make_agent(name, task), heuristic or None
            continue
        found[name] = make_agent(name, task), AS_TRAINED
        if look:
            found[f"{name}{looking_of(look)}"] = make_agent(name, task, **look), AS_TRAINED
    return found


def main() -> None:
    """Play what is asked for, and write the rows beside those of before."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", metavar="TASK")
    parser.add_argument("agents", nargs="+", metavar="AGENT")
    add_looking(parser)
    parser.add_argument("--months", type=int, default=10)
    parser.add_argument("--skip", type=int, default=CHOSEN_ON)
    parser.add_argument("--rounds", type=int, default=1)
    arguments = parser.parse_args()
    task = find_task(arguments.task)
    months = validation_months(task, arguments.skip, arguments.months)
    rows: dict[str, Any] = {}
    asked = players(arguments.agents, task, looking(arguments))
    rounds: dict[str, list[tuple[Evaluation, list[float]]]] = {name: [] for name in asked}
    for number in range(arguments.rounds):
        for name, (agent, heuristic) in asked.items():
            if number == 0:  # what is loaded, once per process, is no decision's time
                play(agent, task, heuristic, months[:1])
            rounds[name].append(play(agent, task, heuristic, months))
            rows[name] = row_of(rounds[name])
            print(short_id(task.id), name, json.dumps(rows[name]), flush=True)
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    measured = {
        "processor": processor(),
        "months": [arguments.skip, arguments.skip + len(months)],
        "rounds": arguments.rounds,
    }
    before = results.get(short_id(task.id), {})
    # Rows that were measured elsewhere, or on other months, are nothing to stand beside.
    kept = before["rows"] if measured.items() <= before.items() else {}
    results[short_id(task.id)] = {**measured, "rows": {**kept, **rows}}
    write_json(RESULTS, results, indent=1)


if __name__ == "__main__":
    main()
