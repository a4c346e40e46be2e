"""The core tests take the main paths of every folder that needs no other packages."""

from __future__ import annotations

from tests.support.paths import CORE, TESTS

OTHER = {
    "device",
    "docs",
    "drive",
    "golden",
    "online",
    "ray",
    "recorder/mapping/poses",
    "recorder/mapping/suggest",
    "recorder/remote",
}
"""Folders whose tests need a GPU, a network, or packages that the core does not have."""


def test_the_core_has_tests_of_every_folder() -> None:
    assert not [path for path in CORE if not path.is_file()]
    folders = {path.parent for path in TESTS.rglob("test_*.py")} - {TESTS / name for name in OTHER}
    assert folders - {path.parent for path in CORE} == set()
