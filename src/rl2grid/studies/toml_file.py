"""Reading the TOML files of studies and searches: every refusal is one sentence that names what is allowed."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_origin

from rl2grid.errors import UsageError
from rl2grid.records.files import read_text


def read_toml(path: Path) -> dict[str, Any]:
    """The contents of a file.

    Raises:
        UsageError: it is no TOML file.
    """
    contents = read_text(path, "a TOML file", "docs/studies.md says what one holds")
    try:
        return tomllib.loads(contents)
    except RecursionError:
        raise UsageError(f"{path} is no TOML file of a study: it is nested too deeply.") from None
    except ValueError as error:
        raise UsageError(f"{path} is no TOML file: {error}.") from None


def check_kind(what: str, value: Any, kind: Any) -> None:
    """Refuse a value that is not of a kind.

    Args:
        what: what the value is of.
        value: as TOML has it, or with tuples in place of lists.
        kind: the type hint of a hyperparameter: bool, int, float, str, a tuple of one of them, or None as well.

    Raises:
        UsageError: what the value must be.
    """
    if not _is_of(value, kind):
        raise UsageError(f"{upper(what)} must be {_description(kind)}, not {value!r}.")


def _is_of(value: Any, kind: Any) -> bool:
    entries = get_args(kind)
    if get_origin(kind) is tuple:
        return isinstance(value, tuple | list) and all(_is_of(entry, entries[0]) for entry in value)
    if entries:
        return any(_is_of(value, entry) for entry in entries)
    if kind is float:
        return type(value) in (int, float)
    return type(value) is kind


def _description(kind: Any) -> str:
    entries = get_args(kind)
    if get_origin(kind) is tuple:
        return f"a list, each entry {_description(entries[0])}"
    if entries:  # TOML has no None
        return " or ".join(_description(entry) for entry in entries if entry is not NoneType)
    return {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}[kind]


def refuse_unknown_keys(where: str, table: Mapping[str, Any], allowed: Sequence[str]) -> None:
    """Refuse a table with a key that is not allowed."""
    for key in table:
        if key not in allowed:
            raise unknown(f"Key of {where},", key, allowed)


def text(where: str, table: Mapping[str, Any], key: str, default: str | None = None) -> str:
    """A text of a table; ``default`` None: it must be there and not be empty."""
    value = table.get(key, default)
    if not isinstance(value, str) or (not value and default is None):
        raise UsageError(f"{upper(where)} needs {key}, a text in quotation marks.")
    if key in ("name", "label") and not all(letter.isalnum() or letter in "-_." for letter in value):
        raise UsageError(f"{upper(where)}: {key} may contain letters, digits, '-', '_' and '.', unlike {value!r}.")
    return value


def table_of(where: str, table: Mapping[str, Any], key: str) -> dict[str, Any]:
    """A table inside a table; empty if it is missing."""
    return as_table(f"{where}, {key}", table.get(key, {}))


def as_table(what: str, value: Any) -> dict[str, Any]:
    """The value, if it is a table."""
    if not isinstance(value, dict):
        raise UsageError(f"{upper(what)} must be a table, not {value!r}.")
    return value


def count(where: str, key: str, value: Any, at_least: int) -> int:
    """The value, if it is a whole number that is large enough."""
    if isinstance(value, bool) or not isinstance(value, int) or value < at_least:
        raise UsageError(f"{upper(where)}: {key} must be a whole number of at least {at_least}, not {value!r}.")
    return value


def unknown(what: str, value: object, allowed: Sequence[str]) -> UsageError:
    """The error for a name outside a closed list, with the name that was probably meant."""
    close = difflib.get_close_matches(str(value), list(allowed), n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    return UsageError(f"{what} {value!r} does not exist{hint}: choose one of {', '.join(allowed)}.")


def upper(text: str) -> str:
    """The text with a capital letter."""
    return text[:1].upper() + text[1:]


def with_tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values read from TOML or JSON, where tuples are lists."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
