"""Observation statistics: exact, shared, counted once, frozen in evaluation."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from toy_grid import ToyGrid

from rl2grid.envs.normalization import CLIP, NormalizeObservation, ObservationNormalizer
from rl2grid.errors import UsageError


class Spy(ToyGrid):
    """Keeps what it showed."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs)
        self.shown: list[np.ndarray[Any, Any]] = []
        self.final: dict[int, np.ndarray[Any, Any]] = {}

    def reset(self, **keywords: Any) -> Any:
        observations, infos = super().reset(**keywords)
        self.shown.append(observations.copy())
        return observations, infos

    def step(self, actions: Any) -> Any:
        result = super().step(actions)
        self.shown.append(result[0].copy())
        ended = result[2] | result[3]
        self.final = {i: result[4]["final_obs"][i].copy() for i in np.flatnonzero(ended)}
        return result


def play(envs: NormalizeObservation, steps: int) -> Any:
    result: Any = envs.reset(seed=5)
    for _ in range(steps):
        result = envs.step(np.zeros(envs.num_envs, np.int64))
    return result


def test_batches_of_any_size_give_the_mean_and_variance_of_all_observations():
    values = np.random.default_rng(0).normal(3.0, 7.0, (101, 4))
    normalizer = ObservationNormalizer(4)
    for batch in np.split(values, [1, 4, 5, 50]):
        normalizer.update(batch)
    assert normalizer.count == 101
    np.testing.assert_allclose(normalizer.mean, values.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(normalizer.variance, values.var(axis=0), rtol=1e-12)


def test_small_deviations_of_large_values_are_not_lost():
    values = 1e6 + np.random.default_rng(0).normal(0.0, 1e-3, (1000, 1))
    normalizer = ObservationNormalizer(1)
    for batch in np.split(values, 100):
        normalizer.update(batch)
    np.testing.assert_allclose(normalizer.variance, values.var(axis=0), rtol=1e-6)


def test_normalised_values_are_standardised_and_clipped():
    normalizer = ObservationNormalizer(1)
    normalizer.update(np.array([[1.0], [3.0]]))
    np.testing.assert_allclose(normalizer.normalize(np.array([4.0])), [2.0], rtol=1e-6)
    assert normalizer.normalize(np.array([[1e9], [-1e9]])).tolist() == [[CLIP], [-CLIP]]
    assert normalizer.normalize(np.array([4.0])).dtype == np.float32


def test_what_is_normalised_follows_the_statistics():
    normalizer, other = ObservationNormalizer(1), ObservationNormalizer(1)
    assert normalizer.normalize(np.array([4.0])).tolist() == [4.0]
    normalizer.update(np.array([[1.0], [3.0]]))
    assert normalizer.normalize(np.array([4.0])) == pytest.approx([2.0])
    normalizer.update(np.array([[2.0], [10.0]]))  # now of deviation 3.5
    assert normalizer.normalize(np.array([11.0])) == pytest.approx([7.0 / 12.5**0.5])
    other.normalize(np.array([4.0]))
    other.load_state_dict(normalizer.state_dict())
    assert other.normalize(np.array([11.0])) == normalizer.normalize(np.array([11.0]))


def test_a_feature_that_never_moves_is_zero():
    normalizer = ObservationNormalizer(1)
    normalizer.update(np.full((3, 1), 8.0))
    assert normalizer.normalize(np.array([8.0])).tolist() == [0.0]


def test_statistics_are_those_of_every_observation_shown_once_over_all_environments():
    inner = Spy(3)
    envs = NormalizeObservation(inner)
    observations, *_ = play(envs, 40)
    seen = np.concatenate(inner.shown).astype(np.float64)
    assert envs.normalizer.count == len(seen) == 3 * 41
    np.testing.assert_allclose(envs.normalizer.mean, seen.mean(axis=0), rtol=1e-9)
    np.testing.assert_array_equal(observations, envs.normalizer.normalize(inner.shown[-1]))
    assert observations.dtype == np.float32
    assert envs.observation_space.contains(observations)


def test_last_observations_of_episodes_are_normalised_without_being_counted():
    inner = Spy(3)
    envs = NormalizeObservation(inner)
    envs.reset(seed=5)
    endings = 0
    for _ in range(30):
        *_, infos = envs.step(np.zeros(3, np.int64))
        for i, final in inner.final.items():
            np.testing.assert_array_equal(infos["final_obs"][i], envs.normalizer.normalize(final))
            assert infos["_final_obs"][i]
            endings += 1
    assert endings > 3
    assert envs.normalizer.count == 3 * 31


def test_frozen_statistics_do_not_move():
    envs = NormalizeObservation(ToyGrid(2))
    play(envs, 5)
    before = envs.normaliser_hash
    envs.freeze()
    play(envs, 5)
    assert envs.normaliser_hash == before
    assert envs.normalizer.frozen


def test_the_hash_tells_statistics_apart():
    envs = NormalizeObservation(ToyGrid(2))
    play(envs, 5)
    before = envs.normaliser_hash
    envs.step(np.zeros(2, np.int64))
    assert envs.normaliser_hash != before


def test_a_restored_wrapper_goes_on_where_the_saved_one_was():
    envs = NormalizeObservation(ToyGrid(2))
    observations, *_ = play(envs, 7)
    restored = NormalizeObservation(ToyGrid(2))
    again, _ = restored.load_state_dict(envs.state_dict())
    np.testing.assert_array_equal(again, observations)
    assert restored.normaliser_hash == envs.normaliser_hash
    np.testing.assert_array_equal(restored.action_masks(), envs.action_masks())
    for mine, theirs in zip(
        restored.step(np.zeros(2, np.int64))[:4], envs.step(np.zeros(2, np.int64))[:4], strict=True
    ):
        np.testing.assert_array_equal(mine, theirs)


def test_a_saved_state_is_a_copy():
    envs = NormalizeObservation(ToyGrid(2))
    play(envs, 3)
    state = envs.state_dict()["normalizer"]
    mean = state["mean"].copy()
    play(envs, 3)
    np.testing.assert_array_equal(state["mean"], mean)


def test_observations_that_are_no_vectors_are_refused():
    inner = ToyGrid(2)
    inner.single_observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2, 2), np.float32)
    with pytest.raises(UsageError, match="flat"):
        NormalizeObservation(inner)
