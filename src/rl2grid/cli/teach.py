"""``rl2grid teach``: label training months with what a teacher decides in every state that it, or a pupil, meets."""

from __future__ import annotations

import argparse
from pathlib import Path

from rl2grid.cli import keywords
from rl2grid.cli.output import Output
from rl2grid.envs.tasks import find_task, short_id
from rl2grid.training.commands import teach_command
from rl2grid.training.teaching import MONTHS, PUPIL_SHARE, THIN, summary_of, teach


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    parser.add_argument("agent", help=f"the teacher: {keywords.AGENT_HELP}")
    parser.add_argument("task", help="for example bus14-T0")
    parser.add_argument(
        "--months",
        type=int,
        default=MONTHS,
        help=f"training months of the round, {MONTHS} by default; more may be asked for later",
    )
    parser.add_argument("--seed", type=int, default=0, help="of which months are played and which decisions are kept")
    parser.add_argument(
        "--pupil",
        metavar="AGENT",
        default=None,
        help="who acts while the teacher says what it would do (DAgger): another round in the same folder",
    )
    parser.add_argument(
        "--pupil-share", type=float, default=PUPIL_SHARE, help="probability with which the pupil acts, else the teacher"
    )
    parser.add_argument(
        "--pupil-top-k",
        type=int,
        default=None,
        help="actions of the pupil that the what-if compares when it acts; by default it plays its best",
    )
    keywords.add_looking(parser, "; of the teacher")
    parser.add_argument(
        "--gamma",
        type=float,
        default=None,
        help="discount of a grid step; by default 0.9, of injections 0.99",
    )
    parser.add_argument(
        "--thin",
        type=float,
        default=THIN,
        help=f"one is kept of so many safe states in which the teacher does nothing, {THIN:g} by default",
    )
    keywords.add_flags(parser)
    parser.add_argument("--workers", type=int, default=None, help="processes; by default one per core")
    parser.add_argument("--output", type=Path, default=None, help="folder of the labels, to begin or to go on with")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace, output: Output) -> int:
    task, chosen = find_task(options.task), keywords.given(options)
    taught = teach(
        options.agent,
        task,
        months=options.months,
        output=options.output,
        seed=options.seed,
        pupil=options.pupil,
        pupil_share=options.pupil_share,
        pupil_top_k=options.pupil_top_k,
        top_k=options.top_k,
        rehearse=options.rehearse,
        gamma=options.gamma,
        thin=options.thin,
        workers=options.workers,
        progress=output.talks,
        command=teach_command(
            options.agent,
            task,
            chosen,
            months=options.months,
            seed=options.seed,
            pupil=options.pupil,
            pupil_share=options.pupil_share,
            pupil_top_k=options.pupil_top_k,
            gamma=options.gamma,
            thin=options.thin,
            output=options.output,
            looking=keywords.looking(options),
        ),
        **chosen,
    )
    summary = summary_of(taught)
    output.results(folder=taught.folder, round=taught.round, teacher=taught.teacher, **summary)
    output.text(
        f"{summary['labels']:,} labels of {taught.teacher} in {taught.folder}, round {taught.round}: "
        f"{summary['months']:,} months of {short_id(task.id)}, {summary['decisions']:,} decisions, "
        f"{summary['acted']:,} actions of the teacher, survival {summary['survival']:.3f}"
        f"{f' with {taught.pupil} acting' if taught.pupil else ''}."
    )
    return 0
