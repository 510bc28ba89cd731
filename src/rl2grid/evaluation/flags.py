"""Flags of the command line, for commands that ask for something again."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from rl2grid.envs.options import TaskOptions
from rl2grid.envs.tasks import Task, short_id

_FLAGS = {"total_timesteps": "decisions", "start_from": "from"}
"""Hyperparameters that have the name of CleanRL, and the word that every command has for the same thing; or a name
beside a word that Python keeps for itself."""
LOOKING = ("top_k", "rehearse")
"""Keywords of :func:`rl2grid.evaluation.agents.make_agent` that say how a policy looks before it acts."""


def flag_of(name: str) -> str:
    """The flag that sets a hyperparameter, keyword or other value of that name, without its dashes."""
    return _FLAGS.get(name, name).replace("_", "-")


def flags(values: Mapping[str, Any]) -> list[str]:
    """Flags that set values, by name."""
    words = []
    for name, value in values.items():
        flag = flag_of(name)
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
            continue
        words += [f"--{flag}", *map(str, value if isinstance(value, tuple | list) else (value,))]
    return words


def environment_flags(keywords: Mapping[str, Any]) -> list[str]:
    """Flags for those keywords of ``gymnasium.make`` that are not at their defaults."""
    defaults = asdict(TaskOptions())
    changes = {name: value for name, value in keywords.items() if value != defaults[name]}
    if isinstance(changes.get("reward"), tuple | list):
        changes["reward"] = ",".join(map(str, changes["reward"]))
    return flags(changes)


def evaluate_command(
    agent: str, task: Task, split: str, seeds: int, months: int | None, keywords: Mapping[str, Any]
) -> str:
    """The ``rl2grid evaluate`` that plays an agent like that.

    Args:
        agent: name, run folder, checkpoint, or where an agent of one's own is written.
        task: the task.
        split: whose months.
        seeds: episodes per month.
        months: the first of the split; None: all.
        keywords: of ``gymnasium.make``; without ``heuristic``, the one that the agent was trained with is played.
    """
    words = ["rl2grid", "evaluate", agent, short_id(task.id), "--split", split, "--seeds", str(seeds)]
    words += [] if months is None else ["--months", str(months)]
    words += ["--heuristic", str(keywords["heuristic"])] if "heuristic" in keywords else []
    return shlex.join([*words, *environment_flags({**keywords, "heuristic": None})])
