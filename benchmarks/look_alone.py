"""How much of what policies that look before they act survive is the look: policies that have learned nothing look.

``python benchmarks/look_alone.py play TASK --k K [--heuristic H] [--seeds 1 2] [--months 100] [--folder F]`` makes
policies of SAC's preset ``tuned``, on redispatching tasks of ``default``, whose networks were never updated (the fewest
decisions that it can be asked for end before its first update), lets the what-if choose of their best K actions, or of
K dispatches drawn around theirs, on the first test months, each seed once, and enters what came out in
``benchmarks/results/look_alone.json``, which has the form of the ledger. ``python benchmarks/look_alone.py table``
prints them as Markdown, beside the trainings of the ledger that look in the same way. Nothing is chosen by it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from gains import begin_or_go_on

import rl2grid
from rl2grid.analysis.ledger_looks import looks_table
from rl2grid.cli.main import main as command
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError
from rl2grid.records.ledger import read_ledger
from rl2grid.training.request import hyperparameters

RESULTS = Path(__file__).resolve().parent / "results"
LEDGER, BEGINNINGS = RESULTS / "baselines.json", RESULTS / "look_alone.json"


def beginning(task: str, heuristic: str | None, seed: int, folder: Path) -> Path:
    """A policy before its first update; made once, or gone on with."""
    run = folder / f"{task}-{heuristic}-{seed}"
    preset = "default" if find_task(task).kind == "R" else "tuned"
    usual = hyperparameters("sac", task, preset)
    changes = {"seed": seed, "total_timesteps": usual.num_envs * usual.num_steps}
    options = {"num_threads": 1, "progress": False, "heuristic": heuristic}
    begin_or_go_on(
        run, lambda: rl2grid.train("sac", task, folder=run, preset=preset, hyperparameters=changes, **options)
    )
    return run


def main() -> int:
    """Play, or print the table; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("table")
    play = commands.add_parser("play")
    play.add_argument("task")
    play.add_argument("--heuristic", help="none unless one is named")
    play.add_argument("--k", type=int, required=True, help="best actions that the what-if compares")
    play.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    play.add_argument("--months", type=int, default=100)
    play.add_argument("--folder", type=Path, default=Path("runs/look_alone"), help="where the policies are kept")
    arguments = parser.parse_args()
    if arguments.command == "table":
        print(looks_table(read_ledger(LEDGER), read_ledger(BEGINNINGS)))
        return 0
    task, heuristic, folder = arguments.task, arguments.heuristic, arguments.folder
    try:
        runs = [str(beginning(task, heuristic, seed, folder)) for seed in arguments.seeds]
    except UsageError as error:
        parser.error(str(error))
    looks = ["--months", str(arguments.months), "--top-k", str(arguments.k)]
    return command(["leaderboard", "test", *runs, *looks, "--ledger", str(BEGINNINGS)])


if __name__ == "__main__":
    raise SystemExit(main())
