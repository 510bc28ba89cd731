"""Formulas as MathML, which browsers draw by themselves: the site needs neither scripts nor a network for them."""

from __future__ import annotations

import html
import re

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

_FORMULA = re.compile(r'<(span|div) class="arithmatex">(?:\\\((.*?)\\\)|\\\[(.*?)\\\])</\1>', re.DOTALL)


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Replace the formulas that arithmatex marked."""

    def to_mathml(formula: re.Match[str]) -> str:
        display = "inline" if formula[2] is not None else "block"
        source = html.unescape(formula[2] if formula[2] is not None else formula[3]).strip()
        try:
            return convert(source, display=display)
        except Exception as error:
            raise PluginError(f"{page.file.src_uri}: formula {source!r} cannot be converted: {error}") from error

    return _FORMULA.sub(to_mathml, content)
