"""The figures of the demonstration that the README shows, for a demonstration elsewhere to be compared with.

``python benchmarks/demonstration.py`` runs ``rl2grid demo`` in a folder of its own, prints the rows of the README's
table and writes ``src/rl2grid/studies/demo.json``.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from rl2grid.records.files import write_json
from rl2grid.studies import demo

PUBLISHED = Path(demo.__file__).with_name(demo.PUBLISHED)


def main() -> None:
    """Run it, and write what came out."""
    with tempfile.TemporaryDirectory() as folder:
        made = demo.run_demo(Path(folder) / "demo")
    write_json(PUBLISHED, demo.figures(made.evaluations))
    for each in made.evaluations:
        survival, completed = each.summary.survival, each.summary.completed
        print(
            f"| {each.summary.agent} | {survival.value:.3f} [{survival.low:.3f}, {survival.high:.3f}] "
            f"| {completed.value:.0%} [{100 * completed.low:.0f}, {100 * completed.high:.0f}] |"
        )


if __name__ == "__main__":
    main()
