"""Whether the engine plays what it played at an earlier revision, to the last bit.

::

    python benchmarks/same_bits.py --before REVISION [--steps 1500] [--grids NAME ...]

Every case is a task, a heuristic and a way to play: random actions, mostly nothing, nothing. Both revisions play it in
processes of their own, 24 environments for so many decisions (a twentieth of them where a heuristic plays between
decisions). After every tenth of the case the two are compared: observations, rewards, ends, and all arrays that an
environment keeps from step to step, voltages and factors of the power flow included. What a later revision keeps
besides is not looked at, nor is the sign of a zero in what is kept (sums and products of numbers that agree but for it
agree but for it, and nothing is divided by zero). Matrices are compared apart: a revision may keep more entries of
them, or in another order, and find the same voltages.

It writes ``benchmarks/results/same_bits.json``: grid steps that were compared, and what differed, by case, and in how
many cases matrices did.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from pathlib import Path
from typing import Any

from parity import source_hash
from training import ROOT, output_of, revision

from rl2grid.grids import GRID_IDS
from rl2grid.records.files import write_json

RESULTS = ROOT / "benchmarks" / "results" / "same_bits.json"
HEURISTICS = {
    "T0": (None, "idle", "recovery", "careful", "secure"),
    "R": (None, "idle", "secure"),
    "H1": (None, "idle"),
}
PLAYS = ("random", "some", "nothing")
MATRICES = frozenset(
    f"flow.{name}"
    for name in (
        "admittance_first", "admittance_node", "admittance", "admittance_panel", "line_entry", "diagonal_entry",
        "first_column", "own_column", "first_panel", "own_panel", "column", "panel",
    )
)  # fmt: skip
"""Admittance matrices, Jacobians and their factors, and where their entries are."""
_PLAY = """
import hashlib, json, sys, warnings
import gymnasium, numpy as np
import rl2grid
from rl2grid.structures import Role, fields_of
warnings.simplefilter("ignore")
N = 24
grid, steps, heuristics, plays = sys.argv[1], int(sys.argv[2]), json.loads(sys.argv[3]), json.loads(sys.argv[4])

def nothing(actions):
    return {k: nothing(v) for k, v in actions.items()} if isinstance(actions, dict) else np.zeros_like(actions)

def some(actions, still):
    if isinstance(actions, dict):
        return {k: some(v, still) for k, v in actions.items()}
    actions[still] = 0
    return actions

def kept(environments):
    found = {}
    for part in ("state", "hidden", "flow", "opponent"):
        structure = getattr(environments, part)
        for name in fields_of(type(structure), Role.KEPT, Role.EPISODE):
            values = np.ascontiguousarray(getattr(structure, name))
            if values.dtype.kind == "f":
                values = values + 0.0  # a zero is a zero, whatever its sign
            found[f"{part}.{name}"] = hashlib.sha256(values.tobytes()).hexdigest()[:16]
    return found

def told(values):
    return b"".join(told(v) for v in values.values()) if isinstance(values, dict) else np.asarray(values).tobytes()

def play(kind, heuristic, how):
    decisions = steps if heuristic is None else max(steps // 20, 10)
    envs = gymnasium.make_vec(f"rl2grid/{grid}-{kind}-v0", num_envs=N, num_threads=1, heuristic=heuristic)
    environments = envs.unwrapped._rows.transitions.engine.environments
    seen, n_steps, hashes = hashlib.sha256(told(envs.reset(seed=5)[0])), 0, []
    envs.action_space.seed(3)
    random = np.random.default_rng(1)
    for k in range(decisions):
        actions = envs.action_space.sample()
        if how == "nothing":
            actions = nothing(actions)
        if how == "some":
            actions = some(actions, random.random(N) < 0.8)
        *results, info = envs.step(actions)
        for values in results:
            seen.update(told(values))
        n_steps += int(np.sum(info["n_steps"]))
        if (k + 1) % (decisions // 10) == 0:
            hashes.append(kept(environments) | {"returned": seen.hexdigest()[:16]})
    envs.close()
    return {"n_steps": n_steps, "hashes": hashes}

for kind, chosen in heuristics.items():
    for heuristic in chosen:
        for how in plays:
            print(json.dumps({"case": [grid, kind, heuristic, how]} | play(kind, heuristic, how)), flush=True)
"""


_SOURCE_HASH = """
import sys
sys.path.insert(0, "benchmarks")
from parity import source_hash
print(source_hash())
"""


def play(source: Path, grid: str, steps: int) -> list[dict[str, Any]]:
    """What a revision plays of all cases of a grid."""
    output = output_of(source, _PLAY, grid, str(steps), json.dumps(HEURISTICS), json.dumps(PLAYS))
    return [json.loads(line) for line in output.splitlines() if line.startswith(b"{")]


def differences(before: dict[str, Any], now: dict[str, Any]) -> dict[str, int]:
    """The first tenth of the case in which each array differs, by its name; of those that do."""
    found: dict[str, int] = {}
    for tenth, (old, new) in enumerate(zip(before["hashes"], now["hashes"], strict=True)):
        for name, value in old.items():
            if new.get(name) != value:
                found.setdefault(name, tenth + 1)
    return found


def main() -> None:
    """Play, compare, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--before", required=True, help="revision to compare with")
    parser.add_argument("--steps", type=int, default=1500, help="decisions of a case without a heuristic")
    parser.add_argument("--grids", nargs="+", choices=GRID_IDS, default=GRID_IDS)
    options = parser.parse_args()
    cases: list[dict[str, Any]] = []
    with revision(options.before) as old:
        before_source = output_of(old, _SOURCE_HASH).decode().split()[-1]
        for grid in options.grids:
            for before, now in zip(play(old, grid, options.steps), play(ROOT, grid, options.steps), strict=True):
                found = differences(before, now)
                others = {name: tenth for name, tenth in found.items() if name not in MATRICES}
                cases.append(
                    {
                        "case": now["case"],
                        "n_steps": now["n_steps"],
                        "differing": [f"{name} in tenth {tenth}" for name, tenth in others.items()],
                        "matrices_differ": not MATRICES.isdisjoint(found),
                    }
                )
            done = [case for case in cases if case["case"][0] == grid]
            n_differing = sum(bool(case["differing"]) for case in done)
            print(f"{grid}: {len(done)} cases, {sum(case['n_steps'] for case in done):,} grid steps, "
                  f"{n_differing} differ", flush=True)  # fmt: skip
            result = {
                "command": shlex.join(["python", "benchmarks/same_bits.py", *sys.argv[1:]]),
                "sources": {"before": before_source, "now": source_hash()},  # as benchmarks/results/parity.json has it
                "n_steps": sum(case["n_steps"] for case in cases),
                "n_differing": sum(bool(case["differing"]) for case in cases),
                "n_matrices_differing": sum(case["matrices_differ"] for case in cases),
                "cases": cases,
            }
            write_json(RESULTS, result)


if __name__ == "__main__":
    main()
