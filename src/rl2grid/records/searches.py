"""A search for hyperparameters as it is stored: what is searched, and the best configuration."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rl2grid.records.files import write_json

SEARCH_FILE, BEST_FILE = "tuning.json", "best.json"


def read_search(folder: Path) -> dict[str, Any] | None:
    """What is searched; None in a folder without a search."""
    path = folder / SEARCH_FILE
    if not path.exists():
        return None
    search: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return search


def write_search(folder: Path, search: Mapping[str, Any]) -> None:
    """Write what is searched."""
    write_json(folder / SEARCH_FILE, search)


def write_best(folder: Path, best: Mapping[str, Any]) -> None:
    """Write the best configuration and the command that trains with it."""
    write_json(folder / BEST_FILE, best)
