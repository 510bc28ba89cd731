"""What Grid2Op's ``obs.simulate`` does: every statement of ``docs/simulate.md``, on live environments."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when NumPy is imported

import grid2op
import numpy as np
import pytest
from grid2op.Action import DontAct, PlayableAction
from grid2op.Chronics import GridStateFromFile, GridValue
from grid2op.Exceptions import (
    ImpossibleRedispatching,
    NoForecastAvailable,
    SimulateUsedTooMuchThisEpisode,
    SimulateUsedTooMuchThisStep,
)
from grid2op.Opponent import BaseOpponent, NeverAttackBudget
from grid2op.Parameters import Parameters
from grids_of_tests import SHORTER_OR_ALL
from lightsim2grid import LightSimBackend
from numpy.typing import NDArray

from rl2grid.engines.reference.dispatch import ExactRedispatchSolver
from rl2grid.grids import load_grid

NO_OPPONENT = {
    "opponent_class": BaseOpponent,
    "opponent_action_class": DontAct,
    "opponent_budget_class": NeverAttackBudget,
    "opponent_init_budget": 0.0,
    "opponent_budget_per_ts": 0.0,
}
MAKER = Callable[..., Any]


@pytest.fixture(scope="module")
def make() -> Iterator[MAKER]:
    """Hands out bundled environments at the first observation of their first series.

    An environment without keywords is opened once and handed out again.
    """
    opened: list[Any] = []
    shared: dict[tuple[str, bool], Any] = {}

    def open_environment(grid_id: str, attacked: bool, **keywords: Any) -> Any:
        folder = Path(grid2op.__file__).parent / "data" / load_grid(grid_id).bundled_names[0]
        settings = {"redispatch_solver": ExactRedispatchSolver} | ({} if attacked else NO_OPPONENT) | keywords
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            environment = grid2op.make(str(folder), backend=LightSimBackend(), action_class=PlayableAction, **settings)
        opened.append(environment)
        return environment

    def hand_out(grid_id: str, *, attacked: bool = False, fresh: bool = False, **keywords: Any) -> Any:
        if fresh or keywords:
            environment = open_environment(grid_id, attacked, **keywords)
        else:
            if (grid_id, attacked) not in shared:
                shared[grid_id, attacked] = open_environment(grid_id, attacked)
            environment = shared[grid_id, attacked]
        environment.seed(0)
        environment.reset(options={"time serie id": 0})
        return environment

    yield hand_out
    for environment in opened:
        environment.close()


def series(environment: Any) -> Any:
    """The object that holds the rows of the series."""
    return getattr(environment.chronics_handler.real_data, "data", environment.chronics_handler.real_data)


def forecast(observation: Any, horizon: int) -> dict[str, NDArray[np.float32]]:
    injection: dict[str, NDArray[np.float32]] = observation._forecasted_inj[horizon][1]["injection"]
    return injection


def forecast_the_truth(environment: Any, observation: Any) -> None:
    """Replace the forecast of the next step by what will be."""
    rows = series(environment)
    truth = {name: getattr(rows, name) for name in ("load_p", "load_q", "prod_p", "prod_v")}
    known = {name: values[rows.current_index + 1].copy() for name, values in truth.items() if values is not None}
    observation._forecasted_inj[1] = (observation._forecasted_inj[1][0], {"injection": known})


def forecast_far(observation: Any, horizon: int = 12) -> None:
    """Repeat the forecast of the next step up to ``horizon``."""
    while len(observation._forecasted_inj) <= horizon:
        observation._forecasted_inj.append(observation._forecasted_inj[1])


def redispatch(environment: Any, generator: int, power: float) -> Any:
    action = environment.action_space()
    values = np.zeros(environment.n_gen, np.float32)
    values[generator] = power
    action.redispatch = values
    return action


def store(environment: Any, power: float) -> Any:
    action = environment.action_space()
    values = np.zeros(environment.n_storage, np.float32)
    values[0] = power
    action.storage_p = values
    return action


def switch(environment: Any, line: int) -> Any:
    return environment.action_space({"change_line_status": [line]})


def close_line(environment: Any, line: int) -> Any:
    return environment.action_space({"set_line_status": [(line, 1)]})


def random_action(environment: Any, random: np.random.Generator) -> Any:
    """Sometimes redispatch, curtailment, storage or a switched line."""
    grid, action = type(environment), environment.action_space()
    if random.random() < 0.5:
        extent = 0.3 * (random.random(grid.n_gen) < 0.3) * grid.gen_redispatchable
        action.redispatch = (random.uniform(-1, 1, grid.n_gen) * grid.gen_max_ramp_up * extent).astype(np.float32)
    if random.random() < 0.3:
        curtailed = grid.gen_renewable & (random.random(grid.n_gen) < 0.2)
        action.curtail = np.where(curtailed, random.uniform(0.6, 1, grid.n_gen), -1).astype(np.float32)
    if grid.n_storage and random.random() < 0.5:
        power = random.uniform(-0.3, 0.3, grid.n_storage) * grid.storage_max_p_absorb
        action.storage_p = power.astype(np.float32)
    if random.random() < 0.3:
        action.line_change_status = [int(random.integers(grid.n_line))]
    return action


def copy_of(environment: Any, action: Any) -> Any:
    """A fresh object for the same action: Grid2Op keeps verdicts on the object."""
    return environment.action_space.from_vect(action.to_vect())


def assert_same(left: Any, right: Any, names: list[str] | None = None, tolerance: float = 0.0) -> None:
    for name in names or type(left).attr_list_vect:
        np.testing.assert_allclose(
            np.asarray(getattr(left, name), float),
            np.asarray(getattr(right, name), float),
            rtol=tolerance / 100,
            atol=tolerance,
            err_msg=name,
        )


# The next step


@pytest.mark.parametrize("grid_id", SHORTER_OR_ALL)
def test_a_simulated_step_is_the_step_itself_when_the_forecast_is_right(make: MAKER, grid_id: str) -> None:
    environment, random, compared = make(grid_id), np.random.default_rng(0), 0
    observation = environment.get_obs()
    for _ in range(30):
        forecast_the_truth(environment, observation)
        action = random_action(environment, random)
        simulated, reward, over, note = observation.simulate(copy_of(environment, action))
        observation, real_reward, real_over, real_note = environment.step(action)
        assert over == real_over
        if real_over:
            observation = environment.reset()
            continue
        compared += 1
        assert_same(simulated, observation, tolerance=1e-3)
        assert reward == pytest.approx(real_reward, rel=1e-4, abs=1e-3)
        assert note["is_illegal"] == real_note["is_illegal"]
        assert_same_dispatch_memory(simulated, observation)
    assert compared > 20


def assert_same_dispatch_memory(left: Any, right: Any) -> None:
    """What the next step needs to know of dispatch, storage and curtailment."""
    remembered = right._env_internal_params["_dispatch_state"]
    for name, value in left._env_internal_params["_dispatch_state"].items():
        np.testing.assert_allclose(np.asarray(value, float), np.asarray(remembered[name], float), rtol=1e-4, atol=1e-2)


@pytest.mark.parametrize("grid_id", SHORTER_OR_ALL)
def test_injections_are_the_forecast_for_the_row(make: MAKER, grid_id: str) -> None:
    environment = make(grid_id)
    observation, *_ = environment.step(environment.action_space())
    rows = series(environment)
    horizons = len(observation._forecasted_inj) - 1
    assert horizons == (12 if grid_id == "bus118-MOB-v1" else 1)
    for horizon in range(1, horizons + 1):
        known = forecast(observation, horizon)
        row = horizons * rows.current_index + horizon - 1
        np.testing.assert_array_equal(known["load_p"], rows.load_p_forecast[row].astype(np.float32))
        simulated, _, over, _ = observation.simulate(environment.action_space(), horizon)
        assert not over
        np.testing.assert_allclose(simulated.load_p, known["load_p"], rtol=1e-5)
        np.testing.assert_allclose(simulated.load_q, known["load_q"], rtol=1e-5)
        others = np.arange(environment.n_gen) != load_grid(grid_id).slack_gen
        np.testing.assert_allclose(simulated.gen_p[others], known["prod_p"][others], rtol=1e-5)


@pytest.mark.parametrize("grid_id", ["bus36-M", "bus36-MO-v0", "bus36-MO-v1", "bus118-M"])
def test_bundled_productions_are_forecast_nearer_to_the_present_row(make: MAKER, grid_id: str) -> None:
    rows = series(make(grid_id))
    ahead = rows.prod_p_forecast[:200]
    to_present, to_next = np.abs(ahead - rows.prod_p[:200]).mean(), np.abs(ahead - rows.prod_p[1:201]).mean()
    assert to_present < 0.8 * to_next


@pytest.mark.parametrize("grid_id", SHORTER_OR_ALL)
def test_without_a_voltage_forecast_the_measured_voltages_are_kept(make: MAKER, grid_id: str) -> None:
    environment = make(grid_id)
    observation, *_ = environment.step(environment.action_space())
    assert ("prod_v" in forecast(observation, 1)) == (grid_id == "bus14")
    simulated, *_ = observation.simulate(environment.action_space())
    kept = forecast(observation, 1)["prod_v"] if grid_id == "bus14" else observation.gen_v
    np.testing.assert_allclose(simulated.gen_v, kept, rtol=1e-5)


def test_simulating_leaves_the_environment_as_it_was(make: MAKER) -> None:
    """Bit for bit, after legal, illegal, ambiguous and fatal actions."""
    simulating, plain = make("bus118-MOB-v0"), make("bus118-MOB-v0", fresh=True)
    random, observations = np.random.default_rng(3), [simulating.get_obs(), plain.get_obs()]
    fatal = {"set_bus": {"loads_id": [(0, -1)]}}
    for _ in range(8):
        before = observations[0].to_vect().copy()
        for action in (random_action(simulating, random), simulating.action_space(fatal)):
            observations[0].simulate(action)
        np.testing.assert_array_equal(observations[0].to_vect(), before)
        action = random_action(simulating, random)
        played = [environment.step(copy_of(environment, action)) for environment in (simulating, plain)]
        observations = [observation for observation, *_ in played]
        np.testing.assert_array_equal(observations[0].to_vect(), observations[1].to_vect())
        assert_same_dispatch_memory(*observations)


def test_simulating_again_gives_the_same(make: MAKER) -> None:
    """Whatever was simulated in between, a game over included, and from an old observation too."""
    environment = make("bus36-MO-v1")
    observation, *_ = environment.step(environment.action_space())
    first, *_ = observation.simulate(switch(environment, 7))
    _, _, over, _ = observation.simulate(environment.action_space({"set_bus": {"loads_id": [(0, -1)]}}))
    assert over
    again, *_ = observation.simulate(switch(environment, 7))
    np.testing.assert_array_equal(first.to_vect(), again.to_vect())
    environment.step(switch(environment, 3))
    much_later, *_ = observation.simulate(switch(environment, 7))
    np.testing.assert_array_equal(first.to_vect(), much_later.to_vect())


def test_the_action_object_keeps_the_verdict_of_its_first_use(make: MAKER) -> None:
    """An ambiguous action passes the second time: simulate and step need objects of their own."""
    environment = make("bus14")
    action = redispatch(environment, 0, 4)
    action._redispatch[0] = 50  # ten times the ramp
    _, _, _, note = environment.get_obs().simulate(action)
    assert note["is_ambiguous"]
    observation, _, _, note = environment.step(action)
    assert not note["is_ambiguous"]
    assert observation.target_dispatch[0] == 50


# Maintenance


MAINTAINED = 8


def plan_maintenance(environment: Any, line: int, first: int, steps: int) -> None:
    """The only maintenance of the episode."""
    rows = series(environment)
    active = np.zeros(rows.load_p.shape[0], np.int32)
    active[first : first + steps] = 1
    for array, nothing in ((rows.maintenance, 0), (rows.maintenance_time, -1), (rows.maintenance_duration, 0)):
        array[:] = nothing
    rows.maintenance[:, line] = active
    rows.maintenance_time[:, line] = GridValue.get_maintenance_time_1d(active)
    rows.maintenance_duration[:, line] = GridValue.get_maintenance_duration_1d(active)


def maintenance_seen(observation: Any) -> tuple[bool, int, int, int]:
    """In service, steps until the maintenance, its duration, cooldown."""
    return (
        bool(observation.line_status[MAINTAINED]),
        int(observation.time_next_maintenance[MAINTAINED]),
        int(observation.duration_next_maintenance[MAINTAINED]),
        int(observation.time_before_cooldown_line[MAINTAINED]),
    )


def before_maintenance(environment: Any, steps: int) -> Any:
    """Play to ``steps`` steps before a maintenance of four steps."""
    plan_maintenance(environment, MAINTAINED, first=6, steps=4)
    observation, *_ = environment.step(environment.action_space())
    while observation.time_next_maintenance[MAINTAINED] > steps:
        observation, *_ = environment.step(environment.action_space())
    forecast_far(observation)
    return observation


def test_maintenance_of_the_simulated_step_is_applied(make: MAKER) -> None:
    environment = make("bus36-MO-v1")
    observation = before_maintenance(environment, steps=1)
    simulated, *_ = observation.simulate(environment.action_space())
    real, *_ = environment.step(environment.action_space())
    assert maintenance_seen(simulated) == maintenance_seen(real) == (False, 0, 4, 4)


def test_maintenance_counts_down_with_the_horizon(make: MAKER) -> None:
    environment = make("bus36-MO-v1")
    observation = before_maintenance(environment, steps=2)
    expected = {1: (True, 1, 4, 0), 2: (False, 0, 4, 4), 3: (False, 0, 3, 3), 5: (False, 0, 1, 1)}
    for horizon, seen in expected.items():
        simulated, *_ = observation.simulate(environment.action_space(), horizon)
        assert maintenance_seen(simulated) == seen


def test_maintenance_that_is_over_before_the_horizon_never_was(make: MAKER) -> None:
    """In truth the line stays out until somebody closes it."""
    environment = make("bus36-MO-v1")
    observation = before_maintenance(environment, steps=2)
    simulated, *_ = observation.simulate(environment.action_space(), 6)
    assert maintenance_seen(simulated) == (True, -1, 0, 0)
    for _ in range(6):
        real, *_ = environment.step(environment.action_space())
    assert maintenance_seen(real) == (False, -1, 0, 0)


def test_closing_a_line_as_its_maintenance_begins_works_only_in_simulation(make: MAKER) -> None:
    environment = make("bus36-MO-v1")
    observation = before_maintenance(environment, steps=1)
    simulated, _, _, note = observation.simulate(close_line(environment, MAINTAINED))
    assert not note["is_illegal"]
    assert maintenance_seen(simulated) == (True, 0, 4, 4)
    real, *_ = environment.step(close_line(environment, MAINTAINED))
    assert maintenance_seen(real) == (False, 0, 4, 4)
    # During the maintenance it is illegal in both.
    _, _, _, note = real.simulate(close_line(environment, MAINTAINED))
    _, _, _, real_note = environment.step(close_line(environment, MAINTAINED))
    assert note["is_illegal"]
    assert real_note["is_illegal"]


# Legality, cooldowns and protections


def test_cooldowns_are_checked_counted_down_and_set(make: MAKER) -> None:
    environment, line = make("bus36-MO-v1"), 5
    observation, *_ = environment.step(switch(environment, line))
    assert observation.time_before_cooldown_line[line] == 3
    forecast_far(observation)
    expected = {1: (True, 2), 2: (True, 1), 3: (True, 0), 4: (False, 3)}
    for horizon, (illegal, cooldown) in expected.items():
        simulated, _, _, note = observation.simulate(switch(environment, line), horizon)
        assert note["is_illegal"] == illegal
        assert simulated.time_before_cooldown_line[line] == cooldown
        assert simulated.line_status[line] == (not illegal)


def test_an_illegal_action_is_simulated_as_do_nothing(make: MAKER) -> None:
    environment = make("bus36-MO-v1")
    observation, *_ = environment.step(switch(environment, 5))
    illegal, _, _, note = observation.simulate(switch(environment, 5))
    nothing, *_ = observation.simulate(environment.action_space())
    assert note["is_illegal"]
    # The attention budget, which only alarms use, does not grow at an illegal action.
    assert_same(illegal, nothing, [name for name in type(nothing).attr_list_vect if name != "attention_budget"])


def test_a_substation_cools_down_too(make: MAKER) -> None:
    environment, sub = make("bus36-MO-v1"), 16
    moved = np.flatnonzero(np.repeat(np.arange(environment.n_sub), environment.sub_info) == sub)[:2]
    buses = np.zeros(environment.dim_topo, np.int32)
    buses[moved] = 2
    simulated, _, over, _ = environment.get_obs().simulate(environment.action_space({"set_bus": buses}))
    assert not over
    assert simulated.time_before_cooldown_sub[sub] == 3
    assert (simulated.topo_vect[moved] == 2).all()


def overload(environment: Any) -> int:
    """Lower the limit of the most loaded line below its current and lift all others."""
    observation = environment.get_obs()
    line = int(observation.rho.argmax())
    limits = 10 * environment.get_thermal_limit()
    limits[line] = observation.a_or[line] / 1.2
    environment.set_thermal_limit(limits)
    return line


def test_overflow_counters_are_carried_so_the_third_overloaded_step_trips(make: MAKER) -> None:
    environment = make("bus14", fresh=True)
    assert environment.parameters.NB_TIMESTEP_OVERFLOW_ALLOWED == 2
    line = overload(environment)
    for overloaded in (1, 2):
        observation, *_ = environment.step(environment.action_space())
        assert observation.timestep_overflow[line] == overloaded
        simulated, _, _, note = observation.simulate(environment.action_space())
        if overloaded == 1:
            assert simulated.timestep_overflow[line] == 2
            assert simulated.line_status[line]
    assert not simulated.line_status[line]
    assert note["disc_lines"][line] == 0
    assert simulated.time_before_cooldown_line[line] == environment.parameters.NB_TIMESTEP_RECONNECTION
    real, *_ = environment.step(environment.action_space())
    assert not real.line_status[line]


def test_a_further_horizon_counts_today_s_overload_for_every_step_up_to_it(make: MAKER) -> None:
    environment = make("bus14", fresh=True)
    line = overload(environment)
    observation, *_ = environment.step(environment.action_space())
    forecast_far(observation)
    near, *_ = observation.simulate(environment.action_space(), 1)
    far, *_ = observation.simulate(environment.action_space(), 2)
    assert near.line_status[line]
    assert not far.line_status[line]


# Dispatch, storage and curtailment


def test_storage_charge_moves_and_power_is_not_held(make: MAKER) -> None:
    environment = make("bus118-MOB-v0")
    observation, *_ = environment.step(store(environment, 6.0))
    forecast_far(observation)
    gained = 6.0 / 12 * environment.storage_charging_efficiency[0]
    for horizon in (1, 2, 12):
        idle, *_ = observation.simulate(environment.action_space(), horizon)
        charging, *_ = observation.simulate(store(environment, 6.0), horizon)
        assert idle.storage_charge[0] == pytest.approx(observation.storage_charge[0])
        assert idle.storage_power[0] == 0
        # One step of charging, however far the horizon.
        assert charging.storage_charge[0] == pytest.approx(observation.storage_charge[0] + gained, abs=1e-4)
        assert charging.actual_dispatch.sum() == pytest.approx(6.0, abs=1e-2)


def test_dispatch_goes_on_from_where_it_is_by_one_ramp(make: MAKER) -> None:
    environment = make("bus14")
    observation, *_ = environment.step(redispatch(environment, 0, 5.0))
    forecast_far(observation)
    assert 0 < observation.actual_dispatch[0] < 5.0  # the ramp is taken by the series as well
    for horizon in (1, 2):
        simulated, *_ = observation.simulate(redispatch(environment, 0, 5.0), horizon)
        assert simulated.target_dispatch[0] == 10.0
        setpoint = forecast(observation, horizon)["prod_p"][0] + simulated.actual_dispatch[0]
        before = observation._env_internal_params["_dispatch_state"]["gen_activeprod_t_redisp"][0]
        assert setpoint == pytest.approx(before + environment.gen_max_ramp_up[0], abs=1e-3)


def test_curtailment_limits_persist_in_simulation(make: MAKER) -> None:
    environment = make("bus118-MOB-v0")
    action = environment.action_space()
    wind = int(np.flatnonzero(environment.gen_renewable & (environment.get_obs().gen_p > 5))[0])
    limit = float(0.9 * environment.get_obs().gen_p[wind] / environment.gen_pmax[wind])
    action.curtail = np.where(np.arange(environment.n_gen) == wind, limit, -1).astype(np.float32)
    observation, *_ = environment.step(action)
    simulated, *_ = observation.simulate(environment.action_space())
    assert simulated.curtailment_limit[wind] == pytest.approx(limit)
    assert simulated.gen_p[wind] <= limit * environment.gen_pmax[wind] + 1e-3
    assert simulated.gen_p_before_curtail[wind] == pytest.approx(forecast(observation, 1)["prod_p"][wind])


def test_a_further_horizon_allows_one_ramp_for_many_steps_of_the_series(make: MAKER) -> None:
    """Once anything is dispatched, far horizons end in game overs that chained steps do not have."""
    environment = make("bus118-MOB-v1")
    generator = int(np.flatnonzero(environment.gen_redispatchable)[0])
    observation, *_ = environment.step(redispatch(environment, generator, 2.0))
    fatal, chained_fatal = dict.fromkeys((1, 2, 6, 12), 0), 0
    for step in range(60):
        if step % 6 == 0:
            for horizon in fatal:
                _, _, over, note = observation.simulate(environment.action_space(), horizon)
                fatal[horizon] += over
                if over:
                    assert isinstance(note["exception"][0], ImpossibleRedispatching)
            chained = observation
            for _ in range(12):
                chained, _, over, _ = chained.simulate(environment.action_space())
                chained_fatal += over
        observation, *_ = environment.step(environment.action_space())
    assert fatal[1] == chained_fatal == 0
    assert fatal[12] >= 3
    untouched = make("bus118-MOB-v1").get_obs()
    assert not untouched.simulate(environment.action_space(), 12)[2]


# Opponent


@pytest.mark.parametrize("grid_id", ["bus36-MO-v0", "bus36-MO-v1", "bus118-MOB-v1"])
def test_attacks_are_not_foreseen_but_attacked_lines_stay_out(make: MAKER, grid_id: str) -> None:
    environment = make(grid_id, attacked=True)
    observation, attack = environment.get_obs(), None
    assert type(observation._obs_env._opponent) is BaseOpponent
    while attack is None or not attack.any():
        before = observation
        observation, _, over, note = environment.step(environment.action_space())
        assert not over
        attack = note["opponent_attack_line"]
    line = int(np.flatnonzero(attack)[0])
    simulated, *_ = before.simulate(environment.action_space())
    assert simulated.line_status[line]
    assert not observation.line_status[line]
    simulated, *_ = observation.simulate(environment.action_space())
    assert not simulated.line_status[line]
    closed, _, _, note = observation.simulate(close_line(environment, line))
    real, _, _, real_note = environment.step(close_line(environment, line))
    assert not real.line_status[line]
    assert note["is_illegal"] == real_note["is_illegal"]
    # The multi-area opponent writes no cooldown: closing is legal, works in simulation only.
    multi_area = load_grid(grid_id).opponent.kind == "multi_area"
    assert note["is_illegal"] == (not multi_area)
    assert closed.line_status[line] == multi_area


# Ends


def test_a_simulated_game_over_blanks_the_observation(make: MAKER) -> None:
    environment = make("bus14")
    fatal = environment.action_space({"set_bus": {"loads_id": [(0, -1)]}})
    simulated, reward, over, note = environment.get_obs().simulate(fatal)
    assert over
    assert note["exception"]
    assert reward == environment.reward_range[0]
    assert (simulated.topo_vect == -1).all()
    assert not simulated.line_status.any()
    assert not simulated.rho.any()
    assert (simulated.time_next_maintenance == -1).all()
    assert (simulated.curtailment_limit == 1).all()


@pytest.mark.parametrize("grid_id", ["bus14", "bus118-MOB-v1"])
def test_the_end_of_the_series_is_not_simulated(make: MAKER, grid_id: str) -> None:
    """The forecast files go on to the last row; ``done`` means game over alone."""
    environment = make(grid_id)
    environment.fast_forward_chronics(environment.max_episode_duration() - 2)
    observation = environment.get_obs()
    for left in (1, 0):
        for horizon in range(1, len(observation._forecasted_inj)):
            assert not observation.simulate(environment.action_space(), horizon)[2]
        if left:
            observation, _, over, _ = environment.step(environment.action_space())
            assert not over
    observation, _, over, _ = environment.step(environment.action_space())
    assert over
    assert not observation.simulate(environment.action_space())[2]


# Horizons and limits


def test_every_simulation_is_one_step_at_the_hour_of_its_horizon(make: MAKER) -> None:
    environment = make("bus118-MOB-v1")
    observation, *_ = environment.step(environment.action_space())
    for horizon in (1, 5, 12):
        simulated, *_ = observation.simulate(environment.action_space(), horizon)
        assert simulated.current_step == observation.current_step + 1
        ahead = simulated.get_time_stamp() - observation.get_time_stamp()
        assert ahead.total_seconds() == 300 * horizon


def test_chained_simulations_walk_through_the_forecasts(make: MAKER) -> None:
    environment = make("bus118-MOB-v1")
    observation, *_ = environment.step(environment.action_space())
    chained = observation
    for horizon in range(1, 13):
        chained, _, over, _ = chained.simulate(environment.action_space())
        assert not over
        np.testing.assert_allclose(chained.load_p, forecast(observation, horizon)["load_p"], rtol=1e-5)
        assert chained.current_step == observation.current_step + horizon
    with pytest.raises(NoForecastAvailable):
        chained.simulate(environment.action_space())


def test_horizon_zero_is_one_more_step_on_the_measured_injections(make: MAKER) -> None:
    """It counts cooldowns and overloads, and adds a dispatch to powers that already contain it."""
    environment = make("bus14", fresh=True)
    line = overload(environment)
    observation, *_ = environment.step(environment.action_space())
    simulated, *_ = observation.simulate(environment.action_space(), 0)
    np.testing.assert_allclose(simulated.load_p, observation.load_p, rtol=1e-5)
    np.testing.assert_allclose(simulated.rho, observation.rho, rtol=1e-4)
    assert simulated.timestep_overflow[line] == observation.timestep_overflow[line] + 1
    assert simulated.current_step == observation.current_step + 1
    dispatched, *_ = environment.step(redispatch(environment, 0, 3.0))
    assert dispatched.actual_dispatch[0] == pytest.approx(3.0, abs=1e-3)
    twice, *_ = dispatched.simulate(environment.action_space(), 0)
    assert twice.gen_p[0] == pytest.approx(dispatched.gen_p[0] + 3.0, abs=1e-2)


def test_horizons_without_a_forecast_are_refused(make: MAKER) -> None:
    environment = make("bus14")
    for horizon in (2, -1):
        with pytest.raises(NoForecastAvailable):
            environment.get_obs().simulate(environment.action_space(), horizon)
    no_files = make("bus14", data_feeding_kwargs={"gridvalueClass": GridStateFromFile})
    assert not no_files.get_obs().simulate(no_files.action_space(), 0)[2]
    with pytest.raises(NoForecastAvailable):
        no_files.get_obs().simulate(no_files.action_space(), 1)
    environment = make("bus14", fresh=True)
    environment.deactivate_forecast()
    observation = environment.reset()
    for horizon in (0, 1):
        with pytest.raises(NoForecastAvailable):
            observation.simulate(environment.action_space(), horizon)


@pytest.mark.parametrize("grid_id", SHORTER_OR_ALL)
def test_no_grid_limits_the_number_of_simulations(make: MAKER, grid_id: str) -> None:
    parameters = make(grid_id).parameters
    assert parameters.MAX_SIMULATE_PER_STEP == parameters.MAX_SIMULATE_PER_EPISODE == -1


def test_a_limit_of_simulations_raises_and_counts_refused_ones(make: MAKER) -> None:
    limits = Parameters()
    limits.MAX_SIMULATE_PER_STEP, limits.MAX_SIMULATE_PER_EPISODE = 2, 5
    environment = make("bus14", param=limits)
    observation = environment.get_obs()

    def simulate() -> None:
        observation.simulate(environment.action_space())

    for _ in range(2):
        simulate()
    with pytest.raises(SimulateUsedTooMuchThisStep):
        simulate()
    observation, *_ = environment.step(environment.action_space())
    for _ in range(2):
        simulate()
    observation, *_ = environment.step(environment.action_space())
    with pytest.raises(SimulateUsedTooMuchThisEpisode):
        simulate()
    observation = environment.reset()
    simulate()
