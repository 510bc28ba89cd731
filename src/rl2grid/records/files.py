"""Files that are written whole or not at all, and read with one way to refuse what is not what it should be.

Everything stored carries a checksum. A JSON file has it as its last entry, :data:`CHECKSUM`; a line of a file that
grows ends with that of the line (:func:`sealed_line`); what another file belongs to names its SHA-256. A file without
one was written by hand, or its checksum was removed because a change was meant: that is allowed.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
import warnings
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rl2grid.errors import DamageWarning, UsageError

CHECKSUM = "checksum"
"""Entry of a JSON file, and name of the last column of a file that grows."""
NAME_BYTES = 120
"""Of a part of the name of a file; systems allow 255 for the whole name."""
MAX_BYTES = 2**28
"""Of a file of text: a larger one is none that was written here."""
DAMAGED = ".damaged"
"""Suffix of a file that was set aside."""

Shape = Any
"""What a value read from JSON must be: a type or a tuple of types; ``{key: shape}`` for an object that has at least
these entries; ``[shape]`` for a list of such."""


def write_text(path: Path, text: str) -> None:
    """Write a file in the place of an earlier one; several processes may do so at once."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, content: bytes) -> None:
    """:func:`write_text` for bytes. A disk that is full leaves nothing behind."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def write_json(path: Path, value: Any, *, indent: int | None = 2) -> None:
    """Write a value as JSON, with a line feed at the end; see :func:`write_text`."""
    write_text(path, json.dumps(value, indent=indent) + "\n")


def write_record(path: Path, value: dict[str, Any], *, indent: int | None = 2) -> None:
    """:func:`write_json` with a checksum, which :func:`read_json` verifies and takes off again."""
    write_json(path, {**value, CHECKSUM: checksum(value)}, indent=indent)


def checksum(value: Any) -> str:
    """Short hash of a value, as JSON has it, whatever the order of its entries."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def read_text(path: Path, what: str, remedy: str) -> str:
    """The text of a file.

    Args:
        path: the file.
        what: it is to be, as "a description of a run".
        remedy: what to do when it is not.

    Raises:
        UsageError: it cannot be read, is too large or not UTF-8.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise not_what(path, what, f"it is larger than {MAX_BYTES // 2**20} MiB", remedy)
        return content.decode("utf-8")
    except OSError as error:
        raise UsageError(f"{path} cannot be read as {what}: {error.strerror or error}.") from None
    except UnicodeDecodeError as error:
        raise not_what(path, what, f"byte {error.start} is no UTF-8", remedy) from None


def read_json(path: Path, what: str, remedy: str, shape: Shape = object) -> Any:
    """A value that was stored as JSON: nothing is taken from a file that is not what it should be.

    Args:
        path: the file.
        what: see :func:`read_text`.
        remedy: see there.
        shape: of the value.

    Raises:
        UsageError: see :func:`read_text`; or it is no JSON, nested too deeply, was changed, or has another shape.
    """
    value = parse_json(read_text(path, what, remedy), path, what, remedy)
    name = _name_of_checksum(value)
    if name is not None:
        stated = value.pop(name)
        if name != CHECKSUM or stated != checksum(value):
            raise not_what(
                path,
                what,
                f"it was changed since it was written (a change that is meant leaves {CHECKSUM!r} out)",
                remedy,
            )
    complaint = misfit(value, shape)
    if complaint:
        raise not_what(path, what, complaint, remedy)
    return value


def _name_of_checksum(value: Any) -> str | None:
    """The entry of an object that is its checksum; the last, if its name was damaged: a change removes it whole."""
    if not isinstance(value, dict) or not value:
        return None
    last = str(next(reversed(value)))
    alike = len(last) == len(CHECKSUM) and sum(map(str.__eq__, last, CHECKSUM)) >= len(CHECKSUM) // 2
    return last if alike else CHECKSUM if CHECKSUM in value else None


def parse_json(text: str, path: Path, what: str, remedy: str) -> Any:
    """A value of the JSON in ``text``, which stands in ``path``.

    Raises:
        UsageError: it is no JSON, or nested too deeply.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise not_what(path, what, "it is nested too deeply", remedy) from None
    except json.JSONDecodeError as error:
        why = f"line {error.lineno} is no JSON" if text.strip() else "it is empty"
        raise not_what(path, what, why, remedy) from None
    except ValueError:  # a number of thousands of digits
        raise not_what(path, what, "it holds a number that is too long", remedy) from None


def misfit(value: Any, shape: Shape, where: str = "") -> str | None:
    """What is wrong with a value of another shape, in words; None: nothing."""
    name = where or "what it holds"
    if isinstance(shape, dict):
        if not isinstance(value, dict):
            return f"{name} is no object"
        inside = [(f"{where}.{key}".lstrip("."), key, inner) for key, inner in shape.items()]
        missing = next((place for place, key, _ in inside if key not in value), None)
        if missing is not None:
            return f"{missing} is missing"
        return next(filter(None, (misfit(value[key], inner, place) for place, key, inner in inside)), None)
    if isinstance(shape, list):
        if not isinstance(value, list):
            return f"{name} is no list"
        (inner,) = shape
        return next(filter(None, (misfit(each, inner, f"{where}[{k}]") for k, each in enumerate(value))), None)
    types = shape if isinstance(shape, tuple) else (shape,)
    allowed = (*types, int) if float in types else types
    if isinstance(value, allowed) and (not isinstance(value, bool) or {bool, object} & set(types)):
        return None
    return f"{name} is {_shortened(value)}"


def not_what(path: Path, what: str, why: str, remedy: str) -> UsageError:
    """The refusal of a file, as a sentence."""
    return UsageError(f"{path} is no {what.removeprefix('a ').removeprefix('an ')}: {why}; {remedy}.")


def sealed_line(line: str) -> str:
    """A line of a file that grows, without its end, with its checksum behind a comma."""
    return f"{line},{zlib.crc32(line.encode()):08x}"


def opened_line(line: str) -> str | None:
    """The inverse of :func:`sealed_line`; None: it was changed."""
    content, _, stated = line.rpartition(",")
    return content if stated == f"{zlib.crc32(content.encode()):08x}" else None


def set_aside(path: Path, why: str) -> Path:
    """Rename a file that only decorates and is damaged, so that work can go on without it; warns.

    Returns:
        What it is called now.
    """
    names = (path.with_name(f"{path.name}{DAMAGED}{number or ''}") for number in range(sys.maxsize))
    kept = next(name for name in names if not name.exists())
    os.replace(path, kept)
    warnings.warn(f"{why.rstrip('.')}. It was set aside as {kept.name}.", DamageWarning, stacklevel=2)
    return kept


def printable(text: str) -> str:
    """A text without what would move a cursor, ring a bell, hide or turn other text: such letters become spaces."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def in_file_name(text: str) -> str:
    """A text as a part of the name of a file or folder: no separators, nothing that a shell or a terminal acts on.

    What is left out becomes hyphens, and of a long text there is its beginning, of at most :data:`NAME_BYTES`.
    """
    return re.sub(r"[^\w.+-]+", "-", text).encode()[:NAME_BYTES].decode(errors="ignore")


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
    """Look whether a folder is there or could be made, without making it.

    Raises:
        UsageError: neither.
    """
    # os.path: unlike Path.exists, it does not raise below a folder that may not be read.
    if os.path.exists(path):
        _refuse_file(path)
        return
    above = next(parent for parent in path.absolute().parents if os.path.exists(parent))
    if not above.is_dir():
        raise _cannot_be_made(path, f"{above} is no folder")
    if not os.access(above, os.W_OK | os.X_OK):
        raise _cannot_be_made(path, f"{above} may not be written")


def _refuse_file(path: Path) -> None:
    if not path.is_dir():
        raise UsageError(f"{path} is a file: give a folder.")


def check_own(folder: Path, marks: Sequence[str], what: str) -> None:
    """Refuse to write among the files of somebody else.

    Args:
        folder: that is to be written to; nothing is made.
        marks: names of which one is there when the folder was written by the same command.
        what: such a folder is.

    Raises:
        UsageError: it is a file, or neither empty nor such a folder.
    """
    if not folder.exists():
        return
    _refuse_file(folder)
    visible = any(not path.name.startswith(".") for path in folder.iterdir())
    if visible and not any((folder / mark).exists() for mark in marks):
        raise UsageError(
            f"{folder} holds other files, and no {what}: give an empty folder, or one that does not exist."
        )


def make_own_folder(folder: Path, marks: Sequence[str], what: str) -> None:
    """:func:`make_folder`, unless it holds the files of somebody else (:func:`check_own`)."""
    check_own(folder, marks, what)
    make_folder(folder)


def _shortened(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}..."


def _cannot_be_made(path: Path, reason: str | None) -> UsageError:
    return UsageError(f"Folder {path} cannot be made: {reason}.")
