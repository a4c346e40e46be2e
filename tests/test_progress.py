"""Tests of the progress of long operations without a terminal."""

from __future__ import annotations

import time
from math import nan

import pytest

from mcaprl import progress
from mcaprl.progress import (
    Training,
    TrainingProgress,
    Work,
    printed_lines,
    terminal_bar,
    terminal_progress,
    terminal_wait,
)


class Clock:
    """A clock that is set by hand."""

    now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Set the time of the progress by hand."""
    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    return clock


@pytest.fixture
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Print the first line after 20 ms, and a line each 50 ms."""
    monkeypatch.setattr(progress, "FIRST_LINE_S", 0.02)
    monkeypatch.setattr(progress, "LINE_INTERVAL_S", 0.05)


def test_the_first_unit_does_not_count_for_the_time_left(clock: Clock) -> None:
    """The first of 1,000 units compiles for a minute; each other one takes 0.1 s."""
    work = Work("drawing", 1_000)
    clock.now_s += 60
    assert work.line() == "drawing: 60 s"
    work.advance(1)
    assert work.line() == "drawing: 1 of 1000"
    for _ in range(10):
        clock.now_s += 0.1
        work.advance(1)
    assert work.line() == "drawing: 11 of 1000", "too early for the time left"
    for _ in range(90):
        clock.now_s += 0.1
        work.advance(1)
    assert work.line() == "drawing: 101 of 1000, about 90 s left"


def test_work_without_a_total_says_what_is_done(clock: Clock) -> None:
    work = Work("reading", None)
    clock.now_s += 6
    work.advance(3)
    assert work.line() == "reading: 3"


def test_a_line_about_training_names_the_seeds_that_are_trained_in_parallel(clock: Clock) -> None:
    training = Training("updates", ("loss",))
    clock.now_s += 7
    assert training.line() == "preparing: 7 s"
    for done in range(100, 1_001, 100):
        clock.now_s += 2
        for seed in (0, 1):
            training.report(TrainingProgress(seed, done, 1_000, {"loss": 1 / done}))
        if done == 400:
            assert (
                training.line() == "seeds 0, 1: 400 of 1000 updates, loss 0.0025, about 12 s left"
            )
    assert training.line() == "seeds 0, 1: 1000 of 1000 updates, loss 0.001, about 0 s left"


def test_a_line_about_seeds_that_are_trained_one_after_the_other_names_the_current_one(
    clock: Clock,
) -> None:
    training = Training("steps", ("loss",))
    for seed, done in ((0, 50), (0, 100), (1, 50)):
        clock.now_s += 6
        training.report(TrainingProgress(seed, done, 100, {"loss": nan}))
    assert training.line() == "seed 1: 50 of 100 steps"


def test_a_line_about_training_says_what_it_waits_for(
    clock: Clock, capsys: pytest.CaptureFixture[str]
) -> None:
    training = Training("updates", ("loss",))
    training.report(TrainingProgress(0, 100, 200, {"loss": 0.5}))
    training.report(TrainingProgress(0, 100, 200, {}, "evaluating 4 candidates"))
    clock.now_s += 12
    assert training.line() == "evaluating 4 candidates: 12 s"
    training.report(TrainingProgress(0, 150, 200, {"loss": 0.25}))
    assert training.line().startswith("seed 0: 150 of 200 updates, loss 0.25")
    assert capsys.readouterr().err == "", "it is not resumed"


def test_a_line_about_training_has_the_first_known_term(clock: Clock) -> None:
    training = Training("steps", ("score", "mean_return"))
    lines = []
    for score, mean_return in ((nan, nan), (nan, 21.5), (0.25, 21.5)):
        terms = {"score": score, "mean_return": mean_return}
        training.report(TrainingProgress(0, 100, 200, terms))
        lines.append(training.line())
    assert lines == [
        "seed 0: 100 of 200 steps",
        "seed 0: 100 of 200 steps, mean return 21.5",
        "seed 0: 100 of 200 steps, score 0.25",
    ]


def test_a_resumed_training_says_where_it_continues(capsys: pytest.CaptureFixture[str]) -> None:
    with terminal_progress("updates", "loss") as report:
        report(TrainingProgress(0, 400, 8_000, {}))
        report(TrainingProgress(0, 500, 8_000, {"loss": 0.5}))
    assert capsys.readouterr().err == "seed 0: resumed at 400 of 8000 updates\n"


@pytest.mark.usefixtures("fast")
def test_lines_are_printed_while_a_unit_of_work_takes_long(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with terminal_bar("fitting", 2) as advance:
        time.sleep(0.1)
        advance(1)
        time.sleep(0.1)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "fitting: 0 s"
    assert lines[-1].startswith("fitting: 1 of 2")
    time.sleep(0.06)
    assert capsys.readouterr().err == ""


@pytest.mark.usefixtures("fast")
def test_of_nested_operations_the_innermost_one_is_printed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    def opened() -> str:
        time.sleep(0.15)
        return capsys.readouterr().err.splitlines()[-1]

    with terminal_wait("reading") as bar:
        assert opened() == "reading: 0 s"
        with bar("stepping", 3) as advance:
            advance(2)
            assert opened().startswith("stepping: 2 of 3")
        assert opened() == "reading: 0 s"
    with terminal_progress("updates", "loss") as report:
        report(TrainingProgress(4, 1, 9, {"loss": 1.0}))
        assert opened().startswith("seed 4: 1 of 9 updates")


@pytest.mark.usefixtures("fast")
def test_a_closed_stderr_ends_the_lines_only(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    class Closed:
        def write(self, text: str) -> None:
            raise BrokenPipeError

        def isatty(self) -> bool:
            return False

    def line() -> str:
        asked.append(1)
        return "waiting"

    monkeypatch.setattr("sys.stderr", Closed())
    with printed_lines(line):
        time.sleep(0.15)
    assert asked


def test_short_work_prints_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with terminal_bar("fitting", 2) as advance:
        advance(1)
        advance(1)
    assert capsys.readouterr().err == ""
