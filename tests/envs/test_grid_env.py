"""The Gymnasium environment: spaces, transitions, endings, simulation, refusals."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.engines import ENGINES
from rl2grid.engines.native import playing
from rl2grid.envs.info import INFO_KEYS
from rl2grid.envs.tasks import all_tasks
from rl2grid.errors import UsageError
from rl2grid.scenarios.library import list_scenarios

BOTH_ENGINES = pytest.mark.parametrize("engine", ENGINES)


def make(task_id, **keywords):
    return gymnasium.make(f"rl2grid/{task_id}-v0", **keywords)


def checked(task_id, engine):
    with warnings.catch_warnings():
        # Gymnasium advises bounds for the observation space; loadings have none.
        warnings.simplefilter("ignore")
        environment = gymnasium.make(task_id, engine=engine, disable_env_checker=True)
        check_env(environment.unwrapped, skip_render_check=True)
        environment.close()


@pytest.mark.parametrize(
    ("engine", "grid_id"),
    [
        ("native", "bus14"),
        ("native", "bus36-MO-v0"),
        ("reference", "bus14"),
        ("reference", "bus36-MO-v0"),
    ],
)
@pytest.mark.parametrize("kind", ["T0", "R", "H0"])
def test_passes_the_environment_checker(engine, grid_id, kind):
    """A grid without opponent and one with; the longer test below checks all tasks."""
    checked(f"rl2grid/{grid_id}-{kind}-v0", engine)


@pytest.mark.slow
@pytest.mark.parametrize("task_id", sorted(all_tasks()))
@BOTH_ENGINES
def test_all_tasks_pass_the_environment_checker(task_id, engine):
    checked(task_id, engine)


@pytest.fixture(scope="module", params=ENGINES)
def engine(request):
    return request.param


@pytest.fixture(scope="module")
def plain(engine):
    environment = make("bus14-T1", engine=engine, split="bundled", opponent=False, maintenance=False, gamma=0.9)
    yield environment.unwrapped
    environment.close()


@pytest.fixture(scope="module")
def idle(engine):
    environment = make("bus14-T1", engine=engine, split="bundled", heuristic="idle", maintenance=False, gamma=0.9)
    yield environment.unwrapped
    environment.close()


def month():
    """A real month of bus14 in which doing nothing fails after some days."""
    return next(name for name in list_scenarios("bus14", "bundled") if "rte_case14" in name)


def test_info_holds_exactly_the_documented_keys(plain):
    documented = {key.name for key in INFO_KEYS}
    _, info = plain.reset(seed=0)
    assert set(info) == documented
    assert set(plain.step(0)[4]) == documented


def test_seed_decides_the_episode(plain):
    first, info = plain.reset(seed=3)
    following, _ = plain.reset()
    again, info_again = plain.reset(seed=3)
    np.testing.assert_array_equal(first, again)
    assert info["scenario"] == info_again["scenario"]
    np.testing.assert_array_equal(following, plain.reset()[0])


def test_an_episode_of_a_given_length_is_completed_there(engine):
    keywords = {"engine": engine, "split": "bundled", "heuristic": "idle", "maintenance": False}
    with make("bus14-T0", episode_length=30, **keywords) as environment:
        _, info = environment.reset(seed=0)
        _, _, terminated, truncated, info = environment.step(0)
        assert (info["episode_length"], info["step"], info["survival"]) == (30, 30, 1.0)
        assert (terminated, truncated) == (False, True)
        spent = environment.unwrapped.operation()
        assert spent.cost_losses > 0
        assert spent.cost_blackout == 0
        assert spent.renewable_used == pytest.approx(spent.renewable_available, rel=1e-6)


def test_training_begins_at_random_rows_and_evaluation_at_row_zero(engine):
    with make("bus14-T0", engine=engine) as environment:
        starts = {environment.reset(seed=seed)[1]["start"] for seed in range(5)}
    assert len(starts) > 1
    with make("bus14-T0", engine=engine, split="test") as environment:
        assert {environment.reset(seed=seed)[1]["start"] for seed in range(5)} == {0}


def test_transition_adds_up_its_grid_steps(plain, idle):
    """An idle transition equals the same steps played one by one."""
    options = {"scenario": month(), "start": 0}
    plain.reset(seed=0, options=options)
    _, info = idle.reset(seed=0, options=options)
    assert info["reset_steps"] == info["step"] > 100
    assert info["n_steps"] == info["discounted_reward"] == info["cost"] == 0
    assert not any(info["reward_components"].values())
    rewards, costs, components = [], [], []
    while plain.unwrapped.state.step[0] < info["step"]:
        observation, reward, terminated, truncated, single = plain.step(0)
        rewards.append(reward)
        costs.append(single["costs"]["TLO"])
        components.append(single["reward_components"]["overload"])
        assert single["n_steps"] == 1
        assert not terminated
        assert not truncated
    # What accrued inside reset is in no transition.
    action = 7
    idle_observation, idle_reward, _, _, idle_info = idle.step(action)
    for name in ("reset_steps", "reset_reward", "reset_components", "reset_costs"):
        assert idle_info[name] == info[name]
    earned = sum(rewards)
    assert info["reset_reward"] == info["episode_return"] == pytest.approx(earned, rel=1e-12)
    assert info["reset_costs"]["TLO"] == sum(costs)
    assert info["reset_components"]["overload"] == pytest.approx(sum(components), rel=1e-12)
    rewards, costs, components = [], [], []
    observation, reward, _, _, single = plain.step(action)
    rewards.append(reward)
    costs.append(single["costs"]["TLO"])
    components.append(single["reward_components"]["overload"])
    while len(rewards) < idle_info["n_steps"]:
        observation, reward, _, _, single = plain.step(0)
        rewards.append(reward)
        costs.append(single["costs"]["TLO"])
        components.append(single["reward_components"]["overload"])
    np.testing.assert_array_equal(idle_observation, observation)
    assert idle_reward == pytest.approx(sum(rewards), rel=1e-12)
    assert idle_info["costs"]["TLO"] == sum(costs)
    assert idle_info["reward_components"]["overload"] == pytest.approx(sum(components), rel=1e-12)
    discounted = sum(0.9**k * reward for k, reward in enumerate(rewards))
    assert idle_info["discounted_reward"] == pytest.approx(discounted, rel=1e-12)
    assert idle_info["episode_return"] == pytest.approx(earned + sum(rewards), rel=1e-12)


def test_idle_never_hands_over_a_safe_grid(idle):
    idle.reset(seed=0, options={"scenario": month(), "start": 0})
    for _ in range(5):
        rho = idle.state.rho[0]
        assert rho.max() >= 0.95
        if any(idle.step(0)[2:4]):
            break


def test_episode_that_ends_inside_reset_is_returned_by_the_first_step(engine):
    scenario = next(name for name in list_scenarios("bus14", "bundled") if "rte_case14" not in name)
    with make("bus14-T0", engine=engine, split="bundled", heuristic="idle", maintenance=False) as environment:
        observation, info = environment.reset(seed=0, options={"scenario": scenario, "start": 0})
        if not info["over"]:
            pytest.fail("the two-day scenario was expected to be safe from its first to its last step")
        reset_reward = info["reset_reward"]
        assert info["reset_steps"] == info["step"] == info["episode_length"]
        after, reward, terminated, truncated, info = environment.step(3)
        assert (terminated, truncated) == (False, True)
        assert info["survival"] == 1.0
        assert info["n_steps"] == reward == 0
        assert info["reset_reward"] == info["episode_return"] == reset_reward > 0
        assert not info["over"]
        np.testing.assert_array_equal(observation, after)
        with pytest.raises(UsageError, match="call reset"):
            environment.unwrapped.step(0)


def test_game_over_terminates_and_completion_truncates(plain):
    plain.reset(seed=0, options={"scenario": month(), "start": 0})
    (line,) = np.flatnonzero((plain.grid.line_or_to_subid == 7) | (plain.grid.line_ex_to_subid == 7))
    catalogue = plain.action_catalogue_ids
    isolate = int(np.flatnonzero(catalogue == len(catalogue) - plain.grid.n_line + line)[0])
    _, reward, terminated, truncated, info = plain.step(isolate)
    assert (terminated, truncated) == (True, False)
    assert reward == 0.0
    assert info["game_over_text"].startswith("GENERATOR_DISCONNECTED")
    assert info["costs"] == {"LSI": 2.0, "TLO": info["costs"]["TLO"]}
    assert info["survival"] == 0.0


def test_a_completed_month_is_no_game_over(plain):
    """Survived to the end: truncated, not terminated, and without the cost of a game over."""
    plain.reset(seed=0, options={"scenario": month(), "start": 8058})
    for _ in range(6):
        _, reward, terminated, truncated, info = plain.step(0)
        assert not terminated
        assert reward > 0.0
    assert truncated
    assert (info["step"], info["survival"], info["game_over"]) == (6, 1.0, 0)
    assert info["costs"]["LSI"] == 0.0


def test_episodes_in_a_row_play_every_scenario(plain):
    """Each with its own series: a copy that is kept must not stand for the others."""
    scenarios = list_scenarios("bus14", "bundled")
    demand = plain.observation_slices["load_p"]
    plain.reset(seed=0)
    played = [plain.reset() for _ in scenarios]
    assert {info["scenario"] for _, info in played} == set(scenarios)
    assert len({observation[demand].tobytes() for observation, _ in played}) == len(scenarios)


def test_scenarios_of_both_mixes_pay(engine):
    """Grid2Op has two environments for bus118-M; one task plays the series of both, and rewards both."""
    scenarios = list_scenarios("bus118-M", "bundled")
    assert {name.split("/")[1] for name in scenarios} == {"x1", "x2.5"}
    with make("bus118-M-T0", engine=engine, split="bundled") as environment:
        for scenario in scenarios:
            environment.reset(seed=0, options={"scenario": scenario})
            _, reward, terminated, _, info = environment.step(0)
            assert not terminated
            # 1 for the step, less at most half of what losses cost.
            assert 0.5 < reward <= 1.0, scenario
            assert info["reward_components"]["survive"] == 1.0
            assert info["reward_components"]["cost"] < 0.0


def test_simulate_returns_what_a_step_would_and_changes_nothing(plain):
    plain.reset(seed=0)
    before = plain._observation()
    result = plain.simulate(7)
    np.testing.assert_array_equal(before, plain._observation())
    assert result.observation.shape == before.shape
    assert result.reward > 0
    assert result.info["step"] == 1
    assert not result.terminated
    with pytest.raises(UsageError, match="at least 1"):
        plain.simulate(7, horizon=0)
    with pytest.raises(UsageError, match="no forecast 5 steps ahead"):
        plain.simulate(7, horizon=5)


def test_the_careful_heuristic_refuses_a_series_without_forecasts(monkeypatch):
    monkeypatch.setattr(playing, "horizons_of", lambda scenario: 0)
    with make("bus14-T0", heuristic="careful") as environment, pytest.raises(UsageError, match="no forecast 1 steps"):
        environment.reset(seed=0)


def test_sums_of_a_simulation_are_of_its_step_alone(idle):
    _, before = idle.reset(seed=0, options={"scenario": month(), "start": 0})
    assert before["reset_steps"] > 100
    result = idle.simulate(7)
    assert (result.info["n_steps"], result.info["reset_steps"], result.info["reset_reward"]) == (1, 0, 0.0)
    assert not any({**result.info["reset_components"], **result.info["reset_costs"]}.values())
    assert result.info["episode_return"] == result.reward


@pytest.mark.parametrize(
    ("action", "message"),
    [(209, "0 to 208"), (-1, "0 to 208"), (1.0, "0 to 208"), ([1, 2], "0 to 208"), ("a", "0 to 208")],
)
def test_wrong_discrete_action_is_refused(plain, action, message):
    plain.reset(seed=0)
    with pytest.raises(UsageError, match=message):
        plain.step(action)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(5, np.float32), r"must have shape \(6,\), got \(5,\)"),
        (np.full(6, np.nan, np.float32), "NaN"),
        (np.array([0, 0, 1.5, 0, 0, 0], np.float32), "must lie in"),
    ],
)
def test_wrong_continuous_action_is_refused(engine, action, message):
    with make("bus14-R", engine=engine) as environment:
        environment.reset(seed=0)
        with pytest.raises(UsageError, match=message):
            environment.unwrapped.step(action)


def test_wrong_reset_options_are_refused(plain):
    with pytest.raises(UsageError, match="choose from scenario, start"):
        plain.reset(options={"scenari": "x"})
    with pytest.raises(UsageError, match="is not in the split bundled of bus14: choose one of"):
        plain.reset(options={"scenario": "no such month"})


def test_observation_slices_cover_the_observation(plain):
    slices = plain.observation_slices
    assert next(iter(slices)) == "t"
    assert sum(s.stop - s.start for s in slices.values()) == plain.observation_space.shape[0]


def test_physical_units_on_request(engine):
    with make("bus14-T0", engine=engine, normalize=None) as environment:
        observation, _ = environment.reset(seed=0)
        slices = environment.unwrapped.observation_slices
        np.testing.assert_array_equal(observation[slices["gen_p"]], environment.unwrapped.state.gen_p[0])


def test_step_listeners_see_every_grid_step(idle):
    seen = []
    idle.step_listeners.append(lambda state, i: seen.append(int(state.step[i])))
    try:
        _, info = idle.reset(seed=0, options={"scenario": month(), "start": 0})
    finally:
        idle.step_listeners.clear()
    assert seen == list(range(info["step"] + 1))
