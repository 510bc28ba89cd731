"""Stored files that were changed as a careful forger would."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any


def rewrite(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change a JSON file, and take off its checksum, which would tell."""
    contents = json.loads(path.read_text())
    contents.pop("checksum", None)
    change(contents)
    path.write_text(json.dumps(contents))
