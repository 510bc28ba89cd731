"""Two engines side by side: the same episodes, the same actions, every value compared after every grid step.

One engine is believed; what it shows decides the actions. Where the engines disagree, the disagreement
is noted with its place and its cause, and the next episode begins with both in step again. A cause is
one of :data:`CAUSES`, each of which needs evidence in the values themselves; without evidence the cause
is empty and the disagreement is a fault of one of the engines.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.compile import jit
from rl2grid.engines.base import Engine
from rl2grid.engines.probes import Probe
from rl2grid.engines.transition import Transitions
from rl2grid.engines.worlds import World
from rl2grid.grids import Grid
from rl2grid.mdp.accumulate import accrue, begin_episode
from rl2grid.mdp.actions import ActionKind, StepAction
from rl2grid.mdp.heuristics import SAFE_RHO
from rl2grid.mdp.rewards import PRESETS, RewardFunction
from rl2grid.mdp.security import SAFE_LOADING
from rl2grid.mdp.state import OBSERVED, OBSERVED_STORAGE, GridState
from rl2grid.mdp.termination import GameOver
from rl2grid.scenarios.episodes import EpisodePlan
from rl2grid.scenarios.library import load_scenario

COMPARED: tuple[str, ...] = (
    *OBSERVED,
    *OBSERVED_STORAGE,
    "step",
    "episode_length",
    "terminated",
    "truncated",
    "game_over",
    "illegal",
    "ambiguous",
    "attacked",
    "excused",
    "transition_reward",
    "transition_components",
    "transition_costs",
    "episode_scores",
)
"""What is compared after every step; sums hold that step alone. ``final_topo_vect`` joins them at a game over
that a power flow decided: without a feasible dispatch none is run, and it has no meaning."""

_COUNTED = ("n_steps", "decisions", "reset_steps", "open_since", "split_since", "attacked_at")
_SUMMED = (
    *("transition_reward", "transition_discounted", "transition_components", "transition_costs"),
    *("reset_reward", "reset_components", "reset_costs", "episode_return", "episode_costs", "episode_scores"),
)
"""Compared from decision to decision: what counts steps, and what adds up over them."""
_NOT_SUMMED = tuple(name for name in COMPARED if name not in _SUMMED)

_POWER_OR_CURRENT, _SHARE, _DEGREES = 1e-4, 1e-5, 1e-4
TOLERANCES: dict[str, float] = {
    **dict.fromkeys(("gen_p", "load_p", "p_or", "a_or"), _POWER_OR_CURRENT),
    **dict.fromkeys(("target_dispatch", "actual_dispatch", "gen_margin_up", "gen_margin_down"), _POWER_OR_CURRENT),
    **dict.fromkeys(("gen_p_before_curtail", "storage_charge"), _POWER_OR_CURRENT),
    **dict.fromkeys(("storage_power_target", "storage_power"), _POWER_OR_CURRENT),
    **dict.fromkeys(("rho", "curtailment", "curtailment_limit"), _SHARE),
    **dict.fromkeys(("gen_theta", "load_theta", "storage_theta"), _DEGREES),
    **dict.fromkeys(("transition_reward", "transition_components", "transition_costs", "episode_scores"), _SHARE),
}
"""Largest admissible difference of an attribute, in its own unit (MW, MWh, A, degrees, or none); 0 where
not listed. The resolution of float32, 1.2e-7 of the value, is admitted on top of it."""

THRESHOLD, DIVERGENCE = "threshold", "divergence"
OPPONENT_RANK, DISPATCH_SOLVER = "opponent rank", "dispatch solver"
CAUSES: dict[str, str] = {
    THRESHOLD: "a line is loaded within 1e-5 of the limit (1) or of the hard limit, or would be after a loss",
    DIVERGENCE: "the power flow of one engine did not converge, that of the other did",
    OPPONENT_RANK: "loadings equal to 1e-5 are ranked differently, so that another line is attacked",
    DISPATCH_SOLVER: "with dispatch='grid2op', SLSQP stopped at another dispatch for the same wish",
}
"""Why engines may disagree without being wrong."""

COUNTS: tuple[str, ...] = (
    "illegal",
    "ambiguous",
    "attacked",
    "in maintenance",
    "overloaded",
    "line open",
    "substation split",
    "dispatched",
)
"""What the steps compared had in them, counted in steps."""

_NEAR = 1e-5
_RANK_LEVELS = 1e5
_MOST_LISTED = 12
_FLOAT32_RESOLUTION = 2.0**-23

Arrays = tuple[NDArray[np.generic], ...]


class Difference(NamedTuple):
    """One value that the engines do not agree on."""

    attribute: str
    """Field of :class:`~rl2grid.mdp.state.GridState`."""
    element: int
    """Position along its axis."""
    expected: float
    actual: float


@dataclass(frozen=True)
class Disagreement:
    """A step, or a simulation, on which the engines do not agree."""

    plan: EpisodePlan
    step: int
    """Steps played when it shows; 0 is the reset."""
    horizon: int
    """Of the simulation that disagrees; 0: the step itself does."""
    action: str
    """What was played."""
    cause: str
    """A key of :data:`CAUSES`; empty: unexplained."""
    evidence: str
    """What speaks for the cause."""
    n_differences: int
    differences: tuple[Difference, ...]
    """The first of them."""

    def __str__(self) -> str:
        plan, what = self.plan, f"simulation {self.horizon} ahead of step" if self.horizon else "step"
        place = f"{plan.scenario_id} from row {plan.start}, seed {plan.seed}, episode {plan.number}, {what} {self.step}"
        values = "; ".join(f"{d.attribute}[{d.element}] {d.expected:.9g} != {d.actual:.9g}" for d in self.differences)
        because = f"{self.cause} ({self.evidence})" if self.cause else "UNEXPLAINED"
        return f"{place}, {self.action}: {because}, {self.n_differences} values: {values}"


@dataclass
class Tally:
    """What was compared, and what came of it."""

    steps: int = 0
    simulations: int = 0
    episodes: int = 0
    completed: int = 0
    game_overs: Counter[str] = field(default_factory=Counter)
    """By name of :class:`~rl2grid.mdp.termination.GameOver`."""
    counts: Counter[str] = field(default_factory=Counter)
    """See :data:`COUNTS`."""
    largest: dict[str, float] = field(default_factory=dict)
    """By attribute: the largest admissible difference met."""
    disagreements: list[Disagreement] = field(default_factory=list)

    @property
    def unexplained(self) -> list[Disagreement]:
        """Disagreements without a cause."""
        return [each for each in self.disagreements if not each.cause]


class SideBySide:
    """Plays episodes on two engines and compares them.

    The believed engine plays in row 0. The other one plays one episode after the other in another of its
    rows, so that what was in a row before, or is in its neighbours, must not matter.
    """

    def __init__(
        self,
        expected: Engine,
        actual: Engine,
        *,
        dispatch: str = "exact",
        reward: RewardFunction = PRESETS["default"],
        simulate_every: int = 25,
    ) -> None:
        """Both engines of one grid, made with ``dispatch``; one step in ``simulate_every`` is simulated too."""
        self.tally = Tally()
        self._expected, self._actual = expected, actual
        self._grid: Grid = expected.grid
        self._dispatch, self._reward, self._simulate_every = dispatch, reward, simulate_every
        self._comparison = _Comparison(expected.state, actual.state)
        self._counts = np.zeros(len(COUNTS), np.int64)
        self._limits: tuple[float, ...] = (1.0, float(self._grid.rules.hard_overflow))

    def play(self, plan: EpisodePlan, probe: Probe, most_steps: int | None = None) -> int:
        """Play an episode to its end, to the first disagreement, or for ``most_steps`` steps.

        Returns:
            Steps compared.
        """
        self._plan, self._row = plan, plan.number % self._actual.state.step.shape[0]
        probe.begin(np.random.default_rng((plan.seed, plan.number)))
        try:
            steps = self._play(probe, plan.n_steps if most_steps is None else most_steps)
        except Exception as error:
            error.add_note(f"in {plan} after step {int(self._expected.state.step[0])} of {self._grid.id}")
            raise
        self._finish(steps)
        return steps

    def _play(self, probe: Probe, most_steps: int) -> int:
        expected, actual, i, j = self._expected, self._actual, 0, self._row
        for engine, row in ((expected, i), (actual, j)):
            engine.reset(row, self._plan)
            begin_episode(engine.state, row)
        before = np.zeros((2, self._grid.n_line), np.float32)
        if self._disagree("reset", before):
            return 0
        horizons = self._horizons()
        for step in range(1, most_steps + 1):
            if expected.state.terminated[i] or expected.state.truncated[i]:
                return step - 1
            before[0], before[1] = expected.state.rho[i], actual.state.rho[j]
            # Shifted from episode to episode, so that short episodes are simulated too.
            simulation, wait = divmod(step + self._plan.number, self._simulate_every)
            if horizons and wait == 0:
                horizon = 1 + simulation % horizons
                if self._simulations_disagree(probe.choose(expected.state, i), horizon, before):
                    return step - 1
            action = probe.choose(expected.state, i)
            for engine, row in ((expected, i), (actual, j)):
                begin_episode(engine.state, row)
                engine.step(row, action)
                self._account(engine.state, row)
            _count(expected.state, i, self._counts)
            if self._disagree(_in_short(action), before):
                return step
        return most_steps

    def _horizons(self) -> int:
        forecast = load_scenario(self._grid.id, self._plan.scenario_id).load_p_forecast
        return 0 if forecast is None else forecast.shape[1]

    def _simulations_disagree(self, action: StepAction, horizon: int, before: NDArray[np.float32]) -> bool:
        states = [
            engine.simulate(row, action, horizon) for engine, row in ((self._expected, 0), (self._actual, self._row))
        ]
        for state in states:
            begin_episode(state, 0)
            self._account(state, 0)
        self.tally.simulations += 1
        comparison = _Comparison(*states)
        disagree = comparison.find(0, 0)
        self._comparison.widen(comparison)
        if disagree:
            self._note(comparison, 0, _in_short(action), horizon, before)
        return disagree

    def _account(self, state: GridState, i: int) -> None:
        survive, overload, cost = self._reward.components(state, i)
        accrue(state, i, survive, overload, cost, self._reward.weights, 1.0)

    def _disagree(self, action: str, before: NDArray[np.float32]) -> bool:
        if not self._differs():
            return False
        self._note(self._comparison, self._row, action, 0, before)
        return True

    def _differs(self) -> bool:
        """Whether the engines show other values after the last step."""
        return self._comparison.find(0, self._row)

    def _note(self, comparison: _Comparison, j: int, action: str, horizon: int, before: NDArray[np.float32]) -> None:
        differences = list(comparison.differences(0, j))
        cause, evidence = self._explain(comparison, j, {each.attribute for each in differences}, before)
        step = int(self._expected.state.step[0])
        listed = tuple(differences[:_MOST_LISTED])
        self.tally.disagreements.append(
            Disagreement(self._plan, step, horizon, action, cause, evidence, len(differences), listed)
        )

    def _explain(
        self, comparison: _Comparison, j: int, attributes: set[str], before: NDArray[np.float32]
    ) -> tuple[str, str]:
        """The cause of a disagreement, as a key of :data:`CAUSES`, and what speaks for it."""
        expected, actual = comparison.expected, comparison.actual
        if "attacked" in attributes and self.ranks_differ(before):
            return OPPONENT_RANK, "the order of the last loadings differs"
        near = [near_threshold(self._limits, rho) for rho in (*before, expected.rho[0], actual.rho[j])]
        if any(near):
            return THRESHOLD, next(each for each in near if each)
        reasons = (int(expected.game_over[0]), int(actual.game_over[j]))
        if sorted(reasons) == [int(GameOver.NONE), int(GameOver.DIVERGENCE)]:
            return DIVERGENCE, "only the reference converged" if reasons[0] == 0 else "only the reference diverged"
        if self._dispatch == "grid2op" and "actual_dispatch" in attributes and "target_dispatch" not in attributes:
            return DISPATCH_SOLVER, "the wish is the same"
        return "", ""

    def ranks_differ(self, before: NDArray[np.float32]) -> bool:
        """Whether the loadings that an opponent saw, float32 [2, line], have another order in the two engines."""
        levels = np.rint(before.astype(np.float64) * _RANK_LEVELS)
        for area in self._grid.opponent.areas:
            orders = np.argsort(levels[:, list(area)], axis=1, kind="stable")
            if (orders[0] != orders[1]).any():
                return True
        return False

    def _finish(self, steps: int) -> None:
        tally, state = self.tally, self._expected.state
        tally.steps += steps
        tally.episodes += 1
        tally.completed += int(state.truncated[0])
        if state.terminated[0]:
            tally.game_overs[GameOver(int(state.game_over[0])).name] += 1
        for name, count in zip(COUNTS, self._counts.tolist(), strict=True):
            tally.counts[name] += count
        self._counts[:] = 0
        tally.largest = self._comparison.largest_by_attribute()


class TransitionsSideBySide(SideBySide):
    """As :class:`SideBySide`, but the engines are compared from decision to decision: a heuristic plays between.

    The heuristic decides on each engine's own state, and in the compiled loop of the engine that has one. Nothing is
    simulated but what the heuristic tries.
    """

    def __init__(self, expected: Transitions, actual: Transitions) -> None:
        super().__init__(expected.engine, actual.engine, reward=expected.reward, simulate_every=0)
        self._transitions = expected, actual
        self._comparison = _Comparison(expected.engine.state, actual.engine.state, compared=_NOT_SUMMED)
        self._limits = (float(SAFE_RHO), *self._limits)

    def _play(self, probe: Probe, most_steps: int) -> int:
        i, j, state = 0, self._row, self._expected.state
        before = np.zeros((2, self._grid.n_line), np.float32)
        for transitions, row in zip(self._transitions, (i, j), strict=True):
            transitions.reset(row, self._plan)
        if self._disagree("reset", before):
            return 0
        while state.step[i] < most_steps and not (state.terminated[i] or state.truncated[i]):
            before[0], before[1] = state.rho[i], self._actual.state.rho[j]
            action = probe.choose(state, i)
            for transitions, row in zip(self._transitions, (i, j), strict=True):
                transitions.play(row, action)
            _count(state, i, self._counts)
            if self._disagree(_in_short(action), before):
                break
        return int(state.step[i])

    def _differs(self) -> bool:
        return super()._differs() or self._sums_differ()

    def _explain(
        self, comparison: _Comparison, j: int, attributes: set[str], before: NDArray[np.float32]
    ) -> tuple[str, str]:
        cause, evidence = super()._explain(comparison, j, attributes, before)
        if cause or self._transitions[0].heuristic != "secure":
            return cause, evidence
        expected, actual = self._transitions
        evidence = near_loss(expected, 0) or near_loss(actual, j)
        return (THRESHOLD, evidence) if evidence else ("", "")

    def _sums_differ(self) -> bool:
        """Whether what adds up over the steps of a transition differs by more than its steps may."""
        (expected, actual), j = (self._expected.state, self._actual.state), self._row
        tolerance = _SHARE * max(int(expected.step[0]), 1)
        pairs = {name: (getattr(expected, name)[0], getattr(actual, name)[j]) for name in (*_COUNTED, *_SUMMED)}
        return not (
            all(np.array_equal(*pairs[name]) for name in _COUNTED)
            and all(np.allclose(*pairs[name], rtol=0, atol=tolerance) for name in _SUMMED)
        )


class Detour:
    """An engine whose environments are saved now and then, play something else, and are brought back.

    It must then be the engine that it wraps: a world holds everything.
    """

    def __init__(self, engine: Engine, probe: Probe, every: int = 20, steps: int = 3) -> None:
        self._engine, self._probe, self._every, self._steps = engine, probe, every, steps
        self.grid, self.network, self.attacks, self.state = engine.grid, engine.network, engine.attacks, engine.state
        self._played = 0

    def reset(self, i: int, plan: EpisodePlan) -> None:
        """Begin the episode ``plan`` in environment ``i``."""
        self._probe.begin(np.random.default_rng((plan.seed, plan.number, 2)))
        self._engine.reset(i, plan)
        self.state = self._engine.state

    def step(self, i: int, action: StepAction) -> None:
        """Play one grid step of environment ``i``, and now and then a few others that are taken back."""
        self._engine.step(i, action)
        self._played += 1
        if self._played % self._every or self.state.terminated[i] or self.state.truncated[i]:
            return
        world = self._engine.save(i)
        for _ in range(self._steps):
            if not (self.state.terminated[i] or self.state.truncated[i]):
                self._engine.step(i, self._probe.choose(self.state, i))
        other = (i + 1) % self.state.step.shape[0]
        self._engine.restore(other, world)
        self._engine.restore(i, self._engine.save(other))

    def simulate(self, i: int, action: StepAction, horizon: int) -> GridState:
        """See :meth:`rl2grid.engines.base.Engine.simulate`."""
        return self._engine.simulate(i, action, horizon)

    def save(self, i: int) -> World:
        """See :meth:`rl2grid.engines.base.Engine.save`."""
        return self._engine.save(i)

    def restore(self, i: int, world: World) -> None:
        """See :meth:`rl2grid.engines.base.Engine.restore`."""
        self._engine.restore(i, world)

    def imagine(self, i: int, seed: int) -> World:
        """See :meth:`rl2grid.engines.base.Engine.imagine`."""
        return self._engine.imagine(i, seed)

    def close(self) -> None:
        """Free what the engine holds."""
        self._engine.close()


def near_threshold(limits: tuple[float, ...], rho: NDArray[np.float32]) -> str:
    """Which line of ``rho`` [line] is loaded within 1e-5 of one of ``limits``, in words; empty if none is."""
    for threshold in limits:
        lines = np.flatnonzero(np.abs(rho.astype(np.float64) - threshold) < _NEAR)
        if len(lines):
            return f"line {lines[0]} is loaded {rho[lines[0]]:.8f}"
    return ""


def near_loss(transitions: Transitions, i: int) -> str:
    """Which loss of a line that is expected in row ``i`` would load another within 1e-5 of the limit, in words."""
    security, state = transitions.security, transitions.engine.state
    for k, line in enumerate(security.line.tolist()):
        if not (state.line_status[i, line] and transitions.expects_loss(i, k)):
            continue
        loading = transitions.loading_after_loss(i, k)
        if abs(loading - SAFE_LOADING) < _NEAR:
            return f"the loss of line {line} would load another {loading:.8f}"
    return ""


class _Comparison:
    """Which values of a row of one state differ from those of a row of another."""

    def __init__(self, expected: GridState, actual: GridState, *, compared: tuple[str, ...] = COMPARED) -> None:
        self.expected, self.actual = expected, actual
        self._names: list[tuple[str, ...]] = []
        self._pairs: list[tuple[Arrays, Arrays]] = []
        self._limits: list[NDArray[np.float64]] = []
        self._largest: list[NDArray[np.float64]] = []
        for dtype in (np.float32, np.float64, np.int32, np.bool_):
            names = tuple(name for name in compared if getattr(expected, name).dtype == dtype)
            if not names:
                continue
            resolution = _FLOAT32_RESOLUTION if dtype == np.float32 else 0.0
            self._names.append(names)
            self._pairs.append((_as_rows(expected, names), _as_rows(actual, names)))
            self._limits.append(np.array([(TOLERANCES.get(name, 0.0), resolution) for name in names]))
            self._largest.append(np.zeros(len(names)))

    def find(self, i: int, j: int) -> bool:
        """Whether row ``i`` of the expected state and row ``j`` of the actual one differ too much."""
        found = self._final_topologies_differ(i, j)
        for pair, limits, largest in zip(self._pairs, self._limits, self._largest, strict=True):
            found |= _differ(*pair, i, j, limits, largest)
        return bool(found)

    def differences(self, i: int, j: int) -> Iterator[Difference]:
        """All values that differ too much."""
        for names, (expected, actual), limits in zip(self._names, self._pairs, self._limits, strict=True):
            for name, old, new, (tolerance, resolution) in zip(names, expected, actual, limits, strict=True):
                a, b = old[i].astype(np.float64), new[j].astype(np.float64)
                wrong = ~(np.abs(a - b) <= tolerance + resolution * np.abs(a))
                yield from (Difference(name, int(k), float(a[k]), float(b[k])) for k in np.flatnonzero(wrong))
        if self._final_topologies_differ(i, j):
            old, new = self.expected.final_topo_vect[i], self.actual.final_topo_vect[j]
            yield from (
                Difference("final_topo_vect", int(k), float(old[k]), float(new[k])) for k in np.flatnonzero(old != new)
            )

    def widen(self, other: _Comparison) -> None:
        """Take over the largest differences of another comparison."""
        for mine, theirs in zip(self._largest, other._largest, strict=True):
            np.maximum(mine, theirs, out=mine)

    def largest_by_attribute(self) -> dict[str, float]:
        """The largest difference that was found admissible so far, by attribute."""
        pairs = zip(self._names, self._largest, strict=True)
        return {name: float(value) for names, values in pairs for name, value in zip(names, values, strict=True)}

    def _final_topologies_differ(self, i: int, j: int) -> bool:
        if self.expected.game_over[i] in (GameOver.NONE, GameOver.DISPATCH):
            return False
        return not np.array_equal(self.expected.final_topo_vect[i], self.actual.final_topo_vect[j])


def _as_rows(state: GridState, names: tuple[str, ...]) -> Arrays:
    """The arrays of ``state`` with two axes each, sharing its memory."""
    return tuple(array[:, None] if array.ndim == 1 else array for array in (getattr(state, name) for name in names))


def _in_short(action: StepAction) -> str:
    changes = [f"{ActionKind(kind).name.lower()} {target} mask {mask:#x}" for kind, target, mask in action.changes]
    return " + ".join([*changes, *(["injection"] if action.values is not None else [])]) or "nothing"


@jit
def _differ(
    expected: Arrays,
    actual: Arrays,
    i: int,
    j: int,
    limits: NDArray[np.float64],
    largest: NDArray[np.float64],
) -> bool:
    """Whether arrays of one type differ by more than ``limits`` [array, (absolute, relative)]; NaN always does.

    Raises ``largest`` [array] to the admissible differences met.
    """
    found = False
    for k in range(len(expected)):
        old, new = expected[k], actual[k]
        for element in range(old.shape[1]):
            value = np.float64(old[i, element])
            difference = abs(value - np.float64(new[j, element]))
            if not difference <= limits[k, 0] + limits[k, 1] * abs(value):
                found = True
            elif difference > largest[k]:
                largest[k] = difference
    return found


@jit
def _count(state: GridState, i: int, counts: NDArray[np.int64]) -> None:
    """Add what the last step of row ``i`` had in it to ``counts``, in the order of :data:`COUNTS`."""
    counts[0] += state.illegal[i]
    counts[1] += state.ambiguous[i]
    counts[2] += state.attacked[i].any()
    if state.terminated[i]:
        return
    counts[3] += (state.time_next_maintenance[i] == 0).any()
    counts[4] += (state.timestep_overflow[i] > 0).any()
    counts[5] += not state.line_status[i].all()
    counts[6] += (state.topo_vect[i] == 2).any()
    counts[7] += (state.actual_dispatch[i] != 0).any()
