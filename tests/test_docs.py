"""Tests of the docs: valid links, up-to-date generated pages, and help for all options."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import click
import pytest

import mcaprl
import mcaprl.errors
from mcaprl._interrupt import INTERRUPTED
from mcaprl.cli import cli
from mcaprl.cli.help import WITH_LOSSES

ROOT = Path(__file__).parent.parent
PAGES = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"]
PAGES += sorted(str(page.relative_to(ROOT)) for page in (ROOT / "docs").rglob("*.md"))


def _generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("page", "generate"), [("cli", "command"), ("api", "api"), ("mapping", "mapping")]
)
def test_generated_references_are_up_to_date(page: str, generate: str) -> None:
    pytest.importorskip("matplotlib")
    text = getattr(_generator(), f"{generate}_reference")()
    assert (ROOT / "docs" / f"{page}.md").read_text() == text, "stale: run `make docs`"


def test_generated_cards_are_up_to_date() -> None:
    pytest.importorskip("matplotlib")
    cards = _generator().cards()
    assert sorted(f"docs/cards/{name}.md" for name in cards) == [
        page for page in PAGES if page.startswith("docs/cards/")
    ]
    for name, text in cards.items():
        assert (ROOT / "docs" / "cards" / f"{name}.md").read_text() == text, "run `make docs`"
        assert "## Action Space" in text
        assert "## Arguments" in text


def test_every_method_has_an_anchor_and_a_signature() -> None:
    page = (ROOT / "docs" / "api.md").read_text()
    assert "### Dataset.split\n\n```text\nsplit(" in page
    assert "- `observations`: (N, *shape) array" in page


def test_docstrings_become_markdown() -> None:
    pytest.importorskip("matplotlib")
    docstring = "Add.\n\nArgs:\n    a: A number\n        or None.\n    b: Another.\n\n>>> 1 + 1\n2"
    assert _generator()._prose(docstring) == (
        "Add.\n\n**Args**\n\n- `a`: A number\n  or None.\n- `b`: Another."
        "\n\n```pycon\n>>> 1 + 1\n2\n```"
    )


@pytest.mark.parametrize("name", PAGES)
def test_links_and_files_exist(name: str) -> None:
    page = ROOT / name
    for target, anchor in re.findall(r"\]\(([^)#]*)#?([^)]*)\)", page.read_text()):
        if target.startswith("http"):
            continue
        linked = page.parent / target if target else page
        assert linked.exists(), f"{name} links to {target}"
        if anchor:
            headings = re.findall(r"^#+ (.*)$", linked.read_text(), re.MULTILINE)
            anchors = [re.sub(r"[^\w\- ]", "", text).lower().replace(" ", "-") for text in headings]
            assert anchor in anchors, f"{name} links to {target}#{anchor}"
    for path in re.findall(
        r"`((?:recorder|sims|offline|online|cli|tests|docs)/[\w./]+\.\w+)`", page.read_text()
    ):
        assert (ROOT / path).exists(), f"{name} names {path}"


def test_every_exit_code_is_documented() -> None:
    errors = [one for one in vars(mcaprl.errors).values() if isinstance(one, type)]
    used = {one.exit_code for one in errors if issubclass(one, mcaprl.McaprlError)}
    used |= {0, WITH_LOSSES, INTERRUPTED}
    section = (ROOT / "docs" / "cli.md").read_text().split("## Exit codes")[1]
    assert {int(code) for code in re.findall(r"^\| (\d+) \|", section, re.MULTILINE)} == used


def test_every_option_has_help() -> None:
    plain = {"help"}
    with click.Context(cli, info_name="mcaprl", **cli.context_settings) as top:
        for name, command in cli.commands.items():
            with click.Context(command, info_name=name, parent=top) as context:
                for parameter in command.get_params(context):
                    if isinstance(parameter, click.Option) and parameter.name not in plain:
                        assert parameter.help, f"{name} --{parameter.name}"
