"""What the seven grids of the benchmark play: generated months, series inside the Grid2Op wheel, or the full datasets.

Training, validation and test play months of the generator (:mod:`rl2grid.scenarios.splits`), source ``generated``. The
split ``bundled`` is every series inside the wheel, source ``bundled``, from beginning to end. The source ``full`` is
Grid2Op's downloadable dataset where the user has it: ``$RL2GRID_FULL_DATA`` names the folder that holds it (the one
with ``l2rpn_case14_sandbox`` and its like inside), and its being set is the request to train, validate and test on it
instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rl2grid.errors import UsageError, one_of
from rl2grid.grids import Grid, MaintenanceConfig, load_grid
from rl2grid.scenarios.bundled import bundled_folders, load_bundled
from rl2grid.scenarios.cache import CachedSeries
from rl2grid.scenarios.full import full_folders, full_split, is_full_requested, load_full
from rl2grid.scenarios.generated import (
    EPISODES_PER_YEAR,
    SEEDS_PER_YEAR,
    VERSION,
    draw_training_months,
    is_training_seed,
    load_generated,
    parse_months,
)
from rl2grid.scenarios.splits import (
    BUNDLED,
    FIRST_TRAINING_SEED,
    HELD_OUT_SPLITS,
    SPLITS,
    TRAIN,
    TRAINING_SEEDS,
    draw_listed,
    require_listed,
    shortened,
)


@dataclass(frozen=True)
class ShippedScenarios:
    """See :class:`rl2grid.grids.systems.Scenarios`."""

    maintained_like: str | None = None
    """Grid of the same lines that says how outages of generated months are sampled; None: the grid itself."""

    def sources(self, grid: Grid) -> Mapping[str, str]:
        bundled = next(iter(bundled_folders(grid)))
        return {"bundled": f"bundled/{bundled}", "full": "full/<series>", "generated": "generated/17-03"}

    def listed(self, grid: Grid, split: str) -> tuple[str, ...]:
        if split == BUNDLED:
            return tuple(f"bundled/{name}" for name in bundled_folders(grid))
        if is_full_requested():
            return tuple(f"full/{name}" for name in full_split(grid, split))
        if split == TRAIN:
            raise UsageError(
                f"The split {split} has no end, and its months cannot be listed: choose one of "
                f"{', '.join(other for other in SPLITS if other != split)}."
            )
        return tuple(f"generated/{name}" for name in HELD_OUT_SPLITS[split])

    def check(self, grid: Grid, split: str, scenario_id: str) -> None:
        if split != TRAIN or is_full_requested():
            require_listed(grid, split, self.listed(grid, split), scenario_id)
            return
        source, _, name = scenario_id.partition("/")
        if source != "generated" or not is_training_seed(parse_months(name).seed):
            raise UsageError(
                f"Scenario {scenario_id!r} is not in the split {TRAIN} of {grid.id}: choose one such as "
                f"generated/{FIRST_TRAINING_SEED}-03, with a seed of at least {FIRST_TRAINING_SEED}."
            )

    def draw(self, grid: Grid, split: str, seed: int, number: int) -> str:
        if split == TRAIN and not is_full_requested():
            return f"generated/{draw_training_months(seed, number)}"
        return draw_listed(self.listed(grid, split), split, seed, number)

    def load(self, grid: Grid, source: str, name: str) -> CachedSeries:
        if source == "generated":
            return load_generated(grid, name)
        names = tuple(bundled_folders(grid) if source == "bundled" else full_folders(grid))
        if name not in names:
            raise one_of(
                f"Scenario of {grid.id}", f"{source}/{name}", shortened([f"{source}/{each}" for each in names])
            )
        return load_bundled(grid, name) if source == "bundled" else load_full(grid, name)

    def sample(self, grid: Grid, split: str) -> tuple[str, tuple[str, ...]]:
        if split == TRAIN and not is_full_requested():
            rule = f"{FIRST_TRAINING_SEED} {TRAINING_SEEDS} {SEEDS_PER_YEAR} {EPISODES_PER_YEAR}\n"
            return rule, (f"generated/{draw_training_months(0, 0)}",)
        return "", self.listed(grid, split)

    def maintenance(self, grid: Grid, source: str) -> MaintenanceConfig:
        if source != "generated" or self.maintained_like is None:
            return grid.maintenance
        return load_grid(self.maintained_like).maintenance

    def generator_version(self, split: str) -> str | None:
        return None if split == BUNDLED or is_full_requested() else VERSION
