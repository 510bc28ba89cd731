"""Makes the docstrings Markdown: roles become links, tables of restructured text and literal blocks become code.

Structures of arrays get a table of what is declared of their fields.
"""

from __future__ import annotations

import importlib
import re
from typing import Any

import griffe

from rl2grid.structures import describe

_ROLE = re.compile(r":(?:func|class|mod|meth|data|attr):`~?([^`]+)`")
_TABLE = re.compile(r"^=+ [= ]+$\n.*^=+ [= ]+$", re.MULTILINE | re.DOTALL)
_LITERAL = re.compile(r"::(\n\n {4})")


class MarkdownDocstrings(griffe.Extension):
    """Rewrites all docstrings of the package once it is loaded."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Called with the loaded package."""
        self._rewrite(pkg, pkg)

    def _rewrite(self, node: Any, package: griffe.Module) -> None:
        if node.is_alias:
            return
        if node.docstring is not None:
            node.docstring.value = _markdown(node.docstring.value, node, package)
            if _is_structure(node):
                node.docstring.value += f"\n\n{describe(_imported(node))}\n"
        for member in node.members.values():
            self._rewrite(member, package)


def _is_structure(node: Any) -> bool:
    """Whether the fields of a class are declared (:mod:`rl2grid.structures`)."""
    if not node.is_class or "NamedTuple" not in map(str, node.bases):
        return False
    return any(str(member.annotation).startswith("Annotated[") for member in node.attributes.values())


def _imported(node: Any) -> Any:
    return getattr(importlib.import_module(node.module.path), node.name)


def _markdown(text: str, node: Any, package: griffe.Module) -> str:
    text = _TABLE.sub(lambda table: f"```text\n{table[0]}\n```", text)
    text = _LITERAL.sub(r":\1", text)
    return _ROLE.sub(lambda role: _reference(role[1], node, package), text)


def _reference(name: str, node: Any, package: griffe.Module) -> str:
    """A link where the object is documented, else its name as code."""
    short = name.rpartition(".")[2]
    path = name if name.startswith("rl2grid.") else _resolved(name, node)
    relative = path.removeprefix("rl2grid.").split(".")
    try:
        target = package[tuple(relative)]
    except (KeyError, griffe.AliasResolutionError):
        return f"`{short}`"
    if target.is_alias or any(part.startswith("_") for part in relative) or not target.has_docstring:
        return f"`{short}`"
    return f"[`{short}`][{path}]"


def _resolved(name: str, node: Any) -> str:
    first, _, rest = name.partition(".")
    try:
        path: str = node.resolve(first)
    except griffe.NameResolutionError:
        return name
    return f"{path}.{rest}" if rest else path
