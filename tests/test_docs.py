"""The docs are correct: code runs, commands exist, generated pages are up to date."""

from __future__ import annotations

import importlib.util
import re
import shlex
from pathlib import Path
from types import ModuleType

import click
import pytest

from mcaprl.cli import cli, run

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
PAGES = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"]
PAGES += sorted(str(page.relative_to(ROOT)) for page in (ROOT / "docs").rglob("*.md"))
# Sizes at which each of the README's commands takes seconds.
SMALLER = {"--episodes": "2", "--steps": "200"}


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


def test_readme_code_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    exec(compile(code, "README.md", "exec"), {})
    assert "Dataset(CartPole-v1: 10 episodes" in capsys.readouterr().out


@pytest.mark.filterwarnings("ignore:0 updates of the target network")
def test_bags_page_code_and_commands_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "bags.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    exec(compile(code, "bags.md", "exec"), {})
    (mapping,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    assert run(["convert", "--suggest", "bag"]) == 0
    Path("suggested.yaml").write_text(capsys.readouterr().out)
    assert run(["convert", "bag", "--mapping", "suggested.yaml", "--dry-run"]) == 0
    Path("robot.yaml").write_text(mapping)
    commands = re.findall(r"^ *mcaprl (.*robot.yaml.*)$", page, re.MULTILINE)
    for command in commands[1:]:
        options = ["--updates", "20"] if command.startswith(("train", "evaluate")) else []
        assert run([*shlex.split(command), *options]) == 0, command
    assert "3 episodes" in capsys.readouterr().out


def test_sims_page_code_runs(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("numba")
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "sims.md").read_text(), re.DOTALL)
    for block in blocks:
        exec(compile(block.replace("episodes=100", "episodes=3"), "sims.md", "exec"), {})
    assert capsys.readouterr().out.splitlines() == [
        "straight 0.5 (600, 600, 3)",
        "(64, 12) (64,)",
        "{'finished': 3}",
    ]


def test_readme_commands_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    lines = [line for line in README.splitlines() if line.startswith("mcaprl ")]
    assert len(lines) == 11
    for line in lines:
        arguments = shlex.split(line)[1:]
        if arguments[0] == "train-offline":
            arguments += ["--updates", "30", "--hidden", "16,16"]
            arguments += ["--gamma", "0.5", "--target-interval", "3"]
        if "--data" in arguments:
            arguments += ["--updates", "10"]
        if arguments[0] == "train-online":
            arguments += ["--eval-episodes", "1", "--final-episodes", "1", "--envs", "2"]
        for option, value in SMALLER.items():
            if option in arguments:
                arguments[arguments.index(option) + 1] = value
        assert run(arguments) == 0, line


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


def test_every_option_has_help() -> None:
    plain = {"help"}
    with click.Context(cli, info_name="mcaprl", **cli.context_settings) as top:
        for name, command in cli.commands.items():
            with click.Context(command, info_name=name, parent=top) as context:
                for parameter in command.get_params(context):
                    if isinstance(parameter, click.Option) and parameter.name not in plain:
                        assert parameter.help, f"{name} --{parameter.name}"
