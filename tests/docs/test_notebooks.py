"""The notebooks run from top to bottom, show what they printed, and lead to pages that exist."""

import json
import re
from pathlib import Path

import pytest
from documentation import ROOT, anchors

FOLDER = ROOT / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
MEGABYTE = 1_000_000
_LINK = re.compile(r"\]\((?P<path>[^)#\s]+)(?:#(?P<anchor>[^)\s]+))?\)")


def name_of(path: Path) -> str:
    return path.stem


def cells(path: Path, kind: str) -> list[dict]:
    return [cell for cell in json.loads(path.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == kind]


def test_there_is_one_for_each_kind_of_newcomer():
    assert [path.stem for path in NOTEBOOKS] == ["engineer", "researcher", "student"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=name_of)
def test_it_is_small_and_shows_what_it_printed(path: Path):
    assert path.stat().st_size < MEGABYTE
    outputs = [output for cell in cells(path, "code") for output in cell["outputs"]]
    assert not [output for output in outputs if output["output_type"] == "error"]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert any(output["output_type"] == "stream" for output in outputs)
    assert not [output for output in outputs if output.get("name") == "stderr"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=name_of)
def test_its_links_lead_somewhere(path: Path):
    for cell in cells(path, "markdown"):
        for link in _LINK.finditer("".join(cell["source"])):
            target = (path.parent / link["path"]).resolve()
            assert target.is_file(), link[0]
            assert link["anchor"] is None or link["anchor"] in anchors(target), link[0]


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=name_of)
def test_it_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("ipykernel", reason="ipykernel is not installed: rl2grid[notebooks]")
    client = pytest.importorskip("nbclient", reason="nbclient is not installed: rl2grid[notebooks]")
    import nbformat

    monkeypatch.chdir(tmp_path)
    notebook = nbformat.read(path, as_version=4)
    client.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
