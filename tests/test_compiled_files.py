"""Damaged files of compiled code are compiled again, with a notice, and never run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import pytest

from rl2grid.compiled_files import verify_files_of
from rl2grid.errors import DamageWarning

pytestmark = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")


def double(x: int) -> int:
    return 2 * x


def triple(x: int) -> int:
    return 3 * x


def compiled(folder: Path, monkeypatch: pytest.MonkeyPatch, function: Callable[[int], int] = double) -> Any:
    """The function as another process would have it: nothing is compiled yet, files are looked for in the folder."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(folder))
    made = numba.njit(cache=True)(function)
    verify_files_of(made)
    return made


def _flip(content: bytes) -> bytes:
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 16]) + content[middle + 1 :]


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize(
    "damage", [_flip, lambda content: content[:100], lambda content: b""], ids=["flip", "cut", "empty"]
)
def test_damaged_machine_code_is_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, damage: Callable[[bytes], bytes]
):
    assert compiled(tmp_path, monkeypatch)(4) == 8
    again = compiled(tmp_path, monkeypatch)
    assert again(4) == 8
    assert sum(again.stats.cache_hits.values()) == 1
    (path,) = tmp_path.rglob(f"*.{suffix}")
    path.write_bytes(damage(path.read_bytes()))
    function = compiled(tmp_path, monkeypatch)
    with pytest.warns(DamageWarning, match=f"{path.name} was damaged: what it held is compiled again"):
        assert function(4) == 8
    assert not function.stats.cache_hits
    sound = compiled(tmp_path, monkeypatch)
    assert sound(4) == 8
    assert sum(sound.stats.cache_hits.values()) == 1


def test_the_machine_code_of_another_function_is_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for function, value in ((double, 8), (triple, 12)):
        assert compiled(tmp_path, monkeypatch, function)(4) == value
    mine, theirs = (next(tmp_path.rglob(f"*{name}-*.nbc")) for name in ("double", "triple"))
    mine.write_bytes(theirs.read_bytes())
    with pytest.warns(DamageWarning, match="was damaged"):
        assert compiled(tmp_path, monkeypatch)(4) == 8
