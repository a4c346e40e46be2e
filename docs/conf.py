"""Settings of the site, which `make docs` builds from these pages without network."""

from __future__ import annotations

from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx

from mcaprl import __version__

project = "mcaprl"
author = "the mcaprl authors"
copyright = author
release = version = __version__
extensions = ["myst_parser", "sphinx_copybutton"]
myst_enable_extensions = ["deflist"]
# Links to headings work as on GitHub.
myst_heading_anchors = 3
nitpicky = True

html_theme = "furo"
pygments_dark_style = "github-dark"
html_title = f"mcaprl {version}"
html_copy_source = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_use_index = False
html_theme_options = {"navigation_with_keys": True}


def add_markdown(app: Sphinx, error: Exception | None) -> None:
    """Copy the Markdown of each page to the page, and list all pages in llms.txt."""
    if error or app.builder.name != "html":
        return
    pages = [app.env.config.root_doc, *_in_order(app, app.env.config.root_doc)]
    lines = []
    for name in pages:
        target = Path(app.outdir, f"{name}.md")
        target.write_bytes(Path(app.env.doc2path(name)).read_bytes())
        lines.append(f"- [{app.env.titles[name].astext()}]({name}.md): {_summary(app, name)}\n")
    head = f"# {project} {version}\n\n> {_summary(app, pages[0])}\n\n## Pages\n\n"
    Path(app.outdir, "llms.txt").write_text(head + "".join(lines))


def _in_order(app: Sphinx, name: str) -> list[str]:
    """Return the pages below a page, in the order in which tables of contents list them."""
    found = []
    for one in app.env.toctree_includes.get(name, []):
        found += [one, *_in_order(app, one)]
    return found


def _summary(app: Sphinx, name: str) -> str:
    """Return the first sentence of a page."""
    page = app.env.get_doctree(name)
    text = next((one.astext() for one in page.findall(nodes.paragraph)), "")
    return " ".join(text.split()).partition(". ")[0].removesuffix(".").removesuffix(":") + "."


def setup(app: Sphinx) -> None:
    """Register `add_markdown` to run after the build."""
    app.connect("build-finished", add_markdown)
