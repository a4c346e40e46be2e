"""Tests that folders, links and the table of packages agree, and that imports stay light."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

import mcaprl

ROOT = Path(__file__).parent.parent
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGES = SETTINGS["tool"]["setuptools"]["packages"]
FOLDERS = SETTINGS["tool"]["setuptools"]["package-dir"]
ROOTS = ("recorder", "sims", "offline", "online", "cli")
MOST_FILES = 22


def modules() -> list[str]:
    found = pkgutil.walk_packages(mcaprl.__path__, "mcaprl.")
    return sorted(module.name for module in found if not module.name.endswith("__main__"))


def test_every_folder_is_a_package() -> None:
    found = {
        "mcaprl",
        "mcaprl.api",
        "mcaprl.device",
        "mcaprl.drive",
        "mcaprl.drive.transports",
        "mcaprl.ray",
        "mcaprl.storage",
    }
    for root in ROOTS:
        for init in (ROOT / root).rglob("__init__.py"):
            found.add("mcaprl." + ".".join(init.parent.relative_to(ROOT).parts))
    # Folders of data files are packages, too.
    found |= set(SETTINGS["tool"]["setuptools"]["package-data"])
    assert found == set(PACKAGES)
    assert {"mcaprl", *(f"mcaprl.{root}" for root in ROOTS)} == set(FOLDERS)
    others = {path.parent.name for path in ROOT.glob("*/__init__.py")} - set(ROOTS)
    assert others <= {"tests", "mcaprl", "benchmarks"}


def test_links_lead_to_the_folders() -> None:
    links = [path for path in (ROOT / "mcaprl").iterdir() if path.is_symlink()]
    if not links:
        pytest.skip("a checkout without symbolic links")
    assert {link.name: link.resolve() for link in links} == {
        name.removeprefix("mcaprl."): ROOT / folder
        for name, folder in FOLDERS.items()
        if name != "mcaprl"
    }


def test_importing_loads_no_engine() -> None:
    heavy = {"torch", "numba", "stable_baselines3", "pygame", "matplotlib", "pandas", "pyarrow"}
    heavy |= {"ray"}
    code = (
        "import sys, mcaprl, mcaprl.cli, mcaprl.sims, mcaprl.recorder.record.wrapper\n"
        f"print(sorted({heavy!r} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_public_names_can_be_imported() -> None:
    for name in dir(mcaprl):
        assert getattr(mcaprl, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = mcaprl.nothing


def test_command_and_changelog_name_the_version() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "mcaprl.cli", "--version"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == f"mcaprl {mcaprl.__version__}"
    assert f"## [{mcaprl.__version__}]" in (ROOT / "CHANGELOG.md").read_text()
    assert f"\nversion: {mcaprl.__version__}\n" in (ROOT / "CITATION.cff").read_text()


@pytest.mark.parametrize("name", modules())
def test_public_names_are_documented(name: str) -> None:
    module = importlib.import_module(name)
    assert inspect.getdoc(module), f"{name} has no docstring"
    for member, value in vars(module).items():
        if member.startswith("_") or getattr(value, "__module__", "") != name:
            continue
        if inspect.isclass(value) or inspect.isfunction(value):
            assert inspect.getdoc(value), f"{name}.{member} has no docstring"


def test_layers_are_kept_by_the_imports_themselves() -> None:
    """Check two rules for imports directly; import-linter also checks them."""
    for path in (ROOT / "recorder").rglob("*.py"):
        assert not _imports(path) & {"torch", "mcaprl.sims", "mcaprl.offline", "numba"}, path
    for path in (ROOT / "sims").rglob("*.py"):
        assert not _imports(path) & {"torch", "mcaprl.recorder", "mcaprl.offline"}, path


def test_reading_a_log_loads_no_writer() -> None:
    code = (
        "import sys, mcaprl.recorder.dataset.open\n"
        "print([name for name in sys.modules if name.startswith('mcaprl') and 'writ' in name])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_no_folder_is_crowded() -> None:
    for root in (*ROOTS, "mcaprl", "tests"):
        for folder in [ROOT / root, *(path.parent for path in (ROOT / root).rglob("__init__.py"))]:
            files = [path for path in folder.glob("*.py") if path.name != "__init__.py"]
            assert len(files) <= MOST_FILES, f"{folder} has {len(files)} files: it wants rooms"


def test_the_project_pins_what_it_was_tested_with() -> None:
    pinned = {
        re.split(r"==", line)[0].lower()
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if "==" in line
    }
    wanted = [*SETTINGS["project"]["dependencies"]]
    for extra in set(SETTINGS["project"]["optional-dependencies"]) - {"all"}:
        wanted += SETTINGS["project"]["optional-dependencies"][extra]
    for requirement in wanted:
        name = re.split(r"[<>=\[]", requirement)[0].lower()
        # An extra may include another extra of mcaprl.
        assert name in {*pinned, "mcaprl"}, f"{name} is not in constraints.txt"


def test_the_word_check_finds_each_entry_of_its_list() -> None:
    """The word check can only find phrases that its pattern matches as a whole."""
    pattern = re.compile(SETTINGS["tool"]["codespell"]["regex"])
    for line in (ROOT / ".ci" / "words.txt").read_text().splitlines():
        entry = line.split("->")[0]
        assert pattern.findall(f"It is {entry}.")[-1] == entry


def _imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
    return {".".join(name.split(".")[:depth]) for name in found for depth in (1, 2)}


def test_imports_helper_sees_both_forms(tmp_path: Path) -> None:
    path = tmp_path / "x.py"
    path.write_text("import torch.nn\nfrom mcaprl.sims.lane.env import X\n")
    assert _imports(path) >= {"torch", "mcaprl.sims"}
    assert isinstance(mcaprl, ModuleType)
