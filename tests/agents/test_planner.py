"""The planner on all kinds of task: what it reaches, what it refuses, and that nothing but the seed decides."""

from collections.abc import Collection
from typing import Any

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.agents.agent import injection_part, no_intervention
from rl2grid.agents.planner import INGREDIENTS, Foretold, Planner
from rl2grid.agents.trend import later_of, undispatched
from rl2grid.engines.native.what_if import WhatIf, forecast_of, snapshot_of
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import AGENTS, kinds_of, make_agent
from rl2grid.grids import load_grid
from rl2grid.mdp.actions import continuous_layout

DAYS = 2 * 288


def environment(task: str, **keywords: Any) -> Any:
    keywords = {"split": "bundled", "disable_env_checker": True, **keywords}
    return gymnasium.make(f"rl2grid/{task}-v0", **keywords)


def play(agent: Any, env: Any, seed: int = 0, steps: int = DAYS) -> tuple[list[Any], float, dict[str, Any]]:
    """Actions, survival and the last info of an episode, or of its first steps."""
    agent.bind(env)
    observation, info = env.reset(seed=seed)
    agent.reset(0)
    actions, over = [], False
    while not over and len(actions) < steps:
        actions.append(agent.act(observation, info))
        observation, _, terminated, truncated, info = env.step(actions[-1])
        over = terminated or truncated
    return actions, float(info["survival"]), info


def why(agent: Planner) -> str:
    considered = agent.explain()
    return "" if considered is None else considered.why


def begun(task: str, start: int, seed: int = 0, without: Collection[str] = ()) -> tuple[Planner, Any]:
    """A planner, and an environment that it is about to play from a row of the month on."""
    agent, env = Planner(without), environment(task)
    agent.bind(env)
    env.reset(seed=seed, options={"start": start})
    agent.reset(0)
    return agent, env


class Nothing:
    def bind(self, env: Any) -> None:
        self._action = no_intervention(env.action_space)

    def reset(self, i: int) -> None:
        pass

    def act(self, observation: Any, info: Any) -> Any:
        return self._action


@pytest.mark.parametrize("task", ["bus36-MO-v0-T0", pytest.param("bus36-MO-v0-H0", marks=pytest.mark.slow)])
def test_survives_attacks_that_end_doing_nothing(task):
    nothing = play(Nothing(), environment(task), seed=3)[1]
    assert play(Planner(), environment(task), seed=3)[1] > 1.5 * nothing


@pytest.mark.parametrize("task", ["bus14-T0", pytest.param("bus118-M-H0", marks=pytest.mark.slow)])
def test_survives_what_doing_nothing_survives(task):
    nothing = play(Nothing(), environment(task))[1]
    assert play(Planner(), environment(task))[1] >= nothing


def test_actions_of_every_kind_of_task_are_of_its_space():
    for task in ("bus14-T0", "bus14-R", "bus14-H0"):
        env = environment(task, episode_length=48)
        actions, _, info = play(Planner(), env)
        assert all(env.action_space.contains(action) for action in actions)
        assert not info["illegal"]
        assert not info["ambiguous"]


def test_it_tells_the_single_actions_that_a_search_compared():
    env = environment("bus36-MO-v0-T0")
    agent, told = Planner(), []
    agent.bind(env)
    observation, info = env.reset(seed=3)
    agent.reset(0)
    over = False
    while not over and len(told) < 3:
        action = agent.act(observation, info)
        ranking = agent.ranking(4)
        if ranking is not None:
            told.append(ranking)
            assert env.unwrapped.action_masks()[list(ranking.actions)].all()
            assert sorted(ranking.values) == list(ranking.values)
            assert len(ranking.actions) <= 4
        observation, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    assert told


def test_prevention_shifts_power_while_the_grid_is_safe():
    env = environment("bus36-MO-v0-H0", opponent=True)
    agent = Planner()
    play(agent, env, steps=60)
    shifted = float(np.abs(env.unwrapped.state.actual_dispatch[0]).sum())
    assert "power is shifted" in why(agent)
    other = environment("bus36-MO-v0-H0", opponent=True)
    play(Planner(without=["prevention"]), other, steps=60)
    assert shifted > 10.0
    assert shifted > 2 * float(np.abs(other.unwrapped.state.actual_dispatch[0]).sum())


class Telling(Planner):
    """Asked after every action where it wants the injections."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[Any] = []

    def act(self, observation: Any, info: Any) -> Any:
        action = super().act(observation, info)
        self.told.append((injection_part(action), self.aim()))
        return action


@pytest.mark.parametrize("task", ["bus36-MO-v0-H0", "bus36-MO-v0-R"])
def test_where_it_wants_injections_is_further_away_than_a_step_and_telling_changes_nothing(task: str):
    telling, silent = Telling(), Planner()
    played, expected = (play(agent, environment(task), seed=4, steps=80) for agent in (telling, silent))
    for one, other in zip(played[0], expected[0], strict=True):
        np.testing.assert_array_equal(injection_part(one), injection_part(other))
    n_gen = len(continuous_layout(load_grid("bus36-MO-v0")).redispatch)
    asked, aims = (np.array(each)[:, :n_gen] for each in zip(*telling.told, strict=True))
    assert np.abs(aims).max() > 2.0
    assert np.abs(asked).max() <= 1.0
    assert (np.sign(asked) * np.sign(aims) >= 0).mean() > 0.8, "it asks for something else than it wants"


def test_power_is_shifted_before_announced_maintenance_where_nobody_attacks():
    """A line whose loss would overload another is to be taken in two hours; without prevention nothing is asked for."""
    shifted = []
    for without in ([], ["prevention"]):
        agent, env = begun("bus36-M-R", 220, without=without)
        base = env.unwrapped
        point = snapshot_of(base.engine, 0)
        worst = WhatIf(base.grid).outages(point, np.arange(base.grid.n_line, dtype=np.int32)).worst_loading
        assert float(base.state.rho[0].max()) < 0.9
        line = int(np.flatnonzero((worst > 1.05) & (worst < 1.3))[0])
        observed = base.restore(base.save())
        base.state.time_next_maintenance[0][line], base.state.duration_next_maintenance[0][line] = 24, 96
        action = agent.act(*observed)
        shifted.append(float(np.abs(action).max()))
    assert shifted[0] > 0.1
    assert shifted[1] == 0.0


def test_topology_is_made_ready_for_announced_maintenance_while_the_grid_is_safe():
    """Twelve steps before: the worst loading without the line is less after what it plays than after nothing."""
    agent, env = begun("bus118-M-T1", 385, seed=1)
    state = env.unwrapped.state
    assert (state.time_next_maintenance[0] == 12).any()
    action = agent.act(*env.unwrapped.restore(env.unwrapped.save()))
    assert "made ready for what is to come" in why(agent)
    point = forecast_of(env.unwrapped.engine, 0)
    assert point is not None
    assert agent._search is not None
    grid = env.unwrapped.grid
    later = later_of(state, point, grid, np.zeros(grid.dim_topo))
    assert agent._search.worst_later(agent._search.after(point, action), later) < agent._search.worst_later(
        point, later
    )
    other, env = begun("bus118-M-T1", 385, seed=1, without=["preparing"])
    assert other.act(*env.unwrapped.restore(env.unwrapped.save())) == 0


def test_the_same_seed_gives_the_same_actions_and_asking_leaves_the_episode_as_it_is():
    first = play(Planner(), environment("bus36-MO-v0-H0"), seed=4, steps=80)
    again = play(Planner(), environment("bus36-MO-v0-H0"), seed=4, steps=80)
    for one, other in zip(first[0], again[0], strict=True):
        assert one["topology"] == other["topology"]
        np.testing.assert_array_equal(one["injection"], other["injection"])
    assert first[1] == again[1]


def test_brought_back_it_plans_anew_and_knows_nothing_of_what_it_saw_later():
    env = environment("bus36-MO-v0-H0", opponent=False)
    agent = Planner()
    play(agent, env, seed=4, steps=40)
    world = env.unwrapped.save()
    observation, info = env.unwrapped.restore(world)
    for _ in range(9):
        observation, *_, info = env.step(agent.act(observation, info))
    observation, info = env.unwrapped.restore(world)
    again = agent.act(observation, info)
    assert max(seen.step for seen in agent._trend._history) == info["step"]
    env.unwrapped.restore(world)
    asked_twice = agent.act(observation, info)
    np.testing.assert_array_equal(again["injection"], asked_twice["injection"])


def test_curtailment_stays_as_it_is_while_nothing_is_planned():
    agent, env = begun("bus14-R", 140)
    limits = np.zeros(env.action_space.shape, np.float32)
    limits[3:] = -0.9
    env.step(limits)
    state = env.unwrapped.state
    kept = state.curtailment_limit[0].copy()
    action = agent._held()
    env.step(action)
    np.testing.assert_allclose(state.curtailment_limit[0], kept, atol=1e-6)


def test_what_was_asked_for_and_not_reached_is_given_up_while_nothing_is_planned():
    """So that nothing is solved again, and a series that rises too fast for its generators ends nothing."""
    agent, env = begun("bus14-R", 140)
    request = np.zeros(env.action_space.shape, np.float32)
    request[0] = 1.0
    env.step(request)
    state = env.unwrapped.state
    assert np.abs(state.actual_dispatch[0] - state.target_dispatch[0]).max() > 0.01
    dispatched = state.actual_dispatch[0].copy()
    env.step(agent._held())
    np.testing.assert_allclose(state.target_dispatch[0], dispatched, atol=1e-5)
    np.testing.assert_array_equal(state.actual_dispatch[0], dispatched)


def test_forewarned_it_makes_the_grid_ready_for_a_loss_that_nobody_publishes():
    left = []
    for told in (True, False):
        env = environment("bus36-M-R")
        agent = Planner()
        agent.bind(env)
        observation, info = env.reset(seed=0, options={"start": 220})
        agent.reset(0)
        base = env.unwrapped
        what_if = WhatIf(base.grid)
        lines = np.arange(base.grid.n_line, dtype=np.int32)
        loading = what_if.outages(snapshot_of(base.engine, 0), lines).worst_loading
        worst = np.argsort(-np.where(np.isfinite(loading), loading, 0.0))[:1].astype(np.int32)
        assert loading[worst] > 1.0
        if told:
            agent.forewarn(Foretold(int(base.state.step[0]) + 24, worst, undispatched(base.state, base.grid)))
        for _ in range(18):
            observation, *_, info = env.step(agent.act(observation, info))
        left.append(float(what_if.outages(snapshot_of(base.engine, 0), worst).worst_loading[0]))
    assert left[0] < left[1] - 0.02


def test_it_says_why():
    env = environment("bus36-MO-v0-T0")
    agent = Planner()
    play(agent, env)
    considered = agent.explain()
    assert considered is not None
    assert "%" in considered.why or "safe" in considered.why


def test_ingredients_are_left_out_by_name():
    assert Planner(without=["danger", "sequences"]).name == "planner without danger without sequences"
    assert Planner(without=["danger", "danger"]).name == "planner without danger"
    for nonsense in ("sequences", None, 5):
        with pytest.raises(UsageError, match="give a list of ingredients"):
            Planner(without=nonsense)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match=r"Ingredient 'luck'.*sequences"):
        Planner(without=["luck"])
    assert set(INGREDIENTS) == {
        "sequences",
        "danger",
        "restoring",
        "prevention",
        "dispatch first",
        "trend",
        "preparing",
    }
    for each in INGREDIENTS:
        play(Planner(without=[each]), environment("bus36-MO-v0-H0"), steps=5)


def test_the_seconds_of_a_search_are_positive():
    assert Planner(seconds=0.5).name == "planner (0.5 s)"
    with pytest.raises(UsageError, match="seconds=0 is not allowed"):
        Planner(seconds=0)
    for nonsense in (True, "0.1", float("inf"), float("nan"), [1.0]):
        with pytest.raises(UsageError, match="is not allowed: give a positive number"):
            Planner(seconds=nonsense)  # type: ignore[arg-type]


def test_seconds_are_refused_where_nothing_is_searched():
    with pytest.raises(UsageError, match="search for topology actions, which rl2grid/bus14-R-v0 has not"):
        Planner(seconds=1.0).bind(environment("bus14-R"))


def test_the_reference_engine_answers_no_what_if():
    with pytest.raises(UsageError, match='engine="native"'):
        Planner().bind(environment("bus14-T0", engine="reference"))


def test_it_is_found_by_name():
    assert isinstance(make_agent("planner"), Planner)
    assert "planner" in AGENTS
    assert kinds_of("planner") == ("T", "R", "H")
