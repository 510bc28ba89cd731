"""The ledger of test results: every frozen configuration plays the test months once.

``python benchmarks/baselines.py test SUBJECT ...`` plays the test months with each subject, a run folder (the best
policy by validation) or an agent without training as ``greedy@bus14-T0`` or ``random@bus14-T0:idle``, and enters the
result in ``benchmarks/results/baselines.json``. A configuration (task, algorithm, hyperparameters, seed, keywords of
the environment) that is in the ledger is not played again: what was chosen after looking at test results is no test.
``python benchmarks/baselines.py verify SUBJECT ...`` plays them again and says whether policy and episodes are those of
the ledger, bit for bit; ``python benchmarks/baselines.py table`` prints the ledger as Markdown.

It is ``rl2grid leaderboard`` with ``--ledger benchmarks/results/baselines.json``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rl2grid.cli.main import main as rl2grid

LEDGER = Path(__file__).resolve().parent / "results" / "baselines.json"


def main(words: list[str] | None = None) -> int:
    """Run the command with this ledger; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("test", "verify", "table"))
    arguments, others = parser.parse_known_args(words)
    return rl2grid(["leaderboard", arguments.command, "--ledger", str(LEDGER), *others])


if __name__ == "__main__":
    raise SystemExit(main())
