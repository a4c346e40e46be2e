"""Logs with huge, deeply nested or wrongly typed metadata: one clear error, and little memory."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from mcap.records import Attachment

import mcaprl
from mcaprl.errors import CorruptLogError, LogError, McaprlError, SpaceError
from mcaprl.recorder.columns.cdr import MessageType
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.writer import McapWriter
from mcaprl.recorder.format.messages import EPISODE_TYPE, definition
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import MAX_ACTIONS, MAX_ELEMENTS, space_from_json
from mcaprl.recorder.record.layout import LAYOUT_NAME, layout_of
from mcaprl.recorder.repair.check import check_log
from tests.support.damage.forged_logs import forged
from tests.support.recordings import record

DEEP = "[" * 100_000 + "]" * 100_000
BOX = '{"type": "Box", "low": 0, "high": 1, "shape": %s, "dtype": "float32"}'
DISCRETE = '{"type": "Discrete", "n": %d, "start": 0}'
LARGE = [
    ("observation_space", BOX % "[300000000]"),
    ("observation_space", BOX % "[100000, 100000, 100000]"),
    ("observation_space", f'{{"type": "Dict", "spaces": [["a", {BOX % [2**24]}]'
     f', ["b", {BOX % [2**24 + 1]}]]}}'),
    ("observation_space", '{"type": "MultiBinary", "n": 1000000000}'),
    ("observation_space", (BOX % "[1]").replace("float32", "U99999999")),
    ("action_space", BOX % "[1000000000]"),
    ("action_space", DISCRETE % 10**12),
    ("action_space", DISCRETE % (2**63 - 1)),
]  # fmt: skip
ODD = [
    ("env_kwargs", DEEP),
    ("env_kwargs", "null"),
    ("env_kwargs", "[1]"),
    ("observation_space", DEEP),
    ("observation_space", '{"type": "Dict", "spaces": [["a", ' * 500 + "1" + "]]}" * 500),
    ("action_meanings", "[[1], [2]]"),
    ("observation_names", "7"),
    ("versions", "[]"),
]


def peak_bytes(function: Callable[[], object]) -> int:
    """Return the peak memory of a call, bytes."""
    tracemalloc.start()
    try:
        function()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(("name", "text"), LARGE)
def test_sizes_are_refused_before_memory_is_taken(log_path: Path, name: str, text: str) -> None:
    forged(log_path, **{name: text})

    def read() -> None:
        with pytest.raises(McaprlError, match="space"):
            mcaprl.open(log_path)
        with pytest.raises(McaprlError):
            mcaprl.info(log_path)
        assert check_log(log_path)
        with pytest.raises(McaprlError):
            mcaprl.recover(log_path, log_path.with_name("out.mcap"))

    assert peak_bytes(read) < 50e6


@pytest.mark.parametrize(("name", "text"), ODD)
def test_odd_metadata_are_one_clear_error(log_path: Path, name: str, text: str) -> None:
    forged(log_path, **{name: text})
    with pytest.raises(LogError) as error:
        mcaprl.open(log_path)
    assert len(str(error.value)) < 500
    assert str(log_path) in str(error.value)
    with pytest.raises(LogError):
        mcaprl.verify(log_path)
    assert check_log(log_path)


def test_sizes_of_real_spaces_are_accepted() -> None:
    image = spaces.Box(0, 255, (2160, 3840, 4), np.uint8)
    assert image.shape == space_from_json(BOX % list(image.shape)).shape
    assert np.prod(image.shape) <= MAX_ELEMENTS


def test_recorders_refuse_what_readers_refuse(log_path: Path) -> None:
    class Large(gym.Env[object, object]):
        observation_space = spaces.Discrete(10**12)
        action_space = spaces.Discrete(MAX_ACTIONS + 1)

    with pytest.raises(SpaceError, match=f"at most {MAX_ACTIONS} discrete actions"):
        mcaprl.RecordMcap(Large(), log_path)
    assert not log_path.exists()
    Large.action_space = spaces.Discrete(2)
    mcaprl.RecordMcap(Large(), log_path).close()


def test_many_actions_are_not_named_one_by_one() -> None:
    many = LogMetadata(spaces.Discrete(2), spaces.Discrete(MAX_ACTIONS))
    assert peak_bytes(lambda: layout_of(many, ["/rl/step"], [], "")) < 5e6
    few = LogMetadata(spaces.Discrete(2), spaces.Discrete(3, start=-1))
    assert few.action_names() == {-1: "-1", 0: "0", 1: "1"}


@pytest.mark.parametrize("layout", [DEEP, "[]", '{"configById": 1}', "no JSON"])
def test_an_attachment_that_is_not_a_layout_is_refused(
    log_path: Path, tmp_path: Path, layout: str
) -> None:
    record(log_path, spaces.Discrete(2), spaces.Discrete(2), [3])
    out = tmp_path / "other.mcap"
    writer = McapWriter(out, source=log_path)
    writer.announce(Attachment(1, 1, LAYOUT_NAME, "application/json", layout.encode()))
    writer.close()
    with pytest.raises(CorruptLogError, match="attachment"):
        mcaprl.layout(out)


def test_a_layout_without_panels_can_be_played(log_path: Path, tmp_path: Path) -> None:
    from mcaprl.recorder.viewer.annotate import attached_layout
    from mcaprl.recorder.viewer.foxglove_server import side_by_side

    record(log_path, spaces.Discrete(2), spaces.Discrete(2), [3])
    out = tmp_path / "other.mcap"
    writer = McapWriter(out, source=log_path)
    writer.announce(Attachment(1, 1, LAYOUT_NAME, "application/json", b"{}"))
    writer.close()
    found = attached_layout(McapReader(out))
    assert side_by_side([found, found], ["a", "b"])["configById"] == {}


def test_strings_longer_than_their_message_have_no_layout() -> None:
    message = MessageType(EPISODE_TYPE, definition(EPISODE_TYPE))
    data = bytes([0, 1, 0, 0]) + bytes(56) + (3_686_906_940).to_bytes(4, "little") + bytes(60)
    assert message.layout(data, ["reason"]) is None


def test_a_channel_that_points_at_another_schema_is_reported(log_path: Path) -> None:
    record(log_path, spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(2), [30, 40])
    data = log_path.read_bytes()
    reader = McapReader(log_path)
    steps, episodes = (reader.channel_of(topic) for topic in ("/rl/step", "/rl/episode"))
    assert steps is not None
    assert episodes is not None
    # In a Channel record, the schema id follows the channel id. The CRC of the summary is set to 0,
    # so it is not checked.
    for channel, other in ((steps, episodes), (episodes, steps)):
        head = channel.id.to_bytes(2, "little") + channel.schema_id.to_bytes(2, "little")
        text = len(channel.topic).to_bytes(4, "little") + channel.topic.encode()
        wrong = head[:2] + other.schema_id.to_bytes(2, "little")
        damaged = data.replace(head + text, wrong + text)
        assert damaged != data
        footer = damaged[:-12] + bytes(4) + damaged[-8:]
        bad = log_path.with_name("bad.mcap")
        bad.write_bytes(footer)
        assert check_log(bad)
        with suppress(McaprlError):
            mcaprl.recover(bad, log_path.with_name("out.mcap"), overwrite=True)


def test_json_of_metadata_is_read_as_written() -> None:
    text = json.loads(LogMetadata(spaces.Discrete(2), spaces.Discrete(2)).to_strings()["versions"])
    assert isinstance(text, dict)
