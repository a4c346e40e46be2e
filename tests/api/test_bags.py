"""`info` and `check` of any bag, without a mapping."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import pytest
from mcap.writer import Writer

import mcaprl
from mcaprl.api.logs import BagInfo
from mcaprl.cli import run
from mcaprl.errors import LogError, NotMcapError
from tests.support.bags import (
    START_NS,
    STEP_NS,
    STEPS,
    Channel,
    numbers,
    write_channels,
    write_rosbag1,
    write_rosbag2,
)
from tests.support.paths import GOLDEN

FORMS = {
    "mcap": lambda path: write_rosbag2(path / "bag"),
    "mcap file": lambda path: next(write_rosbag2(path / "bag").glob("*.mcap")),
    "sqlite3": lambda path: write_rosbag2(path / "bag", "sqlite3"),
    "sqlite3 file": lambda path: next(write_rosbag2(path / "bag", "sqlite3").glob("*.db3")),
    "compressed": lambda path: write_rosbag2(path / "bag", "sqlite3", "MESSAGE"),
    "compressed file": lambda path: write_rosbag2(path / "bag", "sqlite3", "FILE"),
    "ros1": lambda path: write_rosbag1(path / "one.bag"),
    "parts": lambda path: write_rosbag2(path / "bag", "sqlite3", parts=3),
}


def contents(bag: Path) -> BagInfo:
    found = mcaprl.info(bag)
    assert isinstance(found, BagInfo)
    return found


@pytest.mark.parametrize("form", FORMS)
def test_any_bag_is_described_and_checked(
    form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = FORMS[form](tmp_path)
    found = contents(bag)
    odom = found.topics["/odom"]
    assert (odom.type, odom.count) == ("nav_msgs/msg/Odometry", STEPS)
    assert odom.encoding == ("ros1" if form == "ros1" else "cdr")
    assert odom.rate_hz == pytest.approx(10.0)
    assert odom.largest_gap_s == 0.1
    assert (odom.first_ns, odom.last_ns) == (START_NS, START_NS + 11 * STEP_NS)
    assert all(topic.readable for topic in found.topics.values())
    assert sum(each.messages for each in found.recordings) == 5 * STEPS
    assert found.next == f"mcaprl convert --suggest {bag} > robot.yaml"
    assert run(["info", str(bag)]) == 0
    shown = capsys.readouterr().out
    assert "/odom" in shown
    assert "2023-11-14 22:13:20 UTC" in shown
    assert run(["info", str(bag), "--json"]) == 0
    tree = json.loads(capsys.readouterr().out)
    assert tree["kind"] == "bag"
    assert {*tree} == {"kind", "files", "size_bytes", "recordings", "topics", "problems", "next"}
    assert [each["name"] for each in tree["topics"]] == sorted(found.topics)
    assert tree["topics"][3]["rate_hz"] == pytest.approx(10.0)
    assert run(["check", str(bag)]) == 0
    shown = capsys.readouterr().out
    assert "checked, no problems" in shown
    assert "pass --mapping FILE; `mcaprl convert --suggest BAG > FILE` drafts one" in shown
    assert "backup" not in shown


def test_gaps_and_rates_are_those_within_recordings(tmp_path: Path) -> None:
    # 10 Hz with a pause of 3 s in the first file; the second file begins a day later.
    first = [(k / 10 + 3 * (k > 20), 0.0) for k in range(40)]
    write_channels(tmp_path / "a.mcap", [numbers("/x", first), numbers("/once", [(2.0, 1.0)])])
    write_channels(tmp_path / "b.mcap", [numbers("/x", [(86400.0 + k / 10, 0.0) for k in (0, 1)])])
    found = contents(tmp_path)
    assert found.topics["/x"].largest_gap_s == pytest.approx(3.1)
    assert found.topics["/x"].rate_hz == pytest.approx(10.0)
    assert (found.topics["/once"].rate_hz, found.topics["/once"].largest_gap_s) == (0.0, 0.0)
    spans = [(each.paths[0].name, each.last_ns - each.first_ns) for each in found.recordings]
    assert spans == [("a.mcap", 6_900_000_000), ("b.mcap", 100_000_000)]


@pytest.fixture
def mixed(tmp_path: Path) -> Path:
    """MCAP file with a number, a cut message, JSON, and two topics that cannot be read."""
    path = tmp_path / "mixed.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=500)
        writer.start()
        number = writer.register_schema("x/msg/Number", "ros2msg", b"float64 data")
        own = writer.register_schema("own/msg/T", "ros2msg", b"")
        good, bad = (writer.register_channel(f"/{name}", "cdr", number) for name in ("good", "bad"))
        other = [writer.register_channel("/own", "cdr", own)]
        other.append(writer.register_channel("/cbor\x1b[2J", "cbor", 0))
        for k in range(50):
            data = b"\0\1\0\0" + struct.pack("<d", k)
            writer.add_message(good, k * STEP_NS, data, 0)
            writer.add_message(bad, k * STEP_NS, data[: 8 if k in (7, 9) else None], 0)
            for channel in other:
                writer.add_message(channel, k * STEP_NS, b"\0\1\0\0", 0)
        writer.finish()
    return path


def test_what_cannot_be_read_is_named(mixed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = contents(mixed)
    assert not found.topics["/own"].readable
    assert "own/msg/T: its definition is missing" in found.topics["/own"].problem
    assert [problem.split(" ")[0] for problem in found.problems] == ["/cbor\x1b[2J", "/own"]
    result = mcaprl.check(mixed)
    assert [(problem.where, problem.what.split(":")[0]) for problem in result.problems] == [
        ("/bad", f"message 7 at {7 * STEP_NS} ns"),
        ("/bad", f"message 9 at {9 * STEP_NS} ns"),
        ("/cbor\x1b[2J", result.problems[2].what.split(":")[0]),
        ("/own", "own/msg/T"),
    ]
    assert "messages of encoding 'cbor'" in result.problems[2].what
    for command in ("info", "check"):
        assert run([command, str(mixed)]) == int(command == "check")
        out, err = capsys.readouterr()
        assert "\x1b" not in out + err
        assert "/cbor\\x1b[2J" in out


def test_a_cut_bag_shows_what_is_left(
    mixed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = mixed.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(content[: len(content) // 2])
    found = contents(cut)
    assert 5 < found.topics["/good"].count < 50
    assert "has no end" in found.problems[0]
    assert f"`mcaprl recover {cut} OUT`" in found.problems[0]
    assert run(["check", str(cut)]) == 1
    shown = capsys.readouterr().out
    assert f"run `mcaprl recover {cut} OUT`" in shown
    assert "(/own)" in shown


def test_a_damaged_chunk_of_a_bag_is_found(mixed: Path, tmp_path: Path) -> None:
    content = bytearray(mixed.read_bytes())
    content[200] ^= 1
    (tmp_path / "damaged.mcap").write_bytes(content)
    found = mcaprl.check(tmp_path / "damaged.mcap").problems
    assert found
    assert all("recover" in problem.next for problem in found)


def test_empty_bags(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_channels(tmp_path / "empty.mcap", [numbers("/x", [])])
    found = contents(path)
    assert found.topics["/x"].count == 0
    assert found.next == "record again: the bag has no messages"
    (problem,) = mcaprl.check(path).problems
    assert problem.what == "the bag has no messages"
    nothing = write_channels(tmp_path / "nothing.mcap", [])
    assert run(["info", str(nothing)]) == 0
    assert "0 on 0 topics" in capsys.readouterr().out


def test_two_hundred_topics(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    channels = [numbers(f"/robot/part_{k:03}", [(0.0, 1.0), (0.5, 2.0)]) for k in range(200)]
    path = write_channels(tmp_path / "many.mcap", channels)
    assert run(["info", str(path)]) == 0
    shown = capsys.readouterr().out
    assert "400 on 200 topics" in shown
    assert sum("/robot/part_" in line for line in shown.splitlines()) == 200


def test_a_folder_of_bags_of_all_formats(tmp_path: Path) -> None:
    write_rosbag2(tmp_path / "season" / "day" / "a")
    write_rosbag2(tmp_path / "season" / "b", "sqlite3")
    write_rosbag1(tmp_path / "season" / "c.bag")
    bad = Channel("/bad", "x/msg/Number", "float64 data", [(0.0, b"\0")])
    write_channels(tmp_path / "season" / "d.mcap", [bad])
    found = contents(tmp_path / "season")
    assert len(found.sources) == 4
    # The encodings differ, so `/odom` cannot be read as one topic; `check` reads file by file.
    result = mcaprl.check(tmp_path / "season")
    assert len(result.files) == len(result.notes) == 4
    assert [problem.where for problem in result.problems] == ["/bad"]


def test_logs_are_shown_as_before(tmp_path: Path) -> None:
    found = mcaprl.info(GOLDEN / "discrete.mcap")
    assert found.episodes > 0
    assert found.to_json()["kind"] == "log"
    assert not mcaprl.check(GOLDEN / "discrete.mcap").notes
    (tmp_path / "garbage.bag").write_bytes(b"garbage")
    with pytest.raises(LogError, match="cannot be read as a bag"):
        mcaprl.info(tmp_path / "garbage.bag")
    assert not mcaprl.check(tmp_path / "garbage.bag").ok


def test_other_commands_name_the_kind_of_bag(tmp_path: Path) -> None:
    hint = r"needs a mapping: .*mcaprl convert --suggest BAG"
    one, two = write_rosbag1(tmp_path / "one.bag"), write_rosbag2(tmp_path / "two", "sqlite3")
    with pytest.raises(NotMcapError, match=f"is a ROS 1 bag; .*{hint}"):
        mcaprl.open(one)
    with pytest.raises(NotMcapError, match=f"is an SQLite database, as of rosbag2; .*{hint}"):
        mcaprl.layout(next(two.glob("*.db3")))
    with pytest.raises(LogError, match=f"two has no .mcap files; .*{hint}"):
        mcaprl.open(two)
