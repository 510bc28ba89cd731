"""What is left of an environment that was closed."""

from __future__ import annotations

from typing import Any, NoReturn

from rl2grid.errors import UsageError


class Closed:
    """Stands in the place of what played: whoever asks anything of it is told that it is gone."""

    def close(self) -> None:
        """Nothing is left to be closed."""

    def __getattr__(self, name: str) -> NoReturn:
        if name.startswith("__"):  # what Python asks of any object
            raise AttributeError(name)
        raise UsageError("The environment was closed: make another one.")


def closed() -> Any:
    """A :class:`Closed`, which passes for whatever it replaces."""
    return Closed()
