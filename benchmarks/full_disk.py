"""A disk that is full at any write: one sentence, and afterwards everything goes on.

``python benchmarks/full_disk.py [--number 15] [--seed 0] [--only SUBJECT ...]`` lets every subject (those of
``kills.py``, and what writes pictures and pages) run once on a disk of memory with room enough. Then it runs on disks
that are full after a number of bytes drawn from what it took. It must end with a sentence that says so, without a
traceback and not by a signal. Then the disk gets room, and what is called again must leave what was left the first
time. Writes ``benchmarks/results/full_disk.json``, where a subject stays as it was until it is played by another
command. Linux, in a name space of its own (``unshare``), without privileges.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from kills import AT_MOST, SUBJECTS, Subject, call, log_of, run_campaign

RESULTS = Path(__file__).resolve().parent / "results" / "full_disk.json"
INSIDE = "RL2GRID_OWN_MOUNTS"
"""Set in the process that may mount."""
ROOM = 2**30
PAGE = 4096


@dataclass
class Found:
    """What came of a subject."""

    bytes: int = 0
    """What it takes at the end of a run in peace."""
    disks: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    """``said so``: it ended with a sentence; ``finished``: it had room enough, or did without."""
    failures: list[str] = field(default_factory=list)


def _picture(folder: Path) -> list[str]:
    return ["actions", "bus14", "--explain", "3", "--draw", str(folder / "action.svg")]


def _watched(folder: Path) -> list[str]:
    return ["watch", "greedy", "bus14-T0", "--split", "bundled", "--steps", "60", "--output", str(folder / "watch")]


def _exported(folder: Path) -> list[str]:
    return ["data", "export", "bus14", "bundled/0000", str(folder / "export")]


def _is_there(*names: str) -> Any:
    """Tells which files there are, and whether something is in them: pages name the time at which they were made."""
    return lambda folder: [(name, bool(path_size(folder / name))) for name in names]


def path_size(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    files = [path] if path.is_file() else [each for each in path.rglob("*") if each.is_file()]
    return sum(each.stat().st_size for each in files)


WRITERS = (
    Subject("actions --draw", _picture, _picture, _is_there("action.svg")),
    Subject("watch --output", _watched, _watched, _is_there("watch")),
    Subject("data export", _exported, _exported, _is_there("export")),
)
ALL = (*WRITERS, *reversed([one for one in SUBJECTS if not one.cold]))


def mount(folder: Path, size: int) -> None:
    """A new disk of so many bytes in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run(["umount", str(folder)], check=False, stderr=subprocess.DEVNULL)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size},nr_inodes=100000", "none", str(folder)], check=True)


def enlarge(folder: Path) -> None:
    """Room enough on a disk, for what is there to go on."""
    subprocess.run(["mount", "-o", f"remount,size={ROOM}", str(folder)], check=True)


def taken(folder: Path) -> int:
    """Bytes in use."""
    status = os.statvfs(folder)
    return (status.f_blocks - status.f_bfree) * status.f_frsize


def run_subject(subject: Subject, number: int, folder: Path, draws: random.Random) -> Found:
    """Let a subject run with room enough, then on so many disks that are full sooner or later."""
    found = Found()
    mount(folder, ROOM)
    call(subject.first(folder), subject, folder, AT_MOST)
    expected = json.dumps(subject.left(folder), sort_keys=True)
    found.bytes = taken(folder)
    while found.disks < number and len(found.failures) < 10:
        size = PAGE * max(1, draws.randrange(found.bytes // PAGE + 2))
        found.disks += 1
        mount(folder, size)
        try:
            found.outcomes[_on_a_full_disk(subject, folder)] += 1
            enlarge(folder)
            call(subject.again(folder), subject, folder, AT_MOST)
            if json.dumps(subject.left(folder), sort_keys=True) != expected:
                found.failures.append(f"{size} bytes: left something else")
        except Exception as error:  # whatever is raised is what is looked for
            found.failures.append(f"{size} bytes: {type(error).__name__}: {error}")
    subprocess.run(["umount", str(folder)], check=False)
    return found


def _on_a_full_disk(subject: Subject, folder: Path) -> str:
    try:
        call(subject.first(folder), subject, folder, AT_MOST)
    except OSError:
        return "no room to begin"  # of this program, which writes a study's file
    except RuntimeError as error:
        said = log_of(folder).read_text(errors="replace")
        if "Traceback" in said or "exit status -" in str(error):
            raise
        if not any(words in said for words in ("disk is full", "No space left", "room")):
            raise
        return "said so"
    return "finished"


def main() -> int:
    """Fill all disks, write the result, and say whether anything failed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--number", type=int, default=15, help="disks of each subject")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", default=None, choices=[one.name for one in ALL])
    options = parser.parse_args()
    if INSIDE not in os.environ:
        os.environ[INSIDE] = "1"
        os.execvp("unshare", ["unshare", "--map-root-user", "--mount", sys.executable, *sys.argv])
    subjects = [one for one in ALL if options.only is None or one.name in options.only]
    with tempfile.TemporaryDirectory() as scratch:

        def fill(subject: Subject) -> Found:
            draws = random.Random(hashlib.sha256(f"{options.seed} {subject.name}".encode()).digest())
            return run_subject(subject, options.number, Path(scratch) / "disk", draws)

        return run_campaign(RESULTS, subjects, fill, ("disks",))


if __name__ == "__main__":
    sys.exit(main())
