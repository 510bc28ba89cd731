"""Links from the documentation to files of the repository: pages that show the files.

On a hosting site of repositories ``../examples/x.py`` leads to the file. On this site it leads to the file's page in
the API reference, or to a page that shows its text, so that all links work offline.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
_FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"(\]\()(\.\./[^)#\s]+)")
_LANGUAGES = {".py": "python", ".json": "json", ".toml": "toml", ".md": "markdown"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for every file and folder of the repository that a page links to."""
    linked = {path for page in list(files.documentation_pages()) for path in _linked(page)}
    folders = {path for path in linked if (ROOT / path).is_dir()}
    linked |= {f"{folder}/{name.name}" for folder in folders for name in _shown(ROOT / folder)}
    for path in sorted(linked):
        if _page_of(path) not in files.src_uris:
            content = _folder(path) if path in folders else _text(path)
            files.append(File.generated(config, _page_of(path), content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Let links to files of the repository lead to their pages."""

    def lead(link: re.Match[str]) -> str:
        path = _resolve(page.file.src_uri, link[2])
        if path is None:
            return link[0]
        return link[1] + posixpath.relpath(_page_of(path), posixpath.dirname(page.file.src_uri) or ".")

    return _LINK.sub(lead, markdown)


def _linked(file: File) -> set[str]:
    text = _FENCE.sub("", file.content_string)
    found = {_resolve(file.src_uri, link[2]) for link in _LINK.finditer(text)}
    return {path for path in found if path is not None and (ROOT / path).exists()}


def _resolve(source: str, target: str) -> str | None:
    """The path in the repository; None: within the documentation."""
    path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(source), target))
    return None if path.startswith("docs/") else path


def _page_of(path: str) -> str:
    if path.startswith("src/rl2grid/") and path.endswith(".py"):
        return "reference/" + path.removeprefix("src/").removesuffix(".py").removesuffix("/__init__") + ".md"
    return f"repository/{path}.md"


def _shown(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix in _LANGUAGES)


def _folder(path: str) -> str:
    items = "\n".join(f"- [{file.name}]({Path(path).name}/{file.name}.md)" for file in _shown(ROOT / path))
    return f"{_HEADER}# {path}\n\n{items}\n"


def _text(path: str) -> str:
    language = _LANGUAGES.get(Path(path).suffix, "text")
    return f"{_HEADER}# {path}\n\n````{language}\n{(ROOT / path).read_text(encoding='utf-8')}\n````\n"


_HEADER = "---\nsearch:\n  exclude: true\nhide: [toc]\n---\n"
