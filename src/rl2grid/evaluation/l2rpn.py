"""L2RPN's scores of an evaluation: two baselines are played in the same months, once, and remembered.

Doing nothing plays by the rules of the grid. The second baseline reconnects lines as soon as that is legal, on a grid
whose lines are never tripped by an overload. Both are played by the native engine, whatever engine the agent was played
on: that is where the engines agree (``docs/parity.md``).
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from rl2grid.compile import cache_directory
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.transitions import NativeTransitions
from rl2grid.envs.operation import demand, operation_of
from rl2grid.envs.tasks import find_task
from rl2grid.evaluation.crew import Job
from rl2grid.evaluation.episode import environment_seed
from rl2grid.grids import Grid
from rl2grid.mdp.actions import DO_NOTHING, one_change
from rl2grid.mdp.heuristics import reconnect_action
from rl2grid.mdp.rewards import PRESETS
from rl2grid.records.evaluations import Evaluation, identity_hash
from rl2grid.records.files import make_folder, read_json, write_json
from rl2grid.records.l2rpn import Baselines, L2RPNScores, Operation, scores_of, write_scores
from rl2grid.records.l2rpn import operation_of as operation_in
from rl2grid.records.locks import locked
from rl2grid.scenarios.cache import data_folder
from rl2grid.scenarios.episodes import EpisodePlan, plan_episode
from rl2grid.scenarios.library import load_scenario

OnProgress = Callable[[int], None]
"""Told how many months have their baselines."""
_NEVER = np.iinfo(np.int32).max
_ENOUGH_TO_WRITE = 50
"""Months between two writes of what is remembered."""


def l2rpn_scores(result: Evaluation, on_progress: OnProgress = lambda done: None) -> tuple[L2RPNScores, ...]:
    """The scores of the episodes of an evaluation, in their order; stored beside them where these are stored.

    Raises:
        UsageError: the episodes do not say what operation cost.
    """
    played = [operation_in(episode) for episode in result.episodes]
    jobs = [Job(one.scenario, one.seed, one.start) for one in result.episodes]
    baselines = find_baselines(result.identity, jobs, on_progress)
    if result.folder is not None:
        return write_scores(result.folder, result.episodes, baselines)
    return tuple(scores_of(one, baseline) for one, baseline in zip(played, baselines, strict=True))


def find_baselines(
    identity: Mapping[str, Any], jobs: Sequence[Job], on_progress: OnProgress = lambda done: None
) -> list[Baselines]:
    """What the two baselines cost in the episodes ``jobs``: played, or remembered from an earlier call.

    Args:
        identity: of an evaluation: its task, split, maintenance, opponent and length of episodes count.
        jobs: the episodes.
        on_progress: told how far it is.
    """
    grid = find_task(identity["task"]).grid
    asked = {name: identity.get(name) for name in ("split", "maintenance", "opponent", "episode_length")}
    memory = _Memory(grid, asked)
    keys = [memory.key(job) for job in jobs]
    missing = {key: job for key, job in zip(keys, jobs, strict=True) if key not in memory.rows}
    on_progress(len(keys) - len(missing))
    workers = max(1, min(os.cpu_count() or 1, len(missing)))
    crew = _Crew(grid, asked)
    with ThreadPoolExecutor(workers) as pool:
        for done, (key, found) in enumerate(zip(missing, pool.map(crew.play, missing.values()), strict=True), start=1):
            memory.rows[key] = found
            on_progress(len(keys) - len(missing) + done)
            if done % _ENOUGH_TO_WRITE == 0 or done == len(missing):
                memory.write()
    return [memory.rows[key] for key in keys]


class _Memory:
    """Baselines that were played before with the same program, in a file per question."""

    def __init__(self, grid: Grid, asked: Mapping[str, Any]) -> None:
        self._grid_id = grid.id
        question = {**asked, "grid_hash": grid.hash, "program": cache_directory().name}
        self._path: Path = data_folder() / "l2rpn" / f"{grid.id}-{identity_hash(question)}.json"
        self.rows: dict[str, Baselines] = self._read()

    def key(self, job: Job) -> str:
        """Names an episode and the values of its series."""
        content = load_scenario(self._grid_id, job.scenario).content_hash[:16]
        return f"{job.scenario} {content} seed {job.seed} start {job.start}"

    def write(self) -> None:
        """Add what is known to the file; what others have added meanwhile stays."""
        make_folder(self._path.parent)
        with locked(self._path.parent, wait=True):
            known = {**self._read(), **self.rows}
            write_json(self._path, {key: asdict(row) for key, row in known.items()}, indent=None)

    def _read(self) -> dict[str, Baselines]:
        if not self._path.is_file():
            return {}
        stored = read_json(self._path, "a file of L2RPN's baselines", "remove it: it is made again", dict)
        return {key: Baselines(**row) for key, row in stored.items()}


class _Crew:
    """Plays baselines in several threads, each with environments of its own."""

    def __init__(self, grid: Grid, asked: Mapping[str, Any]) -> None:
        self._grid, self._asked = grid, asked
        self._own = threading.local()
        self._lock = threading.Lock()

    def play(self, job: Job) -> Baselines:
        """What both baselines cost in an episode."""
        with self._lock:  # one opens series at a time, and each makes its environments
            series = load_scenario(self._grid.id, job.scenario)
            plan = plan_episode(
                self._grid,
                self._asked["split"],
                environment_seed(job.scenario, job.seed),
                0,
                scenario=job.scenario,
                start=job.start,
                maintenance=self._asked["maintenance"],
                episode_length=self._asked["episode_length"],
            )
            if not hasattr(self._own, "players"):
                self._own.players = _transitions(self._grid, self._asked["opponent"])
        nothing, reconnecting = self._own.players
        most = demand(self._grid.id, plan) * float(self._grid.gen_cost_per_mw.max())
        costs = [_cost(player, plan, self._grid) for player in (nothing, reconnecting)]
        del series  # until here nobody may let it go
        return Baselines(most, *costs)


def _transitions(grid: Grid, opponent: bool) -> tuple[NativeTransitions, NativeTransitions]:
    """Environments for doing nothing, and some whose lines are never tripped, for reconnecting."""
    engines = NativeEngine(grid, 1, opponent=opponent), NativeEngine(grid, 1, opponent=opponent)
    constants = engines[1].environments.constants
    constants.overflow_allowed[:] = _NEVER
    constants.hard_limit[:] = np.inf
    # The heuristic plays what the agent plays as long as all is safe, in compiled code; as on tasks without topology,
    # recovery only reconnects.
    nothing, reconnecting = (
        NativeTransitions(engine, heuristic, "R", PRESETS["default"], 1.0)
        for engine, heuristic in zip(engines, ("idle", "recovery"), strict=True)
    )
    return nothing, reconnecting


def _cost(player: NativeTransitions, plan: EpisodePlan, grid: Grid) -> Operation:
    """What the episode costs whose safe steps the heuristic plays, and the others its like."""
    player.reset(0, plan)
    state = player.engine.state
    while not (state.terminated[0] or state.truncated[0]):
        action = one_change(*reconnect_action(player.opened_state, 0)) if player.heuristic == "recovery" else DO_NOTHING
        player.play(0, action)
    return asdict(operation_of(state, 0, grid.id, plan))
