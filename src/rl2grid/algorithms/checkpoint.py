"""Checkpoints: one file, replaced atomically, loadable without executing code.

A checkpoint is a dictionary of plain values, NumPy arrays and tensors with the sections

- ``algorithm``, ``task``, ``env_keywords``, ``hyperparameters``: what was trained on what;
- ``identity``: versions and hashes that a result of it must name;
- ``policy``: all that is needed to act (networks, frozen observation statistics);
- ``training``: all that is needed to go on (optimiser, random states, environments, counters);
  absent from files that only keep a good policy.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rl2grid.errors import UsageError

FORMAT = 1
"""Raised whenever the sections change; files of another format are refused."""

_ARRAY = "__numpy__"
_SCALARS = (type(None), bool, int, float, str)


def save_checkpoint(path: Path, contents: Mapping[str, Any]) -> None:
    """Write a checkpoint; whoever looks, at any moment, finds the previous file or the new one, complete.

    Raises:
        TypeError: a value that could not be loaded again without executing code.
    """
    temporary = path.with_name(path.name + ".tmp")
    with open(temporary, "wb") as file:
        torch.save(_to_tensors({"format": FORMAT, **contents}), file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


def load_checkpoint(path: Path, *, task: str | None = None) -> dict[str, Any]:
    """Read a checkpoint; nothing in the file is executed.

    Args:
        path: The file.
        task: The task id that the checkpoint must be of; None accepts any.

    Raises:
        UsageError: no such file, not a checkpoint, one of another format or of another task.
    """
    if not path.is_file():
        raise UsageError(f"Checkpoint {str(path)!r} does not exist: give the path of a checkpoint file.")
    try:
        contents = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        # The loader takes the bytes of any other file for instructions, which fail in whatever way.
        raise UsageError(f"File {str(path)!r} is not a checkpoint that can be read.") from error
    if not isinstance(contents, dict) or contents.get("format") != FORMAT:
        raise UsageError(f"File {str(path)!r} is not a checkpoint of format {FORMAT}, the one that can be read.")
    if "task" not in contents:
        raise UsageError(f"File {str(path)!r} is not a checkpoint that can be read: it names no task.")
    if task is not None and contents["task"] != task:
        raise UsageError(
            f"Checkpoint {str(path)!r} is of task {contents['task']!r} and cannot be used for task {task!r}."
        )
    restored: dict[str, Any] = _to_arrays(contents)
    return restored


def _to_tensors(value: Any) -> Any:
    """The same tree with arrays as marked tensors: the loader admits tensors, but no NumPy objects."""
    if isinstance(value, _SCALARS) and not isinstance(value, np.generic):
        return value
    if isinstance(value, torch.Tensor):
        return value.detach()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return {_ARRAY: torch.from_numpy(np.array(value, order="C"))}
    if isinstance(value, Mapping):
        return {key: _to_tensors(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_to_tensors(item) for item in value]
    if isinstance(value, tuple):
        return tuple(_to_tensors(item) for item in value)
    raise TypeError(f"a checkpoint holds plain values, arrays and tensors, not {type(value).__name__}")


def _to_arrays(value: Any) -> Any:
    if isinstance(value, dict):
        if value.keys() == {_ARRAY}:
            return value[_ARRAY].numpy()
        return {key: _to_arrays(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_to_arrays(item) for item in value]
    if isinstance(value, tuple):
        return tuple(_to_arrays(item) for item in value)
    return value
