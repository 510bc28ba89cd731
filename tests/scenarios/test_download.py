"""Downloading a dataset, from a server on this machine."""

import functools
import hashlib
import http.server
import io
import json
import re
import tarfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.scenarios import download
from rl2grid.scenarios.download import Archive, download_dataset, read_list

BUS14 = load_grid("bus14")
NAME = BUS14.grid2op_name
FILES = {f"{NAME}/chronics/{number:04}/load_p.csv": bytes([65 + number]) * 400_000 for number in range(3)}


class Server(NamedTuple):
    folder: Path
    url: str
    requests: list[str]
    """Ranges asked for."""


class Handler(http.server.BaseHTTPRequestHandler):
    """Serves files, from the byte that is asked for; hangs up after ``most`` bytes if that is set."""

    most: int | None = None

    def __init__(self, folder, requests, *arguments):
        self.folder, self.requests = folder, requests
        super().__init__(*arguments)

    def do_GET(self):
        content = (self.folder / self.path[1:]).read_bytes()
        asked = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
        first = int(asked[1]) if asked else 0
        self.requests.append(self.headers.get("Range", ""))
        if first >= len(content):
            self.send_error(416)
            return
        self.send_response(206 if asked else 200)
        self.send_header("Content-Length", str(len(content) - first))
        self.end_headers()
        self.wfile.write(content[first:][: Handler.most])

    def log_message(self, *arguments):
        pass


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    folder = tmp_path / "served"
    folder.mkdir()
    requests: list[str] = []
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, folder, requests)) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        monkeypatch.setattr(Handler, "most", None)
        yield Server(folder, f"http://127.0.0.1:{running.server_address[1]}", requests)
        running.shutdown()
        thread.join()


@pytest.fixture
def archive(server: Server) -> Archive:
    path = server.folder / "data.tar.bz2"
    with tarfile.open(path, "w:bz2", compresslevel=1) as file:
        # Noise, which cannot be compressed, so that there is something to interrupt.
        contents = FILES | {
            f"{NAME}/noise": b"".join(hashlib.sha256(bytes([n % 256, n // 256])).digest() for n in range(9000))
        }
        for name, content in contents.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            file.addfile(entry, io.BytesIO(content))
    return Archive(f"{server.url}/data.tar.bz2", hashlib.sha256(path.read_bytes()).hexdigest())


def assert_complete(target: Path) -> None:
    assert target.name == NAME
    for name, content in FILES.items():
        assert (target.parent / name).read_bytes() == content
    assert [path.name for path in target.parent.iterdir()] == [NAME]


def test_a_dataset_is_fetched_and_unpacked(server: Server, archive: Archive, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    target = download_dataset(BUS14, tmp_path / "data", archive, lambda *progress: told.append(progress))
    assert_complete(target)
    size = (server.folder / "data.tar.bz2").stat().st_size
    assert told[0] == (0, size)
    assert told[-1] == (size, size)
    with pytest.raises(UsageError, match="exists already: delete it to download it again"):
        download_dataset(BUS14, tmp_path / "data", archive, lambda *_: None)


def test_an_interrupted_download_goes_on(server: Server, archive: Archive, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(Handler, "most", 100_000)
    with pytest.raises(UsageError, match="the same command goes on where it stopped"):
        download_dataset(BUS14, tmp_path / "data", archive, lambda *_: None)
    assert [path.name for path in (tmp_path / "data").iterdir()] == [f"{NAME}.part"]
    monkeypatch.setattr(Handler, "most", None)
    told: list[int] = []
    target = download_dataset(BUS14, tmp_path / "data", archive, lambda present, _: told.append(present))
    assert server.requests == ["", "bytes=100000-"]
    assert told[0] == 100_000
    assert_complete(target)


def test_what_was_fetched_completely_is_not_fetched_again(server: Server, archive: Archive, tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / f"{NAME}.part").write_bytes((server.folder / "data.tar.bz2").read_bytes())
    assert_complete(download_dataset(BUS14, tmp_path / "data", archive, lambda *_: None))


def test_another_file_than_promised_is_deleted(archive: Archive, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"is not what Grid2Op's list promises .* deleted: try again"):
        download_dataset(BUS14, tmp_path / "data", archive._replace(sha256="0" * 64), lambda *_: None)
    assert not list((tmp_path / "data").iterdir())


def test_a_file_that_is_no_archive_is_deleted(server: Server, archive: Archive, tmp_path: Path) -> None:
    (server.folder / "data.tar.bz2").write_bytes(b"<html>Sign in</html>")
    with pytest.raises(UsageError, match="cannot be unpacked"):
        download_dataset(BUS14, tmp_path / "data", archive._replace(sha256=None), lambda *_: None)
    assert not list((tmp_path / "data").iterdir())


def test_too_little_space_is_said_before(archive: Archive, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(download, "SPACE_FACTOR", 1e12)
    with pytest.raises(UsageError, match=r"GB of free space: the dataset needs"):
        download_dataset(BUS14, tmp_path / "data", archive, lambda *_: None)
    assert not list((tmp_path / "data").iterdir())


def test_the_list_says_where_archives_are(server: Server) -> None:
    entry = {"base_url": "https://example.org/", "filename": f"{NAME}.tar.bz2", "sha256": "AB"}
    (server.folder / "datasets.json").write_text(json.dumps({NAME: entry}))
    assert read_list(f"{server.url}/datasets.json", NAME) == Archive(f"https://example.org/{NAME}.tar.bz2", "AB")
    with pytest.raises(UsageError, match="'another' is not on Grid2Op's list"):
        read_list(f"{server.url}/datasets.json", "another")


def test_an_unreachable_server_is_one_sentence(tmp_path: Path) -> None:
    nobody = "http://127.0.0.1:9"  # The port of discard, which nothing serves.
    with pytest.raises(UsageError, match=r"cannot be read .*: a connection to the internet is needed"):
        read_list(f"{nobody}/datasets.json", NAME)
    with pytest.raises(UsageError, match="cannot be fetched"):
        download_dataset(BUS14, tmp_path / "data", Archive(f"{nobody}/data.tar.bz2", None), lambda *_: None)
    assert not list((tmp_path / "data").iterdir())
