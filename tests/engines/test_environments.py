"""What is declared of the engine's structures holds: what a step may forget, and how much an environment takes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.environments import Environments, new_environments
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.mdp.actions import DO_NOTHING, full_catalogue
from rl2grid.powerflow.model import load_network
from rl2grid.scenarios.episodes import plan_episode
from rl2grid.structures import Role, declaration_of, fields_of

PARTS = declaration_of(Environments).parts
ROW_PARTS = ("state", "hidden", "flow", "opponent", "notes")


def forget(engine: NativeEngine, random: np.random.Generator) -> None:
    """Overwrite all that the next step is said not to need."""
    for part, kind in PARTS.items():
        for name in fields_of(kind, Role.SCRATCH, Role.WORKSPACE):
            array = getattr(getattr(engine.environments, part), name)
            array[...] = random.integers(0, 2, array.shape).astype(array.dtype)


def kept(engine: NativeEngine) -> dict[str, Any]:
    return {
        f"{part}.{name}": getattr(getattr(engine.environments, part), name).copy()
        for part in ROW_PARTS
        for name in fields_of(PARTS[part], Role.KEPT, Role.EPISODE)
    }


@pytest.mark.parametrize("grid_id", ["bus14", "bus36-MO-v0", "bus118-MOB-v1"])
def test_a_step_needs_nothing_of_what_is_declared_as_passing(grid_id):
    grid = load_grid(grid_id)
    catalogue, random = full_catalogue(grid), np.random.default_rng(4)
    engines = [NativeEngine(grid, 2) for _ in range(2)]
    steps = 0
    for number in range(6):
        for engine in engines:
            engine.reset(1, plan_episode(grid, "bundled", number, 0, start=40))
        while not engines[0].state.terminated[1] and steps < 20 * (number + 1):
            steps += 1
            action = catalogue[int(random.integers(len(catalogue)))] if steps % 3 == 0 else DO_NOTHING
            forget(engines[1], random)
            for engine in engines:
                engine.step(1, action)
            forget(engines[1], random)
            here, there = kept(engines[0]), kept(engines[1])
            for name, array in here.items():
                assert array[1].tobytes() == there[name][1].tobytes(), f"{name} in step {steps}"
            if steps % 5 == 0 and not engines[0].state.terminated[1]:
                simulated = [engine.simulate(1, action, 1) for engine in engines]
                for mine, theirs in zip(*simulated, strict=True):
                    assert mine.tobytes() == theirs.tobytes()
    assert steps > 20


def kilobytes(grid_id: str) -> float:
    """What one more environment takes."""
    grid = load_grid(grid_id)
    network = load_network(grid)
    sizes = []
    for n in (1, 3):
        environments = new_environments(grid, network, n, opponent=False)
        sizes.append(sum(array.nbytes for part in environments for array in part))
    return (sizes[1] - sizes[0]) / 2000


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_an_environment_takes_as_much_as_the_grid_has_elements(grid_id):
    per_element = kilobytes("bus14") / load_grid("bus14").dim_topo
    assert kilobytes(grid_id) <= per_element * load_grid(grid_id).dim_topo


def test_no_array_of_an_environment_has_an_entry_for_every_pair_of_elements():
    for part in ROW_PARTS:
        for name, field in fields_of(PARTS[part]).items():
            if field.per_environment and "attack" not in field.axes:
                assert sum(isinstance(axis, str) for axis in field.axes) <= 1, f"{part}.{name}"
