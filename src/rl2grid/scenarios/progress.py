"""How long work is told of while it is done."""

from __future__ import annotations

from collections.abc import Callable

Report = Callable[[int, int], None]
"""Told how much is done, and how much there is to do."""


def ignore(done: int, total: int) -> None:
    """The :data:`Report` of work that nobody watches."""
