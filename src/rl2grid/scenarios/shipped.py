"""Series that come with Grid2Op: those inside its wheel, and the full datasets where the user has them.

The split ``bundled`` is every series inside the wheel, source ``bundled``, from beginning to end. The source ``full``
is Grid2Op's downloadable dataset: ``$RL2GRID_FULL_DATA`` names the folder that holds it (the one with
``l2rpn_case14_sandbox`` and its like inside), and its being set is the request to train, validate and test on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rl2grid.errors import one_of
from rl2grid.grids import Grid, MaintenanceConfig
from rl2grid.scenarios.bundled import bundled_folders, load_bundled
from rl2grid.scenarios.cache import CachedSeries
from rl2grid.scenarios.full import full_folders, full_split, load_full
from rl2grid.scenarios.splits import BUNDLED, draw_listed, require_listed, shortened


@dataclass(frozen=True)
class ShippedScenarios:
    """See :class:`rl2grid.grids.systems.Scenarios`."""

    def sources(self, grid: Grid) -> Mapping[str, str]:
        return {"bundled": f"bundled/{next(iter(bundled_folders(grid)))}", "full": "full/<series>"}

    def listed(self, grid: Grid, split: str) -> tuple[str, ...]:
        if split == BUNDLED:
            return tuple(f"bundled/{name}" for name in bundled_folders(grid))
        return tuple(f"full/{name}" for name in full_split(grid, split))

    def check(self, grid: Grid, split: str, scenario_id: str) -> None:
        require_listed(grid, split, self.listed(grid, split), scenario_id)

    def draw(self, grid: Grid, split: str, seed: int, number: int) -> str:
        return draw_listed(self.listed(grid, split), split, seed, number)

    def load(self, grid: Grid, source: str, name: str) -> CachedSeries:
        names = tuple(bundled_folders(grid) if source == "bundled" else full_folders(grid))
        if name not in names:
            raise one_of(
                f"Scenario of {grid.id}", f"{source}/{name}", shortened([f"{source}/{each}" for each in names])
            )
        return load_bundled(grid, name) if source == "bundled" else load_full(grid, name)

    def sample(self, grid: Grid, split: str) -> tuple[str, tuple[str, ...]]:
        return "", self.listed(grid, split)

    def maintenance(self, grid: Grid, source: str) -> MaintenanceConfig:
        return grid.maintenance

    def generator_version(self, split: str) -> str | None:
        return None
