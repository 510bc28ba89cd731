"""The API reference: a page for every public module, made of its docstrings."""

from __future__ import annotations

import posixpath
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

PACKAGE = Path(__file__).resolve().parents[2] / "src" / "rl2grid"
LAYERS = (
    "grids", "scenarios", "mdp", "engines", "envs", "records", "agents", "algorithms", "evaluation", "training",
    "ledger", "studies", "drawing", "analysis", "powerflow", "dense", "cli",
)  # fmt: skip
"""Packages, in the order of the menu."""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the reference into the menu."""
    pages: list[Any] = ["reference/rl2grid.md"]
    pages += [{layer: _menu(PACKAGE / layer)} for layer in LAYERS]
    pages.append({"base": [_entry(path) for path in _modules(PACKAGE) if path.parent == PACKAGE]})
    assert config.nav is not None
    config.nav.append({"Reference": pages})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of the reference."""
    for path in [*PACKAGE.rglob("__init__.py"), *_modules(PACKAGE)]:
        content = f"---\ntitle: {_name(path)}\n---\n::: {_name(path)}\n"
        files.append(File.generated(config, _page_of(path), content=content))
    return files


def _menu(layer: Path) -> list[Any]:
    packages = [_entry(path) for path in sorted(layer.rglob("__init__.py")) if path.parent != layer]
    return [_page_of(layer / "__init__.py"), *packages, *map(_entry, _modules(layer))]


def _entry(path: Path) -> dict[str, str]:
    """A page by its name below the layer."""
    return {".".join(_name(path).split(".")[2 if path.parent != PACKAGE else 1 :]): _page_of(path)}


def _modules(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*.py") if not path.name.startswith("_"))


def _name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


def _page_of(path: Path) -> str:
    return posixpath.join("reference", *_name(path).split(".")) + ".md"
