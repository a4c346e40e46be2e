"""Inputs with which the fuzzer found errors in the past, and its seed inputs."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.damage.fuzz_target import try_bytes, write_seeds
from tests.support.paths import FUZZ_CORPUS

pytestmark = pytest.mark.usefixtures("each_copy")
CORPUS = sorted((FUZZ_CORPUS).iterdir())


@pytest.mark.parametrize("path", CORPUS, ids=lambda path: path.name)
def test_past_findings(path: Path) -> None:
    try_bytes(path.read_bytes())


def test_seeds(tmp_path: Path) -> None:
    write_seeds(tmp_path)
    seeds = sorted(tmp_path.iterdir())
    assert len(seeds) == 18
    for seed in seeds:
        try_bytes(seed.read_bytes())
