"""The command ``rl2grid``.

Each subcommand parses its flags, calls one function of the layer below and prints the result. What a
user did wrong is said in one sentence, without a traceback, with exit status 2.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from rl2grid import __version__
from rl2grid.cli import actions, analyse, data, keywords, leaderboard, report, study, watch
from rl2grid.cli.train import INTERRUPTED, train
from rl2grid.errors import UsageError
from rl2grid.scenarios.splits import SPLITS

REFUSED = 2


class _Parser(argparse.ArgumentParser):
    """An argument parser that refuses with one sentence."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message[0].upper()}{message[1:]}; see {self.prog} --help.")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    command_line = sys.argv[1:] if arguments is None else list(arguments)
    try:
        return _run(command_line)
    except UsageError as error:
        print(f"rl2grid: {error}", file=sys.stderr)
        return REFUSED
    except KeyboardInterrupt:
        print("rl2grid: interrupted; the same command goes on where it stopped.", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of our output went away (for example `| head`): nobody is left to tell.
        sys.stderr.close()
        return 0


def _run(command_line: list[str]) -> int:
    if command_line[:1] == ["train"]:
        return train(command_line[1:])
    parser = make_parser()
    options = parser.parse_args(command_line)
    if options.command is None:
        parser.print_help()
        return 0
    status: int = options.run(options)
    return status


def make_parser() -> argparse.ArgumentParser:
    """The parser of all subcommands but ``train``, which parses its own flags."""
    parser = _Parser(prog="rl2grid", description="A benchmark for reinforcement learning in power-grid operation.")
    parser.add_argument("--version", action="version", version=f"rl2grid {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="command", parser_class=_Parser)
    _add_demo(commands)
    _add_tasks(commands)
    commands.add_parser("train", help="train an algorithm on a task", add_help=False)
    _add_evaluate(commands)
    _add_rank(commands)
    analyse.add_parser(commands)
    report.add_parser(commands)
    leaderboard.add_parser(commands)
    actions.add_parser(commands)
    data.add_parser(commands)
    watch.add_parser(commands)
    study.add_parser(commands)
    return parser


def _add_demo(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser = commands.add_parser("demo", help="train PPO on bus14, evaluate it beside simple agents, write a report")
    parser.add_argument("--output", type=Path, default=Path("reports/demo"), help="folder of the report")
    parser.add_argument("--decisions", type=int, default=None, help="decisions to train for")
    parser.set_defaults(run=_demo)


def _demo(options: argparse.Namespace) -> int:
    from rl2grid.studies.demo import run_demo

    run_demo(options.output, decisions=options.decisions)
    return 0


def _add_tasks(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser = commands.add_parser("tasks", help="list the tasks (103 on the seven grids) and their sizes")
    parser.add_argument("--grid", default=None, help="only the tasks of this grid")
    parser.set_defaults(run=_tasks)


def _tasks(options: argparse.Namespace) -> int:
    from rl2grid.cli.tasks import print_tasks

    print_tasks(options.grid)
    return 0


def _add_evaluate(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser = commands.add_parser("evaluate", help="play agents on enumerated scenarios, one row per episode")
    parser.add_argument(
        "agents",
        nargs="+",
        metavar="agent",
        help="do-nothing, random, recovery, greedy, greedy-n1, milp, dc-opf, or a run folder or checkpoint; several "
        "are compared with the first on the same months",
    )
    parser.add_argument("task", help="for example bus14-T0")
    parser.add_argument("--split", default="validation", choices=SPLITS, help="validation picks models; test is last")
    parser.add_argument(
        "--months", type=int, default=None, help="the first of the split, balanced over the seasons; by default all"
    )
    parser.add_argument("--seeds", type=int, default=1, help="episodes per scenario, with seeds 0, 1, ...")
    keywords.add_flags(parser)
    parser.add_argument(
        "--workers",
        type=int,
        default=None,
        help="processes; by default this one for few native episodes, or one per core",
    )
    parser.add_argument("--output", type=Path, default=None, help="folder of the results of one agent")
    parser.set_defaults(run=_evaluate)


def _evaluate(options: argparse.Namespace) -> int:
    from rl2grid.cli.evaluate import run

    return run(options)


def _add_rank(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser = commands.add_parser("rank", help="rank a grid's topology actions by trying them")
    parser.add_argument("grid", help="for example bus14")
    parser.add_argument("--states", type=int, default=1000, help="operating points in which the actions are tried")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sampling", default="exhaustive", help="exhaustive, or uniform as in the paper")
    parser.add_argument("--threads", type=int, default=None, help="threads that try; by default one per core")
    parser.add_argument("--output", type=Path, default=Path("rankings"), help="folder of the result")
    parser.set_defaults(run=_rank)


def _rank(options: argparse.Namespace) -> int:
    from rl2grid.evaluation.ranking import run_ranking

    path = run_ranking(
        options.grid,
        options.states,
        options.seed,
        options.sampling,
        options.output,
        num_threads=options.threads,
    )
    print(f"Ranking written to {path}.")
    return 0
