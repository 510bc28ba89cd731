r"""Rewards of a grid step: presets, weights on the default components, or a function of your own.

A reward is ``weights . (survive, overload, cost)`` (paper, Section 3.1). With L the lines, ``rho`` the
loading of a line, ``losses = sum(gen_p) - sum(load_p)``, ``c`` the cost per MWh of the dearest generator that
produces now and ``c_max`` that of the grid's dearest:

``default`` (weights 1, 0.5, 0.5) is never negative, so that staying alive is never punished. The printed
formula has the sign of an overload the wrong way round and names no normalisers; here

- survive = 1
- overload = -mean over L of (clip(rho - 1, 0, 1) if connected else 1)
- cost = -clip(c (losses' + sum|actual_dispatch| + sum|storage_power| + curtailed) / (0.1 c_max sum(gen_pmax)), 0, 1),
  where losses' = max(losses - sum(storage_power), 0) (what a storage unit absorbs is not lost) and
  curtailed = sum over renewables of max(gen_p_before_curtail - gen_p, 0)
- all are 0 at a game over

``paper`` (weights 1, 0.5, 0.5: its appendix) is the printed formula, the excess counted negative and
every term clipped to the range that the paper states. As sums over the grid and costs in MW are far
larger than those ranges, both terms are saturated most of the time. A step is worth t / T - 1/2 at most then: in the
first half of a month less than a game over, which learners bring about:

- survive = t / T
- overload = clip(-sum over L of (max(rho - 1, 0) if connected else 1), -1, 1)
- cost = clip(-c (losses + sum|actual_dispatch| + sum|storage_power|), -1, 0)
- all are 0 at a game over

``released`` (weights 1, 1, 0.5) is what the paper's released code trains with:

- survive = 1; -5 at a game over
- overload = -sum over L of (max(rho - 1, 0) if connected else 1) / (0.1 \|L\|); -5 at a game over and after an
  illegal or ambiguous action
- cost = -c (losses + 5 sum|actual_dispatch| + sum|storage_power|) / (5.05 c_max sum(gen_pmax)): Grid2Op's
  ``RedispReward`` divided by its largest regret; -1 at a game over and after an illegal or ambiguous action

``trips`` (weights 1, 0.5, 0.5) is ``default`` for whoever is to learn to act before protections do: every line that
they opened in the step counts once more in the overload, 1 each and at most 2. What a protection has opened is locked
for ``reconnection`` steps, far longer than what the agent opens, and that is how it is told.

A function of your own reads row ``i`` of a :class:`~rl2grid.mdp.state.GridState` after every grid step and returns the
three components, which are added up as they are, or one number, which is the first of them. It may be plain Python, or
compiled with ``numba.njit``, which is faster where it has loops::

    def fewer_switches(state, i):
        return 1.0, 0.0, -0.01 * np.sum(state.topo_vect[i] != 1)
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rl2grid.arrays import F32, Flags
from rl2grid.compile import jit
from rl2grid.errors import UsageError
from rl2grid.mdp.state import GridState

_FULL_LOAD = np.float32(1.0)

_MOST_TRIPS = 2
"""Of one step that the ``trips`` reward counts."""

Components = tuple[float, float, float]
"""survive, overload, cost."""


@dataclass(frozen=True)
class RewardFunction:
    """A reward, ready to be evaluated after every grid step."""

    name: str
    components: Callable[[GridState, int], Components]
    """``(state, i) -> (survive, overload, cost)``; those of the package are compiled."""
    weights: Components
    """Weights of the three components in the reward."""

    @property
    def is_preset(self) -> bool:
        """Whether the components are those of one of :data:`PRESETS`, compiled with the package."""
        return any(self.components is preset.components for preset in PRESETS.values())


@jit
def default_components(state: GridState, i: int) -> Components:
    """Components of the ``default`` reward in row ``i``: 1, and two in [-1, 0]; see the module."""
    if state.terminated[i]:
        return 0.0, 0.0, 0.0
    stored = total(state.storage_power[i])
    power = max(total(state.gen_p[i]) - total(state.load_p[i]) - stored, 0.0)
    power += magnitude(state.actual_dispatch[i]) + magnitude(state.storage_power[i])
    power += _curtailed(state.gen_p_before_curtail[i], state.gen_p[i])
    largest = 0.1 * _dearest(state.gen_cost_per_mw) * total(state.gen_pmax)
    cost = 0.0 - min(max(marginal_cost(state.gen_p[i], state.gen_cost_per_mw) * power / largest, 0.0), 1.0)
    return 1.0, overload_component(state, i), cost


@jit
def overload_component(state: GridState, i: int) -> float:
    """Overload of the ``default`` reward in row ``i``, in [-1, 0]; 0 at a game over."""
    if state.terminated[i]:
        return 0.0
    n_lines: int = state.rho.shape[1]
    # Most steps have neither, and only a sum of numbers has to be made in order.
    any_at_all = False
    for line in range(n_lines):
        any_at_all |= (state.rho[i, line] > _FULL_LOAD) | (not state.line_status[i, line])
    if not any_at_all:
        return 0.0
    total = 0.0
    for line in range(n_lines):
        excess = np.float64(state.rho[i, line]) - 1.0
        total -= min(max(excess, 0.0), 1.0) if state.line_status[i, line] else 1.0
    return total / n_lines


@jit
def trips_components(state: GridState, i: int) -> Components:
    """Components of the ``trips`` reward in row ``i``: 1, one in [-3, 0] and one in [-1, 0]; see the module."""
    survive, overload, cost = default_components(state, i)
    return survive, overload - min(trips(state, i), _MOST_TRIPS), cost


@jit
def trips(state: GridState, i: int) -> int:
    """Lines that protections opened in the last grid step of row ``i``; 0 at a game over."""
    found = 0
    for line in range(state.line_status.shape[1]):
        found += has_tripped(state, i, line)
    return found


@jit
def has_tripped(state: GridState, i: int, line: int) -> bool:
    """Whether a protection opened a line in the last grid step of row ``i``; never at a game over.

    It is locked for all of ``reconnection`` now. So is what an agent opened where the rules lock that as long, which no
    grid of the package does.
    """
    locked_for = state.reconnection[0]
    if state.terminated[i] or state.line_status[i, line] or locked_for == 0:
        return False
    by_others = state.attacked[i, line] or state.time_next_maintenance[i, line] == 0
    return not by_others and state.time_before_cooldown_line[i, line] == locked_for


@jit
def paper_components(state: GridState, i: int) -> Components:
    """Components of the ``paper`` reward in row ``i``: in [0, 1], [-1, 1] and [-1, 0]; see the module."""
    if state.terminated[i]:
        return 0.0, 0.0, 0.0
    survive = np.float64(state.step[i]) / np.float64(state.episode_length[i])
    overload = max(0.0 - _overloads_and_outages(state.rho[i], state.line_status[i]), -1.0)
    power = total(state.gen_p[i]) - total(state.load_p[i])
    power += magnitude(state.actual_dispatch[i]) + magnitude(state.storage_power[i])
    cost = min(max(0.0 - marginal_cost(state.gen_p[i], state.gen_cost_per_mw) * power, -1.0), 0.0)
    return survive, overload, cost


@jit
def released_components(state: GridState, i: int) -> Components:
    """Components of the ``released`` reward in row ``i``, the latter two unbounded below; see the module."""
    if state.terminated[i]:
        return -5.0, -5.0, -1.0
    if state.illegal[i] or state.ambiguous[i]:
        return 1.0, -5.0, -1.0
    overload = 0.0 - _overloads_and_outages(state.rho[i], state.line_status[i]) / (0.1 * state.rho.shape[1])
    regret = total(state.gen_p[i]) - total(state.load_p[i]) + magnitude(state.storage_power[i])
    regret += 5.0 * magnitude(state.actual_dispatch[i])
    largest = 5.05 * _dearest(state.gen_cost_per_mw) * total(state.gen_pmax)
    return 1.0, overload, 0.0 - marginal_cost(state.gen_p[i], state.gen_cost_per_mw) * regret / largest


PRESETS: dict[str, RewardFunction] = {
    "default": RewardFunction("default", default_components, (1.0, 0.5, 0.5)),
    "paper": RewardFunction("paper", paper_components, (1.0, 0.5, 0.5)),
    "released": RewardFunction("released", released_components, (1.0, 1.0, 0.5)),
    "trips": RewardFunction("trips", trips_components, (1.0, 0.5, 0.5)),
}


def resolve_reward(spec: str | Sequence[float] | Callable[..., Any]) -> RewardFunction:
    """The reward that ``spec`` asks for.

    Args:
        spec: a name in :data:`PRESETS`; or the weights of the three default components; or a function ``(state, i)``,
            compiled with ``numba.njit`` or not, that returns (survive, overload, cost), which are added up, or one
            number.

    Raises:
        UsageError: ``spec`` is none of these.
    """
    if isinstance(spec, str) and spec in PRESETS:
        return PRESETS[spec]
    if callable(spec):
        return _custom(spec)
    weights = _weights(spec)
    return RewardFunction(f"weights {', '.join(f'{weight:g}' for weight in weights)}", default_components, weights)


def _custom(function: Callable[..., Any]) -> RewardFunction:
    name = getattr(function, "__name__", type(function).__name__)
    try:
        inspect.signature(getattr(function, "py_func", function)).bind(None, 0)
    except (TypeError, ValueError):
        raise UsageError(
            f"Reward function {name!r} is not usable: give a function (state, i) -> (survive, overload, cost), or "
            f"choose one of {', '.join(PRESETS)}."
        ) from None
    return RewardFunction(name, _checked(function, name), (1.0, 1.0, 1.0))


def reward_name(function: Callable[..., Any]) -> str:
    """What stored results call a function that somebody gave as reward: where it is written."""
    source = function if hasattr(function, "__qualname__") else type(function)
    return f"{source.__module__}.{source.__qualname__}"


def _checked(function: Callable[..., Any], name: str) -> Callable[[GridState, int], Components]:
    """The function, whose result is seen to be three numbers, or one."""

    def components(state: GridState, i: int) -> Components:
        result = function(state, i)
        try:
            if np.ndim(result) == 0:
                return float(result), 0.0, 0.0
            survive, overload, cost = result
            return float(survive), float(overload), float(cost)
        except (TypeError, ValueError):
            raise UsageError(
                f"Reward function {name!r} returned {result!r}: it is to return three numbers (survive, overload, "
                "cost), or one."
            ) from None

    return components


def _weights(spec: object) -> Components:
    numbers = spec if isinstance(spec, Sequence | np.ndarray) and not isinstance(spec, str) else ()
    valid = [float(x) for x in numbers if isinstance(x, int | float | np.number) and not isinstance(x, bool)]
    if len(numbers) != 3 or len(valid) != 3 or not all(map(math.isfinite, valid)):
        raise UsageError(
            f"Reward {spec!r} does not exist: choose one of {', '.join(PRESETS)}, three finite weights of the default "
            "components, or a function (state, i)."
        )
    return valid[0], valid[1], valid[2]


@jit
def _overloads_and_outages(rho: F32, line_status: Flags) -> float:
    """Excess loading of connected lines plus number of disconnected ones."""
    total = 0.0
    for line in range(rho.shape[0]):
        if line_status[line]:
            total += max(np.float64(rho[line]) - 1.0, 0.0)
        else:
            total += 1.0
    return total


@jit
def _curtailed(gen_p_before_curtail: F32, gen_p: F32) -> float:
    """MW that renewables would produce more without their limits (other generators have 0 before)."""
    total = 0.0
    for gen in range(gen_p.shape[0]):
        total += max(np.float64(gen_p_before_curtail[gen]) - np.float64(gen_p[gen]), 0.0)
    return total


@jit
def marginal_cost(gen_p: F32, gen_cost_per_mw: F32) -> float:
    """Cost per MWh of the dearest generator that produces now; 0 when none does."""
    dearest = 0.0
    for gen in range(gen_p.shape[0]):
        if gen_p[gen] > 0:
            dearest = max(dearest, np.float64(gen_cost_per_mw[gen]))
    return dearest


@jit
def _dearest(gen_cost_per_mw: F32) -> float:
    dearest = 0.0
    for gen in range(gen_cost_per_mw.shape[0]):
        dearest = max(dearest, np.float64(gen_cost_per_mw[gen]))
    return dearest


@jit
def total(powers: F32) -> float:
    """Their sum, MW."""
    total = 0.0
    for k in range(powers.shape[0]):
        total += np.float64(powers[k])
    return total


@jit
def magnitude(powers: F32) -> float:
    """The sum of their absolute values, MW."""
    total = 0.0
    for k in range(powers.shape[0]):
        total += abs(np.float64(powers[k]))
    return total
