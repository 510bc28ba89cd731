"""The opponents: who attacks which lines, when and for how long.

An attack opens lines and keeps them open. Three kinds of opponent exist (paper, Section 3; Grid2Op's
classes in brackets), and all three are functions of the state and of random numbers drawn at reset:

- ``weighted`` (``WeightedRandomOpponent``): an attack falls uniformly in the next ``attack_period``
  steps and lasts ``max_duration``; a line is chosen in proportion to its loading over its usual one.
- ``geometric`` (``GeometricOpponent``): the times between attacks, and their durations, are geometric.
  A line is chosen by the rank of its loading.
- ``multi_area`` (``GeometricOpponentMultiArea``): one ``geometric`` opponent per area; they may attack
  at the same time.

Attack k of an area is a triple fixed at reset: a wait, a duration, and a number in [0, 1) that chooses
the line given the loadings of the moment. The numbers of attack k depend on the stream and on k alone,
so that an attack that does not take place changes no later one.

A budget, a longest duration and a cooldown limit the attacks (``OpponentSpace``). Their peculiarities
are Grid2Op 1.12.6's, because Grid2Op is the truth here:

- The cooldown starts at its maximum and decays beyond an attack, so two early attacks may follow each
  other closely.
- A geometric attack is given up when one attackable line is open. The waiting time is not renewed then:
  one attack is burnt in every step until all attackable lines are closed.
- An attack refused by the budget or for its duration makes the geometric opponent wait for the duration
  that it would have had. Before the first attack of an area that duration is the one of its last attack.
- A ``multi_area`` attack lasts one step longer than its duration, and is declared anew in each step with
  duration 1: the cooldown of an attacked line shows 0.
- The budget has single precision until the first attack and double precision from then on.

Two things differ on purpose:

- Grid2Op samples geometric attacks up to the length of the *previous* episode; here the episode's own
  length counts.
- Geometric opponents rank loadings to five decimals, and among equals the first in the list has the lower
  rank. Some attackable lines are in series and always loaded alike (``62_58_180`` and ``62_63_160`` of
  three grids), and lines that carry nothing differ by rounding errors. Grid2Op orders those by rounding
  errors and by the processor (``numpy.argsort`` is not stable and uses vector instructions where it can);
  two engines, or two computers, would not play the same attacks.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from rl2grid.arrays import F32, F64, I32, I64, Flags
from rl2grid.compile import jit
from rl2grid.errors import UsageError, one_of
from rl2grid.grids import Grid, OpponentConfig
from rl2grid.grids.axes import axis_sizes
from rl2grid.mdp.state import GridState
from rl2grid.philox import fill_uniforms
from rl2grid.scenarios.episodes import MAX_STEPS
from rl2grid.streams import Stream
from rl2grid.structures import allocate, blank_row, constant, episode, row, scratch

KINDS = ("none", "weighted", "geometric", "multi_area")
"""The kinds of opponent; the position is the code in :attr:`OpponentState.kind`."""

_NONE, _WEIGHTED, _GEOMETRIC, _MULTI_AREA = range(len(KINDS))
_LEVELS = 1e5
"""Loadings are ranked in steps of 1 / _LEVELS."""
_ATTACKS_AT_ONCE = 16
_UNSET = -(2**31)
"""Next attack time before it is set (Grid2Op's ``None``)."""


class OpponentState(NamedTuple):
    """Structure of arrays: the opponents of ``n`` environments of one grid.

    Attribute names are Grid2Op's where it has the attribute. An opponent that is not ``multi_area`` has one area,
    ``none`` has no area. What is blank before an episode begins with it.
    """

    kind: Annotated[I32, constant("1", "position in KINDS")]
    lines: Annotated[I32, constant("area slot", "attackable lines, padded with -1")]
    n_lines: Annotated[I32, constant("area", "number of attackable lines")]
    rho_normalization: Annotated[F64, constant("area slot", "usual loading; 1 unless weighted")]
    log_ratio: Annotated[F64, constant("1", "logarithm of pmax_pmin_ratio")]
    max_duration: Annotated[I32, constant("1", "longest attack", "steps")]
    cooldown: Annotated[I32, constant("1", "between attacks", "steps")]
    initial_budget: Annotated[F32, constant("1", "at the begin of an episode", "line-steps")]
    budget_per_step: Annotated[F32, constant("1", "earned", "line-steps")]
    attack_period: Annotated[I32, constant("1", "in which an attack falls, weighted only", "steps")]
    hazard_rate: Annotated[F64, constant("1", "chance that an attack begins, in a step")]
    recovery_rate: Annotated[F64, constant("1", "chance that an attack ends, in a step")]
    minimum_duration: Annotated[I32, constant("1", "shortest attack", "steps")]

    # Draws of the episode.
    n_attacks: Annotated[I32, episode("area", "attacks drawn", blank=0)]
    waits: Annotated[I32, episode("area attack", "before an attack", "steps")]
    durations: Annotated[I32, episode("area attack", "of an attack", "steps")]
    choices: Annotated[F64, episode("area attack", "in [0, 1): which line")]

    # What changes from step to step.
    budget: Annotated[F64, row("", "left", "line-steps")]
    budget_is_single: Annotated[Flags, row("", "the budget still has single precision", blank=1)]
    previous_fails: Annotated[Flags, row("", "the last attack was refused", blank=0)]
    attack_duration: Annotated[I32, row("", "left", "steps", grid2op="current_attack_duration", blank=0)]
    attack_cooldown: Annotated[I32, row("", "left", "steps", grid2op="current_attack_cooldown")]
    next_attack_time: Annotated[I32, row("area", "to the next attack", "steps", blank=_UNSET)]
    attack_counter: Annotated[I32, row("area", "attacks launched, burnt ones included", blank=0)]
    area_duration: Annotated[
        I32, row("area", "left, multi_area only", "steps", grid2op="_new_attack_time_counters", blank=-1)
    ]
    area_line: Annotated[I32, row("area", "line last chosen, -1 if none", blank=-1)]

    # What anybody can see of it.
    lasted: Annotated[I32, row("area", "for which an attack is under way, 0 if none is", "steps", blank=0)]
    waited: Annotated[I32, row("area", "at which one could have begun since, and did not", "steps", blank=0)]

    # Output of a step.
    attacked: Annotated[Flags, scratch("line", "opened by the opponent in this step", blank=0)]
    cooldown_written: Annotated[I32, scratch("line", "the cooldown becomes at least this", "steps", blank=0)]


class OpponentDraws(NamedTuple):
    """All that is random about the opponent in one episode.

    Attack k of area a is launched ``waits[a, k]`` steps after the one before has ended, lasts
    ``durations[a, k]`` steps and opens the line that ``choices[a, k]`` points at.
    """

    n_attacks: I32  # [area]
    waits: I32  # [area, attack] steps, >= 0
    durations: I32  # [area, attack] steps
    choices: F64  # [area, attack] in [0, 1)


def new_opponent_state(grid: Grid, n: int, longest_episode: int = MAX_STEPS) -> OpponentState:
    """The opponents of ``n`` environments of ``grid``, without attacks until :func:`load_draws`.

    Args:
        grid: Whose ``opponent`` attacks.
        n: Number of environments.
        longest_episode: Steps for which there is room for draws.

    Raises:
        UsageError: The kind of opponent does not exist.
    """
    config = grid.opponent
    if config.kind not in KINDS:
        raise one_of("Opponent", config.kind, KINDS)
    n_areas = len(config.areas)
    n_slots = max((len(area) for area in config.areas), default=0)
    capacity = _most_attacks(config, longest_episode)
    lines = np.full((n_areas, n_slots), -1, np.int32)
    normalization = np.ones((n_areas, n_slots), np.float64)
    for area, members in enumerate(config.areas):
        lines[area, : len(members)] = members
    if config.rho_normalization:
        normalization[0] = config.rho_normalization
    opponent = allocate(
        OpponentState,
        axis_sizes(grid) | {"area": n_areas, "attack": capacity},
        n,
        kind=np.array([KINDS.index(config.kind)], np.int32),
        lines=lines,
        n_lines=np.array([len(area) for area in config.areas], np.int32),
        rho_normalization=normalization,
        log_ratio=np.array([np.log(config.pmax_pmin_ratio) if config.pmax_pmin_ratio else 0.0], np.float64),
        max_duration=np.array([config.max_duration], np.int32),
        cooldown=np.array([config.cooldown], np.int32),
        initial_budget=np.array([config.initial_budget], np.float32),
        budget_per_step=np.array([config.budget_per_step], np.float32),
        attack_period=np.array([config.attack_period], np.int32),
        hazard_rate=np.array([config.hazard_rate], np.float64),
        recovery_rate=np.array([config.recovery_rate], np.float64),
        minimum_duration=np.array([config.minimum_duration], np.int32),
    )
    for i in range(n):
        _begin_episode(opponent, i)
    return opponent


def draw_opponent(grid: Grid, stream: Stream, n_steps: int) -> OpponentDraws:
    """Everything random about the opponent of ``grid`` in an episode of ``n_steps`` steps.

    A shorter episode of the same stream has the same attacks, as far as it goes.
    """
    config = grid.opponent
    n_areas, capacity = len(config.areas), _most_attacks(config, n_steps)
    # The attack is the first axis: its numbers do not depend on how many attacks follow.
    uniforms = stream.uniform(capacity * n_areas * 3).reshape(capacity, n_areas, 3).T
    if config.kind == "weighted":
        waits = (uniforms[0] * config.attack_period).astype(np.int32)
        durations = np.full((n_areas, capacity), config.max_duration, np.int32)
        n_attacks = np.full(n_areas, capacity, np.int32)
    elif config.kind == "none":
        waits, durations = np.zeros((2, n_areas, capacity), np.int32)
        n_attacks = np.zeros(n_areas, np.int32)
    else:
        waits = _geometric(uniforms[0], config.hazard_rate)
        durations = config.minimum_duration + _geometric(uniforms[1], config.recovery_rate)
        launched = np.cumsum(waits + durations, axis=1) - durations
        n_attacks = np.count_nonzero(launched < n_steps, axis=1).astype(np.int32)
    return OpponentDraws(n_attacks, waits, durations, np.ascontiguousarray(uniforms[2]))


def load_draws(opponent: OpponentState, i: int, draws: OpponentDraws) -> None:
    """Begin an episode with ``draws`` in environment ``i``.

    Raises:
        UsageError: There are more attacks than ``opponent`` has room for.
    """
    _begin_episode(opponent, i)
    most, room = int(draws.n_attacks.max(initial=0)), opponent.waits.shape[2]
    if most > room:
        raise UsageError(
            f"The opponent has room for {room} attacks per area, not {most}: give a longer longest_episode."
        )
    opponent.n_attacks[i] = draws.n_attacks
    for name in ("waits", "durations", "choices"):
        getattr(opponent, name)[i, :, :most] = getattr(draws, name)[:, :most]


@jit
def draw_attacks(opponent: OpponentState, i: int, seed: int, key: int, n_steps: int) -> None:
    """Begin an episode of ``n_steps`` steps in environment ``i`` with the draws of stream (seed, key).

    What :func:`draw_opponent` draws and :func:`load_draws` loads, in compiled code.

    Args:
        opponent: The opponents, with room for the attacks of such an episode, and of no longer one.
        i: The environment.
        seed: Of the stream.
        key: Of the stream, see :func:`rl2grid.philox.fill_uniforms`.
        n_steps: Steps of the episode.
    """
    blank_row(opponent, i)
    opponent.budget[i] = opponent.initial_budget[0]
    opponent.attack_cooldown[i] = opponent.cooldown[0]
    if opponent.kind[0] == _NONE:
        return
    n_areas = opponent.n_lines.size
    numbers = np.empty((_ATTACKS_AT_ONCE, n_areas, 3))
    launched = np.zeros(n_areas, np.int64)
    for attack in range(opponent.waits.shape[2]):
        place = attack % _ATTACKS_AT_ONCE
        if place == 0:
            fill_uniforms(seed, key, attack * n_areas * 3, numbers.reshape(-1))
        going_on = False
        for area in range(n_areas):
            going_on |= _draw_attack(opponent, i, area, attack, numbers[place, area], launched, n_steps)
        if not going_on:
            return


@jit
def _draw_attack(
    opponent: OpponentState, i: int, area: int, attack: int, numbers: F64, launched: I64, n_steps: int
) -> bool:
    """Draw the next attack of an area; whether there may be more.

    ``launched`` counts the steps to the end of the last attack, per area, if none is ever refused.
    """
    if attack > opponent.n_attacks[i, area]:
        return False
    if opponent.kind[0] == _WEIGHTED:
        opponent.waits[i, area, attack] = np.int32(numbers[0] * opponent.attack_period[0])
        opponent.durations[i, area, attack] = opponent.max_duration[0]
    else:
        wait = _steps_until(numbers[0], opponent.hazard_rate[0])
        duration = opponent.minimum_duration[0] + _steps_until(numbers[1], opponent.recovery_rate[0])
        if launched[area] + wait >= n_steps:
            return False
        launched[area] += wait + duration
        opponent.waits[i, area, attack] = wait
        opponent.durations[i, area, attack] = duration
    opponent.choices[i, area, attack] = numbers[2]
    opponent.n_attacks[i, area] = attack + 1
    return True


@jit
def _steps_until(uniform: float, chance: float) -> int:
    """:func:`_geometric` of one number."""
    return int(np.floor(np.log1p(-uniform) / np.log1p(-chance)) + 1)


def imagine_opponent(
    opponent: OpponentState, i: int, grid: Grid, stream: Stream, n_steps: int, attacked: Flags, cooldown_line: I32
) -> None:
    """Replace all that nobody can know of the opponent of environment ``i`` by draws from what is published of it.

    Budget, cooldown and attacks under way stay: they follow from what was seen. Of an attack under way, a ``weighted``
    or ``geometric`` opponent has shown the end, in the cooldown of the lines; a ``multi_area`` one has not, and its end
    is drawn, given how long it has lasted. When the next attack comes is drawn, given how long there was none.

    Args:
        opponent: The opponents.
        i: The environment.
        grid: Whose ``opponent`` is published.
        stream: Of the draws.
        n_steps: Steps left of the episode.
        attacked: bool [line], out by the opponent in the last step.
        cooldown_line: int32 [line], as last observed.
    """
    config = grid.opponent
    n_areas = len(config.areas)
    ends, begins = stream.uniform(2 * n_areas).reshape(2, n_areas)
    draws = draw_opponent(grid, stream, n_steps)
    opponent.n_attacks[i] = draws.n_attacks
    for name in ("waits", "durations", "choices"):
        drawn, kept = getattr(draws, name), getattr(opponent, name)[i]
        room = min(drawn.shape[1], kept.shape[1])
        kept[:] = 0
        kept[:, :room] = drawn[:, :room]
    opponent.attack_counter[i] = 0
    opponent.previous_fails[i] = False
    opponent.attack_duration[i] = _duration_left(config, attacked, cooldown_line)
    for area, lines in enumerate(config.areas):
        hit = [line for line in lines if attacked[line]]
        opponent.area_line[i, area] = hit[0] if hit else -1
        opponent.area_duration[i, area] = -1
        if hit and config.kind == "multi_area":
            opponent.area_duration[i, area] = _area_steps_left(config, int(opponent.lasted[i, area]), ends[area])
        opponent.next_attack_time[i, area] = _steps_to_attack(config, int(opponent.waited[i, area]), begins[area])


def _duration_left(config: OpponentConfig, attacked: Flags, cooldown_line: I32) -> int:
    """``current_attack_duration`` as far as it was seen."""
    if not attacked.any():
        return 0
    if config.kind == "multi_area":
        return 1
    # The cooldown was counted down after the attack had written it; switching the line may have made it longer.
    return min(config.max_duration, int(cooldown_line[attacked].min()) + 1)


def _area_steps_left(config: OpponentConfig, lasted: int, uniform: float) -> int:
    """How many more steps an attack takes that has lasted so many, the first one included (``multi_area``)."""
    more = int(_geometric(np.array([uniform]), config.recovery_rate)[0])
    certain = config.minimum_duration + 1 - lasted
    return certain + more if certain >= 0 else more - 1


def _steps_to_attack(config: OpponentConfig, waited: int, uniform: float) -> int:
    """Asked for the how-manieth time from now on, the opponent attacks, if it was asked so often before in vain."""
    if config.kind == "weighted":
        return 1 + int(uniform * max(config.attack_period - waited, 1))
    wait = int(_geometric(np.array([uniform]), config.hazard_rate)[0])
    return wait if waited else 1 + wait


@jit
def opponent_step(state: GridState, opponent: OpponentState, i: int) -> None:
    """The opponent's part in a step of environment ``i``.

    Reads ``rho`` and ``line_status`` of the last observation in ``state``; writes
    ``opponent.attacked[i]``, the lines to open in this step, and ``opponent.cooldown_written[i]``.
    """
    attack(opponent, i, state.rho[i], state.line_status[i])


@jit
def attack(opponent: OpponentState, i: int, rho: F32, line_status: Flags) -> None:
    """:func:`opponent_step` on the ``rho`` [line] and ``line_status`` [line] of the last observation."""
    opponent.attacked[i, :] = False
    opponent.cooldown_written[i, :] = 0
    if opponent.kind[0] == _NONE:
        return
    _earn_budget(opponent, i)
    opponent.attack_duration[i] = max(0, opponent.attack_duration[i] - 1)
    opponent.attack_cooldown[i] = max(0, opponent.attack_cooldown[i] - 1)
    asked = False
    if opponent.attack_duration[i] > 0:
        n_attacked = _mark_attacked(opponent, i)
        _tell_attack_continues(opponent, i)
    elif opponent.attack_cooldown[i] > opponent.cooldown[0]:
        n_attacked = 0
        _tell_attack_continues(opponent, i)
    else:
        asked = True
        n_attacked = _ask_for_attack(opponent, i, rho, line_status)
    _note_seen(opponent, i, asked)
    if n_attacked == 0:
        return
    opponent.budget[i] -= n_attacked
    opponent.budget_is_single[i] = False
    for line in range(opponent.attacked.shape[1]):
        if opponent.attacked[i, line]:
            opponent.cooldown_written[i, line] = opponent.attack_duration[i]


def _begin_episode(opponent: OpponentState, i: int) -> None:
    blank_row(opponent, i)
    opponent.budget[i] = opponent.initial_budget[0]
    opponent.attack_cooldown[i] = opponent.cooldown[0]


def _most_attacks(config: OpponentConfig, n_steps: int) -> int:
    """No area can launch more attacks in ``n_steps`` steps."""
    shortest = config.max_duration if config.kind == "weighted" else config.minimum_duration + 2
    return n_steps // max(shortest, 1) + 1


def _geometric(uniforms: F64, chance: float) -> I32:
    """Steps until an event of probability ``chance`` per step, by inversion of the distribution.

    The smallest k >= 1 with 1 - (1 - chance)^k > u. Uniforms lie in [0, 1), so "floor + 1" is exact
    where "ceil" would give 0 steps for u = 0. log1p keeps the digits of a small ``chance``.
    """
    steps: I32 = (np.floor(np.log1p(-uniforms) / np.log1p(-chance)) + 1).astype(np.int32)
    return steps


@jit
def _earn_budget(opponent: OpponentState, i: int) -> None:
    if opponent.budget_is_single[i]:
        opponent.budget[i] = np.float32(np.float32(opponent.budget[i]) + opponent.budget_per_step[0])
    else:
        opponent.budget[i] += np.float64(opponent.budget_per_step[0])


@jit
def _tell_attack_continues(opponent: OpponentState, i: int) -> None:
    opponent.next_attack_time[i, :] = _UNSET
    opponent.previous_fails[i] = False


@jit
def _mark_attacked(opponent: OpponentState, i: int) -> int:
    """Enter the lines of all areas in ``attacked``; returns how many lines that are."""
    n_attacked = 0
    for area in range(opponent.area_line.shape[1]):
        line = opponent.area_line[i, area]
        if line >= 0 and not opponent.attacked[i, line]:
            opponent.attacked[i, line] = True
            n_attacked += 1
    return n_attacked


@jit
def _note_seen(opponent: OpponentState, i: int, asked: bool) -> None:
    """Count for how long each area is under attack, or has been left alone although it could be attacked."""
    for area in range(opponent.area_line.shape[1]):
        line = opponent.area_line[i, area]
        if line >= 0 and opponent.attacked[i, line]:
            opponent.lasted[i, area] += 1
            opponent.waited[i, area] = 0
        else:
            opponent.lasted[i, area] = 0
            opponent.waited[i, area] += 1 if asked else 0


@jit
def _ask_for_attack(opponent: OpponentState, i: int, rho: F32, line_status: Flags) -> int:
    """Ask the opponent, and refuse what it cannot pay for; returns the number of lines attacked."""
    kind = opponent.kind[0]
    if kind == _WEIGHTED:
        opponent.area_line[i, 0] = _weighted_line(opponent, i, rho, line_status)
        duration = opponent.max_duration[0]
    elif kind == _GEOMETRIC:
        opponent.area_line[i, 0] = _geometric_line(opponent, i, 0, rho, line_status)
        # Meaningless before the first attack, but then no line is attacked either.
        duration = opponent.durations[i, 0, max(0, opponent.attack_counter[i, 0] - 1)]
    else:
        _ask_areas(opponent, i, rho, line_status)
        duration = np.int32(1)
    opponent.previous_fails[i] = False
    n_attacked = _mark_attacked(opponent, i)
    if n_attacked == 0:
        return 0
    if duration > opponent.max_duration[0] or duration * n_attacked > opponent.budget[i]:
        opponent.previous_fails[i] = True
        opponent.attacked[i, :] = False
        return 0
    opponent.attack_duration[i] = duration
    opponent.attack_cooldown[i] += opponent.cooldown[0]
    if kind == _WEIGHTED:
        opponent.attack_counter[i, 0] += 1
    return n_attacked


@jit
def _ask_areas(opponent: OpponentState, i: int, rho: F32, line_status: Flags) -> None:
    for area in range(opponent.area_line.shape[1]):
        opponent.area_duration[i, area] = max(-1, opponent.area_duration[i, area] - 1)
        if opponent.area_duration[i, area] >= 0:
            opponent.next_attack_time[i, area] = _UNSET
            continue
        line = _geometric_line(opponent, i, area, rho, line_status)
        opponent.area_line[i, area] = line
        if line >= 0:
            opponent.area_duration[i, area] = opponent.durations[i, area, opponent.attack_counter[i, area] - 1]


@jit
def _weighted_line(opponent: OpponentState, i: int, rho: F32, line_status: Flags) -> int:
    """The line that a weighted opponent wants to attack now, -1 if none."""
    k = opponent.attack_counter[i, 0]
    if k >= opponent.n_attacks[i, 0]:
        return -1
    if opponent.next_attack_time[i, 0] == _UNSET:
        opponent.next_attack_time[i, 0] = 1 + opponent.waits[i, 0, k]
    opponent.next_attack_time[i, 0] -= 1
    if opponent.next_attack_time[i, 0] > 0:
        return -1
    n = opponent.n_lines[0]
    weights = np.zeros(n, np.float64)
    for slot in range(n):
        line = opponent.lines[0, slot]
        if line_status[line]:
            weights[slot] = np.float64(rho[line]) / opponent.rho_normalization[0, slot]
    if not weights.any():
        return -1
    return int(opponent.lines[0, _choose(weights, opponent.choices[i, 0, k])])


@jit
def _geometric_line(opponent: OpponentState, i: int, area: int, rho: F32, line_status: Flags) -> int:
    """The line that a geometric opponent wants to attack now in ``area``, -1 if none."""
    k = opponent.attack_counter[i, area]
    n_attacks = opponent.n_attacks[i, area]
    if k >= n_attacks:
        return -1
    if opponent.previous_fails[i]:
        before = k - 1 if k > 0 else n_attacks - 1
        opponent.next_attack_time[i, area] = opponent.waits[i, area, k] + opponent.durations[i, area, before]
    if opponent.next_attack_time[i, area] == _UNSET:
        opponent.next_attack_time[i, area] = 1 + opponent.waits[i, area, k]
    opponent.next_attack_time[i, area] -= 1
    if opponent.next_attack_time[i, area] > 0:
        return -1
    opponent.attack_counter[i, area] += 1
    n = opponent.n_lines[area]
    for slot in range(n):
        if not line_status[opponent.lines[area, slot]]:
            return -1
    if n == 1:
        return int(opponent.lines[area, 0])
    steepness = opponent.log_ratio[0] / (n - 1)
    levels = np.zeros(n, np.float64)
    for slot in range(n):
        levels[slot] = np.rint(np.float64(rho[opponent.lines[area, slot]]) * _LEVELS)
    weights = np.zeros(n, np.float64)
    for slot in range(n):
        weights[slot] = np.exp(steepness * _rank(levels, slot))
    return int(opponent.lines[area, _choose(weights, opponent.choices[i, area, k])])


@jit
def _rank(levels: F64, slot: int) -> int:
    """How many entries are lower; among equals the earlier one is lower."""
    rank = 0
    for other in range(len(levels)):
        if levels[other] < levels[slot] or (levels[other] == levels[slot] and other < slot):
            rank += 1
    return rank


@jit
def _choose(weights: F64, uniform: float) -> int:
    """NumPy's ``choice(p=weights / sum)``, given the uniform number that it would draw."""
    total = 0.0
    for weight in weights:
        total += weight
    last = 0.0
    for weight in weights:
        last += weight / total
    reached = 0.0
    for slot in range(len(weights)):
        reached += weights[slot] / total
        if reached / last > uniform:
            return slot
    return len(weights) - 1
