"""Tests of off-policy evaluation through the public API."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch

import mcaprl
from mcaprl.errors import UsageError
from mcaprl.progress import Advance
from tests.support.offline_tasks import crossing


@pytest.mark.parametrize("threads", [1, 2])
def test_pytorch_uses_the_given_threads_and_the_work_is_announced(threads: int) -> None:
    opened: list[tuple[str, int | None]] = []
    seen: list[int] = []

    @contextmanager
    def progress(description: str, total: int | None) -> Iterator[Advance]:
        opened.append((description, total))
        yield lambda amount: seen.extend([torch.get_num_threads()] * amount)

    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        mcaprl.estimate(
            "random", crossing(n_actions=2), updates=4, threads=threads, progress=progress
        )
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    assert opened == [("fitting 2 networks with 4 updates each", 8)]
    assert seen == [threads] * 8


def test_no_threads_are_refused() -> None:
    with pytest.raises(UsageError, match="`threads=0`"):
        mcaprl.estimate("random", crossing(), threads=0)
