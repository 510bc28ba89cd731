"""Keywords of ``gymnasium.make`` as flags."""

from __future__ import annotations

import argparse
from typing import Any

from rl2grid.engines import DISPATCHES, ENGINES, HEURISTICS
from rl2grid.envs.tasks import CONSTRAINTS

NAMES = ("heuristic", "constraint", "engine", "reward", "normalize", "dispatch", "maintenance", "opponent")


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add a flag for each of :data:`NAMES`; those that are not given leave no trace."""
    add = parser.add_argument_group("environment").add_argument
    without = argparse.SUPPRESS
    add("--heuristic", default=without, choices=("None", *HEURISTICS), help="by default the agent's own")
    add("--constraint", default=without, choices=("None", *CONSTRAINTS), help="for tasks whose id names none")
    add("--engine", default=without, choices=ENGINES, help="native (default), or Grid2Op itself")
    add("--reward", default=without, metavar="REWARD", help="default, paper, released, or weights such as 1,0.5,0")
    add("--normalize", default=without, choices=("None", "physical"), help="of observations; by default the policy's")
    add("--dispatch", default=without, choices=DISPATCHES, help="how redispatch is solved")
    add("--maintenance", default=without, action=argparse.BooleanOptionalAction, help="whether it happens")
    add("--opponent", default=without, action=argparse.BooleanOptionalAction, help="whether it attacks")


def given(options: argparse.Namespace) -> dict[str, Any]:
    """The keywords that were given."""
    keywords = {name: getattr(options, name) for name in NAMES if hasattr(options, name)}
    keywords = {name: None if value == "None" else value for name, value in keywords.items()}
    if "reward" in keywords:
        keywords["reward"] = reward_of(keywords["reward"])
    return keywords


def reward_of(text: str) -> str | tuple[float, ...]:
    """The keyword ``reward`` that a name, or weights separated by commas, stand for."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        return text
