"""What the Dockerfile says, done by hand: with the files that it copies, in an environment of its own."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
INDEXES = re.compile(r"--(?:extra-)?index-url \S+")
TRIAL = "evaluate do-nothing bus14-T0 --months 1"


def instructions() -> Iterator[tuple[str, str]]:
    """The lines of the Dockerfile: a word, and what it is about."""
    for line in (ROOT / "Dockerfile").read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            word, _, rest = line.partition(" ")
            yield word, rest


def copied() -> list[str]:
    """Files and folders of the repository that go into the image."""
    return [name for word, rest in instructions() if word == "COPY" for name in rest.split()[:-1]]


def variables() -> dict[str, str]:
    """What is set in the image."""
    return dict(pair.split("=", 1) for word, rest in instructions() if word == "ENV" for pair in rest.split())


def test_what_is_copied_is_there_and_is_sent_to_the_builder() -> None:
    sent = [line.removeprefix("!") for line in (ROOT / ".dockerignore").read_text().splitlines() if line[:1] == "!"]
    assert sorted(copied()) == sorted(sent)
    assert all((ROOT / name).exists() for name in copied())


def test_its_pytorch_is_that_of_the_constraints() -> None:
    (command,) = (rest for word, rest in instructions() if word == "RUN" and "torch==" in rest)
    assert re.findall(r"torch==\S+", command)[0] in (ROOT / "constraints.txt").read_text().splitlines()


@pytest.mark.slow
def test_its_steps_make_a_program_that_plays_and_writes_nothing_beside_its_data(tmp_path: Path) -> None:
    """PyTorch comes from the index of this machine, not from the one of builds for processors."""
    environment = tmp_path / "environment"
    subprocess.run([sys.executable, "-m", "venv", str(environment)], check=True)
    path = f"{environment / 'bin'}{os.pathsep}/usr/bin{os.pathsep}/bin"
    known = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "RL2GRID"))}
    folder = tmp_path
    for word, rest in instructions():
        if word == "WORKDIR":
            folder = tmp_path / rest.lstrip("/")
            folder.mkdir(parents=True)
        if word == "COPY":
            *names, target = rest.split()
            for name in names:
                place = folder / target / name if target.endswith("/") or target == "." else folder / target
                copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copyfile
                copy(ROOT / name, place)
        if word == "RUN":
            command = INDEXES.sub("", rest)
            subprocess.run(shlex.split(command), cwd=folder, env={**known, "PATH": path}, check=True)
    shutil.rmtree(tmp_path / "opt")  # what is installed needs nothing of it
    installed = states(environment)
    own = {name: str(tmp_path / value.lstrip("/")) if value[0] == "/" else value for name, value in variables().items()}
    done = subprocess.run(
        ["rl2grid", *shlex.split(TRIAL)],
        cwd=folder,
        env={"PATH": path, "HOME": str(tmp_path / "nobody"), **own},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "do-nothing" in done.stdout
    assert states(environment) == installed
    assert {entry.name for entry in tmp_path.iterdir()} == {"environment", "data", "out"}


def states(folder: Path) -> dict[str, tuple[int, int]]:
    """Size and time of every file."""
    files = (file for file in folder.rglob("*") if file.is_file() and not file.is_symlink())
    return {str(file): (file.stat().st_size, file.stat().st_mtime_ns) for file in files}
