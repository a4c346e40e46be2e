"""Tests of the progress of long operations without a terminal."""

from __future__ import annotations

import time
from math import nan

import pytest

from mcaprl.progress import TrainingProgress, terminal_bar, terminal_progress


class Clock:
    """A clock that is set by hand."""

    now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Set the time of the progress by hand."""
    clock = Clock()
    monkeypatch.setattr(time, "monotonic", clock.monotonic)
    return clock


def test_long_work_prints_lines_at_intervals(
    clock: Clock, capsys: pytest.CaptureFixture[str]
) -> None:
    with terminal_bar("fitting", 1_000) as advance:
        for _ in range(100):
            clock.now_s += 0.5
            advance(5)
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "fitting: 50 of 1000, about 95 s left",
        "fitting: 150 of 1000, about 85 s left",
        "fitting: 250 of 1000, about 75 s left",
        "fitting: 350 of 1000, about 65 s left",
        "fitting: 450 of 1000, about 55 s left",
    ]


def test_the_first_unit_does_not_count_for_the_time_left(
    clock: Clock, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first of 1,000 units compiles for a minute; each other one takes 0.1 s."""
    with terminal_bar("drawing", 1_000) as advance:
        clock.now_s += 60
        advance(1)
        for _ in range(999):
            clock.now_s += 0.1
            advance(1)
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["drawing: 1 of 1000", "drawing: 102 of 1000, about 90 s left"]


def test_work_without_a_total_prints_what_is_done(
    clock: Clock, capsys: pytest.CaptureFixture[str]
) -> None:
    with terminal_bar("reading", None) as advance:
        clock.now_s += 6
        advance(3)
    assert capsys.readouterr().err == "reading: 3\n"


def test_lines_become_rare(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with terminal_bar("reading", None) as advance:
        for _ in range(10_000):
            clock.now_s += 1
            advance(1)
    times_s = [int(line.split()[1]) for line in capsys.readouterr().err.splitlines()]
    assert times_s[:4] == [5, 15, 25, 35]
    assert times_s[-1] - times_s[-2] > 500


def test_training_prints_lines_about_a_seed(
    clock: Clock, capsys: pytest.CaptureFixture[str]
) -> None:
    with terminal_progress("updates", "loss") as report:
        for done in range(100, 1_001, 100):
            clock.now_s += 2
            for seed in (0, 1):
                report(TrainingProgress(seed, done, 1_000, {"loss": 1 / done}))
    assert capsys.readouterr().err.splitlines() == [
        "seed 0: 300 of 1000 updates, loss 0.003333, about 14 s left",
        "seed 0: 800 of 1000 updates, loss 0.00125, about 4 s left",
    ]


def test_a_line_about_training_has_the_first_known_term(
    clock: Clock, capsys: pytest.CaptureFixture[str]
) -> None:
    with terminal_progress("steps", "score", "mean_return") as report:
        for score, mean_return in ((nan, nan), (nan, 21.5), (0.25, 21.5)):
            clock.now_s += 11
            terms = {"score": score, "mean_return": mean_return}
            report(TrainingProgress(0, 100, 200, terms))
    assert capsys.readouterr().err.splitlines() == [
        "seed 0: 100 of 200 steps",
        "seed 0: 100 of 200 steps, mean return 21.5",
        "seed 0: 100 of 200 steps, score 0.25",
    ]


def test_short_work_prints_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with terminal_bar("fitting", 2) as advance:
        advance(1)
        advance(1)
    assert capsys.readouterr().err == ""
