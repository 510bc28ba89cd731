"""Rewards: against NumPy written from the definitions, by hand, and `released` against Grid2Op's own class."""

import warnings

import numba
import numpy as np
import pytest

from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.probes import make_probe
from rl2grid.engines.reference.engine import ReferenceEngine
from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.mdp.actions import DO_NOTHING
from rl2grid.mdp.rewards import (
    PRESETS,
    default_components,
    overload_component,
    paper_components,
    released_components,
    resolve_reward,
    reward_name,
    trips,
    trips_components,
)
from rl2grid.mdp.state import new_state
from rl2grid.scenarios.episodes import EpisodePlan
from rl2grid.scenarios.library import list_scenarios


def row(state, i):
    """The row's arrays in double precision, by name."""
    names = ("gen_p", "load_p", "actual_dispatch", "storage_power", "gen_p_before_curtail", "rho")
    return {name: getattr(state, name)[i].astype(np.float64) for name in names}


def powers(grid, state, i):
    """Generation - load, sum of |dispatch|, of storage power, of |storage power|, curtailed MW; marginal cost."""
    r = row(state, i)
    cost = grid.gen_cost_per_mw[r["gen_p"] > 0]
    curtailed = np.maximum(r["gen_p_before_curtail"] - r["gen_p"], 0)[grid.gen_renewable].sum()
    return (
        r["gen_p"].sum() - r["load_p"].sum(),
        np.abs(r["actual_dispatch"]).sum(),
        r["storage_power"].sum(),
        np.abs(r["storage_power"]).sum(),
        curtailed,
        float(cost.max()) if len(cost) else 0.0,
    )


def expected_default(grid, state, i):
    if state.terminated[i]:
        return 0.0, 0.0, 0.0
    rho = row(state, i)["rho"]
    overload = -np.where(state.line_status[i], np.clip(rho - 1, 0, 1), 1.0).mean()
    balance, dispatched, stored, exchanged, curtailed, marginal = powers(grid, state, i)
    total = max(balance - stored, 0) + dispatched + exchanged + curtailed
    scale = 0.1 * grid.gen_cost_per_mw.max().astype(float) * grid.gen_pmax.astype(float).sum()
    return 1.0, overload, -np.clip(marginal * total / scale, 0, 1)


def expected_paper(grid, state, i):
    if state.terminated[i]:
        return 0.0, 0.0, 0.0
    rho = row(state, i)["rho"]
    overload = -np.where(state.line_status[i], np.maximum(rho - 1, 0), 1.0).sum()
    balance, dispatched, _, exchanged, _, marginal = powers(grid, state, i)
    cost = -(balance + dispatched + exchanged) * marginal
    return state.step[i] / state.episode_length[i], np.clip(overload, -1, 1), np.clip(cost, -1, 0)


def expected_released(grid, state, i):
    if state.terminated[i]:
        return -5.0, -5.0, -1.0
    if state.illegal[i] or state.ambiguous[i]:
        return 1.0, -5.0, -1.0
    rho = row(state, i)["rho"]
    overload = -np.where(state.line_status[i], np.maximum(rho - 1, 0), 1.0).sum() / (0.1 * grid.n_line)
    balance, dispatched, _, exchanged, _, marginal = powers(grid, state, i)
    regret = marginal * (balance + 5 * dispatched + exchanged) / 12
    worst = (0.05 + 5) * grid.gen_pmax.astype(float).sum() * grid.gen_cost_per_mw.max().astype(float) / 12
    return 1.0, overload, -regret / worst


def expected_trips(grid, state, i):
    survive, overload, cost = expected_default(grid, state, i)
    if state.terminated[i]:
        return survive, overload, cost
    locked = state.time_before_cooldown_line[i] == grid.rules.reconnection
    ours = locked & ~state.line_status[i] & ~state.attacked[i] & (state.time_next_maintenance[i] != 0)
    return survive, overload - min(ours.sum(), 2), cost


@pytest.mark.parametrize(
    ("components", "expected"),
    [
        (default_components, expected_default),
        (paper_components, expected_paper),
        (released_components, expected_released),
        (trips_components, expected_trips),
    ],
)
def test_components_are_those_of_the_definition(grid, random_rows, components, expected):
    assert random_rows.terminated.any()
    assert (random_rows.rho > 1).any()
    for i in range(len(random_rows.step)):
        np.testing.assert_allclose(components(random_rows, i), expected(grid, random_rows, i), rtol=1e-12, atol=1e-12)


def test_the_default_reward_is_never_negative(random_rows):
    reward = resolve_reward("default")
    for i in range(len(random_rows.step)):
        survive, overload, cost = reward.components(random_rows, i)
        assert 0 <= np.dot(reward.weights, (survive, overload, cost)) <= 1
        assert survive in (0, 1)
        assert -1 <= overload <= 0
        assert -1 <= cost <= 0


def test_weights_of_the_presets():
    weights = {name: preset.weights for name, preset in PRESETS.items()}
    assert weights == {
        "default": (1.0, 0.5, 0.5),
        "paper": (1.0, 0.5, 0.5),
        "released": (1.0, 1.0, 0.5),
        "trips": (1.0, 0.5, 0.5),
    }


def test_a_calm_grid_without_losses_earns_everything(calm):
    state = calm(load_grid("bus14"))
    survive, overload, cost = default_components(state, 0)
    assert (survive, overload) == (1.0, 0.0)
    assert -1e-6 < cost <= 0  # the float32 loads do not add up exactly


def test_overload_counts_the_excess_up_to_one_and_a_disconnection_as_one(calm):
    state = calm(load_grid("bus14"))
    state.rho[0, :4] = 1.0, 1.25, 1.5, 7.0
    state.line_status[0, 4] = False
    state.rho[0, 4] = 0.0
    assert overload_component(state, 0) == -(0.25 + 0.5 + 1 + 1) / 20
    assert paper_components(state, 0)[1] == -1.0
    assert released_components(state, 0)[1] == -(0.25 + 0.5 + 6 + 1) / 2


def test_paper_overload_below_saturation(calm):
    state = calm(load_grid("bus14"))
    state.rho[0, 3] = 1.25
    assert paper_components(state, 0) == (0.01, -0.25, pytest.approx(0, abs=1e-3))


def cost_of(components, state, **changes):
    """The cost of a row in which only these attributes are not 0; one MW per entry."""
    state.gen_p[:] = state.load_p[:] = 0
    for name, value in changes.items():
        getattr(state, name)[0, : len(value)] = value
    return components(state, 0)[2]


def test_every_part_of_the_default_cost_by_hand(calm):
    grid = load_grid("bus118-MOB-v0")
    state = calm(grid)
    dear = int(grid.gen_cost_per_mw.argmax())
    cheap = int(np.flatnonzero((grid.gen_cost_per_mw > 0) & (grid.gen_cost_per_mw < grid.gen_cost_per_mw.max()))[0])
    renewable = int(np.flatnonzero(grid.gen_renewable)[0])
    per_mw = 1 / (0.1 * grid.gen_pmax.astype(float).sum())

    def produce(gen, power):
        production = np.zeros(grid.n_gen)
        production[gen] = power
        return production

    nothing = np.zeros(grid.n_gen)
    running = produce(dear, 10)
    ten = {"gen_p": running, "load_p": [10]}
    assert cost_of(default_components, state, gen_p=running, load_p=[7]) == pytest.approx(-3 * per_mw)
    ratio = float(grid.gen_cost_per_mw[cheap]) / float(grid.gen_cost_per_mw[dear])
    assert cost_of(default_components, state, gen_p=produce(cheap, 10), load_p=[7]) == pytest.approx(
        -3 * per_mw * ratio
    )
    assert cost_of(default_components, state, **ten, actual_dispatch=[2, -2]) == pytest.approx(-4 * per_mw)
    state.actual_dispatch[:] = 0
    # Charging 3 MW explains the missing 3 MW: only the exchange costs. Discharging likewise.
    assert cost_of(default_components, state, gen_p=running, load_p=[7], storage_power=[3]) == pytest.approx(
        -3 * per_mw
    )
    assert cost_of(default_components, state, gen_p=running, load_p=[12], storage_power=[-2]) == pytest.approx(
        -2 * per_mw
    )
    state.storage_power[:] = 0
    potential = produce(renewable, 6)
    assert cost_of(default_components, state, **ten, gen_p_before_curtail=potential) == pytest.approx(-6 * per_mw)
    assert cost_of(default_components, state, gen_p=running, load_p=[15], gen_p_before_curtail=nothing) == 0
    assert cost_of(default_components, state, gen_p=nothing, load_p=[0], actual_dispatch=[5]) == 0  # nobody produces
    assert cost_of(default_components, state, gen_p=running, load_p=[-1e6]) == -1


def test_the_printed_cost_saturates(calm):
    grid = load_grid("bus14")
    state = calm(grid)
    dear = grid.gen_cost_per_mw == grid.gen_cost_per_mw.max()
    assert cost_of(paper_components, state, gen_p=10.0 * dear, load_p=[0]) == -1
    assert cost_of(paper_components, state, gen_p=10.0 * dear, load_p=[500]) == 0


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_of_the_printed_reward_the_first_half_of_a_month_is_worth_less_than_its_end(grid_id):
    """Its cost is saturated, so that a step is worth t / T - 1/2 at most, and a game over 0."""
    grid = load_grid(grid_id)
    engine = NativeEngine(grid, 1)
    reward, steps = resolve_reward("paper"), 60
    engine.reset(0, EpisodePlan(1, 0, list_scenarios(grid.id, "bundled")[0], 0, 2 * steps))
    for _ in range(steps - 1):
        engine.step(0, DO_NOTHING)
        assert not engine.state.terminated[0]
        assert np.dot(reward.weights, reward.components(engine.state, 0)) < 0


def test_an_illegal_or_ambiguous_action_is_fined_by_the_released_reward_only(calm):
    for flag in ("illegal", "ambiguous"):
        state = calm(load_grid("bus14"))
        before = default_components(state, 0), paper_components(state, 0)
        getattr(state, flag)[0] = True
        assert released_components(state, 0) == (1.0, -5.0, -1.0)
        assert (default_components(state, 0), paper_components(state, 0)) == before


def steps_of_random_play(engine, grid, episodes, steps):
    """After every step that is no game over: how many lines the reward thinks that protections opened."""
    probe, scenario = make_probe(grid, "topology", "random"), list_scenarios(grid.id, "bundled")[0]
    for number in range(episodes):
        probe.begin(np.random.default_rng(number))
        engine.reset(0, EpisodePlan(1, number, scenario, 20 * number, steps))
        for _ in range(steps):
            engine.step(0, probe.choose(engine.state, 0))
            if engine.state.terminated[0]:
                break
            yield trips(engine.state, 0)


def test_trips_are_the_lines_that_grid2op_disconnects():
    """Among lines that were switched, attacked and under maintenance."""
    grid = load_grid("bus36-MO-v0")
    engine = ReferenceEngine(grid, 1)
    counted = [
        (found, np.count_nonzero(engine.grid2op_environment(0)._disc_lines >= 0))
        for found in steps_of_random_play(engine, grid, episodes=12, steps=60)
    ]
    engine.close()
    assert all(found == expected for found, expected in counted)
    assert sum(found for found, _ in counted) >= 3


@pytest.mark.parametrize("grid_id", ["bus14", "bus118-M", "bus118-MOB-v1"])
def test_trips_are_the_lines_that_protections_open(grid_id):
    """Of grids that lock them for 10 and 12 steps."""
    grid = load_grid(grid_id)
    engine = NativeEngine(grid, 1)
    counted = [
        (found, np.count_nonzero(engine.environments.hidden.tripped[0]))
        for found in steps_of_random_play(engine, grid, episodes=60, steps=100)
    ]
    assert all(found == expected for found, expected in counted)
    assert sum(found for found, _ in counted) >= 3


def test_a_trip_costs_half_a_step_and_more_than_two_no_more(calm):
    state, weights = calm(load_grid("bus36-MO-v0")), PRESETS["trips"].weights
    before = np.dot(weights, trips_components(state, 0))
    for lines, paid in ((1, 0.5), (2, 1.0), (3, 1.0)):
        state.line_status[0, :lines] = False
        state.time_before_cooldown_line[0, :lines] = 12
        out = 0.5 * lines / 59  # what every reward takes for lines out of service
        assert np.dot(weights, trips_components(state, 0)) == pytest.approx(before - paid - out)
    state.time_before_cooldown_line[0] = 11
    assert trips(state, 0) == 0
    state.time_before_cooldown_line[0] = 12
    state.attacked[0] = True
    assert trips(state, 0) == 0


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_no_grid_makes_a_normaliser_zero(grid_id):
    grid = load_grid(grid_id)
    assert grid.gen_cost_per_mw.max() > 0
    assert grid.gen_pmax.sum() > 0


def test_the_released_cost_is_grid2op_s_regret_over_its_largest_regret():
    import grid2op
    from grid2op.Reward import RedispReward
    from lightsim2grid import LightSimBackend

    grid = load_grid("bus14")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = grid2op.make("l2rpn_case14_sandbox", test=True, backend=LightSimBackend(), reward_class=RedispReward)
    observation = env.reset(seed=1, options={"time serie id": 0})
    largest = float(env.get_reward_instance().max_regret)
    state = new_state(grid, 1)
    state.episode_length[:] = 575
    redispatch = {"redispatch": [(int(np.flatnonzero(grid.gen_redispatchable)[0]), 2.0)]}
    for step in range(6):
        observation, reward, done, _ = env.step(env.action_space(redispatch if step in (1, 3) else {}))
        assert not done
        for name in ("gen_p", "load_p", "rho", "line_status", "actual_dispatch"):
            getattr(state, name)[0] = getattr(observation, name)
        regret = largest - float(reward) * observation.load_p.sum()
        assert regret > 0
        assert released_components(state, 0)[2] == pytest.approx(-regret / largest, abs=1e-6)
    assert np.abs(state.actual_dispatch).sum() > 1
    env.close()


def test_weights_apply_to_the_default_components():
    reward = resolve_reward((1, 0.25, np.float32(2)))
    assert reward.components is default_components
    assert reward.weights == (1.0, 0.25, 2.0)
    assert all(type(weight) is float for weight in reward.weights)
    assert reward.name == "weights 1, 0.25, 2"
    assert resolve_reward(np.array([1.0, 0.0, 0.0])).weights == (1.0, 0.0, 0.0)


def test_a_compiled_function_is_taken_as_it_is(calm):
    @numba.njit
    def loading(state, i):
        return 1.0, -np.float64(state.rho[i].max()), 0.0

    reward = resolve_reward(loading)
    assert reward.name == "loading"
    assert reward.weights == (1.0, 1.0, 1.0)
    assert reward.components(calm(load_grid("bus14")), 0) == (1.0, -0.5, 0.0)


def plain(state, i):
    return 1.0, 0.0, 0.0


class Margin:
    """A reward that is an object."""

    def __call__(self, state, i):
        return 1.0 - state.rho[i].max()


@numba.njit
def of_one_argument(state):
    return 1.0, 0.0, 0.0


def of_three_arguments(state, i, more):
    return 1.0, 0.0, 0.0


def test_plain_python_is_taken_too(calm):
    state = calm(load_grid("bus14"))
    assert resolve_reward(plain).components(state, 0) == (1.0, 0.0, 0.0)
    assert resolve_reward(Margin()).components(state, 0) == (0.5, 0.0, 0.0)
    assert reward_name(plain).endswith("test_rewards.plain")
    assert reward_name(Margin()).endswith("test_rewards.Margin")


@pytest.mark.parametrize("function", [of_one_argument, of_three_arguments, type])
def test_an_unusable_function_is_refused(function):
    with pytest.raises(
        UsageError, match=rf"'{function.__name__}' is not usable: give a function \(state, i\) .*choose"
    ):
        resolve_reward(function)


@pytest.mark.parametrize("result", [(1.0, 2.0), "three", None, (1.0, 2.0, "x")])
def test_a_wrong_result_is_refused_in_one_sentence(result, calm):
    reward = resolve_reward(lambda state, i: result)
    with pytest.raises(UsageError, match="it is to return three numbers") as error:
        reward.components(calm(load_grid("bus14")), 0)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "spec",
    ["Default", "", None, 1.0, (1, 2), (1, 2, 3, 4), (1, 2, "3"), (1, 2, float("nan")), (True, 1, 1), {"a": 1}, "abc"],
)
def test_a_wrong_reward_is_refused_with_what_is_allowed(spec):
    with pytest.raises(
        UsageError, match="choose one of default, paper, released, trips, three finite weights"
    ) as error:
        resolve_reward(spec)
    assert "\n" not in str(error.value)
