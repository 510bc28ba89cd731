"""What an operator knows beside the paper's features: told by both engines, and true of what was played."""

import math
from typing import Any

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.envs.graph import GraphObservation
from rl2grid.envs.spec import spec_of
from rl2grid.errors import UsageError
from rl2grid.handles import AsOpened
from rl2grid.mdp.features import OPERATOR_FEATURES, feature_slices
from rl2grid.mdp.security import is_expected, loading_after_loss, new_security
from rl2grid.powerflow.model import load_network

CALENDAR = OPERATOR_FEATURES["calendar"]
ATTACKED = "bus36-MO-v0-T0"
"""A task with an opponent and planned outages."""
DAY = 288


def made(task: str, **keywords: Any) -> Any:
    keywords = {"operator_features": "all", "normalize": None, **keywords}
    return gymnasium.make(f"rl2grid/{task}-v0", disable_env_checker=True, **keywords).unwrapped


def expected_calendar(env: Any) -> list[float]:
    now = env.clock_at(int(env.state.step[0]))
    of_day = (60 * now.hour + now.minute) / 1440
    since_1970 = (now - type(now)(1970, 1, 1)).total_seconds() / 86400
    shares = (of_day, (now.weekday() + of_day) / 7, since_1970 / 365.2425 % 1)
    return [part for share in shares for part in (math.sin(2 * math.pi * share), math.cos(2 * math.pi * share))]


def expected_losses(env: Any, state: Any) -> np.ndarray:
    grid = env.grid
    security = AsOpened()(new_security(grid, load_network(grid), True))
    opened, found = AsOpened()(state), np.zeros(grid.n_line)
    for k, line in enumerate(new_security(grid, load_network(grid), True).line.tolist()):
        if state.line_status[0, line] and is_expected(security, opened, 0, k):
            found[line] = min(loading_after_loss(security, opened, 0, k), 2.0)
    return found


def random_action(env: Any, rng: np.random.Generator) -> int:
    return 0 if rng.random() < 0.7 else int(rng.choice(np.flatnonzero(env.action_masks())))


@pytest.mark.parametrize("engine", ["native", "reference"])
def test_everything_told_is_true_of_what_was_played(engine: str) -> None:
    env, rng = made(ATTACKED, engine=engine), np.random.default_rng(1)
    env.reset(seed=3)
    last_attack, attacks = np.full(env.grid.n_line, -1), 0
    for _ in range(250):
        _, _, terminated, truncated, _ = env.step(random_action(env, rng))
        if terminated or truncated:
            env.reset()
            last_attack[:] = -1
        state, told = env.state, env.observe(scaled=False)
        step, held = int(state.step[0]), state.attacked[0]
        last_attack[held] = step
        attacks += int(held.any())
        assert [told[name].item() for name in CALENDAR] == pytest.approx(expected_calendar(env), abs=1e-6)
        allowed = env.grid.rules.overflow_allowed
        np.testing.assert_array_equal(told["steps_to_trip"], allowed + 1 - state.timestep_overflow[0])
        np.testing.assert_array_equal(told["attacked"], held)
        since = np.where(last_attack >= 0, np.minimum(step - last_attack, DAY), DAY)
        np.testing.assert_array_equal(told["steps_since_attack"], since)
        np.testing.assert_array_equal(told["loading_after_loss"], np.array(expected_losses(env, state), np.float32))
    assert attacks > 10


@pytest.mark.parametrize("task", [ATTACKED, "bus14-R"])
def test_the_papers_features_stay_what_they_are(task: str) -> None:
    with_them, without = made(task, normalize="physical"), made(task, normalize="physical", operator_features=None)
    size = without.observation_space.shape[0]
    for observation, plain in zip(with_them.reset(seed=1), without.reset(seed=1), strict=True):
        if isinstance(plain, np.ndarray):
            np.testing.assert_array_equal(observation[:size], plain)
    slices = with_them.observation_slices
    assert list(slices)[-10:] == [name for names in OPERATOR_FEATURES.values() for name in names]
    assert with_them.observation_space.shape == (size + 6 + 4 * without.grid.n_line,)


def test_groups_come_in_the_order_of_the_table_whatever_the_order_asked_for() -> None:
    grid = made("bus14-T0").grid
    assert feature_slices(grid, "T", "attacks,calendar") == feature_slices(grid, "T", "calendar,attacks")
    assert feature_slices(grid, "T", "all") == feature_slices(grid, "T", ",".join(OPERATOR_FEATURES))
    assert "steps_to_trip" not in feature_slices(grid, "T", "security")


@pytest.mark.parametrize(
    ("heuristic", "engine", "workers"),
    [
        (None, "native", None),
        ("secure", "native", None),
        pytest.param(None, "reference", 1, marks=pytest.mark.slow),
        ("secure", "reference", 0),
    ],
)
def test_a_vector_tells_what_single_environments_tell(heuristic: str | None, engine: str, workers: int | None) -> None:
    keywords = {"heuristic": heuristic, "operator_features": "all", "engine": engine}
    envs = gymnasium.make_vec(
        f"rl2grid/{ATTACKED}-v0", num_envs=2, vectorization_mode="vector_entry_point", num_workers=workers, **keywords
    )
    singles = [made(ATTACKED, normalize="physical", **keywords) for _ in range(2)]
    observations, _ = envs.reset(seed=5)
    expected = [env.reset(seed=5 + k)[0] for k, env in enumerate(singles)]
    np.testing.assert_array_equal(observations, expected)
    rng = np.random.default_rng(0)
    for _ in range(40):
        actions = [random_action(env, rng) for env in singles]
        observations, _, terminated, _, infos = envs.step(np.array(actions))
        for k, env in enumerate(singles):
            expected[k], _, over, truncated, _ = env.step(actions[k])
            assert over == terminated[k]
            if over or truncated:
                np.testing.assert_array_equal(infos["final_obs"][k], expected[k])
                expected[k], _ = env.reset()
        np.testing.assert_array_equal(observations, expected)
    envs.close()


def test_a_forecast_is_told_with_its_own_time_and_flows() -> None:
    env = made(ATTACKED)
    env.reset(seed=2)
    result = env.simulate(0)
    told = {name: result.observation[part] for name, part in env.observation_slices.items()}
    now, then = env.clock_at(0), env.clock_at(1)
    assert (then - now).total_seconds() == 300
    of_day = (60 * then.hour + then.minute) / 1440
    assert told["day_sine"].item() == pytest.approx(math.sin(2 * math.pi * of_day), abs=1e-6)
    assert (told["loading_after_loss"] > 0).sum() == (env.observe(scaled=False)["loading_after_loss"] > 0).sum()
    assert not np.array_equal(told["loading_after_loss"], env.observe(scaled=False)["loading_after_loss"])


def test_a_restored_world_tells_the_same() -> None:
    env = made(ATTACKED)
    env.reset(seed=7)
    while not env.state.attacked.any():
        env.step(0)
    world, before = env.save(), env.observe(scaled=False)
    env.reset(seed=8)
    env.restore(world)
    for name, values in env.observe(scaled=False).items():
        np.testing.assert_array_equal(values, before[name])


def test_networks_and_graphs_are_told_what_they_belong_to() -> None:
    env = gymnasium.make(f"rl2grid/{ATTACKED}-v0", operator_features="all", disable_env_checker=True)
    spec = spec_of(env)
    assert spec.operator_features == "all"
    assert spec.feature("loading_after_loss").of == spec.feature("steps_since_attack").of == "line"
    assert spec.feature("year_cosine").of == "time"
    graph, _ = GraphObservation(env).reset(seed=1)
    observation, _ = env.reset(seed=1)
    assert graph["t"].shape == (7,)
    builder = spec.graph_builder()
    column = graph["edges"][: spec.grid.n_line, builder.edge_features.index("loading_after_loss")]
    where = spec.feature("loading_after_loss")
    np.testing.assert_array_equal(column, observation[where.begin : where.end])


@pytest.mark.parametrize("names", ["", "weather", "calendar,calendar", "calendar security", ("calendar",), 3])
def test_what_is_no_group_is_refused_in_one_sentence(names: object) -> None:
    with pytest.raises(UsageError, match="give some of calendar, trips, attacks, security, separated by commas"):
        made("bus14-T0", operator_features=names)


def test_forecasts_of_changed_topologies_are_told_alike_every_time() -> None:
    """What compiled code is handed outlives the call: factors of a new topology read all of it."""
    env = made(ATTACKED)
    env.reset(seed=2)
    actions = np.flatnonzero(env.action_masks())[:12]
    first = [env.simulate(int(action)).observation for action in actions]
    for action, before in zip(actions, first, strict=True):
        np.testing.assert_array_equal(env.simulate(int(action)).observation, before)
    where = env.observation_slices["loading_after_loss"]
    assert len({tuple(observation[where]) for observation in first}) > 6
