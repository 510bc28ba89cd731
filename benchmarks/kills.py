"""Kills at random moments: what was killed is called again, and must end as if nothing had happened.

``python benchmarks/kills.py [--kills 22] [--seed 0] [--only SUBJECT ...]`` lets every subject (trainings of all
algorithms, an evaluation, labels, a study, the making of months, a ranking, the first compilation) run once in peace.
Then it runs again with the whole group of processes killed (SIGKILL) at a moment drawn from the time that it took (the
shortest so far), is called again as a user would, killed again, and at last left in peace. What it leaves must equal
what it left the first time. A call that ends by itself before its moment is not counted as a kill. Writes
``benchmarks/results/kills.json``, where a subject stays as it was until it is played by another command.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rl2grid import __version__
from rl2grid.algorithms.policy_agent import load_agent
from rl2grid.records.evaluations import load_evaluation
from rl2grid.records.files import write_json

RESULTS = Path(__file__).resolve().parent / "results" / "kills.json"
PROGRAM = (sys.executable, "-m", "rl2grid")
TRAININGS = {
    "ppo": ("bus14-T0", "--num-envs", "8", "--num-steps", "32", "--decisions", "4096"),
    "lagrangian-ppo": ("bus14-T0-TLO", "--num-envs", "8", "--num-steps", "32", "--decisions", "4096"),
    "dqn": ("bus14-T0", "--num-envs", "8", "--learning-starts", "256", "--decisions", "2048"),
    "sac": ("bus14-R", "--num-envs", "8", "--learning-starts", "256", "--decisions", "1536"),
    "td3": ("bus14-R", "--num-envs", "8", "--learning-starts", "256", "--decisions", "1536"),
}
OFTEN = ("--checkpoint-seconds", "0.5", "--evaluate-every", "512", "--validation-months", "2", "--heuristic", "idle")
LABELS = ("teach", "greedy", "bus14-T0", "--months", "4", "--heuristic", "idle", "--episode-length", "2016")
IMITATION = ("bus14-T0", "--num-steps", "4000", "--decisions", "80000", "--validation-months", "2",
             "--evaluate-every", "20000", "--checkpoint-seconds", "0.5", "--heuristic", "idle")  # fmt: skip
STUDY = """name = "kills"
split = "validation"
seeds = [1, 2]
months = 2
budget = 512
validations = 1

[[group]]
tasks = ["bus14-T0"]
agents = ["do-nothing", "random"]

[[group]]
tasks = ["bus14-T0"]
algorithms = ["ppo"]
heuristics = ["idle"]
"""
AT_MOST = 1800.0
"""Seconds after which a call is not waited for any longer."""


@dataclass(frozen=True)
class Subject:
    """Something that takes time and may be killed."""

    name: str
    first: Callable[[Path], list[str]]
    """The command that begins in a folder."""
    again: Callable[[Path], list[str]]
    """The command of a user who finds it killed."""
    left: Callable[[Path], Any]
    """What it leaves, to be compared."""
    own_data: bool = False
    """Its data folder is the folder itself."""
    cold: bool = False
    """It finds no compiled code."""


@dataclass
class Found:
    """What came of a subject."""

    seconds: float = 0.0
    kills: int = 0
    runs: int = 0
    calls: int = 0
    failures: list[str] = field(default_factory=list)


def _training(algorithm: str) -> Subject:
    task, *sizes = TRAININGS[algorithm]

    def first(folder: Path) -> list[str]:
        return ["train", algorithm, task, "--output", str(folder / "run"), *OFTEN, *sizes]

    return Subject(f"train {algorithm}", first, _resumed(first), _trained)


def _resumed(first: Callable[[Path], list[str]]) -> Callable[[Path], list[str]]:
    """The command that goes on with a training, or begins it where nothing was written."""

    def again(folder: Path) -> list[str]:
        known = (folder / "run" / "config.json").exists()
        return ["train", "--resume", str(folder / "run")] if known else first(folder)

    return again


def _imitation(folder: Path) -> list[str]:
    """Learns from labels that lie beside the folder, made the first time."""
    labels = folder.with_name("labels")
    if not labels.exists():
        subprocess.run([*PROGRAM, *LABELS, "--output", str(labels)], check=True, capture_output=True)
    return ["train", "imitation", *IMITATION, "--labels", str(labels), "--output", str(folder / "run")]


def _trained(folder: Path) -> Any:
    run = folder / "run"
    policies = [load_agent(run / name).identity["policy_hash"] for name in ("checkpoint.pt", "best.pt")]
    timed = re.compile("SPS|share|seconds|time|memory|energy", re.IGNORECASE)
    with (run / "metrics.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if not timed.search(row["name"])]
    values = sorted((int(row["step"]), row["name"], row["grid_steps"], row["value"]) for row in rows)
    return policies, values


def _evaluated(folder: Path) -> Any:
    result = load_evaluation(folder / "evaluation")
    return [asdict(episode) | {"wall_time_s": 0.0} for episode in result.episodes]


def _studied(folder: Path) -> Any:
    cells = sorted((folder / "study" / "cells").glob("*/result.json"))
    return [(path.parent.name, _without_times(json.loads(path.read_text()))) for path in cells]


def _without_times(value: Any) -> Any:
    """A result without what differs from run to run: times, energy, and checksums over them."""
    if isinstance(value, list):
        return [_without_times(each) for each in value]
    if not isinstance(value, dict):
        return value
    timed = ("time", "minute", "second", "energy", "checksum", "joule", "folder", "started", "ended", "date", "command")
    return {key: _without_times(each) for key, each in value.items() if not any(word in key for word in timed)}


def _made(folder: Path) -> Any:
    packs = sorted((folder / "packs" / "bus14").glob("*/*.pack"))
    return [(path.name, hashlib.sha256(path.read_bytes()).hexdigest()) for path in packs]


def _ranked(folder: Path) -> Any:
    return sorted(
        (path.name, hashlib.sha256(path.read_bytes()).hexdigest()) for path in (folder / "ranking").glob("*.npz")
    )


def _labelled(folder: Path) -> Any:
    months = sorted((folder / "labels").glob("round-*/*.npz"))
    return [(path.name, hashlib.sha256(path.read_bytes()).hexdigest()) for path in months]


def _study(folder: Path) -> list[str]:
    (folder / "study.toml").write_text(STUDY)
    return ["study", "run", str(folder / "study.toml"), "--output", str(folder / "study"), "--jobs", "2"]


def _evaluation(folder: Path) -> list[str]:
    output = str(folder / "evaluation")
    return ["evaluate", "greedy", "bus14-T0", "--heuristic", "idle", "--months", "8", "--output", output]


def _teaching(folder: Path) -> list[str]:
    return ["teach", "greedy", "bus14-T0", "--months", "6", "--episode-length", "2016",
            "--output", str(folder / "labels")]  # fmt: skip


def _generation(folder: Path) -> list[str]:
    return ["data", "make", "bus14", "--seed", "11"]


def _ranking(folder: Path) -> list[str]:
    return ["rank", "bus14", "--states", "300", "--output", str(folder / "ranking")]


def _compilation(folder: Path) -> list[str]:
    return ["evaluate", "do-nothing", "bus14-T0", "--split", "bundled", "--months", "1",
            "--output", str(folder / "evaluation")]  # fmt: skip


SUBJECTS = (
    *map(_training, TRAININGS),
    Subject("train imitation", _imitation, _resumed(_imitation), _trained),
    Subject("evaluate", _evaluation, _evaluation, _evaluated),
    Subject("teach", _teaching, _teaching, _labelled),
    Subject("study", _study, _study, _studied),
    Subject("make months", _generation, _generation, _made, own_data=True),
    Subject("rank", _ranking, _ranking, _ranked),
    Subject("first compilation", _compilation, _compilation, _evaluated, own_data=True, cold=True),
)


class _KilledError(Exception):
    """The process group was killed at its moment."""


def call(arguments: list[str], subject: Subject, folder: Path, until: float) -> float:
    """Call the program; returns the seconds it took.

    Raises:
        _KilledError: it was killed after ``until`` seconds.
        RuntimeError: it failed; with its last lines.
    """
    environment = dict(os.environ)
    if subject.own_data:
        environment["RL2GRID_DATA"] = str(folder)
    if subject.cold:
        environment["XDG_CACHE_HOME"] = str(folder)  # compiled code
    began = time.monotonic()
    log_file = log_of(folder)
    with log_file.open("wb") as log:
        process = subprocess.Popen(
            [*PROGRAM, *arguments], stdout=log, stderr=subprocess.STDOUT, env=environment, start_new_session=True
        )
        try:
            code = process.wait(timeout=until)
        except subprocess.TimeoutExpired as late:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if until < AT_MOST:
                raise _KilledError from late
            raise RuntimeError(f"still running after {AT_MOST:.0f} s") from late
    if code:
        lines = log_file.read_text(errors="replace").strip().splitlines()
        raise RuntimeError(f"exit status {code}: {' / '.join(lines[-3:])[-400:]}")
    return time.monotonic() - began


def log_of(folder: Path) -> Path:
    """What the program printed, beside the folder that it works in."""
    return folder.with_name(f"{folder.name}.log")


def prepare(folder: Path) -> None:
    """An empty folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)


def run_subject(subject: Subject, kills: int, folder: Path, draws: random.Random) -> Found:
    """Let a subject run in peace, then with so many kills."""
    found = Found()
    prepare(folder)
    found.seconds = round(call(subject.first(folder), subject, folder, AT_MOST), 1)
    expected = json.dumps(subject.left(folder), sort_keys=True)
    while found.kills < kills and len(found.failures) < 5:
        prepare(folder)
        command, found.runs = subject.first, found.runs + 1
        left_in_peace = draws.randrange(1, 6)
        try:
            for _ in range(min(left_in_peace, kills - found.kills)):
                found.calls += 1
                try:
                    took = call(command(folder), subject, folder, draws.uniform(0.0, found.seconds))
                    if command is subject.first:  # on a machine that is less busy than it was
                        found.seconds = round(min(took, found.seconds), 1)
                    break
                except _KilledError:
                    found.kills, command = found.kills + 1, subject.again
            else:
                call(command(folder), subject, folder, AT_MOST)
                found.calls += 1
            if json.dumps(subject.left(folder), sort_keys=True) != expected:
                found.failures.append(f"run {found.runs}: left something else")
        except Exception as error:  # whatever is raised is what is looked for
            found.failures.append(f"run {found.runs}: {type(error).__name__}: {error}")
            shutil.copytree(
                folder, folder.with_name(f"failed-{len(found.failures)}"), dirs_exist_ok=True, symlinks=True
            )
    return found


def run_campaign(
    results: Path, subjects: Sequence[Subject], break_it: Callable[[Subject], Any], counts: Sequence[str]
) -> int:
    """Break all subjects whose results are not those of the same command; returns the exit status.

    Args:
        results: written after every subject; those of other subjects stay in it.
        subjects: what is broken.
        break_it: does it; what it returns has ``failures`` and all of ``counts``.
        counts: what is added up over the subjects.
    """
    command = shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *sys.argv[1:]])
    cells: dict[str, Any] = json.loads(results.read_text())["subjects"] if results.exists() else {}
    for subject in subjects:
        if cells.get(subject.name, {}).get("command") != command:
            cells[subject.name] = {"command": command, "version": __version__, **vars(break_it(subject))}
        print(f"{subject.name}: {cells[subject.name]}", flush=True)
        total = {name: sum(cell[name] for cell in cells.values()) for name in counts}
        failures = sum(len(cell["failures"]) for cell in cells.values())
        write_json(results, {**total, "failures": failures, "subjects": cells}, indent=1)
    return 1 if any(cells[subject.name]["failures"] for subject in subjects) else 0


def main() -> int:
    """Kill all subjects, write the result, and say whether anything failed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=22, help="of each subject")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", default=None, choices=[one.name for one in SUBJECTS])
    parser.add_argument("--folder", type=Path, default=None, help="work here, and keep what failed")
    options = parser.parse_args()
    subjects = [one for one in SUBJECTS if options.only is None or one.name in options.only]
    with tempfile.TemporaryDirectory() as scratch:
        root = (options.folder or Path(scratch)).resolve()

        def kill(subject: Subject) -> Found:
            folder = root / subject.name.replace(" ", "-")
            return run_subject(subject, options.kills, folder, random.Random(f"{options.seed} {subject.name}"))

        return run_campaign(RESULTS, subjects, kill, ("kills", "runs", "calls"))


if __name__ == "__main__":
    sys.exit(main())
