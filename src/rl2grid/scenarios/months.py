"""Generated months for training, validation and test (:mod:`rl2grid.scenarios.splits`) beside recorded series.

What is generated has the source ``generated``; it needs the system's constants of the generator. Where Grid2Op's full
datasets are asked for (:func:`rl2grid.scenarios.full.is_full_requested`), recorded series take the place of all months.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rl2grid.errors import UsageError
from rl2grid.grids import Grid, MaintenanceConfig, load_grid
from rl2grid.grids.systems import Scenarios, Series
from rl2grid.scenarios.fingerprint import VERSION
from rl2grid.scenarios.full import is_full_requested
from rl2grid.scenarios.generated import load_generated
from rl2grid.scenarios.month_names import parse_months, scenario_id_of
from rl2grid.scenarios.splits import (
    BUNDLED,
    FIRST_TRAINING_SEED,
    HELD_OUT_SPLITS,
    LIBRARY_VERSION,
    SPLITS,
    TRAIN,
    TRAINING_SEEDS,
    draw_listed,
    draw_training_months,
    require_listed,
)

GENERATED = "generated"


@dataclass(frozen=True)
class GeneratedScenarios:
    """See :class:`rl2grid.grids.systems.Scenarios`."""

    recorded: Scenarios
    """What the split ``bundled`` holds."""
    maintained_like: str | None = None
    """Grid of the same lines that says how outages of generated months are sampled; None: the grid itself."""

    def sources(self, grid: Grid) -> Mapping[str, str]:
        return {**self.recorded.sources(grid), GENERATED: f"{GENERATED}/17-03"}

    def listed(self, grid: Grid, split: str) -> tuple[str, ...]:
        if not _is_generated(split):
            return self.recorded.listed(grid, split)
        if split == TRAIN:
            raise UsageError(
                f"The split {split} is a library that episodes are drawn from, not a list: choose one of "
                f"{', '.join(other for other in SPLITS if other != split)}."
            )
        return tuple(f"{GENERATED}/{name}" for name in HELD_OUT_SPLITS[split])

    def check(self, grid: Grid, split: str, scenario_id: str) -> None:
        if not _is_generated(split):
            self.recorded.check(grid, split, scenario_id)
            return
        if split != TRAIN:
            require_listed(grid, split, self.listed(grid, split), scenario_id)
            return
        source, _, name = scenario_id.partition("/")
        if source != GENERATED or parse_months(name).seed not in TRAINING_SEEDS:
            raise UsageError(
                f"Scenario {scenario_id!r} is not in the split {TRAIN} of {grid.id}: choose one such as "
                f"{GENERATED}/{FIRST_TRAINING_SEED}-03, with a seed from {FIRST_TRAINING_SEED} to {TRAINING_SEEDS[-1]}."
            )

    def draw(self, grid: Grid, split: str, seed: int, number: int) -> str:
        if not _is_generated(split):
            return self.recorded.draw(grid, split, seed, number)
        if split == TRAIN:
            return scenario_id_of(draw_training_months(seed, number))
        return draw_listed(self.listed(grid, split), split, seed, number)

    def load(self, grid: Grid, source: str, name: str) -> Series:
        return load_generated(grid, name) if source == GENERATED else self.recorded.load(grid, source, name)

    def sample(self, grid: Grid, split: str) -> tuple[str, tuple[str, ...]]:
        if not _is_generated(split):
            return self.recorded.sample(grid, split)
        if split != TRAIN:
            return "", self.listed(grid, split)
        return f"library {LIBRARY_VERSION}\n", (scenario_id_of(draw_training_months(0, 0)),)

    def maintenance(self, grid: Grid, source: str) -> MaintenanceConfig:
        if source != GENERATED:
            return self.recorded.maintenance(grid, source)
        return (grid if self.maintained_like is None else load_grid(self.maintained_like)).maintenance

    def generator_version(self, split: str) -> str | None:
        return VERSION if _is_generated(split) else self.recorded.generator_version(split)


def _is_generated(split: str) -> bool:
    return split != BUNDLED and not is_full_requested()
