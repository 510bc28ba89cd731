"""What a release refuses before anything is built."""

import importlib.util
import subprocess
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "release.py"
PLACES = {
    "pyproject.toml": '[project]\nversion = "1.2.3"\n',
    "src/rl2grid/__init__.py": '__version__ = "1.2.3"\n',
    "CITATION.cff": "version: 1.2.3\n",
    "CHANGELOG.md": "# Changelog\n\n## 1.2.3, 2026-12-01\n",
}


@pytest.fixture
def release(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script, in a repository of four files."""
    specification = importlib.util.spec_from_file_location("release", SCRIPT)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    for name, text in PLACES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.setattr(module, "ROOT", tmp_path)
    return module


def test_the_version_is_the_same_everywhere(release: ModuleType) -> None:
    assert release.checked_version() == "1.2.3"


@pytest.mark.parametrize("name", [name for name in PLACES if name != "pyproject.toml"])
def test_another_version_is_refused(release: ModuleType, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(PLACES[name].replace("1.2.3", "1.2.30"))
    with pytest.raises(SystemExit, match=f"{name} does not name version 1.2.3 of pyproject.toml"):
        release.checked_version()


def test_changes_in_no_commit_are_refused(release: ModuleType, tmp_path: Path) -> None:
    subprocess.run(["git", "init", "--quiet", str(tmp_path)], check=True)
    with pytest.raises(SystemExit, match="changes that are in no commit"):
        release.check_committed()


def test_a_command_that_fails_ends_the_release(release: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="`false` ended with status 1: nothing is released"):
        release.run("false", tmp_path)
