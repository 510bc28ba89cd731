"""The folder of an evaluation, written so that a kill at any moment loses at most the episodes that are under way.

::

    evaluation.json          identity, request, command; the aggregates once it is complete
    episodes.partial.csv     while it runs: the rows finished so far
    episodes.csv             all rows, in the order of scenarios, then seeds
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import BaseFileLock

from rl2grid.errors import UsageError
from rl2grid.records.episodes import EPISODES_FILE, Episode, format_row, read_episodes, write_episodes
from rl2grid.records.evaluations import EVALUATION_FILE, read_request, write_evaluation
from rl2grid.records.files import check_folder, make_folder
from rl2grid.records.locks import LockedError, take_lock
from rl2grid.records.summary import Summary, summarise

PARTIAL_FILE = "episodes.partial.csv"


class Store:
    """Where finished rows go; this one forgets them."""

    episodes: tuple[Episode, ...] = ()
    """Rows of an earlier, interrupted call."""

    def add(self, episode: Episode) -> None:
        """Keep a finished row."""

    def finish(self, episodes: tuple[Episode, ...]) -> None:
        """Keep the complete list."""

    def close(self) -> None:
        """Let others write."""


class FolderStore(Store):
    """Keeps rows in a folder, which is not made before the first of them."""

    def __init__(self, folder: Path, request: Mapping[str, Any], command: str) -> None:
        self._folder, self._request, self._command = folder, request, command
        self._finished, self._partial = folder / EPISODES_FILE, folder / PARTIAL_FILE
        self._lock: BaseFileLock | None = None
        if not folder.exists():
            check_folder(folder)
            return
        if not folder.is_dir():
            raise UsageError(f"{folder} is a file: give a folder to store the evaluation in.")
        self._take_lock()
        try:
            self.episodes = self._stored_episodes()
        except BaseException:
            self.close()
            raise

    def add(self, episode: Episode) -> None:
        if self._lock is None:
            make_folder(self._folder)
            self._take_lock()
            self._check_still_unused()
        if not self._partial.exists():
            self._describe(None)
            write_episodes(self._partial, self.episodes)
        with self._partial.open("a", encoding="utf-8", newline="") as file:
            file.write(format_row(episode))

    def finish(self, episodes: tuple[Episode, ...]) -> None:
        write_episodes(self._finished, episodes)
        self._describe(summarise(episodes))
        self._partial.unlink(missing_ok=True)

    def close(self) -> None:
        if self._lock is not None:
            self._lock.release()

    def _stored_episodes(self) -> tuple[Episode, ...]:
        if not (self._folder / EVALUATION_FILE).exists():
            return ()
        _check_same_request(self._folder, self._request)
        if self._finished.exists():
            return read_episodes(self._finished)
        if not self._partial.exists():
            return ()
        episodes = read_episodes(self._partial)
        # Without the torn line that a kill may have left at the end.
        write_episodes(self._partial, episodes)
        return episodes

    def _check_still_unused(self) -> None:
        """Refuse what another process wrote since this evaluation began, when there was no folder."""
        if not (self._folder / EVALUATION_FILE).exists():
            return
        _check_same_request(self._folder, self._request)
        raise UsageError(
            f"Another process wrote this evaluation to {self._folder} meanwhile: ask again to go on with what it wrote."
        )

    def _describe(self, summary: Summary | None) -> None:
        write_evaluation(self._folder / EVALUATION_FILE, {**self._request, "command": self._command}, summary)

    def _take_lock(self) -> None:
        try:
            self._lock = take_lock(self._folder)
        except LockedError:
            raise UsageError(
                f"Another process is writing to {self._folder}: wait for it, or choose another folder."
            ) from None


def _check_same_request(folder: Path, request: Mapping[str, Any]) -> None:
    stored = read_request(folder / EVALUATION_FILE)
    mine, theirs = request["identity"], stored["identity"]
    differing = [key for key in {**theirs, **mine} if _plain(mine.get(key)) != theirs.get(key)]
    if not differing and stored["jobs"] != request["jobs"]:
        differing = ["scenarios or seeds"]
    if differing:
        raise UsageError(
            f"{folder} holds another evaluation, with a different {differing[0]}: choose another folder, or remove it."
        )


def _plain(value: Any) -> Any:
    """A value as JSON gives it back."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


@contextmanager
def open_store(folder: Path | None, request: Mapping[str, Any], command: str) -> Iterator[Store]:
    """Where the rows of an evaluation go.

    Args:
        folder: of the evaluation; None: nothing is stored.
        request: ``identity``, ``identity_hash`` and ``jobs``.
        command: what to type to obtain the result again.

    Raises:
        UsageError: the folder holds another evaluation, cannot be made, or another process writes to it.
    """
    store = Store() if folder is None else FolderStore(folder, request, command)
    try:
        yield store
    finally:
        store.close()
