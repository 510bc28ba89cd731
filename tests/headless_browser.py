"""A headless browser for tests of pages, where there is one."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
PHONE, DESK = (390, 844), (1280, 900)


@dataclass
class Visit:
    """A page of a browser, and what went wrong on what it showed."""

    page: Any
    """Playwright's."""
    errors: list[str] = field(default_factory=list)
    """What the console and scripts complained about."""
    requests: list[str] = field(default_factory=list)
    """What was fetched beside the page that was opened last."""

    def open(self, path: Path) -> None:
        """Go to a page of this machine."""
        self.requests.clear()
        self.page.goto(path.as_uri())
        self.requests = [url for url in self.requests if url != path.as_uri() and not url.startswith("data:")]

    def resize(self, size: tuple[int, int]) -> None:
        """Turn the screen into one of another width and height."""
        self.page.set_viewport_size({"width": size[0], "height": size[1]})

    @property
    def overflow(self) -> int:
        """Pixels by which the page is wider than the screen."""
        return int(self.page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth"))

    def hidden_width(self, selector: str) -> int:
        """The most pixels that one of these elements hides on its sides, to be scrolled to."""
        hidden = "all => Math.max(0, ...all.map(one => one.scrollWidth - one.clientWidth))"
        return int(self.page.locator(selector).evaluate_all(hidden))


@contextmanager
def browsing(size: tuple[int, int], scheme: str = "light") -> Iterator[Visit]:
    """A browser for one page after the other; the test is skipped where none is found."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: rl2grid[browser]")
    with playwright.sync_playwright() as library:
        own = library.chromium.executable_path
        found = next(filter(None, map(shutil.which, (own, *BROWSERS))), None)
        if found is None:
            pytest.skip(f"no browser is installed: none of {', '.join(BROWSERS)} is on the path")
        # Without a sandbox of its own: tests may run as root, and open nothing but files that they wrote.
        browser = library.chromium.launch(executable_path=found, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": size[0], "height": size[1]}, color_scheme=scheme)
        visit = Visit(page)
        page.on("console", lambda message: visit.errors.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: visit.errors.append(str(error)))
        page.on("request", lambda request: visit.requests.append(request.url))
        yield visit
        browser.close()


@contextmanager
def visiting(path: Path, size: tuple[int, int], scheme: str = "light") -> Iterator[Visit]:
    """Open one page of this machine, in :func:`browsing`."""
    with browsing(size, scheme) as visit:
        visit.open(path)
        yield visit
