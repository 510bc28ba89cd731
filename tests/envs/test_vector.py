"""The vector environment of the reference engine plays what single environments play, in any number of processes."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from returned import assert_same, copied, put_together, with_ending

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.envs.vector import PowerGridVectorEnv
from rl2grid.errors import UsageError

KEYWORDS = {"engine": "reference", "gamma": 0.99}
STEPS = 40


def make_vector(num_envs, num_workers, task_id="rl2grid/bus14-T0-v0", **keywords):
    return gymnasium.make_vec(task_id, num_envs=num_envs, num_workers=num_workers, **KEYWORDS | keywords)


def actions_of(step, num_envs):
    return np.random.default_rng(step).integers(50, size=num_envs)


def play(vector, steps):
    """Everything that a vector returns over some steps of a fixed sequence of actions."""
    observations = [vector.reset(seed=5)[0]]
    rewards, ends, infos = [], [], []
    for step in range(steps):
        observation, reward, terminated, truncated, info = vector.step(actions_of(step, vector.num_envs))
        observations.append(observation)
        rewards.append(reward)
        ends.append(terminated | truncated)
        infos.append(info)
    return np.array(observations), np.array(rewards), np.array(ends), infos


def test_made_by_gymnasium_with_autoreset_in_the_same_step():
    vector = make_vector(2, 0)
    assert vector.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    assert vector.observation_space.shape == (2, *vector.single_observation_space.shape)
    vector.close()


def test_batch_size_does_not_matter():
    more, fewer = make_vector(3, 0), make_vector(2, 0)
    observations = play(more, STEPS)[0]
    fewer.reset(seed=5)
    for step in range(STEPS):
        observation = fewer.step(actions_of(step, 3)[:2])[0]
        np.testing.assert_array_equal(observation, observations[step + 1, :2])
    more.close()
    fewer.close()


def test_workers_play_refuse_and_come_back_as_one_process_does():
    """One test, since every worker loads Grid2Op anew, which takes some seconds."""
    inside, workers = make_vector(3, 0), make_vector(3, 2)
    a, b = play(inside, STEPS), play(workers, STEPS)
    for x, y in zip(a[:3], b[:3], strict=True):
        np.testing.assert_array_equal(x, y)
    assert a[2].any(), "no episode ended: the test did not see an autoreset"
    assert_same(copied(b[3]), copied(a[3]))

    with pytest.raises(UsageError, match="is not in the split train of bus14: choose one such as"):
        workers.reset(options={"scenario": "no such month"})
    np.testing.assert_array_equal(workers.reset(seed=1)[0], inside.reset(seed=1)[0])  # they still answer

    for step in range(6):
        inside.step(actions_of(step, 3))
    assert_same_steps(inside, workers, inside.state_dict())
    world = inside.save(0)
    restored, _ = workers.restore(2, world)
    np.testing.assert_array_equal(restored, inside.restore(2, world)[0])
    assert workers.save(2) == world
    with pytest.raises(UsageError, match='choose engine="native"'):
        workers.imagine(0, 0)

    workers.unwrapped._rows._workers[0]._process.kill()
    with pytest.raises(RuntimeError, match="died"):
        workers.step([0, 0, 0])
    inside.close()
    workers.close()


def assert_same_steps(straight, resumed, saved):
    """What follows a state that was saved and loaded is what follows it where it was saved."""
    resumed.load_state_dict(saved)
    for step in range(6, 14):
        actions = actions_of(step, straight.num_envs)
        a, b = straight.step(actions), resumed.step(actions)
        for x, y in zip(a[:4], b[:4], strict=True):
            np.testing.assert_array_equal(x, y)
        np.testing.assert_array_equal(a[4]["grid_steps"], b[4]["grid_steps"])


def test_equals_single_environments_put_together_by_gymnasium():
    vector = make_vector(2, 0)
    singles = [gymnasium.make("rl2grid/bus14-T0-v0", **KEYWORDS) for _ in range(2)]
    observations, infos = vector.reset(seed=[5, 5])  # alike as long as they are asked the same
    begun = [single.reset(seed=5) for single in singles]
    np.testing.assert_array_equal(observations, [one[0] for one in begun])
    assert_same(copied(infos), put_together([one[1] for one in begun]))
    ends = []
    for step in range(STEPS):
        actions = actions_of(step, 2)
        actions[1] = actions[0 if step < STEPS // 2 else 1]
        played = []
        for action, single in zip(actions, singles, strict=True):
            observation, reward, terminated, truncated, info = single.step(int(action))
            if terminated or truncated:
                last, (observation, begun) = observation, single.reset()
                info = with_ending(begun, last, info)
            played.append((observation, reward, terminated, truncated, info))
        *theirs, their_infos = zip(*played, strict=True)
        *mine, infos = vector.step(actions)
        for array, values in zip(mine, theirs, strict=True):
            np.testing.assert_array_equal(array, values)
        assert_same(copied(infos), put_together(their_infos), f"{step}")
        ends.append(int(np.sum(mine[2] | mine[3])))
    assert {0, 1, 2} <= set(ends), "the test did not see one autoreset, both and none"
    for environment in (vector, *singles):
        environment.close()


def test_state_is_restored_by_playing_again():
    straight, resumed = make_vector(2, 0), make_vector(2, 0)
    straight.reset(seed=1)
    for step in range(6):
        straight.step(actions_of(step, 2))
    assert_same_steps(straight, resumed, straight.state_dict())
    straight.close()
    resumed.close()


def test_masks_are_those_of_the_rules():
    vector = make_vector(2, 0, "rl2grid/bus36-M-T0-v0")
    vector.reset(seed=0)
    assert vector.action_masks().all()
    vector.step([1, 0])
    masks = vector.action_masks()
    assert not masks[0].all()
    assert masks[0, 0]
    assert masks[1].all()
    vector.close()


def test_refused_action_steps_no_environment():
    vector = make_vector(2, 0)
    vector.reset(seed=0)
    before = vector.state_dict()
    with pytest.raises(UsageError, match="from 0 to 49"):
        vector.step([0, 50])
    assert vector.state_dict() == before
    with pytest.raises(UsageError, match="give one each"):
        vector.step([0])
    vector.close()


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"num_envs": 0}, "num_envs=0 is not allowed"),
        ({"num_envs": 2, "num_workers": -1}, "num_workers=-1 is not allowed"),
        ({"num_envs": 2, "num_threads": 2}, "num_threads=2 is not for engine='reference': give num_workers"),
    ],
)
def test_wrong_sizes_are_refused(keywords, message):
    with pytest.raises(UsageError, match=message):
        PowerGridVectorEnv("rl2grid/bus14-T0-v0", engine="reference", **keywords)


@pytest.mark.parametrize("seed", [-1, 1.5, "1", (1, 2), [1, -5], [1, "a"]])
def test_what_is_no_seed_is_refused(seed):
    envs = gymnasium.make_vec("rl2grid/bus14-T0-v0", num_envs=2)
    with pytest.raises(UsageError, match="give an integer that is not negative, or a list of one each"):
        envs.reset(seed=seed)
    envs.close()
