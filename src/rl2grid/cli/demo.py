"""``rl2grid demo``: a training, an evaluation and a report in minutes."""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from pathlib import Path

from rl2grid.cli.output import Output
from rl2grid.errors import UsageError


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    parser.add_argument("--output", type=Path, default=Path("reports/demo"), help="folder of the report")
    parser.add_argument("--decisions", type=int, default=None, help="decisions to train for")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace, output: Output) -> int:
    try:
        from rl2grid.analysis.summary_table import summary_table
        from rl2grid.studies.demo import TASK, figures, published, run_demo, what_differs
    except ImportError as error:
        raise UsageError(
            f"The demonstration needs {error.name}: install it with `pip install rl2grid[train,analysis]`."
        ) from None
    began = time.perf_counter()
    made = run_demo(options.output, decisions=options.decisions, progress=output.talks)
    summaries = [evaluation.summary for evaluation in made.evaluations]
    output.table(summary_table(summaries), [asdict(summary) for summary in summaries], title=f"{TASK}, test scenarios")
    if options.decisions is None:
        output.text(what_differs(figures(made.evaluations), published()))
    output.results(report=made.report)
    output.text(f"Report: {made.report} ({time.perf_counter() - began:.0f} s)")
    return 0
