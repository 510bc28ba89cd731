"""What the corrected target, the levels of the second ranking and the heuristic ``careful`` do to learning.

Trainings of five seeds before and after, of the same budget, on the same generator and validated on the same months.
Both are of revision 804a035d, which holds the results and to whose sources the patch applies; since then training
months are drawn from a library, so that later revisions train on others::

    git checkout 804a035d
    git clone . BEFORE && cd BEFORE               # a state in which all three are undone
    git apply benchmarks/first_target.patch       # the first transition counts what the reset played
    git checkout 34e98fe -- src/rl2grid/grids/data/bus14.ranking.npz src/rl2grid/grids/data/bus36-MO-v0.ranking.npz
    PYTHONPATH=src python benchmarks/corrections.py train FOLDER/before --closing recovery

    python benchmarks/corrections.py train FOLDER/after --closing careful
    python benchmarks/corrections.py compare FOLDER/before FOLDER/after

``train`` is a study (``rl2grid study``): it goes on after a kill, and every cell is evaluated on the 200 validation
months with its best policy of five validations. ``compare`` pairs the evaluations by month and writes
``benchmarks/results/corrections.json``. Test months are not touched.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from rl2grid.cli.main import main as rl2grid
from rl2grid.grids.rankings import ranking_hash
from rl2grid.records.comparisons import paired_differences
from rl2grid.records.files import make_folder, write_json, write_text
from rl2grid.records.statistics import UNIT, Scores, estimate

RESULTS = Path(__file__).resolve().parent / "results" / "corrections.json"
STUDY = """name = "corrections"
output = "{output}"
split = "validation"
seeds = [1, 2, 3, 4, 5]
validations = 5

[[group]]
algorithms = ["ppo"]
tasks = ["bus14-T0"]
heuristics = ["idle", "{closing}"]
budget = 49_152

[[group]]
algorithms = ["dqn", "sac"]
tasks = ["bus14-T0"]
heuristics = ["idle", "{closing}"]
budget = 10_240

[[group]]
algorithms = ["ppo"]
tasks = ["bus36-MO-v0-T0"]
heuristics = ["{closing}"]
budget = 49_152

[[group]]
algorithms = ["dqn", "sac"]
tasks = ["bus36-MO-v0-T0"]
heuristics = ["{closing}"]
budget = 10_240
"""
STATE_FILE = "state.json"
GRIDS = ("bus14", "bus36-MO-v0")
PROBED_RESETS = 20

Setting = tuple[str, str, str]
"""Algorithm, task, and heuristic after the corrections."""


def train(folder: Path, closing: str) -> None:
    """Train and evaluate with the code that is imported, and note which of the corrections it has.

    Args:
        folder: of the study.
        closing: the heuristic that closes lines.
    """
    make_folder(folder)
    state = {
        "closing": closing,
        "reset_in_first_transition": counts_reset_in_first_transition(),
        "rankings": {grid_id: ranking_hash(grid_id) for grid_id in GRIDS},
    }
    write_json(folder / STATE_FILE, state)
    write_text(folder / "study.toml", STUDY.format(output=folder.resolve(), closing=closing))
    rl2grid(["study", "run", str(folder / "study.toml")])


def counts_reset_in_first_transition() -> bool:
    """Whether what a reset plays is part of the first transition, in which case it is reported nowhere else."""
    env = gymnasium.make("rl2grid/bus14-T0-v0", heuristic="idle")
    played = [env.reset(seed=seed)[1]["reset_steps"] for seed in range(PROBED_RESETS)]
    env.close()
    return not any(played)


def read_scores(folder: Path) -> dict[Setting, dict[tuple[str, str], list[float]]]:
    """Survival by setting, by month and seed of its episode, in the order of the trainings' seeds."""
    closing = read_state(folder)["closing"]
    found: dict[Setting, dict[tuple[str, str], list[float]]] = defaultdict(lambda: defaultdict(list))
    with (folder / "episodes.csv").open(encoding="utf-8", newline="") as file:
        rows = sorted(csv.DictReader(file), key=lambda row: int(row["training_seed"]))
    for row in rows:
        heuristic = "careful" if row["heuristic"] == closing else row["heuristic"]
        setting = (row["agent"], row["task"], heuristic)
        found[setting][row["scenario"], row["seed"]].append(float(row["survival"]))
    return found


def read_state(folder: Path) -> dict[str, Any]:
    """What :func:`train` has noted."""
    return dict(json.loads((folder / STATE_FILE).read_text(encoding="utf-8")))


def compare(before: Path, after: Path) -> dict[str, Any]:
    """Survival on both sides and the paired differences, Holm's correction over all settings."""
    one, other = read_scores(before), read_scores(after)
    rows = []
    scores: list[Scores] = []
    for setting in sorted(set(one) & set(other)):
        months = sorted(set(one[setting]) & set(other[setting]))
        pair = [
            Scores(np.array([side[setting][month] for month in months]).T[..., None], UNIT) for side in (one, other)
        ]
        scores += pair
        rows.append(
            {
                "setting": list(setting),
                "runs": [each.runs for each in pair],
                "months": len(months),
                "before": figures(estimate(pair[0])),
                "after": figures(estimate(pair[1])),
            }
        )
    differences = paired_differences(scores, [(2 * k + 1, 2 * k) for k in range(len(rows))])
    for row, difference in zip(rows, differences, strict=True):
        row |= {"difference": figures(difference.estimate), "p": difference.p, "holm": difference.holm}
    return {"before": read_state(before), "after": read_state(after), "rows": rows}


def scores_of(months: list[list[float]]) -> Scores:
    """Survival of a setting, given by month and run."""
    return Scores(np.array(months).T[..., None], UNIT)


def figures(found: Any) -> list[float]:
    """Value and interval of an estimate."""
    return [round(float(x), 4) for x in (found.value, found.low, found.high)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    training = commands.add_parser("train")
    training.add_argument("folder", type=Path)
    training.add_argument("--closing", choices=("recovery", "careful"), required=True)
    comparison = commands.add_parser("compare")
    comparison.add_argument("before", type=Path)
    comparison.add_argument("after", type=Path)
    arguments = parser.parse_args()
    if arguments.command == "train":
        train(arguments.folder, arguments.closing)
        return
    result = compare(arguments.before, arguments.after)
    write_json(RESULTS, result, indent=1)
    for row in result["rows"]:
        print(json.dumps(row))


if __name__ == "__main__":
    main()
