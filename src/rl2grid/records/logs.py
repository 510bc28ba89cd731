"""``log.txt``: what happened in a training run, and what the processes of a cell or a search printed."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TextIO

LOG_FILE = "log.txt"


def open_log(folder: Path) -> TextIO:
    """The log of a folder, to append to."""
    return (folder / LOG_FILE).open("a", encoding="utf-8")


def note(folder: Path, text: str) -> None:
    """Append a line with the time, in UTC, to the log of a folder."""
    with open_log(folder) as log:
        log.write(f"{datetime.now(UTC).isoformat(timespec='seconds')} {text}\n")


def last_line(folder: Path) -> str | None:
    """The last line in the log of a folder that is not empty; None without any."""
    path = folder / LOG_FILE
    lines = path.read_text(encoding="utf-8", errors="replace").split("\n") if path.exists() else []
    return next((line.strip() for line in reversed(lines) if line.strip()), None)
