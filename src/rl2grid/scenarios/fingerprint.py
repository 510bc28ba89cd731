"""Which generator makes the months: its version, and a hash of everything that decides what it makes."""

from __future__ import annotations

import functools
import hashlib
import json
from importlib import resources
from importlib.resources.abc import Traversable

from rl2grid.grids import Grid, System, find_system

VERSION = "2"
"""Version of the generator, named by every result on generated months: it changes with any value that is generated.
The hashes of the months of validation and test are published with it (:mod:`rl2grid.scenarios.published`)."""

_POWER_FLOW = ("ac", "bits", "factors", "flow_state", "model", "newton", "ordering", "topology")
"""Modules of :mod:`rl2grid.powerflow` that decide what is generated."""


def generator_fingerprint(grid: Grid) -> str:
    """Short hash of everything that decides what the generator makes for ``grid``."""
    return _fingerprint(find_system(grid.id))


@functools.lru_cache(maxsize=64)
def _fingerprint(system: System) -> str:
    package = resources.files("rl2grid")
    sources = [
        *(package / "powerflow" / f"{module}.py" for module in _POWER_FLOW),
        *_python_files(package / "scenarios" / "generator"),
        package / "scenarios" / "packs.py",
        package / "grids" / "network.py",
        package / "philox.py",
        package / "streams.py",
    ]
    constants = json.dumps(system.required_constants(), sort_keys=True)
    digest = hashlib.sha256(f"{system.hash} {constants}".encode())
    for source in sources:
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _python_files(package: Traversable) -> list[Traversable]:
    return sorted((file for file in package.iterdir() if file.name.endswith(".py")), key=lambda file: file.name)
