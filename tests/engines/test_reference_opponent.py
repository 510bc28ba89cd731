"""Our opponents against Grid2Op's, attack by attack.

Grid2Op's opponents play with their own random numbers, which are written down while they are drawn.
Ours get the same numbers and the same observations, and must attack the same lines for as long, with
the same budget left; first on made-up observations, then in episodes with agents that open lines, and
in the same episodes with ours in Grid2Op's place.
"""

import dataclasses
import functools
import itertools
import types
import warnings

import numpy as np
import pytest
from grid2op.Parameters import Parameters
from grid2op_copies import made_once

from rl2grid.engines.reference.opponent import OpponentBridge, install_opponent
from rl2grid.grids import load_grid
from rl2grid.mdp.opponents import OpponentDraws, attack, draw_opponent, load_draws, new_opponent_state, opponent_step
from rl2grid.mdp.state import new_state
from rl2grid.streams import Purpose, Stream

ATTACKED_GRIDS = ("bus36-MO-v0", "bus36-MO-v1", "bus118-MOB-v0", "bus118-MOB-v1")
SEED = 11

USUAL = {}
BUSY = {"initial_budget": 500.0, "cooldown": 30, "attack_period": 20, "hazard_rate": 1 / 20, "recovery_rate": 1 / 8}
POOR = {**BUSY, "initial_budget": 4.0, "budget_per_step": 0.1, "minimum_duration": 2}
PATIENT = {**BUSY, "recovery_rate": 1 / 70}
"""Many attacks are longer than allowed."""


class OrderedLoadings(np.ndarray):
    """Loadings that Grid2Op's opponents rank as ours do: to five decimals, equals in list order.

    NumPy's order of equals depends on the processor, and attackable lines in series are equal.
    """

    def argsort(self, *args, **kwargs):
        order = np.rint(np.asarray(self, np.float64) * 1e5).argsort(kind="stable")
        assert np.all(np.diff(np.asarray(self)[order]) > -1.1e-5)
        return order.view(np.ndarray)


class RecordingRandom:
    """A ``RandomState`` that keeps, for attack k, the number that chose the line."""

    def __init__(self, opponent):
        self._random = opponent.space_prng
        self._opponent = opponent
        self.waits = []
        self.choices = {}

    def __getattr__(self, name):
        return getattr(self._random, name)

    def randint(self, bound):
        self.waits.append(self._random.randint(bound))
        return self.waits[-1]

    def choice(self, values, p):
        before = self._random.get_state()
        uniform = self._random.random_sample()
        self._random.set_state(before)
        k = len(self.waits) if self.waits else self._opponent._attack_counter
        self.choices[k - 1] = uniform
        return self._random.choice(values, p=p)


class Recorder:
    """Records the draws of Grid2Op's opponents in one episode."""

    def __init__(self, grid, space):
        self._grid = grid
        self._areas = getattr(space.opponent, "list_opponents", [space.opponent])
        for area in self._areas:
            area.space_prng = RecordingRandom(area)

    def close(self):
        """The draws; the recorders are taken out again."""
        waits, durations, choices = [], [], []
        for area in self._areas:
            recorded, area.space_prng = area.space_prng, area.space_prng._random
            if self._grid.opponent.kind == "weighted":
                waits.append(recorded.waits)
                durations.append([self._grid.opponent.max_duration] * len(recorded.waits))
            else:
                waits.append(area._attack_waiting_times)
                durations.append(area._attack_durations)
            choices.append([recorded.choices.get(k, np.nan) for k in range(len(waits[-1]))])
        n_attacks = np.array([len(area) for area in waits], np.int32)
        return OpponentDraws(
            n_attacks,
            *(_padded(values, n_attacks.max(), np.int32) for values in (waits, durations)),
            _padded(choices, n_attacks.max(), np.float64),
        )


def _padded(lists, length, dtype):
    return np.array([np.pad(np.asarray(values, dtype), (0, length - len(values))) for values in lists])


def grid_with(grid_id, changes):
    """The grid with another opponent configuration; cooldown does not apply to several areas."""
    grid = load_grid(grid_id)
    if grid.opponent.kind == "multi_area":
        changes = {key: value for key, value in changes.items() if key != "cooldown"}
    return dataclasses.replace(grid, opponent=dataclasses.replace(grid.opponent, **changes))


def configure(space, config):
    """Give Grid2Op's opponent the configuration ``config``."""
    space.init_budget = np.float32(config.initial_budget)
    space.budget_per_timestep = np.float32(config.budget_per_step)
    space.attack_cooldown = config.cooldown
    for area in getattr(space.opponent, "list_opponents", [space.opponent]):
        area._attack_period = config.attack_period
        area._attack_hazard_rate = config.hazard_rate
        area._recovery_rate = config.recovery_rate
        area._recovery_minimum_duration = config.minimum_duration


def make_environment(grid_id):
    import grid2op
    from grid2op.Action import PlayableAction
    from lightsim2grid import LightSimBackend

    name, parameters = load_grid(grid_id).bundled_names[0], Parameters()
    parameters.NO_OVERFLOW_DISCONNECTION = True  # episodes last longer
    parameters.NB_TIMESTEP_COOLDOWN_LINE = parameters.NB_TIMESTEP_COOLDOWN_SUB = 3
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return grid2op.make(
            name, test=True, backend=LightSimBackend(), param=parameters, action_class=PlayableAction, other_rewards={}
        )


copied_environment = made_once(make_environment, lambda grid_id: grid_id)


@functools.cache
def original_environment(grid_id):
    """With Grid2Op's opponent."""
    return copied_environment(grid_id)


@functools.cache
def bridged_environment(grid_id):
    """To install ours in."""
    return copied_environment(grid_id)


@dataclasses.dataclass
class Turn:
    """One call of Grid2Op's opponent, or of ours."""

    rho: np.ndarray
    line_status: np.ndarray
    lines: tuple[int, ...]
    duration: int
    budget: float
    single_precision: bool
    refused: bool


def turn_of(space, observation, action, duration):
    lines = () if action is None else tuple(np.flatnonzero(action.get_topological_impact()[0]).tolist())
    return Turn(
        observation.rho.copy(),
        observation.line_status.copy(),
        lines,
        int(duration),
        float(space.budget),
        isinstance(space.budget, np.float32),
        space.previous_fails,
    )


def assert_same_turns(grid, draws, turns):
    """Our opponent, given the same draws and observations, takes the same turns."""
    opponent, state = new_opponent_state(grid, 3), new_state(grid, 3)
    load_draws(opponent, 1, draws)
    for t, turn in enumerate(turns):
        state.rho[1], state.line_status[1] = turn.rho, turn.line_status
        opponent_step(state, opponent, 1)
        lines = np.flatnonzero(opponent.attacked[1])
        assert tuple(lines.tolist()) == turn.lines, t
        assert opponent.cooldown_written[1, lines].tolist() == [turn.duration] * len(lines), t
        assert opponent.cooldown_written[1].sum() == turn.duration * len(lines), t
        assert opponent.budget[1] == turn.budget, t
        assert opponent.budget_is_single[1] == turn.single_precision, t
        assert opponent.previous_fails[1] == turn.refused, t


def burnt(opponent):
    """Attacks launched that chose no line, over all areas; weighted opponents burn none."""
    areas = getattr(opponent, "list_opponents", [opponent])
    return sum(area._attack_counter - len(area.space_prng.choices) for area in areas if not area.space_prng.waits)


# Made-up observations


def play_made_up(grid, n_steps, seed):
    """Grid2Op's opponent on random loadings; lines open for a while. Returns draws, turns, burnt attacks."""
    env, rng = original_environment(grid.id), np.random.default_rng(seed)
    space, attackable = env._oppSpace, [line for area in grid.opponent.areas for line in area]
    configure(space, grid.opponent)
    for area in getattr(space.opponent, "list_opponents", [space.opponent]):
        area._get_episode_duration = lambda: n_steps
    env._opponent.seed(seed)
    space.reset()  # the next reset samples up to the new length
    space.reset()
    recorder, turns = Recorder(grid, space), []
    closes_at = np.zeros(grid.n_line, np.int64)
    attacked = np.zeros(grid.n_line, np.bool_)
    for t in range(n_steps):
        if rng.random() < 0.02:
            closes_at[rng.choice(attackable)] = t + rng.integers(1, 12)
        if rng.random() < 0.004:
            closes_at[attackable] = t + rng.integers(1, 6)
        rho = rng.random(grid.n_line).astype(np.float32) * np.float32(1.4) + np.float32(0.01)
        observation = types.SimpleNamespace(rho=rho, line_status=(closes_at <= t) & ~attacked)
        rho[~observation.line_status] = 0
        action, duration = space.attack(observation, None, None)
        turns.append(turn_of(space, observation, action, duration))
        attacked[:] = False
        attacked[list(turns[-1].lines)] = True
    n_burnt = burnt(space.opponent)
    draws = recorder.close()
    for area in getattr(space.opponent, "list_opponents", [space.opponent]):
        del area._get_episode_duration
    configure(space, load_grid(grid.id).opponent)
    return draws, turns, n_burnt


@pytest.mark.parametrize("changes", [USUAL, BUSY, POOR, PATIENT], ids=["usual", "busy", "poor", "patient"])
@pytest.mark.parametrize("grid_id", ATTACKED_GRIDS)
def test_same_attacks_on_made_up_observations(grid_id, changes):
    grid = grid_with(grid_id, changes)
    draws, turns, n_burnt = play_made_up(grid, 4000, seed=5)
    begun = sum(bool(turn.lines) and not before.lines for before, turn in itertools.pairwise(turns))
    refused = sum(turn.refused for turn in turns)
    together = max(len(turn.lines) for turn in turns)
    assert begun >= 5
    assert (n_burnt > 0) == (grid.opponent.kind != "weighted")
    if changes == POOR:
        assert refused > 3
    if changes == PATIENT and grid.opponent.kind == "geometric":
        assert refused > 3
    if changes == BUSY and grid.opponent.kind == "multi_area":
        assert together == 3
    assert_same_turns(grid, draws, turns)


# Episodes


def random_choices(grid, rng, n_steps):
    """What an agent tries in each step: nothing, a line, or some elements of a substation to change."""
    attackable = [line for area in grid.opponent.areas for line in area]
    for _ in range(n_steps):
        kind = rng.random()
        if kind < 0.03:
            yield "line", rng.choice(attackable)
        elif kind < 0.05:
            yield "line", rng.integers(grid.n_line)
        elif kind < 0.07:
            yield "line_or", rng.integers(grid.n_line)
        else:
            yield "nothing", 0


def action_for(env, observation, choice):
    """A fresh action; open lines are closed again as soon as that is possible."""
    kind, line = choice
    ready = np.flatnonzero(~observation.line_status & (observation.time_before_cooldown_line == 0))
    if kind == "nothing" and ready.size:
        return env.action_space({"set_line_status": [(ready[0], 1)]})
    if kind == "line":
        return env.action_space({"set_line_status": [(line, -1)]})
    if kind == "line_or":
        return env.action_space({"change_bus": {"lines_or_id": [line]}})
    return env.action_space({})


@dataclasses.dataclass
class Step:
    """What an episode showed in one step."""

    attacked: np.ndarray | None
    duration: int
    rho: np.ndarray
    topo_vect: np.ndarray
    cooldown: np.ndarray
    done: bool


def step_of(observation, done, info):
    return Step(
        info["opponent_attack_line"],
        info["opponent_attack_duration"],
        observation.rho,
        observation.topo_vect,
        observation.time_before_cooldown_line,
        done,
    )


def play_original(grid, choices):
    """An episode with Grid2Op's opponent: draws, its turns, and the steps."""
    env = original_environment(grid.id)
    space = env._oppSpace
    configure(space, grid.opponent)
    env.seed(SEED)
    # Grid2Op samples the attacks of an episode before it looks up its length: the second reset has the right one.
    env.reset(options={"time serie id": 0})
    observation, turns, steps, done = env.reset(seed=SEED, options={"time serie id": 0}), [], [], False
    recorder = Recorder(grid, space)

    def noted_attack(observation, agent_action, env_action):
        shown = types.SimpleNamespace(rho=observation.rho.view(OrderedLoadings), line_status=observation.line_status)
        action, duration = type(space).attack(space, shown, agent_action, env_action)
        turns.append(turn_of(space, observation, action, duration))
        return action, duration

    space.attack = noted_attack
    for choice in choices:
        if done:
            break
        observation, _, done, info = env.step(action_for(env, observation, choice))
        steps.append(step_of(observation, done, info))
    del space.attack
    return recorder.close(), turns, steps


def play_bridged(grid, draws, choices):
    """The same episode with our opponent inside Grid2Op, from row 1 of 2."""
    env, state, opponent = bridged_environment(grid.id), new_state(grid, 2), new_opponent_state(grid, 2)
    install_opponent(env, state, opponent, 1)
    env.seed(SEED)
    env.reset(options={"time serie id": 0})
    load_draws(opponent, 1, draws)
    observation, steps, done = env.reset(seed=SEED, options={"time serie id": 0}), [], False
    for choice in choices:
        if done:
            break
        state.rho[1], state.line_status[1] = observation.rho, observation.line_status
        observation, _, done, info = env.step(action_for(env, observation, choice))
        steps.append(step_of(observation, done, info))
        if info["opponent_attack_line"] is not None:
            np.testing.assert_array_equal(opponent.attacked[1], info["opponent_attack_line"])
    return steps


def assert_same_episode(grid, n_steps, seed):
    choices = list(random_choices(grid, np.random.default_rng(seed), n_steps))
    draws, turns, steps = play_original(grid, choices)
    assert_same_turns(grid, draws, turns)
    bridged = play_bridged(grid, draws, choices)
    assert len(bridged) == len(steps)
    for t, (ours, theirs) in enumerate(zip(bridged, steps, strict=True)):
        assert (ours.attacked is None) == (theirs.attacked is None), t
        for name in ("attacked", "rho", "topo_vect", "cooldown"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=f"{name} {t}")
        assert (ours.duration, ours.done) == (theirs.duration, theirs.done), t
    return turns


@pytest.mark.parametrize("changes", [USUAL, BUSY], ids=["usual", "busy"])
@pytest.mark.parametrize("grid_id", ATTACKED_GRIDS)
def test_same_attacks_in_an_episode(grid_id, changes):
    grid = grid_with(grid_id, changes)
    turns = assert_same_episode(grid, 200, seed=2)
    assert len(turns) > 100
    if changes == BUSY:
        assert len({turn.lines for turn in turns}) >= 3


@pytest.mark.parametrize(("grid_id", "twins"), [("bus36-MO-v1", (56, 45)), ("bus118-MOB-v1", (180, 160))])
def test_attackable_lines_in_series_are_loaded_alike(grid_id, twins):
    # Why loadings are not ranked by their last digits.
    observation = original_environment(grid_id).reset()
    assert observation.rho[twins[0]] == pytest.approx(observation.rho[twins[1]], abs=1e-6)
    assert set(twins) <= {line for area in load_grid(grid_id).opponent.areas for line in area}


@pytest.mark.slow
@pytest.mark.parametrize("grid_id", ATTACKED_GRIDS)
def test_same_attacks_in_many_episodes(grid_id):
    for seed in range(10):
        for changes in (USUAL, BUSY, POOR, PATIENT):
            assert_same_episode(grid_with(grid_id, changes), 900, seed)


# The bridge


def bridged_and_attacked(grid_id="bus36-MO-v1"):
    """An environment in the middle of an attack, with its state and opponent."""
    grid = grid_with(grid_id, {**BUSY, "initial_budget": 1000.0})
    env, state, opponent = bridged_environment(grid_id), new_state(grid, 1), new_opponent_state(grid, 1)
    install_opponent(env, state, opponent, 0)
    load_draws(opponent, 0, draw_opponent(grid, Stream(0, 0, Purpose.OPPONENT), 400))
    observation = env.reset(seed=SEED, options={"time serie id": 0})
    while not opponent.attacked[0].any():
        state.rho[0], state.line_status[0] = observation.rho, observation.line_status
        observation, _, done, _ = env.step(env.action_space({}))
        assert not done
    state.rho[0], state.line_status[0] = observation.rho, observation.line_status
    return env, state, opponent, observation


def snapshot(opponent):
    return [array.copy() for array in opponent]


def test_a_copy_plays_the_same_attacks_on_its_own():
    env, state, opponent, _ = bridged_and_attacked()
    copied, before = env.copy(), snapshot(opponent)
    attacks = []
    for _ in range(60):
        *_, done, info = copied.step(copied.action_space({}))
        assert not done
        attacks.append(info["opponent_attack_line"])
    assert isinstance(copied._oppSpace, OpponentBridge)
    assert all(np.array_equal(a, b) for a, b in zip(before, opponent, strict=True))
    assert any(lines is None for lines in attacks)
    for lines in attacks:
        observation, _, _, info = env.step(env.action_space({}))
        np.testing.assert_array_equal(info["opponent_attack_line"], lines)
        state.rho[0], state.line_status[0] = observation.rho, observation.line_status
    copied.close()


def test_simulate_and_forecasts_are_not_attacked():
    env, _, opponent, observation = bridged_and_attacked()
    before = snapshot(opponent)
    forecast = observation.get_forecast_env()
    simulated = observation.simulate(env.action_space({}))[3]
    foreseen = forecast.step(forecast.action_space({}))[3]
    assert simulated["opponent_attack_line"] is None
    assert foreseen["opponent_attack_line"] is None
    assert all(np.array_equal(a, b) for a, b in zip(before, opponent, strict=True))
    forecast.close()


@pytest.mark.parametrize("grid_id", ["bus36-MO-v1", "bus118-MOB-v1"])
def test_without_opponent_nothing_is_attacked(grid_id):
    grid = load_grid(grid_id)
    env = bridged_environment(grid_id)
    install_opponent(env, new_state(grid, 1), None, 0)
    env.reset(seed=SEED, options={"time serie id": 0})
    for _ in range(20):
        *_, info = env.step(env.action_space({}))
        assert info["opponent_attack_line"] is None
    assert env.copy()._oppSpace.attack(env.get_obs(), None, None) == (None, 0)


def test_the_reset_is_not_a_turn():
    env, state, opponent, _ = bridged_and_attacked()
    load_draws(opponent, 0, draw_opponent(load_grid("bus36-MO-v1"), Stream(0, 1, Purpose.OPPONENT), 400))
    before = snapshot(opponent)
    env.reset()
    assert all(np.array_equal(a, b) for a, b in zip(before, opponent, strict=True))
    attack(opponent, 0, state.rho[0], state.line_status[0])
    assert not all(np.array_equal(a, b) for a, b in zip(before, opponent, strict=True))
