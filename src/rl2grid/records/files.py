"""Files that are written whole or not at all, and folders to write them to."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from rl2grid.errors import UsageError


def write_text(path: Path, text: str) -> None:
    """Write a file in the place of an earlier one; several processes may do so at once."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    temporary.write_text(text, encoding="utf-8", newline="\n")
    os.replace(temporary, path)


def write_json(path: Path, value: Any, *, indent: int | None = 2) -> None:
    """Write a value as JSON, with a line feed at the end; see :func:`write_text`."""
    write_text(path, json.dumps(value, indent=indent) + "\n")


def make_folder(path: Path) -> None:
    """Make a folder, and those above it, that may exist already.

    Raises:
        UsageError: it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _cannot_be_made(path, error.strerror) from None


def check_folder(path: Path) -> None:
    """Look whether a folder that does not exist yet could be made, without making it.

    Raises:
        UsageError: it could not.
    """
    # os.path: unlike Path.exists, it does not raise below a folder that may not be read.
    above = next(parent for parent in path.absolute().parents if os.path.exists(parent))
    if not above.is_dir():
        raise _cannot_be_made(path, f"{above} is no folder")
    if not os.access(above, os.W_OK | os.X_OK):
        raise _cannot_be_made(path, f"{above} may not be written")


def _cannot_be_made(path: Path, reason: str | None) -> UsageError:
    return UsageError(f"Folder {path} cannot be made: {reason}.")
