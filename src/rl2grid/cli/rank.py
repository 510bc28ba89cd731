"""``rl2grid rank``: the order of a grid's topology actions, by trying them."""

from __future__ import annotations

import argparse
from pathlib import Path

from rl2grid.cli.output import Output


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    parser.add_argument("grid", help="for example bus14")
    parser.add_argument("--states", type=int, default=1000, help="operating points in which the actions are tried")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sampling", default="exhaustive", help="exhaustive, or uniform as in the paper")
    parser.add_argument("--threads", type=int, default=None, help="threads that try; by default one per core")
    parser.add_argument("--output", type=Path, default=Path("rankings"), help="folder of the result")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace, output: Output) -> int:
    from rl2grid.evaluation.ranking import run_ranking

    path = run_ranking(
        options.grid,
        options.states,
        options.seed,
        options.sampling,
        options.output,
        num_threads=options.threads,
        progress=output.talks,
    )
    output.results(ranking=path)
    output.remark(f"Ranking written to {path}.")
    return 0
