"""Replay memory: what a vector environment played, every observation held once, resumable bit by bit.

Layout
    A *row* is one step of all environments; the transition of row t in environment i has the index
    ``t * num_envs + i``. A transition holds its observation, the legal actions (one bit each), the action, the
    reward and the discount of what follows. The next observation is that of row t + 1; only where an episode
    was truncated, whose last observation nobody acts on, it is kept aside. A transition can be drawn once the
    row behind it is there. The memory remembers the latest ``capacity`` transitions.

Files
    Rows are grouped in *segments*, one file each, that are only ever appended to and removed as a whole, and
    not before two checkpoints can do without them. Saving writes what is new since the last time; whatever
    lies behind the number of rows that a checkpoint names is ignored, and written again, when a run goes on
    from it. So a kill at any moment, the middle of a write included, loses nothing. Small memories are kept in
    the computer's memory and appended to the files when a checkpoint asks for it; large ones are memory-mapped files.

Randomness
    The k-th minibatch is a pure function of (seed, k, contents): no state but k has to be saved.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import UsageError
from rl2grid.streams import Purpose, Stream

_SEGMENTS = 16
"""Segments that a full memory consists of: few, because a minibatch is gathered from each."""


class Step(NamedTuple):
    """One decision in every environment, and what came of it."""

    observations: NDArray[np.float32]
    """float32 [num_envs, size], as the environment gave them, before normalisation"""
    masks: NDArray[np.bool_] | None
    """bool [num_envs, actions], legal discrete actions"""
    actions: NDArray[Any]
    """int [num_envs], or float32 [num_envs, dimensions]"""
    rewards: NDArray[Any]
    """R_k [num_envs], scaled"""
    discounts: NDArray[Any]
    """gamma ** n_k [num_envs]; 0 where the episode was terminated"""
    ended: NDArray[np.bool_]
    """the episode ended with this transition [num_envs]"""
    decided: NDArray[np.bool_]
    """the action had an effect [num_envs]; other transitions are never drawn"""
    last_observations: Mapping[int, NDArray[np.float32]]
    """by environment, float32 [size]: last observations of truncated episodes"""


class Minibatch(NamedTuple):
    """Transitions drawn at random; every array is [batch, ...]."""

    observations: NDArray[np.float32]
    masks: NDArray[np.bool_] | None
    actions: NDArray[Any]
    rewards: NDArray[np.float32]
    discounts: NDArray[np.float32]
    next_observations: NDArray[np.float32]
    """zeros behind a termination, where the discount is 0"""
    next_masks: NDArray[np.bool_] | None
    """at the end of an episode, for which the environment tells none, the masks of its last decision"""


class ReplayMemory:
    """The latest transitions of a vector environment."""

    def __init__(
        self,
        *,
        num_envs: int,
        observation_size: int,
        action_dimensions: int | None,
        masked_actions: int | None,
        max_transitions: int,
        max_bytes: int,
        memory_bytes: int,
        seed: int,
    ) -> None:
        """An empty memory.

        Args:
            num_envs: Environments that are stepped together.
            observation_size: Features of an observation.
            action_dimensions: Of a continuous action; None: actions are ids.
            masked_actions: Number of actions that masks tell the legality of; None: there are no masks.
            max_transitions: Transitions to remember.
            max_bytes: Bytes that they may take; remembers fewer if need be.
            memory_bytes: A memory that takes more than this becomes memory-mapped files.
            seed: Of the minibatches.

        Raises:
            UsageError: two steps of all environments do not fit.
        """
        self.num_envs = num_envs
        self.seed = seed
        self._mask_size = masked_actions
        action = ("action", np.int32) if action_dimensions is None else ("action", np.float32, (action_dimensions,))
        self.record = np.dtype(
            [
                ("observation", np.float32, (observation_size,)),
                action,
                ("reward", np.float32),
                ("discount", np.float32),
                ("ended", np.bool_),
                ("decided", np.bool_),
                ("mask", np.uint8, (0 if masked_actions is None else -(-masked_actions // 8),)),
            ],
            align=True,
        )
        """One transition."""
        self._last_record = np.dtype([("index", np.int64), ("observation", np.float32, (observation_size,))])
        row_bytes = num_envs * self.record.itemsize
        rows = min(-(-max_transitions // num_envs), max_bytes // row_bytes)
        self.segment_rows = max(1, rows // _SEGMENTS)
        # One segment more than the window holds: the oldest and the newest are rarely both complete.
        self.window_rows = min(rows, max_bytes // row_bytes - self.segment_rows)
        if self.window_rows < 2:
            raise UsageError(
                f"A replay memory of {max_bytes} bytes and {max_transitions} transitions is too small for two steps of "
                f"{num_envs} environments: give it at least {3 * row_bytes} bytes and {2 * num_envs} transitions."
            )
        self.capacity = self.window_rows * num_envs
        """Transitions that are remembered."""
        self.bytes = (self.window_rows + self.segment_rows) * row_bytes
        """What a full memory takes."""
        self.mapped = self.bytes > memory_bytes
        """Whether it is memory-mapped files."""
        self.folder: Path | None = None
        self.rows = 0
        """Steps of all environments so far, forgotten ones included."""
        self.batches = 0
        """Minibatches drawn so far."""
        self._segments: dict[int, _Segment] = {}
        self._drawable = 0
        self._newest = 0
        self._saved_first = 0

    def __len__(self) -> int:
        """Number of transitions that can be drawn."""
        return self._drawable

    def store_in(self, folder: Path) -> None:
        """Keep the files there from now on; before the first step."""
        self.folder = folder

    def add(self, step: Step) -> None:
        """Remember a step, forget the oldest one when full.

        Raises:
            UsageError: the memory is to be memory-mapped files, and no folder was named.
        """
        number, row = divmod(self.rows, self.segment_rows)
        if row == 0:
            self._segments[number] = self._begun_segment(number)
        segment = self._segments[number]
        records = segment.data[row]
        records["observation"] = step.observations
        records["action"] = step.actions
        records["reward"] = step.rewards
        records["discount"] = step.discounts
        records["ended"] = step.ended
        records["decided"] = step.decided
        if step.masks is not None:
            records["mask"] = np.packbits(step.masks, axis=1)
        for i, observation in step.last_observations.items():
            segment.last[self.rows * self.num_envs + i] = np.array(observation, np.float32)
        self.rows += 1
        self._drawable += self._newest
        self._newest = int(np.count_nonzero(step.decided))
        self._forget()

    def draw(self, size: int) -> Minibatch:
        """``size`` transitions, uniformly and with replacement; needs ``len(self) > 0``."""
        stream = Stream(self.seed, self.batches, Purpose.AGENT)
        self.batches += 1
        first, past = self._first_row * self.num_envs, (self.rows - 1) * self.num_envs
        indices = np.empty(0, np.int64)
        records = np.empty(0, self.record)
        while len(indices) < size:
            drawn = first + (stream.uniform(size) * (past - first)).astype(np.int64)
            found = self._gather(drawn)
            indices = np.concatenate([indices, drawn[found["decided"]]])
            records = np.concatenate([records, found[found["decided"]]])
        return self._minibatch(indices[:size], records[:size])

    def state_dict(self) -> dict[str, Any]:
        """All of it: with a folder, the files hold the transitions, up to date when this returns.

        Files that neither this state nor the one returned before needs are removed.
        """
        state: dict[str, Any] = {"layout": self._layout(), "rows": self.rows, "batches": self.batches}
        if self.folder is None:
            state["segments"] = {number: self._segments[number].state_dict() for number in self._needed()}
            return state
        for segment in self._segments.values():
            segment.save(self._filled(segment.number))
        state["sums"] = {number: self._segments[number].sums for number in self._needed()}
        for path in self.folder.glob("*.*"):
            if path.stem.isdigit() and int(path.stem) < self._saved_first:
                path.unlink(missing_ok=True)
        self._saved_first = self._first_row // self.segment_rows
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Be what ``state_dict`` was called of, whatever the files have got since.

        Raises:
            UsageError: the files are not there, were changed, or are of another memory.
        """
        if state["layout"] != self._layout():
            raise UsageError("The replay memory of the checkpoint has another size or layout: it cannot be resumed.")
        self.rows, self.batches = state["rows"], state["batches"]
        self._segments = {}
        for number in self._needed():
            segment = self._segment(number)
            if self.folder is None:
                segment.load_state_dict(state["segments"][number])
            else:
                segment.load(self.folder, self._filled(number), self.rows * self.num_envs, mapped=self.mapped)
                segment.check(state.get("sums", {}).get(number, segment.sums))
            self._segments[number] = segment
        self._saved_first = self._first_row // self.segment_rows
        self._drawable = sum(
            int(np.count_nonzero(self._row(row)["decided"])) for row in range(self._first_row, self.rows - 1)
        )
        self._newest = int(np.count_nonzero(self._row(self.rows - 1)["decided"])) if self.rows else 0

    @property
    def _first_row(self) -> int:
        return max(0, self.rows - self.window_rows)

    def _needed(self) -> range:
        """Numbers of the segments that hold remembered rows."""
        return range(self._first_row // self.segment_rows, -(-self.rows // self.segment_rows))

    def _filled(self, number: int) -> int:
        """Rows of a segment that were written."""
        return min(self.rows - number * self.segment_rows, self.segment_rows)

    def _row(self, row: int) -> NDArray[Any]:
        number, within = divmod(row, self.segment_rows)
        records: NDArray[Any] = self._segments[number].data[within]
        return records

    def _forget(self) -> None:
        forgotten = self.rows - self.window_rows - 1
        if forgotten < 0:
            return
        self._drawable -= int(np.count_nonzero(self._row(forgotten)["decided"]))
        number, within = divmod(forgotten, self.segment_rows)
        if within == self.segment_rows - 1:
            del self._segments[number]

    def _segment(self, number: int) -> _Segment:
        return _Segment(number, (self.segment_rows, self.num_envs), self.record, self._last_record)

    def _begun_segment(self, number: int) -> _Segment:
        if self.mapped and self.folder is None:
            raise UsageError(
                f"A replay memory of {self.bytes} bytes is to be files: name their folder, lower buffer_bytes, "
                "or raise buffer_memory_share."
            )
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
        segment = self._segment(number)
        segment.begin(self.folder, mapped=self.mapped)
        return segment

    def _gather(self, indices: NDArray[np.int64]) -> NDArray[Any]:
        """Copies of the transitions with these indices [batch]."""
        length = self.segment_rows * self.num_envs
        numbers = indices // length
        gathered = np.empty((len(indices), self.record.itemsize), np.uint8)
        for number in np.unique(numbers).tolist():
            here = numbers == number
            gathered[here] = self._segments[number].bytes[indices[here] - number * length]
        return gathered.view(self.record)[:, 0]

    def _minibatch(self, indices: NDArray[np.int64], records: NDArray[Any]) -> Minibatch:
        following = self._gather(indices + self.num_envs)
        next_observations, next_masks = following["observation"], following["mask"]
        length = self.segment_rows * self.num_envs
        for k in np.flatnonzero(records["ended"]).tolist():
            index = int(indices[k])
            next_observations[k] = self._segments[index // length].last.get(index, 0.0)
            next_masks[k] = records["mask"][k]
        return Minibatch(
            records["observation"],
            self._unpacked(records["mask"]),
            records["action"],
            records["reward"],
            records["discount"],
            next_observations,
            self._unpacked(next_masks),
        )

    def _unpacked(self, masks: NDArray[np.uint8]) -> NDArray[np.bool_] | None:
        if self._mask_size is None:
            return None
        return np.unpackbits(masks, axis=1, count=self._mask_size).view(np.bool_)

    def _layout(self) -> dict[str, int]:
        """What two memories must have in common to read each other's files."""
        return {
            "num_envs": self.num_envs,
            "transition_bytes": self.record.itemsize,
            "segment_rows": self.segment_rows,
            "window_rows": self.window_rows,
            "seed": self.seed,
        }


class _Segment:
    """Some consecutive rows; ``data`` [rows, num_envs], and the last observations of truncated episodes by index."""

    def __init__(self, number: int, shape: tuple[int, int], record: np.dtype[Any], last_record: np.dtype[Any]) -> None:
        self.number = number
        self.last: dict[int, NDArray[np.float32]] = {}
        self._shape = shape
        self._record = record
        self._last_record = last_record
        self._row_bytes = shape[1] * record.itemsize
        self._saved_rows = self._saved_last = 0
        self._rows_sum = self._last_sum = 0

    def begin(self, folder: Path | None, *, mapped: bool) -> None:
        """Be empty, with files of its own if there is a folder."""
        if folder is not None:
            self._name_files(folder)
            self._path.write_bytes(b"")
            self._last_path.write_bytes(b"")
        self._allocate(mapped=mapped)

    def load(self, folder: Path, filled: int, past_index: int, *, mapped: bool) -> None:
        """Hold the first ``filled`` rows of the files, and the last observations of transitions before ``past_index``.

        Raises:
            UsageError: the files hold less.
        """
        self._name_files(folder)
        present = self._path.is_file() and self._last_path.is_file()
        if not present or self._path.stat().st_size < filled * self._row_bytes:
            raise UsageError(f"The replay file {str(self._path)!r} is missing or too short: the run cannot be resumed.")
        self._allocate(mapped=mapped)
        if not mapped:
            self.data[:filled] = np.fromfile(self._path, self._record, filled * self._shape[1]).reshape(filled, -1)
        self._add_last(self._last_path.read_bytes(), past_index)
        os.truncate(self._last_path, len(self.last) * self._last_record.itemsize)
        self._saved_rows, self._saved_last = filled, len(self.last)
        self._rows_sum = zlib.crc32(self._records(0, filled))
        self._last_sum = zlib.crc32(self._packed(list(self.last.items())))

    @property
    def sums(self) -> tuple[int, int]:
        """Checksums of what the files hold."""
        return self._rows_sum, self._last_sum

    def check(self, sums: Sequence[int]) -> None:
        """Refuse files that do not hold what was saved.

        Raises:
            UsageError: they were changed.
        """
        if tuple(sums) != self.sums:
            raise UsageError(
                f"The replay file {str(self._path)!r} was changed since it was written: the run cannot be resumed."
            )

    def save(self, filled: int) -> None:
        """Append to the files what they lack of the first ``filled`` rows; on disk when this returns."""
        if filled == self._saved_rows:
            return
        if isinstance(self.data, np.memmap):
            self.data.flush()
        else:
            _write_at(self._path, self._saved_rows * self._row_bytes, self.data[self._saved_rows : filled].tobytes())
        self._rows_sum = zlib.crc32(self._records(self._saved_rows, filled), self._rows_sum)
        self._saved_rows = filled
        new = list(self.last.items())[self._saved_last :]
        if new:
            content = self._packed(new)
            _write_at(self._last_path, self._saved_last * self._last_record.itemsize, content)
            self._last_sum = zlib.crc32(content, self._last_sum)
            self._saved_last = len(self.last)

    def state_dict(self) -> dict[str, Any]:
        """The contents as plain values."""
        return {
            "rows": self.bytes.copy(),
            "last": np.frombuffer(self._packed(list(self.last.items())), np.uint8).copy(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """The contents that ``state_dict`` returned."""
        self._allocate(mapped=False)
        self.bytes[:] = state["rows"]
        self._add_last(state["last"].tobytes(), None)

    def _name_files(self, folder: Path) -> None:
        self._path = folder / f"{self.number:06d}.rows"
        self._last_path = folder / f"{self.number:06d}.last"

    def _allocate(self, *, mapped: bool) -> None:
        if mapped:
            _reserve(self._path, self._shape[0] * self._row_bytes)
            self.data: NDArray[Any] = np.memmap(self._path, self._record, "r+", shape=self._shape)
        else:
            self.data = np.zeros(self._shape, self._record)
        # The same data as bytes [rows * num_envs, record], which are copied fastest.
        self.bytes = self.data.view(np.ndarray).reshape(-1).view(np.uint8).reshape(self.data.size, -1)

    def _records(self, first: int, past: int) -> memoryview:
        """The bytes of some rows."""
        return np.ascontiguousarray(self.bytes[first * self._shape[1] : past * self._shape[1]]).data

    def _packed(self, last: list[tuple[int, NDArray[np.float32]]]) -> bytes:
        return np.array(last, self._last_record).tobytes()

    def _add_last(self, content: bytes, past_index: int | None) -> None:
        count = len(content) // self._last_record.itemsize  # a kill may have left a part of one more
        for index, observation in np.frombuffer(content, self._last_record, count):
            if past_index is not None and index >= past_index:
                return
            self.last[int(index)] = observation.copy()


def _reserve(path: Path, size: int) -> None:
    """Give a file its full size on disk: writing to a mapped file on a full disk would kill the process."""
    with open(path, "r+b") as file:
        file.truncate(size)
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)


def _write_at(path: Path, position: int, content: bytes) -> None:
    with open(path, "r+b") as file:
        file.seek(position)
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def computer_memory() -> int:
    """Bytes of memory that this process may use: the computer's, or its container's limit."""
    return min(_memory_limits())


def _memory_limits() -> Iterator[int]:
    yield os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for path in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        try:
            text = Path(path).read_text(encoding="ascii").strip()
        except OSError:
            continue
        if text.isdigit():
            yield int(text)
