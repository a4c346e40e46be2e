"""MCAP files as datasets: publishers, several files and resets of the clock, by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.mapping.config import parse_mapping
from mcaprl.recorder.mapping.read import MappedBag, read_bag
from tests.support.bags import START_NS, Channel, integer, integers, number, numbers, write_channels


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
    assert (found.report.recordings, found.report.clock_resets) == (2, 0)


def test_a_topic_that_a_file_lacks_does_not_shift_the_others(tmp_path: Path) -> None:
    paths = []
    for name, value, topics in (("a", 0, 2), ("b", 1, 1), ("c", 2, 2)):
        channels = [
            integers("/cmd", commands(0, 20, value)),
            numbers("/odom", seconds(0, 20, 100 * value)),
        ]
        paths.append(write_channels(tmp_path / f"{name}.mcap", channels[:topics]))
    assert observed(read(paths)) == [([0, 1], {0}), ([200, 201], {2})]


def test_only_the_parts_that_metadata_lists_are_one_recording(tmp_path: Path) -> None:
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
    other = {"other": {"field": "/other.data", "missing": -1}}
    found = read(paths, fields=other)
    assert [episode.length for episode in found.dataset.episodes] == [19, 19, 19]
    listed = ", ".join(path.name for path in paths)
    metadata = f"rosbag2_bagfile_information: {{relative_file_paths: [{listed}]}}"
    (tmp_path / "metadata.yaml").write_text(metadata)
    for data in (tmp_path, str(tmp_path / "*.mcap"), paths):
        found = read(data, fields=other)
        assert [episode.length for episode in found.dataset.episodes] == [59]
        assert found.dataset.observations.ravel().tolist() == list(range(59))
        assert found.report.recordings == 1
    # A file that the metadata does not list is another recording.
    write_channels(
        tmp_path / "more.mcap",
        [numbers("/odom", seconds(6, 20, 60)), integers("/cmd", commands(6, 20, 0))],
    )
    found = read(tmp_path)
    assert [episode.length for episode in found.dataset.episodes] == [59, 19]


def test_jitter_between_the_parts_of_a_split_bag_is_sorted(tmp_path: Path) -> None:
    odom, cmd = seconds(0, 60, 0), commands(0.01, 60, 1)
    # The first message of the second part is 5 ms before the last one of the first part.
    odom[30] = (odom[29][0] - 0.005, 30)
    for name, part in (("a", slice(30)), ("b", slice(30, 60))):
        channels = [numbers("/odom", odom[part]), integers("/cmd", cmd[part])]
        write_channels(tmp_path / f"{name}.mcap", channels)
    metadata = "rosbag2_bagfile_information: {relative_file_paths: [a.mcap, b.mcap]}"
    (tmp_path / "metadata.yaml").write_text(metadata)
    found = read(tmp_path)
    assert [episode.length for episode in found.dataset.episodes] == [59]
    # At 2.9 s, the last message is number 29.
    assert found.dataset.observations[28:32].ravel().tolist() == [28, 29, 29, 31]


CLOCKS = ({"rate_hz": 10}, {"topic": "/odom"})


@pytest.mark.parametrize("clock", CLOCKS, ids=str)
@pytest.mark.parametrize("align", ["last", "nearest", "linear"])
@pytest.mark.parametrize("pause_s", [1.1, 5.0, 864_000.0])
def test_recordings_have_the_same_steps_together_as_apart(
    tmp_path: Path, clock: Any, align: str, pause_s: float
) -> None:
    parts = []
    for name, start, first in (("a", 0.0, 0), ("b", 2.9 + pause_s, 100)):
        odom, cmd = seconds(start, 30, first), commands(start, 30, 1)
        channels = [numbers("/odom", odom), integers("/cmd", cmd)]
        parts.append(write_channels(tmp_path / f"{name}.mcap", channels))
    parts_read = {"clock": clock, "observation": {"x": {"field": "/odom.data", "align": align}}}
    found = read(parts, **parts_read)
    assert [episode.length for episode in found.dataset.episodes] == [29, 29]
    assert found.dataset.frames.ravel().tolist() == [*range(30), *range(100, 130)]
    assert found.report.clock_steps == 60
    apart = [read(path, **parts_read).dataset for path in parts]
    for k, episode in enumerate(found.dataset.episodes):
        assert episode.log_time_ns.tolist() == apart[k].episodes[0].log_time_ns.tolist()


@pytest.mark.parametrize("clock", CLOCKS, ids=str)
@pytest.mark.parametrize("align", ["last", "nearest", "linear"])
def test_a_pause_of_a_recording_has_no_steps(tmp_path: Path, clock: Any, align: str) -> None:
    odom, cmd = seconds(0, 30, 0), commands(0, 30, 1)
    odom, cmd = odom + seconds(22.9, 30, 100), cmd + commands(22.9, 30, 1)
    path = write_channels(
        tmp_path / "pause.mcap",
        # Nothing is observed between the drives, though the commands go on.
        [numbers("/odom", odom), integers("/cmd", cmd), integers("/on", commands(0, 259, 7))],
    )
    tree = {"clock": clock, "observation": {"x": {"field": "/odom.data", "align": align}}}
    for more in ({}, {"fields": {"on": {"field": "/on.data"}}}):
        found = read(path, **tree, **more)
        assert [episode.length for episode in found.dataset.episodes] == [29, 29]
        assert found.dataset.frames.ravel().tolist() == [*range(30), *range(100, 130)]
        assert (found.report.recordings, found.report.ends) == (1, {"gap": 1, "end_of_data": 1})


def test_nothing_is_carried_from_one_recording_to_the_next(tmp_path: Path) -> None:
    one = write_channels(
        tmp_path / "a.mcap",
        [
            numbers("/odom", seconds(0, 30, 0)),
            integers("/cmd", commands(0, 30, 2)),
            numbers("/goal", [(0.0, 5.0)]),
        ],
    )
    # A day later, the first command comes after one second, and the goal after 1.5 s.
    day = 86_400.0
    two = write_channels(
        tmp_path / "b.mcap",
        [
            numbers("/odom", seconds(day, 30, 0)),
            integers("/cmd", commands(day + 1, 20, 1)),
            numbers("/goal", [(day + 1.5, 6.0)]),
        ],
    )
    observation = {"x": {"field": "/odom.data"}, "g": {"field": "/goal.data", "missing": -1}}
    found = read([one, two], observation=observation)
    first, second = found.dataset.episodes
    assert set(first.observations[:, 1].tolist()) == {5.0}
    assert (second.length, set(second.actions.tolist())) == (19, {1})
    assert second.observations[:, 1].tolist() == [-1.0] * 5 + [6.0] * 14


def test_an_episode_for_each_recording(tmp_path: Path) -> None:
    paths = []
    for name, start in (("a", 0.0), ("b", 100.0)):
        # The first part of each recording is shorter than the second one.
        odom = seconds(start, 10, 0) + seconds(start + 10, 20, 100)
        cmd = commands(start, 10, 0) + commands(start + 10, 20, 1)
        channels = [numbers("/odom", odom), integers("/cmd", cmd)]
        paths.append(write_channels(tmp_path / f"{name}.mcap", channels))
    assert [each.length for each in read(paths).dataset.episodes] == [9, 19, 9, 19]
    found = read(paths, episodes={"per": "recording"})
    assert [each.length for each in found.dataset.episodes] == [19, 19]
    assert found.report.dropped == [9, 9]
    assert any("2 short episodes" in each.what for each in found.report.problems())


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
    # All commands were recorded after the second run.
    path = recorded(tmp_path / "one.mcap", [*odom, *cmd[:40]])
    with pytest.raises(UsageError, match="the clocks of /odom and /cmd go back at different"):
        read(path)
    # The clock of the commands goes on.
    rows = drive(40, 0, 0) + [(topic, time + 4, value) for topic, time, value in drive(40, 40, 1)]
    rows = [(t, time - 4 * (t == "/odom" and k >= 80), v) for k, (t, time, v) in enumerate(rows)]
    path = recorded(tmp_path / "other.mcap", rows)
    with pytest.raises(UsageError, match=r"the clock of /odom goes back at 3.900 s, that of /cmd"):
        read(path)


def test_a_topic_with_few_messages_belongs_to_runs_by_its_place(tmp_path: Path) -> None:
    runs = [drive(40, 0, 0), drive(50, 1000, 1)]
    for goal_s in ((1.0, 1.5), (1.0, 3.0), (3.0, 0.5)):
        rows = []
        for part, at_s, value in zip(runs, goal_s, (7.0, 8.0), strict=True):
            at = next(k for k, row in enumerate(part) if row[1] >= at_s)
            rows += [*part[:at], ("/goal", at_s, value), *part[at:]]
        path = recorded(tmp_path / "goals.mcap", rows)
        goal = {"g": {"field": "/goal.data", "missing": -1}}
        found = read(path, observation={"x": {"field": "/odom.data"}, **goal})
        assert found.report.clock_resets == 1
        first, second = found.dataset.episodes
        assert set(first.observations[:, 1].tolist()) == {-1.0, 7.0}
        assert set(second.observations[:, 1].tolist()) == {-1.0, 8.0}


def test_a_reset_by_less_than_the_gap_divides_the_recording(tmp_path: Path) -> None:
    # The first run has 15 steps: its clock goes back by 1.4 s.
    found = read(recorded(tmp_path / "short.mcap", [*drive(15, 0, 0), *drive(50, 100, 1)]))
    assert found.report.clock_resets == 1
    assert observed(found) == [([0, 1], {0}), ([100, 101], {1})]
    assert [episode.length for episode in found.dataset.episodes] == [14, 49]


@pytest.mark.parametrize("bad_s", [0.0, 900.0, 1e6, 1050.0])
@pytest.mark.parametrize("row", [0, 20, 39])
def test_single_messages_with_impossible_times_are_left_out(
    tmp_path: Path, bad_s: float, row: int
) -> None:
    rows = [(topic, time_s + 1000, value) for topic, time_s, value in drive(40, 0, 1)]
    rows[2 * row] = ("/odom", bad_s, rows[2 * row][2])
    found = read(recorded(tmp_path / "bad.mcap", rows))
    values = [float(k) for k in range(40) if k != row]
    seen = found.dataset.frames.ravel().tolist()
    assert sorted(set(seen)) == values
    assert seen == sorted(seen)
    assert [episode.length for episode in found.dataset.episodes] == [39 - (row in (0, 39))]
    # A message before the others, or after them, may be right; it has no steps around it.
    is_between = 0 < row < 39 or (row == 0) == (bad_s > 1000)
    count = [each for each in found.report.left_out if each.where == "/odom"]
    assert [each.what[:9] for each in count] == (["1 message"] if is_between else [])


@pytest.mark.parametrize("other", [False, True])
def test_publishers_with_different_clocks_are_refused(tmp_path: Path, other: bool) -> None:
    # The clock of every second message of each topic, or only of /odom, is 5 s late.
    rows = [
        (topic, time_s + 10 - 5 * (k // 2 % 2 and (topic == "/odom" or not other)), value)
        for k, (topic, time_s, value) in enumerate(drive(100, 0, 1))
    ]
    with pytest.raises(UsageError, match="goes back 50 times in 100 messages, as if publishers"):
        read(recorded(tmp_path / "two.mcap", rows))


def test_a_topic_that_was_written_out_of_order_is_sorted(tmp_path: Path) -> None:
    rows = drive(100, 0, 1)
    odom, cmd = rows[::2], rows[1::2]
    # The chunks of /odom: 0 s to 2 s, 5 s to 7 s, 2 s to 5 s, 7 s to 10 s.
    odom = odom[:20] + odom[50:70] + odom[20:50] + odom[70:]
    rows = [row for pair in zip(odom, cmd, strict=True) for row in pair]
    found = read(recorded(tmp_path / "chunks.mcap", rows))
    assert found.dataset.frames.ravel().tolist() == list(range(100))
    assert found.report.clock_resets == 0


def test_each_message_of_a_clock_is_a_step_also_with_equal_times(tmp_path: Path) -> None:
    # A simulation whose clock has 20 ticks, with three messages of each topic in each tick.
    rows = [
        (topic, k // 3 / 10, float(k % 2 if topic == "/cmd" else k))
        for k in range(60)
        for topic in ("/odom", "/cmd")
    ]
    path = recorded(tmp_path / "slow.mcap", rows)
    found = read(path, clock={"topic": "/odom"})
    assert [episode.length for episode in found.dataset.episodes] == [59]
    assert found.dataset.frames.ravel().tolist() == list(range(60))
    assert found.dataset.actions.tolist() == [k % 2 for k in range(59)]
    assert found.report.clock_steps == 60
    (episode,) = found.dataset.episodes
    since_ns = episode.log_time_ns - episode.log_time_ns[0]
    assert since_ns.tolist() == [k // 3 * 100_000_000 + k % 3 for k in range(60)]
    assert found.dataset.metadata["step_duration_ns"] == str(round(1.9e9 / 59))


STAMPED = "float64 data\nuint64 timestamp"


def test_each_quantity_may_have_its_own_time(tmp_path: Path) -> None:
    # The sensor is 0.3 s late: its stamp, in microseconds, says when it measured.
    odom = [
        (k / 10 + 0.3, number(k) + (START_NS // 1000 + k * 100_000).to_bytes(8, "little"))
        for k in range(40)
    ]
    path = write_channels(
        tmp_path / "late.mcap",
        [
            Channel("/odom", "acme_msgs/msg/Stamped", STAMPED, odom),
            integers("/cmd", commands(0, 40, 0)),
            integers("/mode", [(k / 10, k) for k in range(40)]),
        ],
    )
    action = {"field": "/mode.data", "align": "last"}
    for time in ("timestamp", "/odom.timestamp"):
        stamp = {"field": time, "unit": "us"}
        observation = {"x": {"field": "/odom.data", "time": stamp}}
        found = read(path, observation=observation, action=action).dataset
        assert found.observations[:, 0].tolist() == found.actions.tolist() == list(range(39))
    late = read(path, action=action).dataset
    assert set((late.actions - late.observations[:, 0])[:-3].tolist()) == {3}
    with pytest.raises(
        UsageError, match=r"action: /mode \(std_msgs/msg/Int32\) has no header.stamp"
    ):
        read(path, action={**action, "time": "header"})
    with pytest.raises(
        UsageError, match="action: time is a field of /odom, expected a field of /m"
    ):
        read(path, action={**action, "time": {"field": "/odom.timestamp", "unit": "us"}})
    with pytest.raises(UsageError, match=r"observation.x.time.unit: Input should be 's'"):
        read(path, observation={"x": {"field": "/odom.data", "time": {"field": "a", "unit": "h"}}})


def test_a_damaged_message_costs_one_message(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    odom, cmd = numbers("/odom", seconds(0, 30, 0)), integers("/cmd", commands(0, 30, 1))
    odom.messages[10] = (odom.messages[10][0], b"abc")
    path = write_channels(tmp_path / "bad.mcap", [odom, cmd])
    found = read(path)
    assert found.dataset.frames.ravel().tolist() == [*range(10), 9, *range(11, 30)]
    (problem,) = found.report.left_out
    assert problem.where == "/odom"
    assert problem.what.startswith(
        "1 of 30 messages cannot be decoded and are left out; the first is message 10 at"
        f" {START_NS + 10**9} ns: cannot decode 7 bytes as std_msgs/msg/Float64"
    )
    tree = {
        "clock": {"rate_hz": 10},
        "observation": {"x": {"field": "/odom.data"}},
        "action": {"field": "/cmd.data"},
    }
    with pytest.raises(LogError, match=f"/odom: message 10 at {START_NS + 10**9} ns: cannot"):
        read_bag(path, {**tree, "strict": True})
    with pytest.warns(UserWarning, match="1 of 30 messages cannot be decoded"):
        assert len(mcaprl.open(path, mapping=tree)) == 29
    (tmp_path / "robot.yaml").write_text(json.dumps(tree))
    command = ["convert", str(path), "--dry-run", "--mapping", str(tmp_path / "robot.yaml")]
    assert run(command) == 0
    assert "1 of 30 messages cannot be decoded" in " ".join(capsys.readouterr().out.split())
    assert run([*command, "--strict"]) == 1
    assert "/odom: message 10 at" in capsys.readouterr().err


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
        mcaprl.convert(opened, log)
        times = [episode.log_time_ns.tolist() for episode in mcaprl.open(log).episodes]
        assert times == [episode.log_time_ns.tolist() for episode in opened.episodes]
        assert times[0][0] == 0
        assert times[1][0] == 4_900_000_000
    assert logs[0].read_bytes() == logs[1].read_bytes()
