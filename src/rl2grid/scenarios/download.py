"""Fetching the full datasets that Grid2Op offers, to where :mod:`rl2grid.scenarios.full` looks for them.

Addresses and checksums come from Grid2Op's own list. Unlike its downloader, an interrupted transfer goes on where it
stopped, space is checked before, and the dataset appears whole or not at all.
"""

from __future__ import annotations

import hashlib
import http
import http.client
import json
import os
import shutil
import tarfile
import urllib.error
import urllib.request
from pathlib import Path
from typing import NamedTuple

from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.scenarios.progress import Report

TIMEOUT = 20.0
"""Seconds without an answer after which a server counts as unreachable."""
SPACE_FACTOR = 2.5
"""Space for the archive and its content, whose tables are compressed already, relative to the archive."""
_BLOCK = 2**18


class Archive(NamedTuple):
    """Where a dataset can be fetched."""

    url: str
    sha256: str | None
    """None: nothing is known, and only the archive's own checksums protect it."""


def find_archive(name: str) -> Archive:
    """The archive of the dataset called ``name``, from Grid2Op's list.

    Raises:
        UsageError: The list cannot be read, or has no such dataset.
    """
    # Importing Grid2Op takes seconds, and only its list's address is needed.
    from grid2op.MakeEnv.Make import _LIST_REMOTE_URL, _github_raw_url

    return read_list(_github_raw_url(_LIST_REMOTE_URL), name)


def read_list(url: str, name: str) -> Archive:
    """The archive of the dataset ``name`` in the list at ``url``; errors as :func:`find_archive`."""
    try:
        with urllib.request.urlopen(url, timeout=TIMEOUT) as answer:
            entries = json.load(answer)
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise UsageError(
            f"Grid2Op's list of datasets at {url} cannot be read ({error}): a connection to the internet is needed."
        ) from error
    if name not in entries:
        raise UsageError(f"Dataset {name!r} is not on Grid2Op's list at {url}: it is no longer offered.")
    entry = entries[name]
    return Archive(entry["base_url"] + entry["filename"], entry.get("sha256"))


def download_dataset(grid: Grid, folder: Path, archive: Archive, report: Report) -> Path:
    """Fetch and unpack the full dataset of ``grid``.

    Args:
        grid: the grid.
        folder: where datasets are kept; made if need be.
        archive: what to fetch.
        report: told how many bytes of the archive are there.

    Returns:
        The folder of the dataset.

    Raises:
        UsageError: It is there already, there is not enough space, or it cannot be fetched; what was fetched so far
            is kept, and the same call goes on.
    """
    target = folder / grid.grid2op_name
    if target.exists():
        raise UsageError(f"{target} exists already: delete it to download it again.")
    partial = folder / f"{grid.grid2op_name}.part"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _fetch(archive.url, partial, report)
    except (OSError, http.client.HTTPException) as error:
        raise UsageError(
            f"{archive.url} cannot be fetched to {folder} ({error}): the same command goes on where it stopped."
        ) from error
    _check_sum(partial, archive)
    _unpack(partial, target, archive)
    partial.unlink()
    return target


def _fetch(url: str, partial: Path, report: Report) -> None:
    present = partial.stat().st_size if partial.is_file() else 0
    request = urllib.request.Request(url, headers={"Range": f"bytes={present}-"} if present else {})
    try:
        answer = urllib.request.urlopen(request, timeout=TIMEOUT)
    except urllib.error.HTTPError as error:
        if error.code == http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
            return  # All of it is there.
        raise
    with answer:
        if answer.status != http.HTTPStatus.PARTIAL_CONTENT:
            present = 0  # The server sends it from the beginning.
        total = present + int(answer.headers.get("Content-Length", 0))
        _check_space(partial.parent, round(SPACE_FACTOR * total) - present)
        with partial.open("ab" if present else "wb") as stream:
            report(present, total)
            while block := answer.read(_BLOCK):
                stream.write(block)
                present += len(block)
                report(present, total)
    if present < total:
        raise ConnectionError(f"the transfer ended after {present:,} of {total:,} bytes")


def _check_space(folder: Path, needed: int) -> None:
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise UsageError(f"{folder} has {free / 1e9:.1f} GB of free space: the dataset needs {needed / 1e9:.1f} GB.")


def _check_sum(partial: Path, archive: Archive) -> None:
    if archive.sha256 is None:
        return
    with partial.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    if digest != archive.sha256.strip().lower():
        partial.unlink()
        raise UsageError(
            f"What {archive.url} sent is not what Grid2Op's list promises (SHA-256 {digest}), and was deleted: "
            "try again."
        )


def _unpack(partial: Path, target: Path, archive: Archive) -> None:
    temporary = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        with tarfile.open(partial) as file:
            file.extractall(temporary, filter="data")
        (content,) = temporary.iterdir()
        os.replace(content, target)
    except (OSError, tarfile.TarError, EOFError, ValueError) as error:
        partial.unlink()
        raise UsageError(
            f"The archive from {archive.url} cannot be unpacked ({error}), and was deleted: try again."
        ) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
