"""Reports of why a mapping finds no episode, and of how much each quantity prevents."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mcaprl.errors import LogError
from mcaprl.recorder.mapping.config import Mapping
from mcaprl.recorder.mapping.read import MappedBag, read_open_bag
from tests.support.memory_bag import MemoryBag

SECONDS = [k / 2 for k in range(41)]
MAPPING: dict[str, Any] = {
    "clock": {"rate_hz": 2},
    "observation": {"speed": {"field": "/odom.speed"}},
    "action": {"field": "/mode.data"},
    "episodes": {"gap_s": 2.0},
}


def drive(**topics: Any) -> MemoryBag:
    """Return a drive of 20 s with a speed and a mode at 2 Hz, and with other topics."""
    count = len(SECONDS)
    known = {
        "/odom": (SECONDS, {"speed": np.arange(count, dtype=float)}),
        "/mode": (SECONDS, {"data": np.zeros(count)}),
    }
    return MemoryBag({**known, **topics})


def read(bag: MemoryBag, **keys: Any) -> MappedBag:
    return read_open_bag(bag, Mapping.model_validate({**MAPPING, **keys}))


def observing(*names: str, **keys: Any) -> dict[str, Any]:
    others = {name: {"field": f"/{name}.x", **keys} for name in names}
    return {"observation": {**MAPPING["observation"], **others}}


def why_not(bag: MemoryBag, **keys: Any) -> str:
    """Return the cause in the error of a mapping that finds no episode."""
    with pytest.raises(LogError, match="the mapping finds no episode of 2 or more steps") as found:
        read(bag, **keys)
    assert "\n" not in str(found.value)
    return str(found.value).partition("more steps: ")[2]


def test_an_event_that_is_older_than_gap_s_is_named() -> None:
    # Two messages at 10,000 Hz, before the other topics: too old from the third second on.
    bag = drive(**{"/event": ([-1.9999, -1.9998], {"x": [1.0, 2.0]})})
    text = why_not(bag, **observing("event"), episodes={"gap_s": 1.5})
    assert text == (
        "event (/event) has messages from 0.00 to 0.00 s, and /odom from 2.00 to 22.00 s: they do"
        " not overlap in time"
    )
    bag = drive(**{"/event": ([0.0, 0.0001], {"x": [1.0, 2.0]})})
    text = why_not(bag, **observing("event"), episodes={"gap_s": 0.25})
    assert "event (/event) is older than gap_s (0.25 s) during" in text
    assert "2 messages from 0.00 to 0.00 s of 20.00 s" in text
    assert "`missing`" in text


def test_topics_that_do_not_overlap_are_named_with_their_times() -> None:
    bag = drive(**{"/gps": ([100.0, 101.0, 102.0], {"x": [1.0, 2.0, 3.0]})})
    text = why_not(bag, **observing("gps"))
    assert "gps (/gps) has messages from 100.00 to 102.00 s, and /odom from 0.00 to 20.00" in text
    assert "do not overlap in time" in text
    late = MemoryBag(
        {
            "/odom": (SECONDS, {"speed": np.zeros(len(SECONDS))}),
            "/mode": ([50.0, 51.0], {"data": [0.0, 0.0]}),
        }
    )
    text = why_not(late)
    assert "/mode of the action has messages from 50.00 to 51.00 s, and /odom from 0.00" in text


@pytest.mark.parametrize(
    ("times_s", "text"),
    [
        ([], "x (/x) has no messages"),
        ([-9.0], "x (/x) has one message only: set `missing`, or remove it"),
        ([-9.0, -9.0], "x (/x) has 2 messages with the same time: use another `time`"),
    ],
)
def test_topics_without_different_times_are_named(times_s: list[float], text: str) -> None:
    bag = drive(**{"/x": (times_s, {"x": np.ones(len(times_s))})})
    assert why_not(bag, **observing("x")) == text


def test_elements_that_are_not_finite_are_named() -> None:
    ranges = np.ones((len(SECONDS), 40))
    ranges[:, 3], ranges[::2, 17] = np.inf, np.nan
    bag = drive(**{"/scan": (SECONDS, {"x": ranges})})
    text = why_not(bag, **observing("scan"))
    assert text == (
        "scan (/scan) is not finite at 100% of the steps (elements 3, 17 of 40, for example inf):"
        " set `clip` to bound infinite values, or `missing`"
    )
    text = why_not(drive(**{"/v": (SECONDS, {"x": [np.nan] * len(SECONDS)})}), **observing("v"))
    assert "v (/v) is not finite at 100% of the steps (the value is nan)" in text


def test_conditions_without_a_beginning_are_named() -> None:
    text = why_not(drive(), episodes={"begin": "speed > 1000"})
    assert text == "41 steps have all values, but no episode begins: `begin` never becomes true"
    text = why_not(drive(), episodes={"terminated": "speed >= 0"})
    assert "no episode begins: `terminated` is always true" in text


def test_the_share_of_time_that_a_quantity_alone_prevents() -> None:
    # The topic ends in the middle of the drive: it alone prevents the second half.
    half = [time for time in SECONDS if time <= 9]
    bag = drive(**{"/x": (half, {"x": np.ones(len(half))})})
    report = read(bag, **observing("x"), episodes={"gap_s": 1.0}).report
    # Fresh until 10 s. The instants are the times of all messages: 41 + 41 + 19, of which those
    # from 10.5 s on (20 + 20) have no value.
    assert report.fields["x"].prevents == pytest.approx(40 / 101)
    assert report.fields["speed"].prevents == 0.0
    assert "alone prevents 39.6% of the time" in str(report.fields["x"])
    assert any("x alone prevents 40% of the time" in str(one) for one in report.problems())
    assert read(bag, **observing("x", missing=0)).report.fields["x"].prevents == 0.0


def test_ages_between_drives_do_not_count() -> None:
    # Two drives of 5 s at 2 Hz, with a pause of 100 s.
    times = [k / 2 for k in range(11)] + [105 + k / 2 for k in range(11)]
    bag = MemoryBag(
        {
            "/odom": (times, {"speed": np.zeros(22)}),
            "/mode": (times, {"data": np.zeros(22)}),
        }
    )
    report = read(bag, clock={"rate_hz": 4}).report
    assert report.fields["speed"].max_age_s <= 2.0
    assert report.fields["speed"].missing == 0.0


def test_each_run_has_a_report() -> None:
    # The clock is reset after 10 s; in the second run, a value is missing in half of the steps.
    times = [*np.arange(0, 10, 0.5), *np.arange(0, 10, 0.5)]
    values = np.array([0.0] * 20 + [0.0, np.nan] * 10)
    bag = MemoryBag({"/odom": (times, {"speed": values}), "/mode": (times, {"data": np.zeros(40)})})
    observation = {"speed": {"field": "/odom.speed", "missing": 0}}
    report = read(bag, observation=observation).report
    assert [run.steps for run in report.runs] == [19, 19]
    assert [run.fields["speed"].missing for run in report.runs] == [0.0, 0.5]
    assert report.elements == ["speed"]


def test_the_topic_of_the_action_without_messages_is_named() -> None:
    bag = drive(**{"/turn": ([], {"x": []})})
    action = {"fields": ["/mode.data", "/turn.x"], "box": {"low": [0, 0], "high": [1, 1]}}
    text = why_not(bag, action=action)
    assert text == "no step has an action: /turn of the action has no messages"
