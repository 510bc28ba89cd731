"""Everything that a release takes, up to the upload, which is left to a person: ``make release``.

1. The working copy is that of a commit, and the version is the same wherever it stands.
2. ``make test``, then ``make docs``: the tests build no site.
3. Wheel and source distribution are built into ``dist/``.
4. Each is installed into an environment of its own, with the versions of ``constraints.txt``, and tried from another
   folder with an empty data folder and no compiler within reach: commands, an evaluation, a training, its evaluation.
5. What is left to be typed is printed.
"""

from __future__ import annotations

import hashlib
import os
import re
import shlex
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DIST = ROOT / "dist"
EXTRAS = "[train,analysis]"
TRIALS = (
    "rl2grid --version",
    "rl2grid tasks",
    "rl2grid evaluate do-nothing bus14-T0 --months 2",
    "rl2grid train ppo bus14-T0 --heuristic idle --decisions 2048 --validation-months 1 --output run",
    "rl2grid evaluate run bus14-T0 --months 1",
)


def main() -> int:
    version = checked_version()
    check_committed()
    run("make test", ROOT)
    run("make docs", ROOT)
    built = build(version)
    for package in built:
        print(f"== Trying {package.name} in an environment of its own", flush=True)
        try_out(package)
    print(left_to_do(version, built))
    return 0


def checked_version() -> str:
    """The version of the package, if it is the same everywhere.

    Raises:
        SystemExit: it is not.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    version = str(project["version"])
    places = {
        "src/rl2grid/__init__.py": rf'^__version__ = "{re.escape(version)}"$',
        "CITATION.cff": rf"^version: {re.escape(version)}$",
        "CHANGELOG.md": rf"^## {re.escape(version)}, \d{{4}}-\d\d-\d\d$",
    }
    for path, pattern in places.items():
        if not re.search(pattern, (ROOT / path).read_text(encoding="utf-8"), re.MULTILINE):
            raise SystemExit(f"{path} does not name version {version} of pyproject.toml: let both say the same.")
    return version


def check_committed() -> None:
    """Refuse to release what is in no commit.

    Raises:
        SystemExit: there are changes.
    """
    if output_of("git status --porcelain"):
        raise SystemExit("The working copy has changes that are in no commit: commit them, or put them aside.")


def build(version: str) -> list[Path]:
    """The wheel and the source distribution, made anew."""
    built = [DIST / f"rl2grid-{version}-py3-none-any.whl", DIST / f"rl2grid-{version}.tar.gz"]
    for package in built:
        package.unlink(missing_ok=True)
    run(f"{shlex.quote(sys.executable)} -m hatchling build -t wheel -t sdist -d {shlex.quote(str(DIST))}", ROOT)
    return built


def try_out(package: Path) -> None:
    """Install a package as a stranger does, and use it."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        run(f"{shlex.quote(sys.executable)} -m venv environment", place)
        install = (
            f"environment/bin/python -m pip install --quiet --constraint {shlex.quote(str(ROOT / 'constraints.txt'))}"
        )
        run(f"{install} {shlex.quote(f'{package}{EXTRAS}')}", place)
        # Nothing but the environment and what every system has: a compiler would hide that one is needed.
        programs = place / "programs"
        programs.mkdir()
        for name in ("env", "uname"):
            (programs / name).symlink_to(f"/usr/bin/{name}")
        path = f"{place / 'environment' / 'bin'}{os.pathsep}{programs}"
        own = {"PATH": path, "RL2GRID_DATA": str(place / "data"), "PYTHONPATH": "", "COLUMNS": "120"}
        for words in TRIALS:
            run(words, place, own)


def left_to_do(version: str, built: list[Path]) -> str:
    """What a person types, with the checksums of what was tried."""
    files = " ".join(f"dist/{package.name}" for package in built)
    sums = "\n".join(f"  {hashlib.sha256(package.read_bytes()).hexdigest()}  {package.name}" for package in built)
    return (
        f"Version {version} was built, installed and tried:\n{sums}\nLeft to do, in this order:\n"
        f"  git tag -a v{version} -m 'Version {version}'\n  git push origin v{version}\n"
        f"  python -m pip install twine && python -m twine upload {files}"
    )


def run(words: str, folder: Path, variables: Mapping[str, str] | None = None) -> None:
    """Run a command, shown before, whose failure ends the release.

    Raises:
        SystemExit: the command failed.
    """
    print(f"$ {words}", flush=True)
    done = subprocess.run(shlex.split(words), cwd=folder, env={**os.environ, **(variables or {})}, check=False)
    if done.returncode:
        raise SystemExit(f"`{words}` ended with status {done.returncode}: nothing is released.")


def output_of(words: str) -> str:
    """What a command prints."""
    return subprocess.run(shlex.split(words), cwd=ROOT, check=True, capture_output=True, text=True).stdout


if __name__ == "__main__":
    raise SystemExit(main())
