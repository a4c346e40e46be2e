"""Tests that all code and all commands in the README and the docs run."""

from __future__ import annotations

import re
import shlex
import sys
import tomllib
from contextlib import nullcontext
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

import mcaprl
from mcaprl.cli import cli
from tests.conftest import need
from tests.docs.pages import PROSE, ROOT, Run, commands, has_node, languages, link_examples

PAGES = [
    "README.md",
    *sorted(str(page.relative_to(ROOT)) for page in (ROOT / "docs").rglob("*.md")),
]
GENERATED = {"docs/cli.md", "docs/api.md", "docs/mapping.md"}
# Other tools that the page is about, which have their own installation.
OTHERS = {
    "docs/formats.md": {"minari"},
    "docs/howto/environment.md": {"ale_py"},
    "docs/howto/lerobot.md": {"lerobot", "torch"},
}
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())
RUN = {"python", "sh", "sql", "js", "output", "yaml", "toml"}


def with_code() -> list[str]:
    return [page for page in PAGES if set(languages(ROOT / page)) - PROSE]


def run_page(page: str, folder: Path, monkeypatch: pytest.MonkeyPatch, *, quick: bool) -> Run:
    need("js" not in languages(ROOT / page) or has_node(), "tests/node is not installed: npm ci")
    monkeypatch.chdir(folder)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.syspath_prepend(folder)
    link_examples(folder)
    if quick:
        monkeypatch.setattr("mcaprl.online.agent.CENTERING_STEPS", 100)
    run = Run(quick=quick)
    run.page(ROOT / page)
    return run


@pytest.mark.filterwarnings("ignore:.*updates of the target network")
@pytest.mark.parametrize("page", with_code())
def test_a_page_runs_with_small_numbers(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_page(page, tmp_path, monkeypatch, quick=True)


@pytest.mark.slow
@pytest.mark.parametrize("page", with_code())
def test_a_page_runs_as_written(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_page(page, tmp_path, monkeypatch, quick=False)


def test_slow_commands_are_announced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.docs.pages.SLOW_S", 0.05)
    page = tmp_path / "page.md"
    for text, is_announced in (("", False), ("  # about two minutes", True)):
        page.write_text(f"```sh\npython -c 'sum(range(10**7))'{text}\n```\n")
        with nullcontext() if is_announced else pytest.raises(AssertionError, match="announced"):
            Run(quick=False).page(page)


def test_the_readme_code_runs_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    for _ in range(2):
        for block in blocks:
            exec(compile(block, "README.md", "exec"), {})


@pytest.mark.parametrize("page", PAGES)
def test_every_block_has_a_known_language(page: str) -> None:
    assert set(languages(ROOT / page)) <= RUN | PROSE


@pytest.mark.parametrize("page", PAGES)
def test_blocks_that_are_not_run_have_a_reason(page: str) -> None:
    for comment in re.findall(r"<!--+\s*skip:\s*(.*?)-->", (ROOT / page).read_text()):
        assert re.fullmatch(r'next (if\(quick, )?"[^"]{8,}"\)? ', comment), comment


@pytest.mark.parametrize("page", sorted(set(with_code()) - GENERATED))
def test_the_extras_of_a_page_contain_what_it_imports(page: str) -> None:
    text, project = (ROOT / page).read_text(), SETTINGS["project"]
    named = set(re.findall(r"[Ee]xtras?(?: is|:)?\s+`(\w+)`", text))
    for extras in re.findall(r"(?:mcaprl|\.)\[([\w,]+)\]'", text):
        named |= set(extras.split(","))
    wanted, seen = [*project["dependencies"]], set[str]()
    while extras := named - seen:
        seen |= extras
        for extra in extras:
            wanted += project["optional-dependencies"][extra]
        for extras_of_ours in re.findall(r"mcaprl\[([\w,]+)\]", " ".join(wanted)):
            named |= set(extras_of_ours.split(","))
    names = {re.split(r"[^\w.-]", each)[0].lower().replace("-", "_") for each in wanted}
    found = packages_distributions()
    for block in re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        for module in re.findall(r"^ *(?:import|from) (\w+)", block, re.MULTILINE):
            is_ours = module == "mcaprl" or f"<!-- file: {module}.py" in text
            if is_ours or module in sys.stdlib_module_names or module in OTHERS.get(page, ()):
                continue
            packages = {each.lower().replace("-", "_") for each in found.get(module, [module])}
            assert packages & names, f"{page} imports {module}, which no extra on it contains"


def test_every_command_is_in_a_block_that_runs() -> None:
    used = set()
    for page in with_code():
        document = Run(quick=True).parse(ROOT / page)
        for example in document.examples():
            if example.region.lexemes and example.region.lexemes.get("arguments") == "sh":
                for line in commands(example.parsed):
                    words = shlex.split(line)
                    used |= {words[1]} if words[0] == "mcaprl" else set()
    assert used == set(cli.commands)


@pytest.mark.parametrize("name", dir(mcaprl))
def test_every_public_name_is_on_a_written_page(name: str) -> None:
    pages = [(ROOT / page).read_text() for page in PAGES if page not in GENERATED]
    used = re.compile(rf"\bmcaprl\.{name}\b")
    assert any(used.search(page) for page in pages), f"no page names {name}"


@pytest.mark.parametrize("name", dir(mcaprl))
def test_every_public_name_is_in_the_reference(name: str) -> None:
    assert f"\n## mcaprl.{name}\n" in (ROOT / "docs" / "api.md").read_text()


@pytest.mark.parametrize(
    ("page", "error"),
    [
        ("```python\n1 / 0\n```\n", "division"),
        ("```sh\nmcaprl info nothing.mcap\n```\n", "exits with 1"),
        ("```sh\nfalse\ntrue\n```\n", "exits with 1"),
        ("```sh\nmake nothing\n```\n", "nothing"),
        ("```sh\nsh examples/nothing.sh\n```\n", "nothing"),
        ("```sh\npip install '.[nothing]'\n```\n", "nothing"),
        ("```toml\na\n```\n", "line 1"),
        ("```yaml\na: 1\n```\n", "needs <!-- file"),
        ("```python\nprint(1)\n```\n\n```output\n2\n```\n", "the output is\n1"),
        ("```python\nprint(1)\n```\n\n```sh\ntrue\n```\n\n```output\n1\n```\n", "the output"),
    ],
)
def test_the_runner_finds_what_is_wrong(
    page: str, error: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "page.md").write_text(page)
    with pytest.raises(Exception, match=error):
        Run(quick=True).page(tmp_path / "page.md")


def test_the_runner_knows_its_comments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "page.md").write_text(
        "<!-- file: sub/a.yaml -->\n\n```yaml\na: 1\n```\n\n"
        '<!-- skip: next "a reason" -->\n\n```sh\nfalse\n```\n\n'
        '<!-- skip: next if(quick, "a reason") -->\n\n```python\nfirst = 1\n```\n\n'
        "<!-- invisible-code-block: python\nsecond = 2\n-->\n\n"
        "```python\nfrom pathlib import Path\n"
        "print('a', second, 'first' in globals(), Path('sub/a.yaml').read_text())\n```\n\n"
        "```output\na ... False a: 1\n```\n"
    )
    run = Run(quick=True)
    run.page(tmp_path / "page.md")
    assert run.printed == "a 2 False a: 1\n\n"


def test_commands_of_a_block() -> None:
    block = "a b \\\n  --c   # why\n\n# comment\nd \"1 # 2\" '\n'\n"
    assert commands(block) == ["a b --c", "d \"1 # 2\" '\n'"]
