"""The N-1 score in the reward."""

import gymnasium
import pytest

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.engines.native.what_if import n_minus_1_score
from rl2grid.envs.security_reward import SecurityReward
from rl2grid.errors import UsageError


def make(**keywords):
    return gymnasium.make("rl2grid/bus14-T0-v0", disable_env_checker=True, **keywords)


def test_the_weighted_score_is_added():
    plain, scored = make(), SecurityReward(make(), weight=0.5)
    plain.reset(seed=3)
    scored.reset(seed=3)
    scores = set()
    for action in (0, 5, 0, 5):
        expected, mine = plain.step(action), scored.step(action)
        assert (mine[0] == expected[0]).all()
        score = mine[4]["n_minus_1"]
        assert score == pytest.approx(n_minus_1_score(scored.unwrapped._environments.engine, 0))
        assert 0 <= score <= 1
        assert mine[1] == pytest.approx(expected[1] + 0.5 * score)
        assert mine[4]["reward_components"]["security"] == 0.5 * score
        scores.add(score)
    assert len(scores) > 1


def test_nothing_is_scored_at_the_end():
    env = SecurityReward(make())
    env.reset(seed=0)
    over = False
    while not over:
        _, _, terminated, truncated, info = env.step(0)
        over = terminated or truncated
    assert info["n_minus_1"] == 0.0


def test_bad_requests_are_refused():
    env, reference = make(), make(engine="reference")
    with pytest.raises(UsageError, match="give a finite number"):
        SecurityReward(env, weight=float("nan"))
    with pytest.raises(UsageError, match='choose engine="native"'):
        SecurityReward(reference)
