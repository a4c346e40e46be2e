"""Tests that the site builds without warnings or network access, and works in a browser."""

from __future__ import annotations

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

from tests.docs.pages import ROOT
from tests.test_page import browse, colors_at

PAGES = sorted(str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md"))
# A browser loads these addresses when it shows the page. All other links need a click.
LOADED = {("script", "src"), ("img", "src"), ("link", "href"), ("iframe", "src")}


class Links(HTMLParser):
    """Ids and links of a page."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.loaded: list[str] = []
        self.followed: list[str] = []
        self.feed(page.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id" and value:
                self.ids.add(value)
            if name in ("src", "href") and value:
                (self.loaded if (tag, name) in LOADED else self.followed).append(value)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the site as `make docs` does."""
    folder = tmp_path_factory.mktemp("site")
    recipe = re.findall(r"sphinx-build (.*) docs build/site", (ROOT / "Makefile").read_text())
    options = [*recipe[0].split(), "-d", str(folder.with_name("doctrees"))]
    subprocess.run(
        [sys.executable, "-m", "sphinx", *options, str(ROOT / "docs"), str(folder)],
        stderr=subprocess.STDOUT,
        check=True,
    )
    return folder


def test_the_site_needs_no_network(site: Path) -> None:
    for page in site.rglob("*.html"):
        for target in Links(page).loaded:
            assert not target.startswith(("http", "//")), f"{page} loads {target}"
    for style in site.rglob("*.css"):
        assert not re.search(r"url\(.?(https?:)?//|@import .?http", style.read_text()), style


def test_all_links_of_the_site_lead_somewhere(site: Path) -> None:
    pages = {page: Links(page) for page in site.rglob("*.html")}
    for page, links in pages.items():
        for link in links.loaded + links.followed:
            path, _, anchor = link.partition("#")
            if re.match(r"\w+:", path):
                continue
            target = (page.parent / unquote(path.partition("?")[0])).resolve() if path else page
            assert target.exists(), f"{page} links to {link}"
            if anchor and target in pages:
                assert unquote(anchor) in pages[target].ids, f"{page} links to {link}"


def test_the_markdown_of_each_page_is_beside_it(site: Path) -> None:
    listed = re.findall(r"^- \[.+\]\((.+)\): .+", (site / "llms.txt").read_text(), re.MULTILINE)
    assert sorted(listed) == PAGES
    for name in PAGES:
        assert (site / name).read_text() == (ROOT / "docs" / name).read_text()
        assert (site / name).with_suffix(".html").is_file()


@pytest.mark.parametrize("word", ["behavior_prob", "mcap", "truncated"])
def test_the_search_finds_pages(site: Path, word: str) -> None:
    document, console = browse(
        site / "search.html", "--allow-file-access-from-files", query=f"?q={word}"
    )
    assert console == ""
    assert re.search(r'<a href="[^"]*log-format\.html', document)


@pytest.mark.parametrize("page", ["index", "tutorial", "cli", "results"])
@pytest.mark.parametrize(("width", "dark"), [(1200, False), (390, False), (390, True)])
def test_pages_fit_phones_and_color_schemes(
    site: Path, tmp_path: Path, page: str, width: int, dark: bool
) -> None:
    colors_at(site / f"{page}.html", tmp_path, width, dark=dark)


def test_the_link_check_sees_ids_and_links(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text('<p id="a"><a href="x.html#b">x</a><img src="y.png"></p>')
    links = Links(page)
    assert (links.ids, links.loaded, links.followed) == ({"a"}, ["y.png"], ["x.html#b"])
