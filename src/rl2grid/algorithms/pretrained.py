"""Policies that come with the package, each with a card that says how it was made and how long it survives.

They are called ``pretrained/<grid>-<kind>``, as in ``rl2grid.load("pretrained/bus14-T0")``; wherever a run folder can
be named, they can. ``benchmarks/pretrained.py`` writes them.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from rl2grid.errors import one_of
from rl2grid.records.statistics import Estimate

PREFIX = "pretrained/"
LARGEST = 1_000_000
"""Bytes of a policy at most."""


@dataclass(frozen=True)
class Survival:
    """How long a policy survives on validation months that nothing was chosen by."""

    agent: str
    """Who played: the policy, or an agent beside it."""
    months: int
    survival: float
    low: float
    """Bounds of the 95% interval over months."""
    high: float
    completed: float
    """Share of the months that were completed."""

    @property
    def estimate(self) -> Estimate:
        """The survival with its interval."""
        return Estimate(self.survival, self.low, self.high)


@dataclass(frozen=True)
class ModelCard:
    """How a policy was made, and what it is worth."""

    name: str
    """Without :data:`PREFIX`."""
    task: str
    """Its id, short."""
    heuristic: str | None
    """With which it is to be played."""
    algorithm: str
    network: str
    policy_hash: str
    commands: tuple[str, ...]
    """What makes it again, one after the other."""
    validation: tuple[Survival, ...]
    """First the policy, then who played beside it on the same months."""
    limits: str
    """What it cannot do."""

    @property
    def file(self) -> Path:
        """The checkpoint."""
        return folder() / f"{self.name}.pt"


def folder() -> Path:
    """Where the policies and their cards are."""
    return Path(str(resources.files("rl2grid.algorithms") / "policies"))


def cards() -> tuple[ModelCard, ...]:
    """The cards of all policies, by name."""
    return tuple(_read(file) for file in sorted(folder().glob("*.json")))


def is_pretrained(spec: object) -> bool:
    """Whether a policy of the package is asked for: its name, and nothing of that name in the working folder."""
    return isinstance(spec, str | Path) and Path(spec).as_posix().startswith(PREFIX) and not Path(spec).exists()


def pretrained(spec: str | Path) -> ModelCard:
    """The card of the policy ``pretrained/<name>``.

    Raises:
        UsageError: there is no such policy.
    """
    name = Path(spec).as_posix().removeprefix(PREFIX)
    every = {card.name: card for card in cards()}
    if name not in every:
        raise one_of("Pretrained policy", PREFIX + name, tuple(PREFIX + each for each in every))
    return every[name]


def _read(file: Path) -> ModelCard:
    content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    played = tuple(Survival(**each) for each in content.pop("validation"))
    return ModelCard(**{**content, "commands": tuple(content["commands"])}, validation=played)
