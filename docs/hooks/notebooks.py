"""Pages of the notebooks under ``docs/notebooks``: text, code and what it printed and drew, as they are stored.

Nothing is executed while the site is built. A link to another notebook leads to its page.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

FOLDER = "notebooks"
_TO_NOTEBOOK = re.compile(r"(\]\([^)#\s]+)\.ipynb")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for every notebook; the notebook itself stays beside it, to be downloaded."""
    for path in sorted((Path(config.docs_dir) / FOLDER).glob("*.ipynb")):
        notebook = json.loads(path.read_text(encoding="utf-8"))
        files.append(File.generated(config, f"{FOLDER}/{path.stem}.md", content=page_of(notebook, path.name)))
    return files


def page_of(notebook: dict[str, Any], name: str) -> str:
    """A notebook as Markdown."""
    title, *others = [_cell(cell) for cell in notebook["cells"]]
    where = f"[The notebook of this page]({name}){{download}} can be run cell by cell."
    return "\n\n".join([title, where, *others])


def _cell(cell: dict[str, Any]) -> str:
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        return _TO_NOTEBOOK.sub(r"\1.md", source)
    return "\n\n".join([f"```python\n{source}\n```", *filter(None, map(_output, cell["outputs"]))])


def _output(output: dict[str, Any]) -> str:
    if output["output_type"] == "stream":
        return _printed("".join(output["text"]).rstrip())
    data = output.get("data", {})
    if "image/png" in data:
        picture = "".join(data["image/png"]).strip()
        return f'<img alt="figure drawn by the code above" src="data:image/png;base64,{picture}">'
    return _printed("".join(data["text/plain"])) if "text/plain" in data else ""


def _printed(text: str) -> str:
    """What was printed; columns stay below each other, and scroll, anything else is wrapped."""
    aligned = any("  " in line.strip() for line in text.splitlines())
    return f"```{{.text{' .aligned' if aligned else ''}}}\n{text}\n```"
