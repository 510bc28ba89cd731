"""The replay memory: what comes out is what went in, by index, by seed, and after any interruption."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rl2grid.algorithms.checkpoint import load_checkpoint, save_checkpoint
from rl2grid.algorithms.replay import Minibatch, ReplayMemory, Step, computer_memory
from rl2grid.errors import UsageError

ENVS, SIZE, ACTIONS = 3, 5, 11
IN_MEMORY, MAPPED = 10**12, 0
STORAGE = pytest.mark.parametrize("memory_bytes", [IN_MEMORY, MAPPED], ids=["memory", "mapped"])


def memory(
    folder: Path | None = None, *, rows: int = 40, memory_bytes: int = IN_MEMORY, **changes: Any
) -> ReplayMemory:
    settings = {
        "num_envs": ENVS,
        "observation_size": SIZE,
        "action_dimensions": None,
        "masked_actions": ACTIONS,
        "max_transitions": rows * ENVS,
        "max_bytes": 10**9,
        "memory_bytes": memory_bytes,
        "seed": 1,
        **changes,
    }
    made = ReplayMemory(**settings)
    if folder is not None:
        made.store_in(folder)
    return made


def step(t: int, *, continuous: bool = False) -> Step:
    """Step ``t`` of a game in which every number tells its row and its environment."""
    random = np.random.Generator(np.random.Philox(key=[7, t]))
    ended = random.uniform(size=ENVS) < 0.3
    terminated = ended & (random.uniform(size=ENVS) < 0.5)
    masks = random.uniform(size=(ENVS, ACTIONS)) < 0.5
    return Step(
        observations=observation(t, np.arange(ENVS)),
        masks=None if continuous else masks,
        actions=random.uniform(-1, 1, (ENVS, 2)).astype(np.float32)
        if continuous
        else random.integers(0, ACTIONS, ENVS),
        rewards=random.normal(size=ENVS),
        discounts=np.where(terminated, 0.0, 0.9 ** random.integers(1, 5, ENVS)),
        ended=ended,
        decided=random.uniform(size=ENVS) < 0.8,
        last_observations={i: -observation(t, np.array([i]))[0] for i in np.flatnonzero(ended & ~terminated).tolist()},
    )


def observation(t: int, i: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return np.stack([np.full(len(i), t), i, *np.zeros((SIZE - 2, len(i)))], axis=1).astype(np.float32)


def fill(memory: ReplayMemory, first: int, past: int) -> None:
    for t in range(first, past):
        memory.add(step(t))


def assert_same(mine: Minibatch, theirs: Minibatch) -> None:
    for one, other in zip(mine, theirs, strict=True):
        np.testing.assert_array_equal(one, other)


@STORAGE
@pytest.mark.parametrize("past", [2, 30, 41, 500])
def test_a_minibatch_holds_transitions_as_they_were(tmp_path: Path, memory_bytes: int, past: int):
    replay = memory(tmp_path, memory_bytes=memory_bytes)
    fill(replay, 0, past)
    batch = replay.draw(2000)
    assert batch.masks is not None
    assert batch.next_masks is not None
    seen = set()
    for k in range(2000):
        t, i = int(batch.observations[k, 0]), int(batch.observations[k, 1])
        played, following = step(t), step(t + 1)
        seen.add((t, i))
        assert played.decided[i]
        assert batch.actions[k] == played.actions[i]
        assert batch.rewards[k] == np.float32(played.rewards[i])
        assert batch.discounts[k] == np.float32(played.discounts[i])
        np.testing.assert_array_equal(batch.masks[k], played.masks[i])  # type: ignore[index]
        if not played.ended[i]:
            np.testing.assert_array_equal(batch.next_observations[k], following.observations[i])
            np.testing.assert_array_equal(batch.next_masks[k], following.masks[i])  # type: ignore[index]
            continue
        np.testing.assert_array_equal(batch.next_observations[k], played.last_observations.get(i, np.zeros(SIZE)))
        np.testing.assert_array_equal(batch.next_masks[k], played.masks[i])  # type: ignore[index]
    # The newest row waits for its successor, the oldest ones are forgotten; all others are drawn.
    window = range(max(0, past - replay.window_rows), past - 1)
    assert seen == {(t, i) for t in window for i in range(ENVS) if step(t).decided[i]}
    assert len(replay) == len(seen)


def test_transitions_are_drawn_uniformly():
    replay = memory()
    fill(replay, 0, 100)
    drawn = replay.draw(40_000).observations
    counts = np.unique(drawn[:, :2], axis=0, return_counts=True)[1]
    expected = 40_000 / len(replay)
    chi_squared = float(np.square(counts - expected).sum() / expected)
    # Mean and deviation of the chi-squared distribution with that many degrees of freedom.
    assert abs(chi_squared - len(replay)) < 5 * np.sqrt(2 * len(replay))


def test_minibatches_are_a_function_of_the_seed():
    replays = [memory(seed=seed) for seed in (1, 1, 2)]
    for replay in replays:
        fill(replay, 0, 30)
    first = [replay.draw(50) for replay in replays]
    assert_same(first[0], first[1])
    assert not np.array_equal(first[0].observations, first[2].observations)
    assert not np.array_equal(first[0].observations, replays[0].draw(50).observations)


def test_continuous_actions_and_no_masks():
    replay = memory(action_dimensions=2, masked_actions=None)
    for t in range(10):
        replay.add(step(t, continuous=True))
    batch = replay.draw(50)
    assert batch.masks is None
    assert batch.next_masks is None
    for k in range(50):
        t, i = batch.observations[k, :2].astype(int)
        np.testing.assert_array_equal(batch.actions[k], step(int(t), continuous=True).actions[i])


# --- Size -----------------------------------------------------------------------------------------------------------


def test_each_observation_is_held_once_and_the_bytes_are_kept_to():
    """A million transitions of 1,500 features: two observations each would take 12 GB."""
    replay = memory(
        num_envs=50, observation_size=1500, masked_actions=None, max_transitions=10**6, max_bytes=10**10, memory_bytes=0
    )
    assert replay.capacity == 10**6
    assert replay.record.itemsize <= 1500 * 4 + 16
    smaller = memory(max_transitions=10**6, max_bytes=100_000)
    fill(smaller, 0, 3000)
    assert smaller.bytes <= 100_000
    assert sum(segment.data.nbytes for segment in smaller._segments.values()) <= 100_000
    assert smaller.capacity * smaller.record.itemsize > 90_000


def test_a_memory_too_small_is_refused():
    with pytest.raises(UsageError, match=r"too small for two steps of 3 environments: give it at least \d+ bytes"):
        memory(max_bytes=200)
    with pytest.raises(UsageError, match="and 6 transitions"):
        memory(rows=1)


def test_large_memories_are_files(tmp_path: Path):
    assert memory(memory_bytes=10).mapped
    assert not memory(memory_bytes=10**6).mapped
    with pytest.raises(UsageError, match="name their folder"):
        fill(memory(memory_bytes=10), 0, 1)
    replay = memory(tmp_path, memory_bytes=10)
    fill(replay, 0, 1)
    assert isinstance(replay._segments[0].data, np.memmap)
    assert 2**28 < computer_memory() < 2**50


# --- Going on -------------------------------------------------------------------------------------------------------


def through_file(state: dict[str, Any], folder: Path) -> Any:
    """The state as a checkpoint gives it back; nothing in it may need code to be loaded."""
    folder.mkdir(exist_ok=True)
    save_checkpoint(folder / "c.pt", {"task": "t", "memory": state})
    return load_checkpoint(folder / "c.pt")["memory"]


@pytest.mark.parametrize("past", [1, 2, 3, 35, 200])
def test_without_a_folder_the_state_holds_everything(tmp_path: Path, past: int):
    replay, resumed = memory(), memory()
    fill(replay, 0, past)
    if len(replay):
        replay.draw(5)
    resumed.load_state_dict(through_file(replay.state_dict(), tmp_path))
    for one in (replay, resumed):
        fill(one, past, past + 20)
    assert len(replay) == len(resumed)
    for _ in range(3):
        assert_same(replay.draw(100), resumed.draw(100))


@pytest.mark.parametrize("stop", [3, 55, 183])
@pytest.mark.parametrize("lost", [1, 17, 90])
@pytest.mark.parametrize(("before", "after"), [(IN_MEMORY, IN_MEMORY), (MAPPED, MAPPED), (MAPPED, IN_MEMORY)])
def test_what_was_played_after_the_checkpoint_is_forgotten(
    tmp_path: Path, stop: int, lost: int, before: int, after: int
):
    """The killed process went on, around the window and over, before it was killed: the files know, we may not."""
    straight = memory(rows=160)
    fill(straight, 0, stop)
    killed = memory(tmp_path / "replay", rows=160, memory_bytes=before)
    for t in range(stop):
        if t % 10 == 9:
            killed.state_dict()
        killed.add(step(t))
    state = through_file(killed.state_dict(), tmp_path / "state")
    for t in range(stop, stop + lost):
        killed.add(step(10_000 + t))  # what must not come back
        if t == stop + lost // 2:
            killed.state_dict()  # written, but killed before the checkpoint was renamed
    del killed
    resumed = memory(tmp_path / "replay", rows=160, memory_bytes=after)
    resumed.load_state_dict(state)
    for one in (straight, resumed):
        fill(one, stop, stop + 30)
        one.batches = 5
    for _ in range(3):
        assert_same(straight.draw(300), resumed.draw(300))


@STORAGE
def test_half_written_files_do_no_harm(tmp_path: Path, memory_bytes: int):
    straight = memory(tmp_path / "straight")
    fill(straight, 0, 33)
    replay = memory(tmp_path / "replay", memory_bytes=memory_bytes)
    fill(replay, 0, 33)
    state = replay.state_dict()
    del replay
    for path in (tmp_path / "replay").iterdir():
        with path.open("ab") as file:
            file.write(b"\x01" * 13)
    resumed = memory(tmp_path / "replay", memory_bytes=memory_bytes)
    resumed.load_state_dict(state)
    for one in (straight, resumed):
        fill(one, 33, 60)
    assert_same(straight.draw(300), resumed.draw(300))
    again = memory(tmp_path / "replay", memory_bytes=memory_bytes)
    again.load_state_dict(resumed.state_dict())
    assert_same(straight.draw(300), again.draw(300))


@STORAGE
def test_files_with_a_flipped_bit_are_refused(tmp_path: Path, memory_bytes: int):
    replay = memory(tmp_path, memory_bytes=memory_bytes)
    fill(replay, 0, 33)
    state = replay.state_dict()
    del replay
    files = [path for path in sorted(tmp_path.iterdir()) if path.stat().st_size]
    assert {path.suffix for path in files} == {".rows", ".last"}
    for path in files:
        content = path.read_bytes()
        path.write_bytes(bytes([content[0] ^ 4]) + content[1:])
        with pytest.raises(UsageError, match="was changed since it was written"):
            memory(tmp_path, memory_bytes=memory_bytes).load_state_dict(state)
        path.write_bytes(content)
    memory(tmp_path, memory_bytes=memory_bytes).load_state_dict(state)


def test_a_full_disk_is_said_before_a_mapped_file_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def full(number: int, begin: int, size: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(OSError, match="No space left"):
        memory(tmp_path, memory_bytes=0).add(step(0))


def test_a_checkpoint_appends_what_is_new_and_removes_what_nobody_needs(tmp_path: Path, monkeypatch: Any):
    written = []
    from rl2grid.algorithms import replay as module

    write = module._write_at
    monkeypatch.setattr(
        module, "_write_at", lambda p, at, content: (written.append(len(content)), write(p, at, content))
    )
    replay = memory(tmp_path, rows=64)
    row_bytes = replay.record.itemsize * ENVS
    for t in range(400):
        replay.add(step(t))
        if t % 20 == 19:
            written.clear()
            replay.state_dict()
            new_last = sum(len(step(k).last_observations) for k in range(t - 19, t + 1))
            assert sum(written) == 20 * row_bytes + new_last * replay._last_record.itemsize
    segments = sorted(int(path.stem) for path in tmp_path.glob("*.rows"))
    # Needed: the 64 rows before the previous checkpoint, at row 380.
    assert segments == list(range((380 - replay.window_rows) // replay.segment_rows, -(-400 // replay.segment_rows)))
    assert replay.state_dict().keys() == {"layout", "rows", "batches", "sums"}


def test_the_checkpoint_before_the_last_can_be_resumed_too(tmp_path: Path):
    """A kill between writing the memory's files and renaming the checkpoint leaves the older checkpoint."""
    replay, straight = memory(tmp_path / "a"), memory()
    fill(replay, 0, 100)
    older = replay.state_dict()
    fill(replay, 100, 200)
    replay.state_dict()
    fill(straight, 0, 100)
    resumed = memory(tmp_path / "a")
    resumed.load_state_dict(older)
    assert_same(straight.draw(500), resumed.draw(500))


def test_missing_files_and_other_memories_are_refused(tmp_path: Path):
    replay = memory(tmp_path)
    fill(replay, 0, 30)
    state = replay.state_dict()
    with pytest.raises(UsageError, match="another size or layout"):
        memory(tmp_path, rows=50).load_state_dict(state)
    (tmp_path / "000003.rows").write_bytes(b"")
    with pytest.raises(UsageError, match=r"000003\.rows' is missing or too short"):
        memory(tmp_path).load_state_dict(state)
    shutil.rmtree(tmp_path)
    with pytest.raises(UsageError, match="is missing or too short"):
        memory(tmp_path).load_state_dict(state)
