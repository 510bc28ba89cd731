"""Damaged files of compiled code are compiled again, with a notice, and never run."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import pytest

from rl2grid import compile_notices
from rl2grid.compiled_files import VerifiedCacheFile, is_kept, keep_code_of
from rl2grid.errors import DamageWarning

pytestmark = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")


def double(x: int) -> int:
    return 2 * x


def triple(x: int) -> int:
    return 3 * x


def compiled(folder: Path, function: Callable[[int], int] = double) -> Any:
    """The function as another process would have it: nothing is compiled yet, files are looked for in the folder."""
    made = numba.njit(function)
    keep_code_of(made, folder)
    return made


def _flip(content: bytes) -> bytes:
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 16]) + content[middle + 1 :]


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize(
    "damage", [_flip, lambda content: content[:100], lambda content: b""], ids=["flip", "cut", "empty"]
)
def test_damaged_machine_code_is_not_run(tmp_path: Path, suffix: str, damage: Callable[[bytes], bytes]):
    assert compiled(tmp_path)(4) == 8
    again = compiled(tmp_path)
    assert again(4) == 8
    assert sum(again.stats.cache_hits.values()) == 1
    (path,) = tmp_path.rglob(f"*.{suffix}")
    path.write_bytes(damage(path.read_bytes()))
    function = compiled(tmp_path)
    with pytest.warns(DamageWarning, match=f"{path.name} was damaged: what it held is compiled again"):
        assert function(4) == 8
    assert not function.stats.cache_hits
    sound = compiled(tmp_path)
    assert sound(4) == 8
    assert sum(sound.stats.cache_hits.values()) == 1


def test_the_machine_code_of_another_function_is_not_run(tmp_path: Path):
    for function, value in ((double, 8), (triple, 12)):
        assert compiled(tmp_path, function)(4) == value
    mine, theirs = (next(tmp_path.rglob(f"*{name}-*.nbc")) for name in ("double", "triple"))
    mine.write_bytes(theirs.read_bytes())
    with pytest.warns(DamageWarning, match="was damaged"):
        assert compiled(tmp_path)(4) == 8


def test_what_is_kept_is_known_beforehand(tmp_path: Path):
    assert not is_kept(compiled(tmp_path), (numba.int64,))
    compiled(tmp_path)(4)
    assert is_kept(compiled(tmp_path), (numba.int64,))
    assert not is_kept(compiled(tmp_path), (numba.float64,))


def test_a_folder_that_cannot_be_written_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    compiled(tmp_path)(4)

    def refuse(*_: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    said: list[str] = []
    monkeypatch.setattr(compile_notices, "say", said.append)
    monkeypatch.setattr(VerifiedCacheFile, "_open_for_write", refuse)
    kept = compiled(tmp_path)
    assert kept(4) == 8
    assert sum(kept.stats.cache_hits.values()) == 1
    assert said == []
    for function, value in ((double, 4.0), (triple, 6.0)):
        assert compiled(tmp_path, function)(2.0) == value
    assert said == [
        f"compiled code cannot be kept in {tmp_path} (Read-only file system): every process compiles it again."
    ]
