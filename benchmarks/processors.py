"""Whether trainings come out the same on other kinds of processors.

``python benchmarks/processors.py`` trains every algorithm for some iterations, once as this machine does, and in
processes whose compilers and libraries are told to choose code for other processors; it compares all weights of the
policies, bit by bit, after every iteration, and writes ``benchmarks/results/processors.json``. It ends with status 1 if
any differ. ``PYTHONPATH=OTHER/src`` asks for the sources of another checkout.

``python benchmarks/processors.py --again``, on another machine, trains once, compares with the weights of the machine
that wrote the results, and adds to them under ``elsewhere`` which trainings differ; status 1 likewise.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from rl2grid.records.files import write_json
from rl2grid.records.versions import library_versions, processor

RESULTS = Path(__file__).resolve().parent / "results" / "processors.json"
ITERATIONS = 4
TRAININGS: tuple[tuple[str, str], ...] = (
    ("ppo", "bus14-T0"),
    ("ppo", "bus14-R"),
    ("lagrangian-ppo", "bus14-T0-TLO"),
    ("dqn", "bus14-T0"),
    ("sac", "bus14-T0"),
    ("sac", "bus14-R"),
    ("td3", "bus14-R"),
)
_NO_AVX512 = "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR"
PROCESSORS: dict[str, dict[str, str]] = {
    "this one": {},
    "AVX-512 in PyTorch": {"ATEN_CPU_CAPABILITY": "avx512"},
    "oneDNN for any processor": {"ONEDNN_MAX_CPU_ISA": "SSE41"},
    "AVX2 throughout": {
        "NUMBA_CPU_NAME": "haswell",
        "NUMBA_CPU_FEATURES": "+avx,+avx2,+fma,+bmi,+bmi2,+lzcnt,+popcnt,+f16c,+movbe,+sse4.1,+sse4.2",
        "ONEDNN_MAX_CPU_ISA": "SSE41",
        "NPY_DISABLE_CPU_FEATURES": _NO_AVX512,
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-AVX2_Usable,-FMA,-FMA_Usable,-FMA4",
    },
}
"""What is chosen, by environment variables of Numba, PyTorch, oneDNN, NumPy and the C library."""


def train() -> None:
    """Print a hash of the policy of every training, before it and after each iteration."""
    from rl2grid.algorithms.registry import find_algorithm
    from rl2grid.training.request import RunArgs, hyperparameters
    from rl2grid.training.runs import make_envs

    for algorithm, task in TRAININGS:
        small: dict[str, Any] = {"total_timesteps": 4096, "num_envs": 8, "num_steps": 32}
        if "learning_starts" in find_algorithm(algorithm).type_hints():
            small["learning_starts"] = 64
        chosen = hyperparameters(algorithm, task, **small)
        envs = make_envs(RunArgs(task, chosen, algorithm, num_threads=1))
        trainer = find_algorithm(algorithm).trainer(chosen, envs)
        hashes = [_hash(trainer)]
        for _ in range(ITERATIONS):
            trainer.iterate()
            hashes.append(_hash(trainer))
        envs.close()
        print(json.dumps([f"{algorithm} {task}", hashes]), flush=True)


def _hash(trainer: Any) -> str:
    digest = hashlib.sha256()
    for weights in trainer.policy()[0].state_dict().values():
        digest.update(weights.detach().numpy().tobytes())
    return digest.hexdigest()[:16]


def trained(variables: dict[str, str]) -> dict[str, list[str]]:
    """The hashes of all trainings in a process with these environment variables."""
    command = [sys.executable, __file__, "--train"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"} | variables
    output = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True).stdout
    return dict(json.loads(line) for line in output.splitlines())


def again(results: Path) -> int:
    """Compare with the machine that wrote the results, and add what came out."""
    written = json.loads(results.read_text())
    differing = [run for run, hashes in trained({}).items() if hashes != written["hashes"][run]]
    print(f"{processor()}: {', '.join(differing) or 'none'} differ from {written['processor']}")
    written["elsewhere"][processor()] = {"versions": library_versions(), "differing": differing}
    write_json(results, written, indent=1)
    return int(bool(differing))


def main() -> int:
    """Compare them, and write what came out."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--train", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--again", action="store_true", help="compare with the machine of the results")
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    if arguments.train:
        train()
        return 0
    if arguments.again:
        return again(arguments.results)
    found: dict[str, dict[str, list[str]]] = {}
    differing: dict[str, list[str]] = {}
    for name, variables in PROCESSORS.items():
        found[name] = trained(variables)
        differing[name] = [run for run, hashes in found[name].items() if hashes != found["this one"][run]]
        print(f"{name}: {', '.join(differing[name]) or 'the same'}", flush=True)
    result = {
        "command": "python benchmarks/processors.py",
        "processor": processor(),
        "versions": library_versions(),
        "hashes": found["this one"],
        "variables": PROCESSORS,
        "differing": differing,
        "elsewhere": {},
    }
    write_json(arguments.results, result, indent=1)
    return int(any(differing.values()))


if __name__ == "__main__":
    sys.exit(main())
