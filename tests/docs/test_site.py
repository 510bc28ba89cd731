"""The documentation site builds without a warning, and needs no network when it is read."""

import re

import pytest

pytest.importorskip("mkdocs")

from rl2grid.envs.options import OPTION_NAMES

pytestmark = pytest.mark.slow  # a strict build takes a minute; `make docs` makes one too
FETCHED = re.compile(r"""<(?:script|link|img)\b[^>]*?(?:src|href)=["']?(https?:[^"'\s>]+)""")


def test_no_page_fetches_anything(site):
    fetched = {page.name: FETCHED.findall(page.read_text(encoding="utf-8")) for page in site.rglob("*.html")}
    assert {name: addresses for name, addresses in fetched.items() if addresses} == {}


def test_the_page_of_the_tasks_describes_every_keyword(site):
    page = (site / "tasks.html").read_text(encoding="utf-8")
    assert all(f'<td data-heading="keyword"><code>{name}</code></td>' in page for name in OPTION_NAMES)


def test_the_first_page_has_a_picture_the_result_and_the_line_that_installs(site):
    page = (site / "index.html").read_text(encoding="utf-8")
    pictures = set(re.findall(r'src="(assets/[^"#]+[.]png)', page))
    assert {"assets/grids/bus36-MO-v0-light.png", "assets/baselines/bus14-T0-dark.png"} <= pictures
    assert all((site / picture).read_bytes().startswith(b"\x89PNG") for picture in pictures)
    assert "% of a month survived" in re.sub("<[^>]+>", "", page)
    assert "pip" in page
    assert "<!--" not in page.split('<article class="md-content__inner')[1].split("</article>")[0]


def test_code_is_wrapped_and_printed_columns_scroll(site):
    page = (site / "notebooks" / "student.html").read_text(encoding="utf-8")
    assert "aligned" in page
    rules = (site / "assets" / "site.css").read_text(encoding="utf-8")
    assert "pre > code { white-space: pre-wrap" in rules


def test_formulas_are_mathml(site):
    page = (site / "mdp.html").read_text(encoding="utf-8")
    assert page.count("<math") > 50
    assert "arithmatex" not in page


def test_grids_have_pictures_and_the_reference_their_docstrings(site):
    tasks = (site / "tasks.html").read_text(encoding="utf-8")
    pictures = re.findall(r'src="(assets/grids/[^"#]+)', tasks)
    assert len(pictures) == 14
    assert all((site / picture).read_bytes().startswith(b"\x89PNG") for picture in pictures)
    assert "<!-- tasks:" not in tasks
    rewards = (site / "reference/rl2grid/mdp/rewards.html").read_text(encoding="utf-8")
    assert "staying alive is never punished" in rewards
    assert 'href="state.html#rl2grid.mdp.state.GridState"' in rewards
    state = (site / "reference/rl2grid/mdp/state.html").read_text(encoding="utf-8")
    assert "busbar of each element, -1 when disconnected" in state
