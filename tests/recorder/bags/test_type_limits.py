"""ROS types that contain themselves or are too large, and fields that cannot be read."""

from __future__ import annotations

import struct
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.bags.bag import open_bag
from mcaprl.recorder.bags.decoders import RosDecoder
from mcaprl.recorder.mapping.align import field_path
from tests.support.bags import Channel, write_channels

LINE = f"\n{'=' * 80}\nMSG: "


def text_of(**types: str) -> str:
    """Return a definition; the first type is that of the message."""
    first, *others = types.items()
    return first[1] + "".join(f"{LINE}p/{name}\n{text}" for name, text in others)


def chain(count: int, fields: int = 1) -> str:
    """Return types T0 to T(count - 1), each with some fields of the next type."""
    parts = {
        f"T{k}": "\n".join(f"p/T{k + 1} f{j}" for j in range(fields)) for k in range(count - 1)
    }
    return text_of(**parts, **{f"T{count - 1}": "float64 x"})


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("p/A a", "p/msg/A contains itself"),
        (text_of(A="p/B b", B="p/A[] a"), "p/msg/A contains itself"),
        (chain(3000), "nested in more than 64 levels"),
        (chain(40, fields=2), "has more than 10000 fields"),
        (text_of(A="p/E[1000000000] x", E="uint8 b"), "arrays of 1000000000 messages or strings"),
        ("string[1000000000] x", "fixed arrays of 1000000000 messages or strings"),
        ("float64 x\n" * 60_000, "has more than 10000 fields and constants"),
        ("#" * 2**20 + "\nfloat64 x", "1048586 characters; at most 1048576"),
    ],
)
def test_types_that_are_too_large_cost_only_their_topic(
    text: str, reason: str, tmp_path: Path
) -> None:
    plain = Channel("/plain", "p/msg/X", "float64 x", [(0, struct.pack("<d", 1.5))])
    channels = [Channel("/large", "p/msg/A", text, [(0, b"\0" * 16)]), plain]
    with closing(open_bag(write_channels(tmp_path / "a.mcap", channels))) as bag:
        assert reason in bag.topics["/large"].problem
        assert bag.read("/plain", ["x"]).columns["x"].tolist() == [1.5]


def test_ros1_messages_without_bytes_are_counted() -> None:
    texts = {"A": "p/B[300] b", "B": "p/C[300] c", "C": "p/E[300] e", "E": ""}
    with pytest.raises(LogError, match="nested messages in 0 bytes"):
        RosDecoder("p/A", text_of(**texts), encoding="ros1msg")
    with pytest.raises(LogError, match="b is a sequence of messages with too few bytes"):
        RosDecoder("p/A", text_of(A="p/B[] b", B="p/E[60] e", E=""), encoding="ros1msg")
    decoder = RosDecoder("p/A", text_of(A="p/E[3] e\nuint8 x", E=""), encoding="ros1msg")
    assert decoder.decode(b"\x07").x == 7


def test_arrays_are_compared_with_the_bytes_of_the_message() -> None:
    decoder = RosDecoder("p/A", text_of(A="p/B[] b", B="float64 x"))
    with pytest.raises(LogError, match="cannot decode 8 bytes"):
        decoder.decode(b"\0\1\0\0" + struct.pack("<I", 2**31))
    decoder = RosDecoder("p/A", "float64[1000000000] x")
    with pytest.raises(LogError, match="cannot decode 20 bytes"):
        decoder.decode(b"\0\1\0\0" + bytes(16))


def test_a_ros2_message_without_fields_has_one_byte() -> None:
    decoder = RosDecoder("p/A", text_of(A="p/E e\nuint8 x", E=""))
    assert decoder.decode(b"\0\1\0\0\0\x07").x == 7


def test_leaf_fields_of_arrays_of_messages() -> None:
    text = text_of(
        A="p/B[] b\np/B one\nfloat32[3] v\nbuiltin_interfaces/Time[] t",
        B="float32 q\np/C[2] c",
        C="float64[4] d",
    )
    assert RosDecoder("p/A", text).fields == {
        "b": "p/msg/B[]",
        "b[].q": "float32[]",
        "b[].c": "p/msg/C[2][]",
        "b[].c[].d": "float64[4][][]",
        "one.q": "float32",
        "one.c": "p/msg/C[2]",
        "one.c[].d": "float64[4][]",
        "v": "float32[3]",
        "t": "builtin_interfaces/msg/Time[]",
        "t[].sec": "int32[]",
        "t[].nanosec": "uint32[]",
    }


WIDE = text_of(
    A="float64 before\np/Inner first\nfloat64 after",
    Inner="int32 n\nwstring text\nint32 m",
)


@pytest.mark.parametrize(("code", "size"), [("H", 2), ("I", 4)])
@pytest.mark.parametrize("text", ["", "a", "hi", "abc", "\u4f60\u597d, robot"])
def test_wide_strings_cost_only_themselves(tmp_path: Path, code: str, size: int, text: str) -> None:
    # The characters have 16 or 32 bits, as the DDS of the robot has them.
    wide = struct.pack(f"<I{len(text)}{code}", len(text), *map(ord, text))
    data = struct.pack("<di", 1.5, 7) + wide
    data += bytes(-len(data) % 4) + struct.pack("<i", 9)
    data += bytes(-len(data) % 8) + struct.pack("<d", 2.5)
    nested = text_of(N="float64 x\np/A a" + LINE + "p/A\n" + WIDE)
    channels = [
        Channel("/wide", "p/msg/A", WIDE, [(0, data), (1, data)]),
        # A type that nests the field after the wanted number.
        Channel("/nests", "p/msg/N", nested, [(0, struct.pack("<d", 3.5) + data)]),
        Channel("/array", "p/msg/R", "float64 x\nwstring[] w", [(0, struct.pack("<dI", 4.5, 0))]),
    ]
    with closing(open_bag(write_channels(tmp_path / "wide.mcap", channels))) as bag:
        assert not any(topic.problem for topic in bag.topics.values())
        assert bag.topics["/wide"].fields == {
            "before": "float64",
            "first.n": "int32",
            "first.m": "int32",
            "after": "float64",
        }
        found = bag.read("/wide", ["before", "first.n"]).columns
        assert (found["before"].tolist(), found["first.n"].tolist()) == ([1.5, 1.5], [7, 7])
        found = bag.read("/wide", ["first.m", "after"]).columns
        assert (found["first.m"].tolist(), found["after"].tolist()) == ([9, 9], [2.5, 2.5])
        assert bag.read("/nests", ["x", "a.after"]).columns["a.after"].tolist() == [2.5]
        assert bag.read("/array", ["x"]).columns["x"].tolist() == [4.5]
        for topic, field in (("/wide", "first.text"), ("/nests", "a.first.text"), ("/array", "w")):
            with pytest.raises(LogError, match=rf"{topic}: .* contains a wstring, whose encoding"):
                bag.read(topic, [field])
            with pytest.raises(UsageError, match=rf"{topic}: .* contains a wstring"):
                field_path(bag, f"{topic}.{field}")


def test_fields_after_wide_strings_of_unknown_form_are_missing(tmp_path: Path) -> None:
    # The length counts bytes, and no form fits.
    data = struct.pack("<diI2H", 1.5, 7, 4, *b"hi") + struct.pack("<id", 9, 2.5)
    path = write_channels(tmp_path / "wide.mcap", [Channel("/wide", "p/msg/A", WIDE, [(0, data)])])
    with closing(open_bag(path)) as bag:
        found = bag.read("/wide", ["first.n", "after", "publish_time"]).columns
        assert found["first.n"].tolist() == [7]
        assert np.isnan(found["after"]).tolist() == [True]


def test_field_names_that_are_words_of_python() -> None:
    decoder = RosDecoder("p/A", "uint8 from\nuint8 x")
    message = decoder.decode(b"\0\1\0\0\x03\x04")
    assert (getattr(message, "from"), message.x) == (3, 4)
