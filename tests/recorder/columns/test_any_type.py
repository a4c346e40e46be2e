"""Columns of random message types equal the messages that mcap-ros2-support decodes."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mcaprl.errors import LogError
from mcaprl.recorder.columns.cdr import MessageType
from mcaprl.recorder.columns.definitions import TIME_TYPES
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.topic import Topic

pytestmark = pytest.mark.usefixtures("each_copy")
NAME = "demo_msgs/msg/Outer"
SCALARS = ("float64", "int64", "uint32", "float32", "int16", "uint8", "bool", "string")
TIMES = ("builtin_interfaces/Time", "builtin_interfaces/Duration")
SEPARATOR = "=" * 80 + "\n"
TIME_TEXTS = "".join(f"{SEPARATOR}MSG: {name}\nint32 sec\nuint32 nanosec\n" for name in TIMES)


def lines(kinds: tuple[str, ...]) -> st.SearchStrategy[str]:
    """Generate message definitions with up to four fields."""
    arrays = st.sampled_from(["", "", "[3]", "[]"])
    fields = st.lists(st.tuples(st.sampled_from(kinds), arrays), min_size=1, max_size=4)
    return fields.map(
        lambda found: "".join(f"{kind}{end} f{k}\n" for k, (kind, end) in enumerate(found))
    )


DEFINITIONS = st.tuples(
    lines((*SCALARS, *TIMES, "demo_msgs/Middle")),
    lines((*SCALARS, *TIMES, "demo_msgs/Inner")),
    lines(SCALARS),
).map(
    lambda texts: (
        f"{texts[0]}{SEPARATOR}MSG: demo_msgs/Middle\n{texts[1]}"
        f"{SEPARATOR}MSG: demo_msgs/Inner\n{texts[2]}{TIME_TEXTS}"
    )
)


class Maker:
    """Generator of random messages of a type. Some strings and arrays differ in length."""

    def __init__(self, text: str, seed: int) -> None:
        self.store = get_typestore(Stores.EMPTY)
        found = get_types_from_msg(text, NAME)
        self.store.register({k: v for k, v in found.items() if k not in self.store.fielddefs})
        self._random = np.random.default_rng(seed)

    def message(self, name: str = NAME) -> Any:
        fields = self.store.fielddefs[name][1]
        return self.store.types[name](**{field: self._value(kind) for field, kind in fields})

    def _value(self, description: Any) -> Any:
        kind, what = description
        if kind.name == "BASE":
            return self._scalar(what[0])
        if kind.name == "NAME":
            return self.message(what)
        element, count = what
        values = [self._value(element) for _ in range(count or self._length())]
        is_number = element[0].name == "BASE" and element[1][0] != "string"
        return np.array(values, element[1][0]) if is_number else values

    def _length(self) -> int:
        return 2 if self._random.random() < 0.7 else int(self._random.integers(0, 4))

    def _scalar(self, kind: str) -> Any:
        if kind == "string":
            return "\u00e4bc"[: self._length()]
        if kind == "bool":
            return bool(self._random.random() < 0.5)
        if kind.startswith("float"):
            return float(np.float32(self._random.normal()))
        return int(self._random.integers(0, 100))


def write(path: Path, text: str, messages: list[bytes]) -> None:
    out = io.BytesIO()
    writer = Writer(out, chunk_size=300)
    writer.start(profile="ros2")
    schema = writer.register_schema(NAME, "ros2msg", text.encode())
    channel = writer.register_channel("/any", "cdr", schema)
    for row, data in enumerate(messages):
        writer.add_message(channel, row, data, row)
    writer.finish()
    path.write_bytes(out.getvalue())


def at(message: Any, path: str) -> Any:
    """Return the value of the field with this path; times are in nanoseconds."""
    for name in path.split("."):
        message = getattr(message, name)
    return plain(message)


def plain(value: Any) -> Any:
    """Convert messages to dicts, times to nanoseconds, and arrays to lists."""
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(each) for each in value]
    if hasattr(value, "nanosec"):
        return value.sec * 10**9 + value.nanosec
    if hasattr(value, "__dict__"):
        names = getattr(type(value), "__slots__", None) or vars(value)
        return {name: plain(getattr(value, name)) for name in names if name[0] != "_"}
    return list(value) if isinstance(value, bytes) else value


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(text=DEFINITIONS, seed=st.integers(0, 999))
def test_all_fields_equal_those_of_another_reader(text: str, seed: int, tmp_path: Path) -> None:
    maker, path = Maker(text, seed), tmp_path / "any.mcap"
    write(path, text, [bytes(maker.store.serialize_cdr(maker.message(), NAME)) for _ in range(12)])
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        messages = [found for *_, found in reader.iter_decoded_messages()]
    topic = Topic(McapReader(path), "/any")
    assert len(messages) == len(topic) == 12
    for name in topic.kinds:
        expected = [at(message, name) for message in messages]
        try:
            column = topic.read([name])[name]
        except LogError:
            # Arrays of numbers can only be read as a column if their lengths are equal.
            assert len({len(value) for value in expected}) > 1
            continue
        assert [plain(value) for value in column.tolist()] == expected


@settings(max_examples=60)
@given(text=DEFINITIONS, seed=st.integers(0, 999), is_little=st.booleans())
def test_a_layout_checks_one_message_like_many(text: str, seed: int, is_little: bool) -> None:
    maker, wanted = Maker(text, seed), [f"f{number}" for number in range(4)]
    type_ = MessageType(NAME, text)
    messages = [
        bytes(maker.store.serialize_cdr(maker.message(), NAME, little_endian=is_little))
        for _ in range(12)
    ]
    layout = type_.layout(messages[0], wanted)
    if layout is None:
        return
    alike = [message for message in messages if len(message) == len(messages[0])]
    rows = np.frombuffer(b"".join(alike), layout.dtype)
    assert [layout.fits_one(message) for message in alike] == layout.matching(rows).tolist()


def test_times_are_leaves_and_lists_are_objects(tmp_path: Path) -> None:
    text = "demo_msgs/Inner[] parts\nstring[] names\nbuiltin_interfaces/Duration d\n"
    text += f"{SEPARATOR}MSG: demo_msgs/Inner\nuint8 a\n{TIME_TEXTS}"
    maker, path = Maker(text, 0), tmp_path / "any.mcap"
    types = maker.store.types
    inner, duration = types["demo_msgs/msg/Inner"], types[TIME_TYPES[1]]
    rows = [
        types[NAME]([inner(1), inner(2)], ["x", "yz"], duration(-1, 500_000_000)),
        types[NAME]([], ["yz", ""], duration(0, 7)),
        types[NAME]([inner(3)], [], duration(2, 0)),
    ]
    write(path, text, [bytes(maker.store.serialize_cdr(row, NAME)) for row in rows])
    columns = Topic(McapReader(path), "/any").read(["parts", "names", "d", "d.sec"])
    assert [[each.a for each in value] for value in columns["parts"]] == [[1, 2], [], [3]]
    assert columns["names"].tolist() == [["x", "yz"], ["yz", ""], []]
    assert columns["d"].tolist() == [-500_000_000, 7, 2_000_000_000]
    assert columns["d.sec"].tolist() == [-1, 0, 2]


@pytest.mark.parametrize("kind", ["wstring", "wstring[]", "wstring[2]", "wstring<=9"])
def test_wide_strings_cost_only_the_fields_after_them(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "wide.mcap"
    texts = {"wide": f"uint8 a\n{kind} b\nuint8 c\n", "plain": "uint8 a\n", "first": f"{kind} b\n"}
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        for topic, text in texts.items():
            schema = writer.register_schema(f"demo_msgs/msg/{topic}", "ros2msg", text.encode())
            channel = writer.register_channel(f"/{topic}", "cdr", schema)
            rest = b"" if topic == "plain" else b"\0\0\0\2\0\0\0a\0b\0\1"
            writer.add_message(channel, 0, b"\0\1\0\0\7" + rest, 0)
        writer.finish()
    reader = McapReader(path)
    wide = Topic(reader, "/wide")
    assert wide.kinds == {"a": "uint8"}
    assert wide.read(["a"])["a"].tolist() == [7]
    for name in ("b", "c"):
        with pytest.raises(LogError, match=r"/wide: .*field b contains a wstring, whose encoding"):
            wide.read([name])
    with pytest.raises(LogError, match=r"/first: .*field b contains a wstring"):
        Topic(reader, "/first")
    assert Topic(reader, "/plain").read(["a"])["a"].tolist() == [7]
