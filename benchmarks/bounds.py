"""What is left to gain: how long the test months can be survived by one who knows them, beside who does not.

``python benchmarks/bounds.py play [TASK ...] [--months N] [--attempts N]`` plays the first N test months of each task,
of all that the planner had a test on unless some are named, with the agent ``foresight`` and the heuristic by which the
planner survives longest, and writes ``benchmarks/results/bounds.json``, which has the form of the ledger. A task that
is there is not played again, and one that was interrupted goes on at its next month. ``python benchmarks/bounds.py
table`` prints them as Markdown, beside what others survive of the same months by the ledger. Nothing is chosen by it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rl2grid.agents.foresight import Foresight
from rl2grid.agents.planner import Planner
from rl2grid.analysis.ledger_bounds import headroom_table
from rl2grid.analysis.ledger_overview import best_row, by_task, kind_of
from rl2grid.envs.tasks import find_task, short_id
from rl2grid.evaluation.protocol import evaluate
from rl2grid.ledger.subjects import heuristic_rules, tested_months
from rl2grid.records.evaluations import identity_hash
from rl2grid.records.ledger import HashedTest, add_test, hashed_test, read_ledger
from rl2grid.scenarios.splits import TEST

RESULTS = Path(__file__).resolve().parent / "results"
LEDGER, BOUNDS = RESULTS / "baselines.json", RESULTS / "bounds.json"


def heuristics(results: dict[str, HashedTest]) -> dict[str, str | None]:
    """Of every task that the planner had a test on, the heuristic by which it survives longest."""
    planned = {
        task: [row for row in rows if kind_of(row.first) == "planner"] for task, rows in by_task(results).items()
    }
    best = {task: best_row(rows) for task, rows in planned.items()}
    return {task: row.first.heuristic for task, row in best.items() if row is not None}


def play(task_id: str, heuristic: str | None, months: int, attempts: int, folder: Path) -> None:
    """Play a task's test months and enter what came out, unless it is there."""
    task, agent = find_task(task_id), Foresight(attempts=attempts)
    configuration = {
        "agent": agent.name,
        "guide": {"agent": "planner", "rules": Planner.rules[task.kind]},
        "task": task.id,
        "heuristic": heuristic,
        "test": tested_months(task, months),
        **heuristic_rules(task, heuristic),
    }
    digest = identity_hash(configuration)
    if digest in read_ledger(BOUNDS):
        return
    evaluation = evaluate(
        agent,
        task,
        split=TEST,
        months=months,
        heuristic=heuristic,
        output=folder / digest,
        progress=True,
    )
    add_test(BOUNDS, hashed_test(configuration, {}, evaluation))
    print(f"{short_id(task.id)}, {heuristic}: {evaluation.summary.survival.value:.3f}", flush=True)


def main() -> None:
    """Play, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("play", "table"))
    parser.add_argument("tasks", metavar="TASK", nargs="*")
    parser.add_argument("--months", type=int, default=20)
    parser.add_argument("--attempts", type=int, default=100, help="at averting one game over")
    parser.add_argument("--folder", type=Path, default=Path("runs/bounds"), help="where interrupted ones are kept")
    arguments = parser.parse_args()
    results = read_ledger(LEDGER)
    if arguments.command == "table":
        print(headroom_table(results, read_ledger(BOUNDS)))
        return
    by_heuristic = heuristics(results)
    asked = [find_task(name).id for name in arguments.tasks]
    for task in asked:
        if task not in by_heuristic:
            parser.error(
                f"the planner had no test on {short_id(task)}: choose of {' '.join(map(short_id, by_heuristic))}"
            )
    for task in asked or by_heuristic:
        play(task, by_heuristic[task], arguments.months, arguments.attempts, arguments.folder)


if __name__ == "__main__":
    main()
