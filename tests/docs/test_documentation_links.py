"""Every relative link of the readme and the documentation leads somewhere, anchors included."""

import pytest
from documentation import PAGES, ROOT, anchors, files_named, links, name_of

BESIDE_THE_README = ("CHANGELOG.md", "CODE_OF_CONDUCT.md", "CONTRIBUTING.md", "SECURITY.md")
EVERY_PAGE = (*PAGES, *(ROOT / name for name in BESIDE_THE_README))


@pytest.mark.parametrize("page", EVERY_PAGE, ids=name_of)
def test_links_lead_somewhere(page):
    broken = []
    for link in links(page):
        path, _, anchor = link.partition("#")
        if path.startswith(("https://", "http://")):
            continue
        target = (page.parent / path).resolve() if path else page
        if (
            not target.exists()
            or not target.is_relative_to(ROOT)
            or (anchor and target.suffix == ".md" and anchor not in anchors(target))
        ):
            broken.append(link)
    assert not broken


@pytest.mark.parametrize("page", EVERY_PAGE, ids=name_of)
def test_files_that_are_named_exist(page):
    # Pages name files from the root, from the package, or from the tests.
    roots = (ROOT, ROOT / "src", ROOT / "src" / "rl2grid", ROOT / "tests", ROOT / "docs", page.parent)
    missing = [name for name in files_named(page) if not any((root / name).exists() for root in roots)]
    assert not missing


def test_every_page_is_reached_by_the_menu():
    menu = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    missing = [name_of(page) for page in PAGES[1:] if page.relative_to(ROOT / "docs").as_posix() not in menu]
    assert not missing
