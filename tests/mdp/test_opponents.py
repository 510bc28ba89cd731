"""The opponents: draws against their distributions, rules by hand, statistics against Grid2Op's opponents.

Attack by attack, with Grid2Op's own draws, they are compared in ``tests/engines/test_reference_opponent.py``.
"""

import dataclasses
import functools
import types
import warnings

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.mdp import opponents
from rl2grid.mdp.opponents import (
    OpponentDraws,
    attack,
    draw_opponent,
    load_draws,
    new_opponent_state,
    opponent_step,
)
from rl2grid.mdp.state import new_state
from rl2grid.streams import Purpose, Stream
from rl2grid.structures import row_of

ATTACKED_GRIDS = ("bus36-MO-v0", "bus36-MO-v1", "bus118-MOB-v0", "bus118-MOB-v1")
GEOMETRIC_GRIDS = ATTACKED_GRIDS[1:]
KOLMOGOROV = 1.95
"""Largest scaled distance of two distribution functions that chance exceeds once in a thousand."""


def stream(number=0, seed=7):
    return Stream(seed, number, Purpose.OPPONENT)


def draws_of(waits, durations, choices):
    """Draws of one area per list."""
    n_attacks = np.array([len(area) for area in waits], np.int32)
    return OpponentDraws(n_attacks, np.array(waits, np.int32), np.array(durations, np.int32), np.array(choices))


def altered(grid, **changes):
    return dataclasses.replace(grid, opponent=dataclasses.replace(grid.opponent, **changes))


class Play:
    """Steps one opponent; attacked lines are open in the next observation."""

    def __init__(self, grid, draws):
        self.opponent = new_opponent_state(grid, 1)
        load_draws(self.opponent, 0, draws)
        self.rho = np.linspace(0.1, 0.9, grid.n_line, dtype=np.float32)
        self.status = np.ones(grid.n_line, np.bool_)

    def step(self, open_lines=()):
        """Attacked lines and the cooldown written to them."""
        status = self.status & ~self.opponent.attacked[0]
        status[list(open_lines)] = False
        attack(self.opponent, 0, self.rho, status)
        lines = np.flatnonzero(self.opponent.attacked[0])
        return tuple(lines.tolist()), tuple(self.opponent.cooldown_written[0, lines].tolist())

    def steps(self, n):
        return [self.step() for _ in range(n)]


# Draws


def test_draws_are_a_function_of_the_stream():
    grid = load_grid("bus118-MOB-v1")
    first, again, other = (draw_opponent(grid, stream(number), 2000) for number in (3, 3, 4))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first.choices, other.choices)


@pytest.mark.parametrize("grid_id", ATTACKED_GRIDS)
def test_a_shorter_episode_has_the_same_attacks(grid_id):
    grid = load_grid(grid_id)
    long, short = draw_opponent(grid, stream(), 8064), draw_opponent(grid, stream(), 700)
    for area, n_attacks in enumerate(short.n_attacks):
        for name in ("waits", "durations", "choices"):
            expected = getattr(long, name)[area, :n_attacks]
            np.testing.assert_array_equal(getattr(short, name)[area, :n_attacks], expected)


@pytest.mark.parametrize("grid_id", GEOMETRIC_GRIDS)
def test_attacks_fill_the_episode_and_end_with_it(grid_id):
    grid, n_steps = load_grid(grid_id), 3000
    for number in range(20):
        draws = draw_opponent(grid, stream(number), n_steps)
        for area, n_attacks in enumerate(draws.n_attacks):
            elapsed = 0
            for wait, duration in zip(draws.waits[area, :n_attacks], draws.durations[area, :n_attacks], strict=True):
                assert elapsed + wait < n_steps
                elapsed += wait + duration
            assert elapsed + draws.waits[area, n_attacks] >= n_steps


def test_an_attack_at_the_end_of_the_episode_is_not_drawn():
    grid = load_grid("bus36-MO-v1")
    draws = draw_opponent(grid, stream(), 3000)
    launch = int(draws.waits[0, :3].sum() + draws.durations[0, :2].sum())
    assert draw_opponent(grid, stream(), launch).n_attacks.tolist() == [2]
    assert draw_opponent(grid, stream(), launch + 1).n_attacks.tolist() == [3]


@pytest.mark.parametrize("grid_id", GEOMETRIC_GRIDS)
def test_waits_and_durations_are_geometric(grid_id):
    grid = load_grid(grid_id)
    draws = [draw_opponent(grid, stream(number), 8064) for number in range(40)]
    waits = np.concatenate([each.waits.ravel() for each in draws])
    durations = np.concatenate([each.durations.ravel() for each in draws])
    assert waits.min() == 1
    assert durations.min() == grid.opponent.minimum_duration + 1
    for sample, rate in (
        (waits, grid.opponent.hazard_rate),
        (durations - grid.opponent.minimum_duration, grid.opponent.recovery_rate),
    ):
        n = len(sample)
        below = np.bincount(sample, minlength=400).cumsum()[:400] / n
        assert np.abs(below - (1 - (1 - rate) ** np.arange(400))).max() * np.sqrt(n) < KOLMOGOROV


def test_weighted_waits_are_uniform():
    grid = load_grid("bus36-MO-v0")
    waits = np.concatenate([draw_opponent(grid, stream(number), 8064).waits[0] for number in range(200)])
    counts = np.bincount(waits, minlength=288)
    assert len(counts) == 288
    expected = len(waits) / 288
    assert ((counts - expected) ** 2 / expected).sum() < 287 + 4 * np.sqrt(2 * 287)


def test_a_geometric_draw_is_at_least_one_step():
    assert opponents._geometric(np.array([0.0, 0.249, 0.25, 1 - 2.0**-53]), 0.25).tolist() == [1, 1, 2, 128]


def test_too_many_attacks_are_refused():
    grid = load_grid("bus36-MO-v1")
    with pytest.raises(UsageError, match="room for 8 attacks"):
        load_draws(new_opponent_state(grid, 1, 100), 0, draws_of([[1] * 9], [[13] * 9], [[0.5] * 9]))


def test_an_unknown_kind_is_refused():
    with pytest.raises(UsageError, match="'angry' does not exist"):
        new_opponent_state(altered(load_grid("bus14"), kind="angry"), 1)


# Rules


@pytest.mark.parametrize("grid_id", [grid_id for grid_id in GRID_IDS if grid_id not in ATTACKED_GRIDS])
def test_grids_without_opponent_are_never_attacked(grid_id):
    grid = load_grid(grid_id)
    play = Play(grid, draw_opponent(grid, stream(), 100))
    assert set(play.steps(100)) == {((), ())}


def test_a_geometric_attack_lasts_its_duration():
    grid = load_grid("bus36-MO-v1")
    play = Play(grid, draws_of([[3]], [[14]], [[0.0]]))
    first = grid.opponent.areas[0][0]
    steps = play.steps(20)
    assert [lines for lines, _ in steps] == [()] * 3 + [(first,)] * 14 + [()] * 3
    assert [cooldown[0] for _, cooldown in steps[3:17]] == list(range(14, 0, -1))


def test_an_open_line_burns_one_attack_per_step():
    grid = load_grid("bus36-MO-v1")
    line = grid.opponent.areas[0][4]
    play = Play(grid, draws_of([[3, 50, 50, 50]], [[14] * 4], [[0.0, 0.1, 0.2, 0.99]]))
    play.steps(3)
    for burnt in range(3):
        assert play.opponent.attack_counter[0, 0] == burnt
        assert play.step(open_lines=[line]) == ((), ())
    last = grid.opponent.areas[0][-1]
    assert play.step() == ((last,), (14,))


def test_a_weighted_opponent_attacks_around_open_lines():
    grid = load_grid("bus36-MO-v0")
    *others, last = grid.opponent.areas[0]
    play = Play(grid, draws_of([[0]], [[48]], [[0.0]]))
    assert play.step(open_lines=others) == ((last,), (48,))


def test_a_weighted_opponent_waits_until_a_line_is_closed():
    grid = load_grid("bus36-MO-v0")
    play = Play(grid, draws_of([[0]], [[48]], [[0.0]]))
    for _ in range(3):
        assert play.step(open_lines=grid.opponent.areas[0]) == ((), ())
    assert play.step()[1] == (48,)


def test_two_early_weighted_attacks_may_follow_each_other():
    # The cooldown begins at 288 and decays throughout: after 48 steps it does not hold the next attack back.
    grid = load_grid("bus36-MO-v0")
    play = Play(grid, draws_of([[276, 2, 5]], [[48] * 3], [[0.5] * 3]))
    attacked = [bool(lines) for lines, _ in play.steps(900)]
    begins = [t for t in range(1, 900) if attacked[t] and not attacked[t - 1]]
    # Cooldown 288 - 277 + 288 = 299 at the first attack, 249 + 288 = 537 at the second, 288 after 249 more steps.
    assert begins == [276, 276 + 48 + 2, 326 + 249 + 5]


def test_equally_loaded_lines_are_ranked_in_list_order():
    # Probabilities 1 : 4^(1/9) : ... : 4 by rank; noise below 1e-5 does not change them.
    grid = load_grid("bus36-MO-v1")
    lines = list(grid.opponent.areas[0])
    weights = 4 ** (np.arange(10) / 9)
    for noise in (1e-7, -1e-7):
        for slot, share in enumerate(np.cumsum(weights / weights.sum())):
            play = Play(grid, draws_of([[1]], [[13]], [[share - 1e-9]]))
            play.rho[lines] = 0.4 + np.linspace(0, noise, 10)
            play.step()
            assert play.step() == ((lines[slot],), (13,))


def test_the_most_loaded_line_is_attacked_four_times_as_often():
    grid = load_grid("bus36-MO-v1")
    lines = grid.opponent.areas[0]
    loadings = np.random.default_rng(0).permutation(10)
    counts = np.zeros(10)
    for choice in (np.arange(2000) + 0.5) / 2000:
        play = Play(grid, draws_of([[1]], [[13]], [[choice]]))
        play.rho[list(lines)] = 0.1 * loadings
        play.step()
        counts[loadings[lines.index(play.step()[0][0])]] += 1
    np.testing.assert_allclose(counts / counts[0], 4 ** (np.arange(10) / 9), rtol=0.02)


def test_attacks_cost_budget_and_are_refused_without():
    grid = altered(load_grid("bus36-MO-v1"), initial_budget=20.0, budget_per_step=0.5)
    play = Play(grid, draws_of([[1, 1]], [[40, 13]], [[0.5, 0.5]]))
    play.step()
    assert play.step() == ((), ())
    assert play.opponent.previous_fails[0]
    # The second attack comes 1 + 40 steps later, as if the first had taken place, less the step of the refusal.
    assert [bool(lines) for lines, _ in play.steps(42)] == [False] * 40 + [True] * 2
    assert play.opponent.budget[0] == 20.0 + 44 * 0.5 - 2


def test_an_attack_longer_than_allowed_is_refused():
    play = Play(load_grid("bus36-MO-v1"), draws_of([[1]], [[97]], [[0.5]]))
    assert set(play.steps(120)) == {((), ())}
    assert play.opponent.attack_counter[0, 0] == 1


def test_areas_attack_together_one_step_longer_and_without_cooldown():
    grid = load_grid("bus118-MOB-v1")
    play = Play(grid, draws_of([[2], [4], [50]], [[13], [20], [13]], [[0.0], [0.0], [0.0]]))
    first, second = (area[0] for area in grid.opponent.areas[:2])
    steps = play.steps(28)
    attacked = [set(lines) for lines, _ in steps]
    assert [first in lines for lines in attacked] == [False] * 2 + [True] * 14 + [False] * 12
    assert [second in lines for lines in attacked] == [False] * 4 + [True] * 21 + [False] * 3
    assert {cooldown for _, cooldowns in steps for cooldown in cooldowns} == {1}
    assert play.opponent.budget[0] == pytest.approx(1000 + 28 * 0.51 - 14 - 21, abs=1e-4)


def test_a_line_of_two_areas_costs_once():
    grid = altered(load_grid("bus118-MOB-v1"), areas=((7,), (7,)))
    play = Play(grid, draws_of([[1], [1]], [[13], [13]], [[0.0], [0.0]]))
    assert play.steps(2)[1] == ((7,), (1,))
    assert play.opponent.budget[0] == pytest.approx(1000 + 2 * 0.51 - 1, abs=1e-4)


def test_rows_are_independent_and_reload_completely():
    grid = load_grid("bus118-MOB-v1")
    opponent, alone = new_opponent_state(grid, 3), Play(grid, draw_opponent(grid, stream(1), 4000))
    load_draws(opponent, 2, draw_opponent(grid, stream(5), 4000))
    for _ in range(700):
        attack(opponent, 2, alone.rho, alone.status)
    load_draws(opponent, 2, draw_opponent(grid, stream(1), 4000))
    for _ in range(700):
        alone.step()
        attack(opponent, 2, alone.rho, alone.status)
        assert np.array_equal(opponent.attacked[2], alone.opponent.attacked[0])
    assert not opponent.attacked[:2].any()
    own = row_of(opponent, 2)
    attack(opponent, 2, alone.rho, alone.status)
    attack(own, 0, alone.rho, alone.status)
    assert own.budget[0] == opponent.budget[2]


@pytest.mark.parametrize("grid_id", ATTACKED_GRIDS)
def test_compiled_and_interpreted_agree(grid_id, monkeypatch):
    grid = altered(load_grid(grid_id), hazard_rate=0.1, attack_period=8, initial_budget=60.0)
    state, rng = new_state(grid, 2), np.random.default_rng(1)
    draws = draw_opponent(grid, stream(), 400)
    compiled, interpreted = new_opponent_state(grid, 2), new_opponent_state(grid, 2)
    load_draws(compiled, 1, draws)
    load_draws(interpreted, 1, draws)
    observations = []
    for _ in range(400):
        state.rho[1] = rng.random(grid.n_line)
        state.line_status[1] = rng.random(grid.n_line) > 0.003
        opponent_step(state, compiled, 1)
        observations.append((state.rho[1].copy(), state.line_status[1].copy(), row_of(compiled, 1)))
    assert compiled.attack_counter[1].min() > 1
    for name, function in vars(opponents).copy().items():
        if hasattr(function, "py_func"):
            monkeypatch.setattr(opponents, name, function.py_func)
    for rho, line_status, expected in observations:
        state.rho[1], state.line_status[1] = rho, line_status
        opponents.opponent_step(state, interpreted, 1)
        for name, array in zip(interpreted._fields, row_of(interpreted, 1), strict=True):
            np.testing.assert_array_equal(array, getattr(expected, name), err_msg=name)


# Statistics against Grid2Op's opponents: our draws and its draws, on the same made-up loadings


@functools.cache
def grid2op_environment(name):
    import grid2op
    from lightsim2grid import LightSimBackend

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return grid2op.make(name, test=True, backend=LightSimBackend())


@dataclasses.dataclass
class Statistics:
    """What many episodes showed."""

    counts: np.ndarray
    """Attacks begun per episode."""
    steps: np.ndarray
    """Line-steps under attack per episode."""
    lengths: np.ndarray
    """Length of each uninterrupted attack on a line."""
    lines: np.ndarray
    """Attacks begun per line."""

    @classmethod
    def of(cls, episodes):
        """From ``attacked`` [step, line] of each episode."""
        counts, steps, lengths, lines = [], [], [], 0
        for attacked in episodes:
            change = np.diff(np.pad(attacked, ((1, 1), (0, 0))).astype(np.int8), axis=0).T
            begins, ends = np.argwhere(change == 1), np.argwhere(change == -1)
            counts.append(len(begins))
            steps.append(attacked.sum())
            lengths.append(ends[:, 1] - begins[:, 1])
            lines += np.bincount(begins[:, 0], minlength=attacked.shape[1])
        return cls(np.array(counts), np.array(steps), np.concatenate(lengths), lines)


def play_grid2op(grid, rho, n_episodes, n_steps):
    """Attacked lines [step, line] of each episode."""
    env = grid2op_environment(grid.bundled_names[0])
    space = env._oppSpace
    for area in getattr(space.opponent, "list_opponents", [space.opponent]):
        area._get_episode_duration = lambda: n_steps
    env._opponent.seed(20)
    space.reset()  # the next reset samples with the new episode length
    for _ in range(n_episodes):
        space.reset()
        attacked = np.zeros((n_steps, grid.n_line), np.bool_)
        observation = types.SimpleNamespace(rho=rho, line_status=np.ones(grid.n_line, np.bool_))
        for t in range(n_steps):
            action, _ = space.attack(observation, None, None)
            if action is not None:
                attacked[t] = action.get_topological_impact()[0]
            observation.line_status = ~attacked[t]
        yield attacked


def play_ours(grid, rho, n_episodes, n_steps):
    """Attacked lines [step, line] of each episode."""
    opponent = new_opponent_state(grid, 1)
    for episode in range(n_episodes):
        attacked = np.zeros((n_steps, grid.n_line), np.bool_)
        load_draws(opponent, 0, draw_opponent(grid, stream(episode), n_steps))
        line_status = np.ones(grid.n_line, np.bool_)
        for t in range(n_steps):
            attack(opponent, 0, rho, line_status)
            attacked[t] = opponent.attacked[0]
            line_status = ~attacked[t]
        yield attacked


def deviations(ours, theirs):
    """Difference of the means in standard errors."""
    return abs(ours.mean() - theirs.mean()) / np.sqrt(ours.var() / len(ours) + theirs.var() / len(theirs))


def assert_same_statistics(grid, n_episodes, n_steps):
    rho = np.random.default_rng(3).permutation(np.linspace(0.1, 1.2, grid.n_line)).astype(np.float32)
    ours, theirs = (Statistics.of(play(grid, rho, n_episodes, n_steps)) for play in (play_ours, play_grid2op))
    assert theirs.counts.sum() > 5 * n_episodes
    assert deviations(ours.counts, theirs.counts) < 3.5
    assert deviations(ours.steps, theirs.steps) < 3.5
    longest = 1 + max(ours.lengths.max(), theirs.lengths.max())
    below = [np.bincount(each.lengths, minlength=longest).cumsum() / len(each.lengths) for each in (ours, theirs)]
    n = 1 / (1 / len(ours.lengths) + 1 / len(theirs.lengths))
    assert np.abs(below[0] - below[1]).max() * np.sqrt(n) < KOLMOGOROV
    # Two-sample chi-square over the attackable lines.
    assert np.array_equal(ours.lines > 0, theirs.lines > 0)
    assert set(np.flatnonzero(ours.lines)) == {line for area in grid.opponent.areas for line in area}
    a, b = (each.lines[each.lines > 0].astype(float) for each in (ours, theirs))
    ratio = np.sqrt(b.sum() / a.sum())
    degrees = len(a) - len(grid.opponent.areas)
    assert ((a * ratio - b / ratio) ** 2 / (a + b)).sum() < degrees + 4 * np.sqrt(2 * degrees)


@pytest.mark.parametrize("grid_id", ATTACKED_GRIDS)
def test_statistics_equal_grid2op(grid_id):
    assert_same_statistics(load_grid(grid_id), n_episodes=10, n_steps=4032)


@pytest.mark.slow
@pytest.mark.parametrize("grid_id", ATTACKED_GRIDS)
def test_statistics_equal_grid2op_over_months(grid_id):
    assert_same_statistics(load_grid(grid_id), n_episodes=200, n_steps=8064)
