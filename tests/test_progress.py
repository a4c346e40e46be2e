"""Tests of the progress of long operations without a terminal."""

from __future__ import annotations

import time

import pytest

from mcaprl.progress import terminal_bar


class Clock:
    """A clock that is set by hand."""

    now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s


def test_long_work_prints_lines_at_intervals(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = Clock()
    monkeypatch.setattr(time, "monotonic", clock.monotonic)
    with terminal_bar("fitting", 1_000) as advance:
        for _ in range(100):
            clock.now_s += 0.5
            advance(5)
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "fitting: 50 of 1000, about 95 s left",
        "fitting: 350 of 1000, about 65 s left",
    ]


def test_work_without_a_total_prints_what_is_done(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = Clock()
    monkeypatch.setattr(time, "monotonic", clock.monotonic)
    with terminal_bar("reading", None) as advance:
        clock.now_s += 6
        advance(3)
    assert capsys.readouterr().err == "reading: 3\n"


def test_short_work_prints_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with terminal_bar("fitting", 2) as advance:
        advance(1)
        advance(1)
    assert capsys.readouterr().err == ""
