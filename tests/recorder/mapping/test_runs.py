"""MCAP files as datasets: publishers, several files and resets of the clock, by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

import mcaprl
from mcaprl.errors import UsageError
from mcaprl.recorder.mapping.config import parse_mapping
from mcaprl.recorder.mapping.read import MappedBag, read_bag
from tests.support.bags import Channel, integer, integers, number, numbers, write_channels


def read(paths: Any, **parts: Any) -> MappedBag:
    """Read bags with the observation `/odom`, the action `/cmd` and 10 steps per second."""
    tree = {
        "clock": {"rate_hz": 10},
        "observation": {"x": {"field": "/odom.data"}},
        "action": {"field": "/cmd.data"},
        **parts,
    }
    return read_bag(paths, parse_mapping(tree))


def test_two_publishers_of_a_topic_are_one_stream(tmp_path: Path) -> None:
    # Each topic has one channel for even steps and one for odd steps.
    odom = [numbers("/odom", [(k / 10, k) for k in range(first, 100, 2)]) for first in (0, 1)]
    cmd = [integers("/cmd", [(k / 10, k % 2) for k in range(first, 100, 2)]) for first in (0, 1)]
    found = read(write_channels(tmp_path / "bag.mcap", [*odom, *cmd]))
    assert found.report.clock_resets == 0
    assert [episode.length for episode in found.dataset.episodes] == [99]
    assert found.dataset.observations.ravel().tolist() == list(range(99))
    assert found.dataset.actions.tolist() == [k % 2 for k in range(99)]


def seconds(start: float, count: int, first: float) -> list[tuple[float, float]]:
    """Return `count` messages, 0.1 s apart, whose values are `first`, `first + 1`, ..."""
    return [(start + k / 10, first + k) for k in range(count)]


def commands(start: float, count: int, value: int) -> list[tuple[float, int]]:
    """Return `count` equal commands, 0.1 s apart."""
    return [(start + k / 10, value) for k in range(count)]


def observed(found: MappedBag) -> list[tuple[list[float], set[int]]]:
    """Return the first two observations and the set of actions of each episode."""
    return [
        (episode.observations[:2].ravel().tolist(), set(episode.actions.tolist()))
        for episode in found.dataset.episodes
    ]


def test_files_that_overlap_are_separate_recordings(tmp_path: Path) -> None:
    # The first command of B is before that of A, though A begins first.
    one = write_channels(
        tmp_path / "A.mcap",
        [numbers("/odom", seconds(0.01, 50, 0)), integers("/cmd", commands(0.5, 50, 0))],
    )
    two = write_channels(
        tmp_path / "B.mcap",
        [numbers("/odom", seconds(0.02, 50, 1000)), integers("/cmd", commands(0.1, 50, 1))],
    )
    for paths in ([one, two], [two, one]):
        # The first command of A is in the step from 0.41 s to 0.51 s.
        assert observed(read(paths)) == [([4, 5], {0}), ([1000, 1001], {1})]
    # B overlaps the end of A by less than `gap_s`.
    late = write_channels(
        tmp_path / "late.mcap",
        [numbers("/odom", seconds(4, 50, 1000)), integers("/cmd", commands(4, 50, 1))],
    )
    found = read([one, late])
    assert observed(found) == [([4, 5], {0}), ([1000, 1001], {1})]
    assert found.report.clock_resets == 1


def test_a_topic_that_a_file_lacks_does_not_shift_the_others(tmp_path: Path) -> None:
    paths = []
    for name, value, topics in (("a", 0, 2), ("b", 1, 1), ("c", 2, 2)):
        channels = [
            integers("/cmd", commands(0, 20, value)),
            numbers("/odom", seconds(0, 20, 100 * value)),
        ]
        paths.append(write_channels(tmp_path / f"{name}.mcap", channels[:topics]))
    assert observed(read(paths)) == [([0, 1], {0}), ([200, 201], {2})]


def test_files_that_follow_each_other_are_one_run(tmp_path: Path) -> None:
    odom, cmd = seconds(0, 60, 0), commands(0, 60, 1)
    paths = [
        write_channels(
            tmp_path / f"{first}.mcap",
            [
                numbers("/odom", odom[first : first + 20]),
                integers("/cmd", cmd[first : first + 20]),
                # Only the first and the last file have this topic.
                *([numbers("/other", odom[first : first + 1])] if first != 20 else []),
            ],
        )
        for first in (40, 0, 20)
    ]
    found = read(paths, fields={"other": {"field": "/other.data"}})
    assert [episode.length for episode in found.dataset.episodes] == [59]
    assert found.dataset.observations.ravel().tolist() == list(range(59))


def recorded(path: Path, rows: list[tuple[str, float, float]]) -> Path:
    """Write topics, times in seconds and values in this order, each topic with one channel."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        channels: dict[str, int] = {}
        for topic, time_s, value in rows:
            if topic not in channels:
                kind, text = (
                    ("Int32", "int32 data") if topic == "/cmd" else ("Float64", "float64 data")
                )
                schema = writer.register_schema(f"std_msgs/msg/{kind}", "ros2msg", text.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            data = integer(int(value)) if topic == "/cmd" else number(value)
            time_ns = round(time_s * 1e9)
            writer.add_message(channels[topic], time_ns, b"\0\1\0\0" + data, time_ns)
        writer.finish()
    return path


def drive(count: int, first: float, command: float) -> list[tuple[str, float, float]]:
    """Return odometry and commands from time 0, 0.1 s apart."""
    return [
        row
        for k in range(count)
        for row in (("/odom", k / 10, first + k), ("/cmd", k / 10 + 0.05, command))
    ]


def test_a_simulation_that_restarts_begins_a_run(tmp_path: Path) -> None:
    rows = [*drive(40, 0, 0), *drive(50, 1000, 1)]
    # The last command of the first run arrives after the first odometry of the second run.
    rows[79], rows[80] = rows[80], rows[79]
    found = read(recorded(tmp_path / "two.mcap", rows))
    assert found.report.clock_resets == 1
    assert observed(found) == [([0, 1], {0}), ([1000, 1001], {1})]
    assert [episode.length for episode in found.dataset.episodes] == [39, 49]


def test_clocks_that_are_not_reset_together_are_refused(tmp_path: Path) -> None:
    first, second, third = (drive(40, 100 * k, k) for k in range(3))
    odom = [row for row in (*first, *second) if row[0] == "/odom"]
    cmd = [row for row in (*second, *third) if row[0] == "/cmd"]
    # /odom has the first and the second run, /cmd has the second and the third.
    rows = [*odom[:40], *second, *cmd[40:]]
    path = recorded(tmp_path / "some.mcap", rows)
    with pytest.raises(
        UsageError, match=r"some.mcap: the clocks of /odom and /cmd go back at different places"
    ):
        read(path)
    path = recorded(tmp_path / "one.mcap", [*odom, *cmd[:40]])
    with pytest.raises(UsageError, match="the clock of /odom goes back 1 times, that of /cmd 0"):
        read(path)


def test_arrays_of_bytes_are_numbers(tmp_path: Path) -> None:
    payloads = [(k / 10, bytes([49, 48 + k])) for k in range(5)]
    path = write_channels(
        tmp_path / "bytes.mcap",
        [
            Channel("/odom", "acme_msgs/msg/Levels", "uint8[2] data", payloads),
            integers("/cmd", commands(0, 5, 0)),
        ],
    )
    assert read(path).dataset.observations[:3].tolist() == [[49, 48], [49, 49], [49, 50]]


def test_a_converted_log_has_the_times_of_the_bag(tmp_path: Path) -> None:
    # Two runs of a simulation, whose clock starts at 0; 4.9 s are between the first steps.
    bag = write_channels(
        tmp_path / "bag.mcap",
        [
            numbers("/odom", [*seconds(0, 11, 0), *seconds(4.9, 11, 100)]),
            integers("/cmd", [*commands(0, 11, 0), *commands(4.9, 11, 1)]),
        ],
        start_ns=0,
    )
    mapping = {
        "clock": {"rate_hz": 10},
        "observation": {"x": {"field": "/odom.data", "tolerance_s": 0.05}},
        "action": {"field": "/cmd.data"},
    }
    opened = mcaprl.open(bag, mapping=mapping)
    logs = [tmp_path / "one.mcap", tmp_path / "two.mcap"]
    for log in logs:
        mcaprl.convert(bag, log, mapping=mapping)
        times = [episode.log_time_ns.tolist() for episode in mcaprl.open(log).episodes]
        assert times == [episode.log_time_ns.tolist() for episode in opened.episodes]
        assert times[0][0] == 0
        assert times[1][0] == 4_900_000_000
    assert logs[0].read_bytes() == logs[1].read_bytes()
