"""What becomes of damaged files: copies of every kind of stored file are damaged, and read as the commands read them.

::

    python benchmarks/damage.py [--number 5000] [--seed 0] [--only KIND ...]   # into benchmarks/results/damage.json

A damage flips some bits, cuts the end off, empties the file, puts another file in its place, or changes its shape (an
entry of JSON is taken out or gets another type, with a checksum that agrees: forged, so that another result is none of
our business). It may end in the same result, with or without
a warning, in a warning that says what was lost, or in a refusal (:class:`UsageError`). Anything else is a failure: an
exception of another kind, or another result without a word. An interrupted campaign goes on with the same command;
damage ``k`` of a kind is a function of the seed, the kind and ``k``.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numba
import numpy as np

from rl2grid.algorithms.policy_agent import load_agent
from rl2grid.compiled_files import keep_code_of
from rl2grid.engines import ENGINES  # noqa: F401 - loads the native engine before anything is measured
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError
from rl2grid.evaluation.protocol import evaluate
from rl2grid.grids import load_grid
from rl2grid.ledger.making import make_entry
from rl2grid.records.collection import collect
from rl2grid.records.entries import read_entry, write_entry
from rl2grid.records.evaluation_folder import FolderStore
from rl2grid.records.evaluations import load_evaluation, read_description
from rl2grid.records.files import CHECKSUM, DamageWarning, write_json, write_record
from rl2grid.records.labels import read_labels
from rl2grid.records.ledger import add_test, hashed_test, read_ledger
from rl2grid.records.searches import read_search, write_search
from rl2grid.records.studies import read_result
from rl2grid.records.trainings import read_energy, read_tracking, read_training_run, write_tracking
from rl2grid.scenarios import generated
from rl2grid.scenarios.cache import remove_damaged
from rl2grid.scenarios.folder import FolderContent
from rl2grid.scenarios.imported import load_imported, store_imported
from rl2grid.scenarios.library import list_scenarios, load_scenario
from rl2grid.scenarios.series_hash import hash_of_series
from rl2grid.studies.cell import prepare, run_cell
from rl2grid.studies.run import record_study
from rl2grid.studies.states import read_states
from rl2grid.studies.study import load_study, parse_study
from rl2grid.training import request, runs
from rl2grid.training.limits import TimeLimit
from rl2grid.training.teaching import teach

RESULTS = Path(__file__).parent / "results" / "damage.json"
TASK = find_task("bus14-T0")
WAYS = ("flipped", "cut", "emptied", "replaced", "reshaped")
STUDY = {
    "name": "damage",
    "split": "validation",
    "group": [{"tasks": ["bus14-T0"], "agents": ["do-nothing", "random"], "months": 2}],
}


@dataclass(frozen=True)
class Kind:
    """A kind of stored file."""

    name: str
    sample: str
    """Folder of the sample that it is damaged in."""
    files: str
    """Pattern of the file's name in there."""
    read: Callable[[Path], Any]
    """The result of reading the folder, to be compared."""
    share: float = 1.0
    """How often it is damaged, relative to others: less where reading takes seconds."""
    by_hand: bool = False
    """Written by people: what was changed may be meant, so that another result is none of our business."""
    alone: bool = False
    """Stands for itself: another sound file of its kind in its place is sound."""


@dataclass
class Found:
    """What came of the damages of one kind."""

    damages: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    """Same result, ``warned`` or ``refused``, and ``failed``."""
    failures: list[str] = field(default_factory=list)
    """The first of them in words."""


# --- Samples --------------------------------------------------------------------------------------------------------


def make_samples(folder: Path) -> None:
    """One of everything, and another one to put in its place."""
    months = list_scenarios("bus14", "validation")[:2]
    for number, name in enumerate(("one", "other")):
        evaluate("random", TASK, scenarios=months, seeds=[number], output=folder / f"evaluation-{name}")
        shutil.copytree(folder / f"evaluation-{name}", folder / f"partial-{name}")
        _make_partial(folder / f"partial-{name}")
        for algorithm in ("ppo", "dqn"):
            run = _train(folder / f"{algorithm}-{name}", algorithm, seed=number + 1)
            write_tracking(run, f"id{number}")
        teach("greedy", TASK, months=2, output=folder / f"labels-{name}", seed=number, workers=0, episode_length=200)
        results = folder / f"results-{name}"
        results.mkdir()
        write_entry(results / "entry.json", make_entry(folder / f"evaluation-{name}"))
        evaluation = load_evaluation(folder / f"evaluation-{name}")
        for heuristic in (None, "idle"):
            configuration = {"agent": f"random-{name}", "task": TASK.id, "heuristic": heuristic}
            add_test(results / "ledger.json", hashed_test(configuration, {}, evaluation))
        write_search(results, {"name": name, "seeds": [number], "task": TASK.id, "budget": 1000 + number})
        (results / "study.toml").write_text(_toml(number))
        _make_study(folder / f"study-{name}", seeds=number + 1)
        _make_data(folder / f"data-{name}", seed=3 + number)
        _call(folder / f"code-{name}", (_double, _triple)[number])


def _train(folder: Path, algorithm: str, seed: int) -> Path:
    """A run that was stopped in its middle."""
    sizes: dict[str, Any] = {"num_envs": 4, "num_steps": 8, "total_timesteps": 128, "seed": seed}
    if algorithm == "dqn":
        sizes |= {"learning_starts": 16, "batch_size": 8, "buffer_size": 160, "layers": (8,)}
    else:
        sizes |= {"update_epochs": 1, "actor_layers": (8,), "critic_layers": (8,)}
    args = request.RunArgs(
        task=TASK,
        hyperparameters=request.hyperparameters(algorithm, TASK, **sizes),
        algorithm=algorithm,
        folder=folder,
        num_threads=1,
        evaluate_every=32,
        checkpoint_seconds=0.0,
        env_keywords={"split": "train", "heuristic": None},
        tensorboard=False,
        progress=False,
    )
    return runs.train(args, evaluate=lambda agent: {"survival": 0.5}, limit=TimeLimit(1e-9))


def _make_partial(folder: Path) -> None:
    """An evaluation that was broken off before its last row."""
    episodes = load_evaluation(folder).episodes
    described = read_description(folder).request
    shutil.rmtree(folder)
    store = FolderStore(folder, described, described["command"])
    for episode in episodes[:-1]:
        store.add(episode)
    store.close()


def _make_study(folder: Path, seeds: int) -> None:
    study = parse_study({**STUDY, "evaluation_seeds": seeds}, output=folder)
    for cell in study.cells:
        prepare(study.folder(cell), cell)
        run_cell(study.folder(cell))
    record_study(study, read_states(study))


def _toml(number: int) -> str:
    return (
        f'name = "damage"\nsplit = "validation"\nseeds = [{number}]\n\n[[group]]\ntasks = ["bus14-T0"]\n'
        'agents = ["do-nothing"]\nmonths = 2\n'
    )


def _make_data(folder: Path, seed: int) -> None:
    """A data folder with a pack, its expanded copy and an imported series."""
    _in_data(folder, lambda: generated.load_generated(load_grid("bus14"), f"{seed}-00"))
    scenario = load_scenario("bus14", "bundled/0000").window(seed, 300)
    arrays = {name: np.array(getattr(scenario, name)) for name in ("load_p", "load_q", "prod_p", "prod_v")}
    content = FolderContent(scenario.start_datetime, arrays)
    _in_data(folder, lambda: store_imported(load_grid("bus14"), "mine", content))


def _double(x: int) -> int:
    return 2 * x


def _triple(x: int) -> int:
    return 3 * x


def _call(folder: Path, function: Callable[[int], int]) -> int:
    """Call a function as a process does that finds its machine code in the folder, or compiles it."""
    compiled = numba.njit(function)
    keep_code_of(compiled, folder)
    return int(compiled(4))


def _in_data(folder: Path, do: Callable[[], Any]) -> Any:
    before = os.environ.get("RL2GRID_DATA")
    os.environ["RL2GRID_DATA"] = str(folder)
    try:
        return do()
    finally:
        if before is None:
            del os.environ["RL2GRID_DATA"]
        else:
            os.environ["RL2GRID_DATA"] = before


# --- Reading --------------------------------------------------------------------------------------------------------


def _resumed(folder: Path) -> Any:
    """What a run ends with."""
    runs.resume(folder, evaluate=lambda agent: {"survival": 0.5})
    return load_agent(folder / "checkpoint.pt").identity["policy_hash"], load_agent(folder).identity["policy_hash"]


def _described(folder: Path) -> Any:
    args, identity = request.read_config(folder)
    run = read_training_run(folder)
    return args.hyperparameters, args.env_keywords, args.task, identity, run.settings, run.seed


def _curve(folder: Path) -> Any:
    metrics = read_training_run(folder).curve.metrics
    return {name: (metric.decisions.tolist(), metric.values.tolist()) for name, metric in metrics.items()}


def _is_shorter(way: str, kind: Kind) -> bool:
    """Whether a damage leaves what a kill leaves of a file that grows: fewer rows are no fault."""
    return way == "cut" and kind.name == "metrics.csv"


def _played(folder: Path) -> Any:
    result = load_evaluation(folder)
    return result.episodes, result.identity, result.command


def _learned_from(folder: Path) -> Any:
    description, labels = read_labels([folder], TASK.id)
    return description, [None if each is None else each.tobytes() for each in vars(labels).values()]


def _gone_on(folder: Path) -> Any:
    months = list_scenarios("bus14", "validation")[:2]
    result = evaluate("random", TASK, scenarios=months, seeds=[0], output=folder)
    return [replace(episode, wall_time_s=0.0) for episode in result.episodes]


def _collected(folder: Path) -> Any:
    study = parse_study({**STUDY, "evaluation_seeds": 1}, output=folder)
    for cell in study.cells:
        prepare(study.folder(cell), cell)
    results = [read_result(study.folder(cell)) for cell in study.cells]
    states = [(state.state, state.result, state.error) for state in read_states(study)]
    collection = collect([str(folder)])
    return results, states, [(each.episodes, each.identity) for each in collection.evaluations], collection.missing


def _entered(folder: Path) -> Any:
    entry = read_entry(folder / "entry.json")
    actions = [hashlib.sha256(one.actions.tobytes()).hexdigest() for one in entry.episodes]
    return entry.label, entry.identity, entry.command, entry.training, [one.episode for one in entry.episodes], actions


def _made(folder: Path) -> Any:
    """A month without its expanded copy: from its pack, or made again."""

    def load() -> Any:
        name, grid = _month_of(folder), load_grid("bus14")
        shutil.rmtree(folder / "series", ignore_errors=True)
        hashes = generated.series_hash(grid, name)
        series = generated.load_generated(grid, name)
        return hashes, hash_of_series(*(series.arrays[each] for each in ("load_p", "load_q", "prod_p")))

    return _in_data(folder, load)


def _expanded(folder: Path) -> Any:
    def load() -> Any:
        remove_damaged("bus14")
        series = generated.load_generated(load_grid("bus14"), _month_of(folder))
        return series.content_hash, hash_of_series(*(series.arrays[each] for each in ("load_p", "load_q", "prod_p")))

    return _in_data(folder, load)


def _imported(folder: Path) -> Any:
    def load() -> Any:
        shutil.rmtree(folder / "series", ignore_errors=True)
        return load_imported(load_grid("bus14"), "mine").content_hash

    return _in_data(folder, load)


def _month_of(folder: Path) -> str:
    return "3-00" if (folder / "one").exists() else "4-00"


KINDS = (
    Kind("config.json, resumed", "dqn", "config.json", _resumed, 0.2),
    Kind("checkpoint.pt, resumed", "dqn", "checkpoint.pt", _resumed, 0.2),
    Kind("metrics.csv, resumed", "ppo", "metrics.csv", _resumed, 0.2, alone=True),
    Kind("energy.json, resumed", "ppo", "energy.json", _resumed, 0.2, alone=True),
    Kind("replay, resumed", "dqn", "replay/*.*", _resumed, 0.4),
    Kind("config.json", "ppo", "config.json", _described, alone=True),
    Kind("best.pt", "ppo", "best.pt", lambda folder: load_agent(folder).identity),
    Kind("metrics.csv", "ppo", "metrics.csv", _curve, alone=True),
    Kind("energy.json", "ppo", "energy.json", read_energy, alone=True),
    Kind("wandb.json", "ppo", "wandb.json", read_tracking, alone=True),
    Kind("evaluation.json", "evaluation", "evaluation.json", _played),
    Kind("episodes.csv", "evaluation", "episodes.csv", _played),
    Kind("episodes.partial.csv", "partial", "episodes.partial.csv", _gone_on, 0.2),
    Kind("labels.json", "labels", "labels.json", _learned_from),
    Kind("labels of a month", "labels", "round-*/*.npz", _learned_from),
    Kind("cell.json", "study", "cells/*/cell.json", _collected, 0.5),
    Kind("result.json", "study", "cells/*/result.json", _collected, 0.5),
    Kind("study.json", "study", "study.json", _collected, 0.5),
    Kind("entry", "results", "entry.json", _entered, alone=True),
    Kind("ledger", "results", "ledger.json", lambda folder: read_ledger(folder / "ledger.json"), alone=True),
    Kind("tuning.json", "results", "tuning.json", read_search, alone=True),
    Kind(
        "study.toml",
        "results",
        "study.toml",
        lambda folder: load_study(str(folder / "study.toml")),
        by_hand=True,
        alone=True,
    ),
    Kind("index of compiled code", "code", "*/*.nbi", lambda folder: _call(folder, _double), 0.5),
    Kind("compiled code", "code", "*/*.nbc", lambda folder: _call(folder, _double), 0.5),
    Kind("pack", "data", "packs/*/*/*.pack", _made, 0.1),
    Kind("expanded series", "data", "series/*/*/generated.*.npy", _expanded, 0.3),
    Kind("manifest of a series", "data", "series/*/*/generated.*.json", _expanded, 0.3),
    Kind("imported series", "data", "imported/*/mine.npz", _imported, 0.5, alone=True),
)


# --- Damages --------------------------------------------------------------------------------------------------------


def damage(path: Path, others: list[Path], way: str, draws: random.Random) -> str:
    """Damage a file in one way; says what was done."""
    content = path.read_bytes()
    if way == "flipped":
        number = draws.choice((1, 1, 2, 8, 20))
        damaged = bytearray(content)
        for place in (draws.randrange(8 * len(content)) for _ in range(number if content else 0)):
            damaged[place // 8] ^= 1 << place % 8
        path.write_bytes(damaged)
        return f"{number} bits flipped"
    if way == "cut":
        length = draws.randrange(len(content) + 1)
        path.write_bytes(content[:length])
        return f"cut to {length} of {len(content)} bytes"
    if way == "emptied":
        path.write_bytes(b"")
        return way
    if way == "reshaped" and path.suffix == ".json":
        try:
            value = json.loads(content)
        except ValueError:
            value = None
        if isinstance(value, dict) and value:
            return _reshape(path, value, draws)
    other = draws.choice(others)
    path.write_bytes(other.read_bytes())
    return f"replaced by {other.parent.name}/{other.name}"


def _reshape(path: Path, value: dict[str, Any], draws: random.Random) -> str:
    """Take out an entry somewhere, or give it another type, with a checksum that agrees."""
    value.pop(CHECKSUM, None)
    place, words = value, []
    while True:
        key = draws.choice(list(place))
        words.append(str(key))
        inside = place[key]
        if not isinstance(inside, dict) or not inside or draws.random() < 0.3:
            break
        place = inside
    another = draws.choice(("taken out", None, "text", -1, [], {}, True, 1e400, [[[]]]))
    if another == "taken out":
        del place[key]
    else:
        place[key] = another
    write_record(path, value)
    return f"{'.'.join(words)} is {another!r}"


def outcome(kind: Kind, folder: Path, expected: str | None) -> tuple[str, str]:
    """How reading a damaged folder ends, and the failure in words; ``expected`` None: any result will do."""
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            found = kind.read(folder)
        except UsageError as error:
            lines = str(error).strip().splitlines()
            return ("refused", "") if len(lines) == 1 else ("failed", f"a refusal of {len(lines)} lines")
        except Exception as error:
            frame = traceback.extract_tb(error.__traceback__)[-1]
            return "failed", f"{type(error).__name__}: {error} ({Path(frame.filename).name}:{frame.lineno})"
    if any(issubclass(each.category, DamageWarning) for each in warned):
        return "warned", ""
    if expected is None or _plain(found) == expected:
        return "same", ""
    return "failed", "another result without a word"


def _plain(value: Any) -> str:
    return repr(value)


def run(kind: Kind, samples: Path, scratch: Path, found: Found, until: int, seed: int) -> None:
    """Damage one kind until there are so many damages, those of earlier calls included."""
    sample = samples / f"{kind.sample}-one"
    others = _others(kind, samples)
    _copy(sample, scratch)
    expected = _plain(kind.read(scratch))
    saved = time.monotonic()
    while found.damages < until:
        # hashlib: Python's own hash of a text differs from process to process.
        draws = random.Random(hashlib.sha256(f"{seed} {kind.name} {found.damages}".encode()).digest())
        _copy(sample, scratch)
        path = draws.choice(sorted(scratch.glob(kind.files)))
        alike = sorted((samples / f"{kind.sample}-other").glob(kind.files))
        by_alike = not kind.alone and draws.random() < 0.5
        way = WAYS[found.damages % len(WAYS)]
        words = damage(path, alike if by_alike else others, way, draws)
        any_will_do = kind.by_hand or " is " in words or _is_shorter(way, kind)
        ended, why = outcome(kind, scratch, None if any_will_do else expected)
        if ended == "failed" and len(found.failures) < 20:
            found.failures.append(f"{path.relative_to(scratch)}, {words}: {why}")
        found.outcomes[ended] += 1
        found.damages += 1
        if time.monotonic() - saved > 30:
            yield_to_disk()
            saved = time.monotonic()


def _others(kind: Kind, samples: Path) -> list[Path]:
    """Files of other kinds."""
    names = {path.name for path in samples.glob(f"{kind.sample}-*/{kind.files}")}
    files = [path for path in sorted(samples.rglob("*")) if path.is_file() and not path.name.startswith(".")]
    return [path for path in files if path.name not in names and path.stat().st_size < 2**20]


_STATE: dict[str, Found] = {}


def yield_to_disk() -> None:
    """Write what was found so far."""
    kinds = {
        name: {"damages": one.damages, **dict(sorted(one.outcomes.items())), "failures": one.failures}
        for name, one in _STATE.items()
    }
    total = Counter[str]()
    for one in _STATE.values():
        total += one.outcomes
    write_json(
        RESULTS, {"command": _command(), "damages": sum(total.values()), **dict(sorted(total.items())), "kinds": kinds}
    )


def _command() -> str:
    return f"python benchmarks/damage.py {' '.join(sys.argv[1:])}".strip()


def _stored() -> dict[str, Found]:
    if not RESULTS.exists():
        return {}
    kinds = json.loads(RESULTS.read_text())
    if kinds["command"] != _command():
        return {}
    names = ("same", "warned", "refused", "failed")
    return {
        name: Found(one["damages"], Counter({each: one[each] for each in names if each in one}), one["failures"])
        for name, one in kinds["kinds"].items()
    }


def _copy(sample: Path, scratch: Path) -> None:
    shutil.rmtree(scratch, ignore_errors=True)
    shutil.copytree(sample, scratch)
    if sample.name == "data-one":
        (scratch / "one").write_text("")


def main() -> None:
    """Damage every kind."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--number", type=int, default=5000, help="damages of all kinds together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", default=None, help="these kinds alone; nothing is written")
    options = parser.parse_args()
    kinds = [kind for kind in KINDS if options.only is None or kind.name in options.only]
    if options.only is None:
        _STATE.update(_stored())
    unit = options.number / sum(kind.share for kind in kinds)
    with tempfile.TemporaryDirectory() as folder:
        samples = Path(folder) / "samples"
        samples.mkdir()
        make_samples(samples)
        for kind in kinds:
            found = _STATE.setdefault(kind.name, Found())
            run(kind, samples, Path(folder) / "scratch", found, -int(-unit * kind.share // 1), options.seed)
            print(
                f"{kind.name}: {found.damages} damages, {dict(found.outcomes)}", *found.failures, sep="\n  ", flush=True
            )
            if options.only is None:
                yield_to_disk()
    failed = sum(found.outcomes["failed"] for found in _STATE.values())
    print(f"{sum(found.damages for found in _STATE.values())} damages, {failed} failures.")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
