"""The pages of the documentation, their code blocks, headings and links, read without building the site."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))

_FENCE = re.compile(r"^(?P<fence>`{3,})(?P<language>\w*)[^\n]*\n(?P<code>.*?)^(?P=fence)`*$", re.MULTILINE | re.DOTALL)
_NOT_RUN = re.compile(r"<!-- not run: (?P<reason>[^>]+) -->\s*$")
_INLINE_CODE = re.compile(r"`[^`\n]+`")
_LINK = re.compile(r"\[(?:[^\[\]]|\[[^\]]*\])*\]\((?P<target>[^)\s]+)\)")
_FILE = re.compile(r"`(?P<path>\w+/[\w./-]+\.(?:py|json|toml|npz))(?:::\w+)?`")
_HEADING = re.compile(r"^#{1,6} +(?P<text>.+?) *$", re.MULTILINE)


@dataclass(frozen=True)
class Block:
    """A fenced block of code."""

    page: Path
    line: int
    """Of the page, where its first line is."""
    language: str
    code: str
    not_run: str
    """Why it is not run, as ``<!-- not run: reason -->`` before it says; empty for blocks that are."""


def name_of(page: Path) -> str:
    """The path of a page in the repository."""
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path) -> Iterator[Block]:
    """The fenced blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    for fence in _FENCE.finditer(text):
        marked = _NOT_RUN.search(text, 0, fence.start())
        line = text.count("\n", 0, fence.start("code")) + 1
        yield Block(page, line, fence["language"], fence["code"], marked["reason"] if marked else "")


def links(page: Path) -> Iterator[str]:
    """What a page links to: paths and addresses, as written."""
    for link in _LINK.finditer(_INLINE_CODE.sub("`code`", _prose(page))):
        yield link["target"]


def files_named(page: Path) -> Iterator[str]:
    """Files of the repository that a page names in code, as written."""
    for name in _FILE.finditer(_prose(page)):
        yield name["path"]


def anchors(page: Path) -> set[str]:
    """The anchors of the headings of a page."""
    found: set[str] = set()
    for heading in _HEADING.finditer(_prose(page)):
        slug = _slug(heading["text"])
        number = 0
        while (slug if not number else f"{slug}_{number}") in found:
            number += 1
        found.add(slug if not number else f"{slug}_{number}")
    return found


def _prose(page: Path) -> str:
    return _FENCE.sub("", page.read_text(encoding="utf-8"))


def _slug(heading: str) -> str:
    """The anchor that Python-Markdown gives to a heading."""
    text = re.sub(r"[`*]|\]\([^)]*\)|\[", "", heading)
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", text).strip().lower())
