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
from rl2grid.records.episodes import COLUMN_NAMES, EPISODES_FILE, Episode, format_row, parse_episodes, write_episodes
from rl2grid.records.evaluations import EVALUATION_FILE, read_description, read_finished, write_evaluation
from rl2grid.records.files import (
    CHECKSUM,
    check_folder,
    check_own,
    make_folder,
    opened_line,
    read_text,
    sealed_line,
    set_aside,
    write_text,
)
from rl2grid.records.locks import LockedError, take_lock
from rl2grid.records.summary import Summary, summarise

PARTIAL_FILE = "episodes.partial.csv"


_PARTIAL_HEADER = ",".join((*COLUMN_NAMES, CHECKSUM))


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
        check_own(folder, (EVALUATION_FILE,), "evaluation")
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
            self._begin_partial()
        with self._partial.open("a", encoding="utf-8", newline="") as file:
            file.write(_sealed_row(episode))

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
        description = read_description(self._folder)
        _check_same_request(self._folder, description.request, self._request)
        # A kill may have come between the rows and the description that vouches for them.
        if self._finished.exists() and description.complete:
            return read_finished(self._folder, description)
        if not self._partial.exists():
            return ()
        self.episodes = self._partial_episodes()
        # Without the torn line that a kill may have left at the end.
        self._begin_partial()
        return self.episodes

    def _partial_episodes(self) -> tuple[Episode, ...]:
        """The rows that are whole and of this evaluation; others are played again."""
        text = read_text(self._partial, "a file of episodes", "remove it, and they are played again")
        head, *lines = text[: text.rfind("\n") + 1].splitlines() or [""]
        rows = [opened_line(line) for line in lines] if head == _PARTIAL_HEADER else [None]
        whole = parse_episodes(self._partial, [row for row in rows if row is not None])
        own = tuple(row for row in whole if row.identity == self._request.get("identity_hash", row.identity))
        if len(own) < len(rows):
            words = f"{len(own)} of its rows are whole and of this evaluation, others are played again"
            set_aside(self._partial, f"{self._partial} was damaged: {words}")
        return own

    def _begin_partial(self) -> None:
        write_text(self._partial, f"{_PARTIAL_HEADER}\n{''.join(map(_sealed_row, self.episodes))}")

    def _check_still_unused(self) -> None:
        """Refuse what another process wrote since this evaluation began, when there was no folder."""
        if not (self._folder / EVALUATION_FILE).exists():
            return
        _check_same_request(self._folder, read_description(self._folder).request, self._request)
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


def _sealed_row(episode: Episode) -> str:
    return sealed_line(format_row(episode).removesuffix("\n")) + "\n"


def _check_same_request(folder: Path, stored: Mapping[str, Any], request: Mapping[str, Any]) -> None:
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
