"""Made-up runs, evaluations and studies in folders."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sample_results import TASK, result

from rl2grid.records.episodes import EPISODES_FILE, write_episodes
from rl2grid.records.evaluations import EVALUATION_FILE, write_evaluation

METRICS = "step,grid_steps,wall_time,name,value\n64,640,1.0,charts/survival,0.25\n128,1280,2.0,charts/survival,0.5\n"


def write_made_up_evaluation(folder: Path, agent: str = "ppo", heuristic: str | None = "idle") -> None:
    folder.mkdir(parents=True)
    one = result(agent, [[0.5], [1.0]], heuristic, agent_hash=str(folder))
    write_episodes(folder / EPISODES_FILE, one.episodes)
    request = {"identity": dict(one.identity), "jobs": [], "command": f"rl2grid evaluate {folder}"}
    write_evaluation(folder / EVALUATION_FILE, request, one.summary)


def write_made_up_run(folder: Path, seed: int = 1) -> None:
    folder.mkdir(parents=True)
    request = {
        "task": TASK,
        "algorithm": "ppo",
        "hyperparameters": {"seed": seed, "gamma": 0.9},
        "env_keywords": {"heuristic": "idle"},
    }
    (folder / "config.json").write_text(json.dumps({"request": request, "identity": {"task": TASK, "seed": seed}}))
    (folder / "metrics.csv").write_text(METRICS)


def write_made_up_study(folder: Path, cells: list[dict[str, Any]]) -> None:
    """Each cell as in ``cell.json``; those whose ``finished`` is False have no result yet."""
    for cell in cells:
        place = folder / "cells" / cell["name"]
        if cell["training"]:
            write_made_up_run(place / "run", cell["training"]["seed"])
        write_made_up_evaluation(place / "evaluation", cell["agent"], cell["heuristic"])
        (place / "cell.json").write_text(json.dumps(cell))
        if cell.pop("finished", True):
            (place / "result.json").write_text("{}")
    (folder / "study.json").write_text(json.dumps({"cells": [{"cell": cell["name"]} for cell in cells]}))


def cell(name: str, agent: str = "ppo", seed: int | None = 1, **changes: Any) -> dict[str, Any]:
    training = None if seed is None else {"seed": seed}
    words = {"agent": agent, "task": TASK, "heuristic": "idle", "split": "test", "training": training}
    return {"name": name, **words, **changes}


CELLS = [
    cell("bus14-T0-v0-ppo-idle-1"),
    cell("bus14-T0-v0-ppo-idle-2", seed=2),
    cell("bus14-T0-v0-ppo-idle-small-nets-1"),
    cell("bus14-T0-v0-do-nothing-idle", "do-nothing", None),
]
