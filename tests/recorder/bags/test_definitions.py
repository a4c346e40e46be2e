"""Type definitions in bags: IDL, ROS 1 in MCAP, missing types, and unsupported encodings."""

from __future__ import annotations

import re
import struct
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

from mcaprl.errors import LogError
from mcaprl.recorder.bags.bag import open_bag
from mcaprl.recorder.bags.decoders import RosDecoder
from tests.support.bags import START_NS, STORE1, STORE2, Channel, numbers, write_channels

IDL = """\
================================================================================
IDL: demo_msgs/msg/Level
module demo_msgs { module msg {
  module Level_Constants { const uint8 HIGH = 3; };
  struct Level { uint8 level; double ratio; sequence<float> parts; };
}; };
"""


def write_mcap(path: Path, channels: list[tuple[str, str, str, str, str, bytes]]) -> Path:
    """Write one message for each channel.

    A channel is given as topic, type, schema encoding, definition, message encoding and data.
    """
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic, name, schema_encoding, text, encoding, data in channels:
            schema = writer.register_schema(name, schema_encoding, text.encode())
            channel = writer.register_channel(topic, encoding, schema)
            writer.add_message(channel, START_NS, data, START_NS + 5)
        writer.finish()
    return path


def vector(store: Any, kind: str = "geometry_msgs/msg/Vector3") -> Any:
    return store.types[kind](1.0, 2.0, 3.0)


def test_idl_definitions(tmp_path: Path) -> None:
    decoder = RosDecoder("demo_msgs/msg/Level", IDL, encoding="ros2idl")
    assert decoder.fields == {"level": "uint8", "ratio": "float64", "parts": "float32[]"}
    data = bytes([0, 1, 0, 0]) + struct.pack("<B7xdI2f", 2, 0.5, 2, 1.0, 2.0)
    path = write_mcap(
        tmp_path / "idl.mcap", [("/level", "demo_msgs/msg/Level", "ros2idl", IDL, "cdr", data)]
    )
    with closing(open_bag(path)) as bag:
        found = bag.read("/level", ["level", "ratio", "parts", "publish_time"]).columns
        assert (found["level"][0], found["ratio"][0]) == (2, 0.5)
        assert found["parts"].tolist() == [[1.0, 2.0]]
        assert found["publish_time"].tolist() == [START_NS + 5]


def test_ros1_messages_in_mcap(tmp_path: Path) -> None:
    text, _ = STORE1.generate_msgdef("geometry_msgs/msg/Vector3", ros_version=1)
    data = bytes(STORE1.serialize_ros1(vector(STORE1), "geometry_msgs/msg/Vector3"))
    path = write_mcap(
        tmp_path / "one.mcap", [("/v", "geometry_msgs/Vector3", "ros1msg", text, "ros1", data)]
    )
    with closing(open_bag(path)) as bag:
        found = bag.read("/v", ["x", "z"]).columns
        assert [found["x"].tolist(), found["z"].tolist()] == [[1.0], [3.0]]


def test_known_types_need_no_definition_and_others_are_named(tmp_path: Path) -> None:
    kind = "geometry_msgs/msg/Vector3"
    data = bytes(STORE2.serialize_cdr(vector(STORE2), kind))
    broken = "geometry_msgs/Vector3 inner\nacme_msgs/Wheel wheel\n"
    path = write_mcap(
        tmp_path / "types.mcap",
        [
            ("/known", kind, "ros2msg", "", "cdr", data),
            ("/unknown", "acme_msgs/msg/Robot", "ros2msg", "", "cdr", data),
            ("/nested", "acme_msgs/msg/Car", "ros2msg", broken, "cdr", data),
            ("/flat", "fb.Thing", "flatbuffer", "", "flatbuffer", data),
        ],
    )
    with closing(open_bag(path)) as bag:
        assert bag.read("/known", ["y"]).columns["y"].tolist() == [2.0]
        problems = {name: topic.problem for name, topic in bag.topics.items()}
        assert problems["/known"] == ""
        assert "acme_msgs/msg/Robot: its definition is missing" in problems["/unknown"]
        assert "the definition of nested type acme_msgs/msg/Wheel is mi" in problems["/nested"]
        assert "encoding 'flatbuffer'" in problems["/flat"]
        assert bag.topics["/flat"].count == 1
        with pytest.raises(LogError, match="/unknown cannot be read: acme_msgs/msg/Robot"):
            bag.read("/unknown", ["x"])


def test_a_topic_of_several_types_costs_only_itself(tmp_path: Path) -> None:
    kinds = ("geometry_msgs/msg/Vector3", "geometry_msgs/msg/Point")
    channels = [
        (topic, kind, "ros2msg", "", "cdr", bytes(STORE2.serialize_cdr(vector(STORE2, kind), kind)))
        for topic, kind in (("/mixed", kinds[0]), ("/mixed", kinds[1]), ("/one", kinds[0]))
    ]
    with closing(open_bag(write_mcap(tmp_path / "mixed.mcap", channels))) as bag:
        assert "messages of several types" in bag.topics["/mixed"].problem
        assert bag.topics["/mixed"].count == 2
        assert bag.read("/one", ["x"]).columns["x"].tolist() == [1.0]


POINT = "acme_msgs/msg/Point"
XY, YX = "float64 x\nfloat64 y", "float64 y\nfloat64 x"


def test_each_message_is_decoded_by_its_own_definition(tmp_path: Path) -> None:
    data = struct.pack("<2d", 1.0, 2.0)
    one = write_channels(tmp_path / "one.mcap", [Channel("/p", POINT, XY, [(0, data)])])
    two = write_channels(
        tmp_path / "two.mcap",
        [Channel("/p", POINT, YX, [(1, data)]), Channel("/p", POINT, XY, [(2, data)])],
    )
    with closing(open_bag([two, one])) as bag:
        found = bag.read("/p", ["x", "y"]).columns
        assert found["x"].tolist() == [1, 2, 1]
        assert found["y"].tolist() == [2, 1, 2]
        assert bag.read("/p", ["x"], np.array([1, 0, 1])).columns["x"].tolist() == [2, 1, 2]


def test_fields_and_constants_of_several_definitions(tmp_path: Path) -> None:
    old, new = "float32 x\nint32 A=1\nint32 B=2", "float64 x\nfloat64 y\nint32 A=1\nint32 B=3"
    channels = [
        Channel("/p", POINT, old, [(0, struct.pack("<f", 1.5))]),
        Channel("/p", POINT, new, [(1, struct.pack("<2d", 2.5, 3.5))]),
    ]
    with closing(open_bag(write_channels(tmp_path / "new.mcap", channels))) as bag:
        assert bag.topics["/p"].constants == {"A": 1}
        found = bag.read("/p", ["x", "y"]).columns
        assert found["x"].tolist() == [1.5, 2.5]
        # The older definition has no `y`.
        np.testing.assert_array_equal(found["y"], [np.nan, 3.5])
    channels[0] = Channel("/p", POINT, "string x", [(0, struct.pack("<I2s", 2, b"a\0"))])
    with closing(open_bag(write_channels(tmp_path / "text.mcap", channels))) as bag:
        problem = bag.topics["/p"].problem
        assert "several definitions: x is string in one and float64 in another" in problem


def test_channels_of_a_topic_are_merged_in_the_order_of_recording(tmp_path: Path) -> None:
    channels = [numbers("/odom", [(k, k) for k in range(first, 6, 3)]) for first in range(3)]
    with closing(open_bag(write_channels(tmp_path / "three.mcap", channels))) as bag:
        np.testing.assert_array_equal(bag.times("/odom"), START_NS + np.arange(6) * 10**9)
        assert bag.read("/odom", ["data"]).columns["data"].tolist() == [0, 1, 2, 3, 4, 5]
        rows = np.array([4, 0, 4])
        assert bag.read("/odom", ["data"], rows).columns["data"].tolist() == [4, 0, 4]
        places = bag.places("/odom")
        assert set(places[:, 0]) == {0}
        assert (np.diff(places[:, 1]) > 0).all()


def test_damaged_messages_name_their_topic(tmp_path: Path) -> None:
    kind = "geometry_msgs/msg/Vector3"
    path = write_mcap(tmp_path / "bad.mcap", [("/v", kind, "ros2msg", "", "cdr", b"\0\1\0\0abc")])
    with (
        closing(open_bag(path)) as bag,
        pytest.raises(LogError, match=r"/v: message 0 at [0-9]+ ns: cannot decode 7 bytes as "),
    ):
        bag.read("/v", ["x"])


EVENT = """\
service_msgs/msg/ServiceEventInfo info
std_srvs/srv/SetBool_Request[<=1] request
std_srvs/srv/SetBool_Response[<=1] response
"""


@pytest.mark.parametrize("parts", ["", f"{'=' * 80}\nMSG: std_srvs/srv/SetBool_Request\n"])
def test_service_events_are_read_without_their_request(parts: str, tmp_path: Path) -> None:
    kind = "std_srvs/srv/SetBool_Event"
    # The event has type 2, time 3.5 s, a client id of 16 bytes with the value 7, and sequence
    # number 9. It has neither a request nor a response.
    info = struct.pack("<B3xiI16sxxxxq", 2, 3, 500_000_000, b"\7" * 16, 9)
    data = b"\0\1\0\0" + info + struct.pack("<II", 0, 0)
    other = ("/v", "geometry_msgs/msg/Vector3", "ros2msg", "", "cdr")
    value = bytes(STORE2.serialize_cdr(vector(STORE2), other[1]))
    path = write_mcap(
        tmp_path / "events.mcap",
        [
            ("/set/_service_event", kind, "ros2msg", EVENT + parts, "cdr", data),
            (*other, value),
        ],
    )
    with closing(open_bag(path)) as bag:
        assert not bag.topics["/set/_service_event"].problem
        fields = ["info.event_type", "info.stamp", "info.sequence_number", "request"]
        found = bag.read("/set/_service_event", fields).columns
        assert found["info.event_type"].tolist() == [2]
        assert found["info.stamp"].tolist() == [3_500_000_000]
        assert found["info.sequence_number"].tolist() == [9]
        assert len(found["request"][0]) == 0
        assert bag.topics["/set/_service_event"].constants == {}
        assert bag.read("/v", ["x"]).columns["x"].tolist() == [1.0]


def with_parts(text: str, part: str) -> str:
    """Return a definition with the definition of a nested type, as rosbag2 writes it."""
    return f"{text}\n{'=' * 80}\n{part}\n"


@pytest.mark.parametrize("end", ["\r\n", "\r"])
def test_other_ends_of_lines(end: str) -> None:
    text = with_parts("float64 x\n# A comment\n\np/B b\nuint8 A=3", "MSG: p/B\nint32 y\n")
    decoder = RosDecoder("p/A", text.replace("\n", end))
    assert (decoder.fields, decoder.constants) == ({"x": "float64", "b.y": "int32"}, {"A": 3})
    idl = RosDecoder("demo_msgs/msg/Level", IDL.replace("\n", end), encoding="ros2idl")
    assert idl.fields["ratio"] == "float64"


def test_idl_with_preprocessor_lines_and_several_modules() -> None:
    text = f"""\
{"=" * 80}
IDL: car_msgs/msg/Car
// generated from rosidl_adapter/resource/msg.idl.em
#include "geometry_msgs/msg/Point.idl"
#ifndef CAR_IDL
#define CAR_IDL
  #pragma once  // and a comment
module car_msgs {{ module msg {{
  /* # not a directive
   * @verbatim (language="comment", text="x") */
  @verbatim (language="comment", text="a " "# b")
  struct Car {{
    @unit (value="m")
    geometry_msgs::msg::Point at;
    wheels::msg::Wheel wheel;
    #ifdef OLD
    double old;
    #else
    double speed;
    #endif
  }};
}}; }};
#endif // CAR_IDL
{"=" * 80}
IDL: geometry_msgs/msg/Point
module geometry_msgs {{ module msg {{ struct Point {{ double x; double y; }}; }}; }};
module wheels {{ module msg {{ struct Wheel {{ float turns; }}; }}; }};
"""
    expected = {"at.x": "float64", "at.y": "float64", "wheel.turns": "float32", "speed": "float64"}
    assert RosDecoder("car_msgs/msg/Car", text, encoding="ros2idl").fields == expected
    for line, reason in (
        ("#if VERSION > 2", "#if VERSION > 2 cannot be evaluated"),
        ("#endif", "#endif has no #if"),
        ("const long A = ((1));", "expressions in parentheses are not supported"),
        ("const long A = 1 << 10000000000;", "shifts by more than 99 bits"),
        ("const long A = 9; const long B = A * A;", "products of constants"),
        (f"const long A = 1{' + 1' * 20_000};", "more than 10000 fields and constants"),
        (f"const long A = {'A::' * 20_000}A;", "more than 10000 fields and constants"),
        ("@a ((1))", "expressions in parentheses are not supported"),
    ):
        broken = text.replace("module car_msgs", f"{line}\nmodule car_msgs")
        with pytest.raises(
            LogError, match=f"car_msgs/msg/Car does not parse: .*{re.escape(reason)}"
        ):
            RosDecoder("car_msgs/msg/Car", broken, encoding="ros2idl")


def test_idl_wide_strings_and_names_of_services() -> None:
    text = """\
module p { module srv { struct Go_Request { double x; wstring<5> w; double y; }; }; };
"""
    decoder = RosDecoder("p/srv/Go_Request", text, encoding="ros2idl")
    assert decoder.fields == {"x": "float64", "y": "float64"}
    assert set(decoder.unreadable) == {"w"}
    wide = 'float64 x\nwstring<=7 w\nwstring GREETING="hi"\nwstring d "hello"\nfloat64 y'
    decoder = RosDecoder("p/A", wide)
    assert decoder.fields == {"x": "float64", "y": "float64"}
    assert set(decoder.unreadable) == {"w", "d"}


def test_the_encoding_unknown_means_that_there_is_no_definition(tmp_path: Path) -> None:
    kind = "geometry_msgs/msg/Vector3"
    data = bytes(STORE2.serialize_cdr(vector(STORE2), kind))
    path = write_mcap(
        tmp_path / "unknown.mcap",
        [
            ("/known", kind, "unknown", "", "cdr", data),
            ("/own", "acme_msgs/msg/Robot", "unknown", "", "cdr", data),
        ],
    )
    with closing(open_bag(path)) as bag:
        assert bag.read("/known", ["y"]).columns["y"].tolist() == [2.0]
        assert "acme_msgs/msg/Robot: its definition is missing" in bag.topics["/own"].problem
