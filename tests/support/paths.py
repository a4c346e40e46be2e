"""Folders that tests read, and the files of the core tests."""

from __future__ import annotations

from pathlib import Path

TESTS = Path(__file__).parent.parent
ROOT = TESTS.parent
GOLDEN = TESTS / "golden"
NODE = TESTS / "node"
FUZZ_CORPUS = TESTS / "fuzz_corpus"
CORE = {TESTS / name for name in (TESTS / "core.txt").read_text().split()}
