"""Checkpoints: one file, replaced atomically, loadable without executing code, and verified before it is.

The file is the ZIP archive that ``torch.save`` writes, with the SHA-256 of everything before it as its comment.

A checkpoint is a dictionary of plain values, NumPy arrays and tensors with the sections

- ``algorithm``, ``task``, ``env_keywords``, ``hyperparameters``: what was trained on what;
- ``identity``: versions and hashes that a result of it must name;
- ``policy``: all that is needed to act (networks, frozen observation statistics);
- ``training``: all that is needed to go on (optimiser, random states, environments, counters);
  absent from files that only keep a good policy.
"""

from __future__ import annotations

import hashlib
import io
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rl2grid.errors import UsageError

FORMAT = 1
"""Raised whenever the sections change; files of another format are refused."""

_ARRAY = "__numpy__"
_DIGEST_SIZE = 64
_MAX_PARTS = 2_000_000
"""Values, arrays and containers of a checkpoint."""
_SCALARS = (type(None), bool, int, float, str)


def save_checkpoint(path: Path, contents: Mapping[str, Any]) -> None:
    """Write a checkpoint; whoever looks, at any moment, finds the previous file or the new one, complete.

    Raises:
        TypeError: a value that could not be loaded again without executing code.
    """
    buffer = io.BytesIO()
    torch.save(_to_tensors({"format": FORMAT, **contents}), buffer)
    temporary = path.with_name(path.name + ".tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(_with_digest(buffer.getvalue()))
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


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
        contents = torch.load(_checked_archive(path), map_location="cpu", weights_only=True)
    except UsageError:
        raise
    except Exception as error:
        # The loader takes the bytes of any other file for instructions, which fail in whatever way.
        raise UsageError(f"File {str(path)!r} is not a checkpoint that can be read.") from error
    if not isinstance(contents, dict) or contents.get("format") != FORMAT:
        raise UsageError(f"File {str(path)!r} is not a checkpoint of format {FORMAT}, the one that can be read.")
    if not isinstance(contents.get("task"), str):
        raise UsageError(f"File {str(path)!r} is not a checkpoint that can be read: it names no task.")
    if task is not None and contents["task"] != task:
        raise UsageError(
            f"Checkpoint {str(path)!r} is of task {contents['task']!r} and cannot be used for task {task!r}."
        )
    _check_sizes(path, contents)
    restored: dict[str, Any] = _to_arrays(contents)
    return restored


def _with_digest(archive: bytes) -> bytes:
    """A ZIP archive without a comment, with the hash of what is before the comment as its comment."""
    head = archive[:-2] + _DIGEST_SIZE.to_bytes(2, "little")
    return head + hashlib.sha256(head).hexdigest().encode()


def _checked_archive(path: Path) -> io.BytesIO:
    """The bytes of a checkpoint: those that were written, in an archive that does not expand.

    Raises:
        UsageError: they were changed.
        BadZipFile: it is no archive.
    """
    content = path.read_bytes()
    file = io.BytesIO(content)
    with zipfile.ZipFile(file) as archive:
        stated = archive.comment.decode("ascii", errors="replace")
        if stated and stated != hashlib.sha256(content[:-_DIGEST_SIZE]).hexdigest():
            raise UsageError(f"File {str(path)!r} is not a checkpoint that can be read: it was changed.")
        # What torch.save writes is stored as it is, each part with a checksum of its own.
        stored = all(part.compress_type == zipfile.ZIP_STORED for part in archive.infolist())
        if not stored or sum(part.file_size for part in archive.infolist()) > len(content):
            raise UsageError(f"File {str(path)!r} is not a checkpoint that can be read: it is compressed.")
        if archive.testzip() is not None:
            raise UsageError(f"File {str(path)!r} is not a checkpoint that can be read: it was changed.")
    file.seek(0)
    return file


def _check_sizes(path: Path, contents: Any) -> None:
    """Refuse what a few bytes describe and much memory would hold: parts that share, and arrays that repeat, others."""
    waiting, parts = [contents], 0
    while waiting:
        value = waiting.pop()
        parts += 1
        if parts > _MAX_PARTS or (isinstance(value, torch.Tensor) and not _is_whole(value)):
            raise UsageError(f"File {str(path)!r} is not a checkpoint that can be read: it expands.")
        if isinstance(value, dict):
            waiting += value.values()
        elif isinstance(value, list | tuple):
            waiting += value


def _is_whole(tensor: torch.Tensor) -> bool:
    if tensor.layout != torch.strided or tensor.device.type != "cpu":
        return False
    return tensor.numel() * tensor.element_size() <= tensor.untyped_storage().nbytes()


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
