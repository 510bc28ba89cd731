"""A run as long as the paper's: memory, descriptors and disk of one training, and what it comes to.

``python benchmarks/large_run.py FOLDER [--task bus14-T0] [--decisions 80000000] [FLAGS OF rl2grid train ppo]`` trains
PPO with seed 1 in a process of its own, looks at that process every minute, and writes
``benchmarks/results/large_run.json``. It goes on where it was interrupted: samples are in ``FOLDER.samples.jsonl``, the
run in ``FOLDER``. Test months are not touched.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from endurance import anonymous_bytes

from rl2grid.records.files import write_json
from rl2grid.records.metrics import read_validations

RESULTS = Path(__file__).resolve().parent / "results" / "large_run.json"
SAMPLE_SECONDS = 60.0
SHOWN_SAMPLES = 40


def sample(process: int, folder: Path) -> dict[str, float]:
    """What a training holds at this moment."""
    home = Path("/proc") / str(process)
    clock = (home / "stat").read_text().rpartition(")")[2].split()[11:13]
    return {
        "seconds": round(sum(map(int, clock)) / os.sysconf("SC_CLK_TCK"), 1),
        "anonymous_mb": round(anonymous_bytes(home) / 2**20, 1),
        "descriptors": len(os.listdir(home / "fd")),
        "run_folder_mb": round(sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 2**20, 2),
    }


def watch(command: list[str], folder: Path, samples: Path) -> int:
    """Run a training to its end, and add a line to ``samples`` every minute; its exit status."""
    with subprocess.Popen(command) as training:
        try:
            while training.poll() is None:
                time.sleep(SAMPLE_SECONDS)
                if training.poll() is None and folder.is_dir():
                    with samples.open("a") as file:
                        file.write(json.dumps(sample(training.pid, folder)) + "\n")
        except KeyboardInterrupt:
            training.wait()
        return training.returncode


def result(folder: Path, samples: Path, command: str) -> dict[str, Any]:
    """What is kept: samples evenly spaced over all processes, validations, and what the run took."""
    taken = [json.loads(line) for line in samples.read_text().splitlines()]
    step = max(len(taken) // SHOWN_SAMPLES, 1)
    validations = read_validations(folder)
    half = taken[len(taken) // 2 :]
    return {
        "command": command,
        "decisions": max(validations),
        "samples_taken": len(taken),
        "second_half": {name: [min(one[name] for one in half), max(one[name] for one in half)] for name in half[0]},
        "samples": taken[::step],
        "validation_survival": [[step, round(values["survival"], 4)] for step, values in validations.items()],
        "energy": json.loads((folder / "energy.json").read_text()),
    }


def main() -> int:
    """Train, or go on, and write what was seen."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--task", default="bus14-T0")
    parser.add_argument("--decisions", type=int, default=80_000_000)
    options, flags = parser.parse_known_args()
    folder, samples = options.folder, Path(f"{options.folder}.samples.jsonl")
    program = [sys.executable, "-m", "rl2grid", "train"]
    new = ["ppo", options.task, "--decisions", str(options.decisions), "--seed", "1", "--output", str(folder), *flags]
    status = watch([*program, *(["--resume", str(folder)] if folder.exists() else new), "--quiet"], folder, samples)
    if status:
        return status
    command = shlex.join(["rl2grid", "train", *(word if word != str(folder) else "FOLDER" for word in new)])
    write_json(RESULTS, result(folder, samples, command), indent=1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
