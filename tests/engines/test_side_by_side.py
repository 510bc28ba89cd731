"""Rows that are played together, their power flows side by side, are what they are alone, to the last bit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.transitions import NativeTransitions, commands_of
from rl2grid.grids import load_grid
from rl2grid.mdp.actions import DO_NOTHING, StepAction, full_catalogue, level_catalogue, switch
from rl2grid.mdp.rewards import PRESETS
from rl2grid.powerflow.flow_lanes import LOST
from rl2grid.powerflow.lane_flow import DONE, FAILED
from rl2grid.scenarios.episodes import EpisodePlan, plan_episode
from rl2grid.structures import Role, fields_of

N = 21
"""Rows: more than are played at the same time with a heuristic, and no multiple of the lanes."""
STEPS = 40


class Played:
    """Rows of a grid that are asked for together, or one by one."""

    def __init__(self, grid_id: str, heuristic: str | None, together: bool) -> None:
        self.grid, self.together = load_grid(grid_id), together
        engine = NativeEngine(self.grid, N)
        self.transitions = NativeTransitions(engine, heuristic, "T", PRESETS["default"], 1.0)
        self.environments = engine.environments
        self.lane_states: set[int] = set()
        self.begin_all()

    def begin_all(self) -> None:
        for i in range(N):
            self.transitions.engine.prepare(i, self.plan(i, 0))
        rows = np.arange(N)
        for part in [rows] if self.together else np.split(rows, N):
            self.transitions.begin_rows(part, 1)

    def begin(self, i: int, number: int) -> None:
        self.transitions.reset(i, self.plan(i, number))

    def plan(self, i: int, number: int) -> EpisodePlan:
        return plan_episode(self.grid, "bundled", i, number, start=24 * i)

    def step(self, actions: list) -> None:
        commands = commands_of(self.grid, actions)
        if not self.together:
            for i in range(N):
                self.transitions.play_rows(np.array([i]), commands[i : i + 1], 1)
            return
        self.environments.lanes.state[:] = -1
        self.transitions.play_rows(np.arange(N), commands, 1)
        self.lane_states |= set(self.environments.lanes.state.tolist())

    def kept(self) -> dict[str, np.ndarray]:
        """All that is kept from step to step, but for addresses."""
        found = {}
        for part in ("state", "hidden", "flow", "opponent"):
            structure = getattr(self.environments, part)
            for name in fields_of(type(structure), Role.KEPT, Role.EPISODE):
                found[f"{part}.{name}"] = getattr(structure, name)
        return found


def disturb(played: Played, random: np.random.Generator) -> None:
    """Give some rows factors and anchors that are not theirs: they need more steps, new factors or the cold recipe."""
    flow = played.environments.flow
    for i in range(N):
        spoiled = random.random()
        if spoiled < 0.15:
            flow.panel[i] *= random.uniform(0.8, 1.2)
        elif spoiled < 0.2:
            flow.panel[i] *= -1.0
        elif spoiled < 0.25:
            flow.anchor[i, 0, 0] += 1.0
        elif spoiled < 0.3:
            flow.anchor_steps[i] = 6


@pytest.mark.parametrize(
    ("grid_id", "heuristic"), [("bus14", None), ("bus14", "idle"), ("bus36-MO-v0", "careful"), ("bus118-MOB-v1", None)]
)
def test_a_row_does_not_depend_on_its_company(grid_id, heuristic):
    both = [Played(grid_id, heuristic, together) for together in (True, False)]
    play_both(both, level_catalogue(both[0].grid, 0), 0.2)  # most topologies are shared by a few rows then
    assert {DONE, FAILED} <= both[0].lane_states, "flows were solved side by side, and some were not accepted"
    assert not both[1].lane_states


@pytest.mark.parametrize(("grid_id", "share"), [("bus14", 0.5), ("bus36-M", 0.9), ("bus118-M", 0.9)])
def test_a_row_of_a_topology_of_its_own_does_not_depend_on_its_company(grid_id, share):
    both = [Played(grid_id, None, together) for together in (True, False)]
    play_both(both, full_catalogue(both[0].grid), share)
    used = [played.environments.union.exists.any() for played in both]
    assert used == [True, False], "flows of different topologies were solved side by side"
    assert DONE in both[0].lane_states
    if grid_id == "bus14":
        assert LOST in both[0].lane_states, "some diverged"


@pytest.mark.parametrize("grid_id", ["bus36-M", "bus118-M"])
def test_rows_that_differ_in_their_open_lines_alone_are_solved_side_by_side(grid_id):
    both = [Played(grid_id, None, together) for together in (True, False)]
    for played in both:
        played.step([switch(2 * i) for i in range(N)])
    for step in range(STEPS):
        for played in both:
            played.step([DO_NOTHING] * N)
        assert_kept_the_same(both, step)
    environments = both[0].environments
    lasting = ~environments.state.terminated
    assert lasting.sum() > N // 2
    assert len(np.unique(environments.flow.topo_vect[lasting], axis=0)) > N // 3, "different lines are open"
    assert len(np.unique(environments.flow.pattern[lasting], axis=0)) == 1, "and their matrices have one pattern"
    assert DONE in both[0].lane_states
    topologies = environments.flow.topo_vect[environments.lanes.row[environments.lanes.state == DONE]]
    assert len(np.unique(topologies, axis=0)) > 1, "lanes of the last step had different topologies"


@pytest.mark.parametrize("grid_id", ["bus14", "bus36-MO-v0", "bus118-MOB-v1"])
def test_a_row_that_begins_does_not_depend_on_its_company(grid_id):
    both = [Played(grid_id, None, together) for together in (True, False)]
    used = [played.environments.union.exists.any() for played in both]
    assert used == [True, False], "flows were solved side by side"
    assert DONE in both[0].environments.lanes.state
    assert_kept_the_same(both, -1)


def assert_kept_the_same(both: list[Played], step: int) -> None:
    together, alone = (played.kept() for played in both)
    for name, values in together.items():
        np.testing.assert_array_equal(values, alone[name], err_msg=f"{name} after {step + 1} steps")


def play_both(both: list[Played], actions: Sequence[StepAction], share: float) -> None:
    """Play the same in both, random actions in some rows, and compare all that they keep."""
    random = np.random.default_rng(7)
    numbers = [0] * N
    for step in range(STEPS):
        seed = int(random.integers(2**31))
        for played in both:
            disturb(played, np.random.default_rng(seed))
        chosen = [actions[random.integers(len(actions))] if random.random() < share else DO_NOTHING for _ in range(N)]
        for played in both:
            played.step(chosen)
        assert_kept_the_same(both, step)
        state = both[0].environments.state
        for i in np.flatnonzero(state.terminated | state.truncated).tolist():
            numbers[i] += 1
            for played in both:
                played.begin(i, numbers[i])
