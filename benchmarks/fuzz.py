"""Random steps without end: environments as users make them, and what must hold of every step.

``python benchmarks/fuzz.py [--steps 1000000] [--grids ...] [--kinds T R H]`` plays so many grid steps per grid and kind
of action, a quarter without a heuristic and with each of three, and as many more with ``secure`` and operator features,
and writes ``benchmarks/results/fuzz.json``. Half of the environments play legal actions, the others whatever the space
has; now and then an environment is saved, played on and brought back, and must play the same again; forecasts asked for
twice must be the same. Whatever breaks a rule of :func:`broken_rules`, raises an exception or is another step after
coming back counts as a failure. Redispatching plays some of its steps with Grid2Op's own solver, which takes most of
the time. A cell that is in the results with as many steps and the same seed is not played again.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

import rl2grid
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.records.files import write_json

RESULTS = Path(__file__).resolve().parent / "results" / "fuzz.json"
NUM_ENVS = 32
KINDS = ("T", "R", "H")
SETTINGS: tuple[dict[str, Any], ...] = (
    {"heuristic": None, "split": "train", "gamma": 0.99},
    {"heuristic": "idle", "split": "bundled", "normalize": None, "reward": "paper"},
    {"heuristic": "recovery", "split": "train", "constraint": "TLO", "gamma": 0.9},
    {"heuristic": "careful", "split": "train", "constraint": "LSI", "reward": "released"},
)
SECURE: dict[str, Any] = {"heuristic": "secure", "split": "train", "operator_features": "all"}
"""Played beside :data:`SETTINGS`, as many steps as each of them."""
SOLVER_OF_GRID2OP: dict[str, Any] = {"heuristic": "idle", "split": "train", "dispatch": "grid2op"}
SHARE_OF_SOLVER = 0.01
"""Of the steps of a grid, played with :data:`SOLVER_OF_GRID2OP` behind the others."""
EVERY = 50
"""Steps after which one environment is saved, and after which it is brought back."""
TOLERANCE = 1e-9
"""Relative, of sums of rewards that are added up in another order."""
EXAMPLES = 10
"""Failures of a cell that are put into words."""


@dataclass
class Found:
    """What a cell came to."""

    grid_steps: int = 0
    decisions: int = 0
    episodes: int = 0
    completed: int = 0
    illegal: int = 0
    brought_back: int = 0
    game_overs: Counter[str] = field(default_factory=Counter)
    failures: int = 0
    examples: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def fail(self, words: str) -> None:
        """Count a failure."""
        self.failures += 1
        if len(self.examples) < EXAMPLES:
            self.examples.append(words)


@dataclass
class Sums:
    """What the transitions of the episodes under way add up to."""

    steps: NDArray[np.int64]
    rewards: NDArray[np.float64]

    def begin(self, infos: dict[str, Any], where: NDArray[np.bool_]) -> None:
        """Begin an episode with what its reset played."""
        self.steps[where] = infos["reset_steps"][where]
        self.rewards[where] = infos["reset_reward"][where]


def task_id(grid: str, kind: str) -> str:
    """The task of a kind with the most actions."""
    level = "" if kind == "R" else len(load_grid(grid).level_sizes) - 1
    return f"rl2grid/{grid}-{kind}{level}-v0"


def settings_of(kind: str, steps: int) -> Iterator[tuple[str, dict[str, Any], int]]:
    """Name, keywords and number of grid steps of the cells of a kind on one grid."""
    for setting in SETTINGS:
        yield setting["heuristic"] or "no heuristic", setting, -(-steps // len(SETTINGS))
    yield "secure", SECURE, -(-steps // len(SETTINGS))
    if kind != "T":
        yield "Grid2Op's solver", SOLVER_OF_GRID2OP, round(steps * SHARE_OF_SOLVER)


def actions_of(envs: Any, draws: np.random.Generator) -> Any:
    """Actions of all environments as the vector takes them."""
    space = envs.single_action_space
    if isinstance(space, gymnasium.spaces.Discrete):
        return topology_of(envs, int(space.n), draws)
    if isinstance(space, gymnasium.spaces.Dict):
        topology = topology_of(envs, int(space["topology"].n), draws)
        return {"topology": topology, "injection": injection_of((envs.num_envs, *space["injection"].shape), draws)}
    return injection_of(envs.action_space.shape, draws)


def topology_of(envs: Any, n_actions: int, draws: np.random.Generator) -> NDArray[np.int64]:
    """Legal actions for the first half of the environments, any for the others."""
    actions = draws.integers(n_actions, size=envs.num_envs)
    masks = envs.action_masks()
    for i in range(envs.num_envs // 2):
        actions[i] = draws.choice(np.flatnonzero(masks[i]))
    actions[draws.random(envs.num_envs) < draws.choice([0.0, 0.5, 0.95])] = 0
    return actions


def injection_of(shape: tuple[int, ...], draws: np.random.Generator) -> NDArray[np.float32]:
    """Small, large and extreme requests, and none at all."""
    actions = draws.uniform(-1.0, 1.0, shape) * draws.choice([0.02, 0.2, 1.0], size=(shape[0], 1))
    corners = draws.random(shape[0]) < 0.2
    actions[corners] = draws.choice([-1.0, 0.0, 1.0], size=(int(corners.sum()), shape[1]))
    actions[draws.random(shape[0]) < 0.3] = 0.0
    return actions.astype(np.float32)


def broken_rules(
    envs: Any, outcome: tuple[Any, ...], sums: Sums, legal: NDArray[np.bool_], reward: str
) -> Iterator[str]:
    """What a step breaks of what is promised; ``legal`` marks environments whose action was legal."""
    observations, rewards, terminated, truncated, infos = outcome
    over = terminated | truncated
    last = ended_infos(infos, over)
    played = last["n_steps"]
    yield from (name for name, bad in {
        "an observation is not finite": ~np.isfinite(observations).all(axis=1),
        "a reward is not finite": ~np.isfinite(rewards),
        "a reward is negative": (rewards < 0) & (reward == "default"),
        "both terminated and truncated": terminated & truncated,
        "terminated without a game over": terminated & (last["game_over"] == 0),
        "alive with a game over": ~over & (last["game_over"] != 0),
        "completed, but survival is not 1": truncated & (last["survival"] != 1.0),
        "survival outside of 0 to 1": (last["survival"] < 0) | (last["survival"] > 1),
        "more steps than the episode has": last["step"] > last["episode_length"],
        "a transition without a step": (played < 1) & ~(over & (last["reset_steps"] == last["step"])),
        "steps that no transition has": last["step"] != sums.steps + played,
        "rewards that no transition has": ~np.isclose(
            last["episode_return"], sums.rewards + rewards, rtol=TOLERANCE, atol=1e-6
        ),
        "a legal action was called illegal": legal & last["illegal"].astype(bool),
        "negative costs": np.stack(list(last["costs"].values())).min(axis=0) < 0,
    }.items() if bad.any())  # fmt: skip


def ended_infos(infos: dict[str, Any], over: NDArray[np.bool_]) -> dict[str, Any]:
    """Infos of the transitions: of environments whose episode ended, those of its end."""
    if not over.any():
        return infos
    final = infos["final_info"]
    names = ("n_steps", "step", "episode_length", "survival", "game_over", "illegal", "reset_steps", "episode_return")
    merged = {name: np.where(over, final[name], infos[name]) for name in names}
    costs = {name: np.where(over, final["costs"][name], values) for name, values in infos["costs"].items()
             if not name.startswith("_")}  # fmt: skip
    return merged | {"costs": costs, "game_over_text": np.where(over, final["game_over_text"], "")}


def play(grid: str, kind: str, setting: dict[str, Any], steps: int, seed: int, bar: Any) -> Found:
    """Play a cell."""
    found, began = Found(), time.monotonic()
    draws = np.random.default_rng([seed, GRID_IDS.index(grid), KINDS.index(kind)])
    envs: Any = gymnasium.make_vec(task_id(grid, kind), num_envs=NUM_ENVS, num_threads=1, **setting)
    try:
        _play(envs, setting, steps, draws, seed, found, bar)
    except Exception as error:  # whatever is raised is what is looked for
        frame = traceback.extract_tb(error.__traceback__)[-1]
        found.fail(f"{type(error).__name__}: {error} ({Path(frame.filename).name}:{frame.lineno})")
    envs.close()
    found.seconds = round(time.monotonic() - began, 1)
    return found


def _play(
    envs: Any, setting: dict[str, Any], steps: int, draws: np.random.Generator, seed: int, found: Found, bar: Any
) -> None:
    _, infos = envs.reset(seed=seed)
    sums = Sums(np.zeros(NUM_ENVS, np.int64), np.zeros(NUM_ENVS))
    sums.begin(infos, np.ones(NUM_ENVS, np.bool_))
    reward, discrete = setting.get("reward", "default"), hasattr(envs.single_action_space, "n")
    while found.grid_steps < steps:
        actions = actions_of(envs, draws)
        legal = envs.action_masks()[np.arange(NUM_ENVS), actions] if discrete else np.zeros(NUM_ENVS, np.bool_)
        if found.decisions // NUM_ENVS % EVERY == 0:
            _bring_back(envs, actions, found)
            if not infos["over"].any():  # there is no forecast of an episode that ended inside reset
                _foresee(envs, found)
        outcome = envs.step(actions)
        for words in broken_rules(envs, outcome, sums, legal, reward):
            found.fail(f"{words} (decision {found.decisions // NUM_ENVS})")
        _, rewards, terminated, truncated, infos = outcome
        over = terminated | truncated
        last = ended_infos(infos, over)
        sums.steps += last["n_steps"]
        sums.rewards += rewards
        sums.begin(infos, over)
        played = int(last["n_steps"].sum())
        found.grid_steps += played
        found.decisions += NUM_ENVS
        found.episodes += int(over.sum())
        found.completed += int(truncated.sum())
        found.illegal += int(last["illegal"].sum())
        found.game_overs.update(
            text.partition(":")[0] for text in np.asarray(last.get("game_over_text", ()))[terminated]
        )
        bar(played)


def _bring_back(envs: Any, actions: Any, found: Found) -> None:
    """Save all environments, step, and bring them back twice: the first time, the same step must follow."""
    worlds = [envs.save(j) for j in range(envs.num_envs)]
    observations, rewards, terminated, truncated, _ = envs.step(actions)
    first = observations.copy(), rewards.copy(), terminated.copy(), truncated.copy()
    for j, world in enumerate(worlds):
        envs.restore(j, world)
    again = envs.step(actions)
    names = ("observations", "rewards", "terminated", "truncated")
    for name, before, after in zip(names, first, again[:4], strict=True):
        if not np.array_equal(before, after):
            found.fail(f"other {name} after coming back")
    for j, world in enumerate(worlds):
        envs.restore(j, world)
    found.brought_back += 1


def _foresee(envs: Any, found: Found) -> None:
    """Ask every environment twice for a forecast of a step, which must be the same and finite."""
    space = envs.single_action_space
    space.seed(found.decisions)
    action = space.sample()
    forecasts = (envs.call("simulate", action) for _ in range(2))
    for one, other in zip(*forecasts, strict=True):
        if not np.isfinite(one.observation).all():
            found.fail("a forecast is not finite")
        if not np.array_equal(one.observation, other.observation) or one.reward != other.reward:
            found.fail("two forecasts of the same step differ")


def main() -> int:
    """Play all cells, write the result, and say whether anything failed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=1_000_000, help="grid steps per grid and kind of action")
    parser.add_argument("--grids", nargs="+", default=list(GRID_IDS), choices=GRID_IDS)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    cells: dict[str, Any] = json.loads(RESULTS.read_text())["cells"] if RESULTS.exists() else {}
    asked = [
        (f"{grid} {kind} {name}", grid, kind, setting, steps)
        for grid, kind in itertools.product(options.grids, options.kinds)
        for name, setting, steps in settings_of(kind, options.steps)
    ]
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn(elapsed_when_finished=True)) as progress:
        bar = progress.add_task("grid steps", total=sum(steps for *_, steps in asked))
        for name, grid, kind, setting, steps in asked:
            progress.update(bar, description=name)
            as_asked = {"version": rl2grid.__version__, "seed": options.seed, "asked": steps}
            if as_asked.items() <= cells.get(name, {}).items():
                progress.advance(bar, steps)
                continue
            found = play(grid, kind, setting, steps, options.seed, lambda n: progress.advance(bar, n))
            cells[name] = as_asked | vars(found) | {"game_overs": dict(sorted(found.game_overs.items()))}
            write_json(RESULTS, {**_total(cells), "cells": cells}, indent=1)
            for words in found.examples:
                progress.console.print(f"{name}: {words}", markup=False)
    print(f"{_total(cells)}")
    return 1 if _total(cells)["failures"] else 0


def _total(cells: dict[str, Any]) -> dict[str, int]:
    names = ("grid_steps", "decisions", "episodes", "completed", "illegal", "brought_back", "failures")
    return {name: sum(cell[name] for cell in cells.values()) for name in names}


if __name__ == "__main__":
    sys.exit(main())
