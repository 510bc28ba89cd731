"""The six values of a step beside the five that they are made of."""

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.envs.safety import SafetyTuple, VectorSafetyTuple

STEPS = 40


@pytest.mark.parametrize("constraint", ["LSI", "TLO"])
def test_the_cost_is_that_of_the_constraint(constraint):
    task = f"rl2grid/bus14-T0-{constraint}-v0"
    plain, safe = gymnasium.make(task), SafetyTuple(gymnasium.make(task))
    plain.reset(seed=3)
    safe.reset(seed=3)
    costs = []
    for action in np.random.default_rng(0).integers(50, size=STEPS).tolist():
        observation, reward, terminated, truncated, info = plain.step(action)
        mine = safe.step(action)
        assert len(mine) == 6
        np.testing.assert_array_equal(mine[0], observation)
        assert mine[1:5] == (reward, info["costs"][constraint], terminated, truncated)
        assert isinstance(mine[2], float)
        costs.append(mine[2])
        if terminated or truncated:
            plain.reset()
            safe.reset()
    assert sum(costs) > 0


def test_costs_of_a_vector_are_those_of_single_environments_over_autoresets():
    keywords = {"heuristic": "idle"}  # what accrues before the first decision is in the infos of a reset
    vector = VectorSafetyTuple(gymnasium.make_vec("rl2grid/bus14-T0-LSI-v0", num_envs=2, **keywords))
    singles = [SafetyTuple(gymnasium.make("rl2grid/bus14-T0-LSI-v0", **keywords)) for _ in range(2)]
    vector.reset(seed=5)
    for i, single in enumerate(singles):
        single.reset(seed=5 + i)
    random, endings = np.random.default_rng(1), 0
    for _ in range(STEPS):
        actions = random.integers(50, size=2)
        observations, rewards, costs, terminated, truncated, infos = vector.step(actions)
        assert costs.dtype == np.float64
        assert costs.shape == (2,)
        for i, single in enumerate(singles):
            observation, *rest, _ = single.step(int(actions[i]))
            assert rest == [rewards[i], costs[i], terminated[i], truncated[i]]
            if terminated[i] or truncated[i]:
                endings += costs[i] > 0
                np.testing.assert_array_equal(infos["final_observation"][i], observation)
                observation, _ = single.reset()
            np.testing.assert_array_equal(observations[i], observation)
    assert endings, "no episode was lost: the test did not see the cost of an ending"
