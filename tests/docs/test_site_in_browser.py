"""Every page of the documentation site in a real browser, on a desk and on a phone."""

from __future__ import annotations

from pathlib import Path

import pytest
from headless_browser import PHONE, browsing

pytestmark = pytest.mark.slow

SCREENS = {"desk": (1400, 900), "phone": PHONE}
TABLES = ".md-typeset__scrollwrap"
"""What the theme puts around tables, to be scrolled where they are too wide."""


def test_no_page_scrolls_sideways_or_complains(site: Path) -> None:
    # Addresses of the page for what is not found begin at the root of a server.
    pages = sorted(path for path in site.rglob("*.html") if path.name != "404.html")
    assert len(pages) > 100
    faults = []
    with browsing(SCREENS["desk"]) as visit:
        for page in pages:
            visit.resize(SCREENS["desk"])
            visit.open(page)
            for screen, size in SCREENS.items():
                visit.resize(size)
                for what, pixels in (("page", visit.overflow), ("table", visit.hidden_width(TABLES))):
                    if pixels > 0:
                        faults.append(f"{page.relative_to(site)} on a {screen}: {what} {pixels} pixels too wide")
            faults += [f"{page.relative_to(site)}: {error}" for error in visit.errors]
            visit.errors.clear()
    assert faults == []
