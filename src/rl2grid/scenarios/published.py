"""The held-out months that results are compared on, as they were published.

The generator gives the same months everywhere; should a machine, a compiler or an edit make others, its results are
not comparable with anybody's. ``manifest.json`` therefore holds the first :data:`DIGITS` of the hash of every month of
validation and test: by version of the generator, version of the splits, grid and split, all months of a list in one
string. A month that differs is played, with a warning.
"""

from __future__ import annotations

import functools
import json
import warnings
from collections.abc import Iterable, Mapping
from importlib import resources
from typing import NamedTuple

from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.scenarios.fingerprint import VERSION
from rl2grid.scenarios.generated import pack_path
from rl2grid.scenarios.month_names import parse_months
from rl2grid.scenarios.scenario import Scenario
from rl2grid.scenarios.series_hash import hash_of_series
from rl2grid.scenarios.splits import HELD_OUT_SPLITS, SPLIT_VERSION

Hashes = Mapping[str, str]
"""First digits of the SHA-256 of a month by its name, for example ``710003-09``."""

MANIFEST = "manifest.json"
DIGITS = 8
"""Hexadecimal ones that are published of each hash."""


class DeviationWarning(UserWarning):
    """A held-out month is not the one that was published."""


class Deviation(NamedTuple):
    """A held-out month that is not the one that was published."""

    grid_id: str
    name: str

    def __str__(self) -> str:
        return (
            f"The month {self.name} of {self.grid_id} differs from the one published with version {VERSION} of the "
            "generator: results on it are not comparable."
        )


class Comparison(NamedTuple):
    """Months of this machine beside the published ones."""

    months: int
    """How many were compared."""
    deviations: list[Deviation]


@functools.cache
def published_hashes(grid_id: str) -> Hashes:
    """Hashes of the held-out months of a grid, as this version of the generator was published with them; none before
    it is.
    """
    published = _manifest().get(f"{VERSION} {SPLIT_VERSION}", {}).get(grid_id, {})
    return {
        name: hashes[DIGITS * k : DIGITS * (k + 1)]
        for split, hashes in published.items()
        for k, name in enumerate(HELD_OUT_SPLITS[split])
    }


def listed_hashes(grid: Grid) -> dict[str, str]:
    """What is to be published of a grid whose held-out months are made: the hashes of each list in one string."""
    return {
        split: "".join(str(hash_pack(grid, name))[:DIGITS] for name in names)
        for split, names in HELD_OUT_SPLITS.items()
    }


def held_out_months() -> tuple[str, ...]:
    """Names of the months of validation and test."""
    return tuple(name for names in HELD_OUT_SPLITS.values() for name in names)


def hash_pack(grid: Grid, name: str) -> str | None:
    """Hash of the month called ``name`` in its pack; None where there is no sound one."""
    # Imported where it is needed: compiling takes long, and comparing what is loaded compiles nothing.
    from rl2grid.scenarios.packs import hash_of_month, read_raw

    months = parse_months(name)
    try:
        return hash_of_month(read_raw(pack_path(grid, months.seed, months.first)))
    except UsageError:
        return None


def compare_with_published(grid: Grid, names: Iterable[str]) -> Comparison:
    """Compare the packs of months, those that are there, with what was published of them."""
    published = published_hashes(grid.id)
    found = {name: hash_pack(grid, name) for name in names if name in published}
    made = {name: digest for name, digest in found.items() if digest is not None}
    differing = [Deviation(grid.id, name) for name, digest in made.items() if digest[:DIGITS] != published[name]]
    return Comparison(len(made), differing)


def warn_of_deviation(scenario: Scenario) -> None:
    """Warn if ``scenario`` is a held-out month that differs from the one published: once per grid and process."""
    name = scenario.id.partition("/")[2]
    expected = published_hashes(scenario.grid_id).get(name)
    if expected is None:
        return
    if hash_of_series(scenario.load_p, scenario.load_q, scenario.prod_p)[:DIGITS] != expected:
        _warn_once(scenario.grid_id, str(Deviation(scenario.grid_id, name)))


_warned: set[str] = set()


def _warn_once(grid_id: str, message: str) -> None:
    if grid_id in _warned:
        return
    _warned.add(grid_id)
    warnings.warn(f"{message} `rl2grid data check {grid_id}` lists all that do.", DeviationWarning, stacklevel=2)


@functools.cache
def _manifest() -> Mapping[str, Mapping[str, Mapping[str, str]]]:
    """Hashes by versions of generator and splits, grid and split."""
    manifest: Mapping[str, Mapping[str, Mapping[str, str]]] = json.loads(
        (resources.files("rl2grid.scenarios") / MANIFEST).read_text()
    )
    return manifest
