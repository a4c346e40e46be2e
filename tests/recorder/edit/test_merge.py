"""A joined log has all messages of its source logs, with the episodes in time order."""

from __future__ import annotations

from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import LogError, SpaceError, UsageError
from mcaprl.recorder.columns.reader import McapReader, end_of
from mcaprl.recorder.repair.check import IMPOSSIBLE_ACTION, check_log
from tests.recorder.edit.contents import messages_of
from tests.support.foreign_logs import (
    PLAIN,
    TYPE,
    VARIABLE,
    plain_messages,
    steps_of,
    variable_messages,
)
from tests.support.recordings import MIXED_SPACE, ScriptedEnv, record
from tests.support.strategies import transitions

SPACE = spaces.Box(-1, 1, (2,), np.float32)
ACTIONS = spaces.Discrete(3)
S = 10**9


def logged(path: Path, lengths: list[int], start_s: float = 0.0, **options: Any) -> Path:
    """Record a log of random values that starts at `start_s`."""
    record(path, SPACE, ACTIONS, lengths, start_time_ns=10**18 + round(start_s * S), **options)
    return path


def summaries(data: Any) -> list[str]:
    return [repr(episode.summary) for episode in mcaprl.open(data).episodes]


def test_logs_one_after_the_other(tmp_path: Path) -> None:
    a = logged(tmp_path / "a.mcap", [3, 1])
    b = logged(tmp_path / "b.mcap", [2], start_s=100, seed=1)
    found = mcaprl.merge([a, b], tmp_path / "out.mcap")
    assert (found.episodes, found.steps) == (3, 6)
    assert found.rewritten_chunks == 0
    joined = mcaprl.open(tmp_path / "out.mcap")
    assert joined.fingerprint == mcaprl.open([a, b]).fingerprint
    assert joined.metadata == mcaprl.open([a, b]).metadata
    assert summaries(tmp_path / "out.mcap") == summaries([a, b])
    assert messages_of(tmp_path / "out.mcap") == messages_of(a) + messages_of(b)
    assert check_log(tmp_path / "out.mcap") == []
    # The channel ids do not change, so all chunks are copied unchanged.
    copies = {bytes(r.view[c.chunk_start_offset : end_of(c)]) for r, c in _chunks([a, b])}
    assert {bytes(r.view[c.chunk_start_offset : end_of(c)]) for r, c in _chunks([found.out])} == (
        copies
    )


def _chunks(paths: list[Path]) -> list[tuple[McapReader, Any]]:
    return [(reader, chunk) for reader in map(McapReader, paths) for chunk in reader.chunks]


def test_episodes_are_in_time_order(tmp_path: Path) -> None:
    late = logged(tmp_path / "a.mcap", [3], start_s=100)
    early = logged(tmp_path / "b.mcap", [2], seed=1)
    mcaprl.merge([late, early], tmp_path / "out.mcap")
    expected = mcaprl.open([early, late])
    assert mcaprl.open(tmp_path / "out.mcap").fingerprint == expected.fingerprint


def test_overlapping_logs_are_refused_or_moved(tmp_path: Path) -> None:
    a = logged(tmp_path / "a.mcap", [3, 4])
    b = logged(tmp_path / "b.mcap", [2, 2], start_s=0.1, seed=1)
    with pytest.raises(LogError, match=r"b\.mcap overlap in time with those of .*a\.mcap; pass"):
        mcaprl.merge([a, b], tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()
    mcaprl.merge([a, b], tmp_path / "out.mcap", shift=True)
    joined = mcaprl.open(tmp_path / "out.mcap")
    assert joined.fingerprint == mcaprl.open([a, b]).fingerprint
    assert check_log(tmp_path / "out.mcap") == []
    # Log a has 9 records at intervals of 0.05 s, so log b can start at 0.45 s.
    starts = [episode.summary.start_time_ns - 10**18 for episode in joined.episodes]
    assert starts == [0, round(0.2 * S), round(0.45 * S), round(0.6 * S)]
    before = [episode.summary for episode in mcaprl.open(b).episodes]
    after = [episode.summary for episode in joined.episodes[2:]]
    for one, other in zip(before, after, strict=True):
        moved = one._replace(
            start_time_ns=one.start_time_ns + round(0.35 * S),
            end_time_ns=one.end_time_ns + round(0.35 * S),
        )
        assert repr(moved) == repr(other)


def test_times_inside_of_messages_move(tmp_path: Path) -> None:
    for name in ("a", "b"):
        sim = mcaprl.make_sim("lane")
        env = mcaprl.RecordMcap(sim, tmp_path / f"{name}.mcap", start_time_ns=10**18)
        with closing(env):
            env.reset(seed=0)
            for _ in range(3):
                env.step(0)
    paths = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    mcaprl.merge(paths, tmp_path / "out.mcap", shift=True)
    assert check_log(tmp_path / "out.mcap") == []
    duration = mcaprl.open(paths[0]).episodes[0].summary
    delay = (
        duration.end_time_ns
        - duration.start_time_ns
        + int(mcaprl.open(paths[0]).metadata["step_duration_ns"])
    )
    before, after = stamps_of(paths[1]), stamps_of(tmp_path / "out.mcap")
    assert {topic for topic, _, _ in before} >= {"/scene", "/tf", "/tf_static", "/rosout"}
    assert sum(stamp > 0 for _, _, stamp in before) > 5
    first = stamps_of(paths[0])
    moved = [(topic, time + delay, stamp + delay * (stamp > 0)) for topic, time, stamp in before]
    assert sorted(after) == sorted(first + moved)


def stamps_of(path: Path) -> list[tuple[str, int, int]]:
    """Return topic, log_time and value of each time field in the messages, nanoseconds."""
    found = []
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            for stamp in _stamps(decoded):
                found.append((channel.topic, message.log_time, stamp))
    return found


def _stamps(value: Any) -> list[int]:
    if isinstance(value, list):
        return [stamp for part in value for stamp in _stamps(part)]
    names = getattr(value, "__slots__", ())
    if set(names) == {"sec", "nanosec"} and "Time" in type(value).__name__:
        return [value.sec * S + value.nanosec]
    return [stamp for name in names for stamp in _stamps(getattr(value, name))]


@settings(max_examples=25)
@given(given_=transitions(), data=st.data())
def test_joined_logs_equal_the_logs_read_together(
    tmp_path_factory: pytest.TempPathFactory, given_: dict[str, Any], data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("merge")
    names = [f"{number}.mcap" for number in range(data.draw(st.integers(2, 3)))]
    for name in names:
        compression = data.draw(st.sampled_from(["zstd", "lz4", "none"]))
        mcaprl.Dataset.from_arrays(**given_).save(folder / name, compression=compression)
    paths = [folder / name for name in names]
    mcaprl.merge(paths, folder / "out.mcap", shift=True)
    together = mcaprl.open(paths)
    joined = mcaprl.open(folder / "out.mcap")
    problems = check_log(folder / "out.mcap")
    assert [one for one in problems if one.next != IMPOSSIBLE_ACTION] == []
    lengths = [episode.length for episode in joined.episodes]
    assert sum(lengths) == len(together)
    assert joined.fingerprint == together.fingerprint


def test_images_and_every_kind_of_space(tmp_path: Path) -> None:
    for number, name in enumerate(("a", "b")):
        record(
            tmp_path / f"{name}.mcap",
            MIXED_SPACE,
            ACTIONS,
            [3, 2],
            seed=number,
            start_time_ns=10**18,
        )
    paths = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    mcaprl.merge(paths, tmp_path / "out.mcap", shift=True)
    joined = mcaprl.open(tmp_path / "out.mcap")
    assert joined.fingerprint == mcaprl.open(paths).fingerprint
    assert check_log(tmp_path / "out.mcap") == []


def test_spaces_that_differ_are_named(tmp_path: Path) -> None:
    logged(tmp_path / "a.mcap", [2])
    record(tmp_path / "b.mcap", spaces.Box(-2, 1, (2,), np.float32), ACTIONS, [2])
    record(tmp_path / "c.mcap", SPACE, spaces.Discrete(4), [2])
    for name, field in (("b", "observation_space"), ("c", "action_space")):
        with pytest.raises(SpaceError, match=rf"a\.mcap and .*{name}\.mcap differ in {field}: "):
            mcaprl.merge([tmp_path / "a.mcap", tmp_path / f"{name}.mcap"], tmp_path / "out.mcap")


def test_metadata_that_differ_are_named(tmp_path: Path) -> None:
    logged(tmp_path / "a.mcap", [2])
    logged(tmp_path / "b.mcap", [2], start_s=9, step_duration_s=0.1)
    with pytest.raises(LogError, match="differ in step_duration_ns: 50000000 and 100000000"):
        mcaprl.merge([tmp_path / "a.mcap", tmp_path / "b.mcap"], tmp_path / "out.mcap")


def test_other_metadata_equal_those_of_logs_opened_together(tmp_path: Path) -> None:
    a = logged(tmp_path / "a.mcap", [2], policy="one")
    b = logged(tmp_path / "b.mcap", [2], start_s=9, policy="two")
    mcaprl.merge([a, b], tmp_path / "out.mcap")
    joined = mcaprl.open(tmp_path / "out.mcap")
    assert joined.metadata == mcaprl.open([a, b]).metadata
    assert joined.metadata["policy"] == ""
    assert [episode.summary.policy for episode in joined.episodes] == ["one", "two"]


def sensor_log(path: Path, ids: list[int], *, at_ns: int = 5) -> dict[str, list[bytes]]:
    """Write a file with channels of these ids; the `mcap` library stores channels in chunks."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("pkg/Thing", "jsonschema", b"{}")
        found = {}
        for number in range(max(ids)):
            channel = writer.register_channel(f"/{path.stem}/{number + 1}", "json", schema)
            if channel in ids:
                data = f'{{"a": "{path.stem} {channel}"}}'.encode()
                writer.add_message(channel, at_ns + channel, data, at_ns)
                found[f"/{path.stem}/{number + 1}"] = [data]
        writer.add_metadata("notes", {"who": path.stem})
        writer.add_attachment(1, 1, "note.txt", "text/plain", path.stem.encode())
        writer.finish()
    return found


def test_clashing_ids_are_renumbered(tmp_path: Path) -> None:
    first = sensor_log(tmp_path / "a.mcap", [1, 2])
    second = sensor_log(tmp_path / "b.mcap", [1, 3])
    mcaprl.merge([tmp_path / "a.mcap", tmp_path / "b.mcap"], tmp_path / "out.mcap")
    by_topic: dict[str, list[bytes]] = {}
    with (tmp_path / "out.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for _, channel, message in reader.iter_messages():
            by_topic.setdefault(channel.topic, []).append(message.data)
        assert by_topic == first | second
        assert [one.metadata for one in reader.iter_metadata()] == [{"who": "a"}, {"who": "b"}]
        assert [one.data for one in reader.iter_attachments()] == [b"a", b"b"]
        summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 4
    assert len(summary.channels) == 5
    assert len(summary.schemas) == 1


def test_sensor_file_joins_a_log(tmp_path: Path) -> None:
    log = logged(tmp_path / "log.mcap", [3])
    sensor_log(tmp_path / "camera.mcap", [1, 2, 3], at_ns=10**18)
    mcaprl.merge([log, tmp_path / "camera.mcap"], tmp_path / "out.mcap")
    joined = messages_of(tmp_path / "out.mcap")
    assert joined == messages_of(log) + messages_of(tmp_path / "camera.mcap")
    assert mcaprl.open(tmp_path / "out.mcap").fingerprint == mcaprl.open(log).fingerprint


def foreign_log(path: Path, text: str, start_ns: int, seed: int) -> Path:
    """Write a log without metadata, like a log of another program."""
    steps = steps_of([3, 2], start_ns=start_ns, seed=seed)
    encode = plain_messages if text == PLAIN else partial(variable_messages, text_of=str)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(TYPE, "ros2msg", text.encode())
        channel = writer.register_channel("/rl/step", "cdr", schema)
        for time_ns, data in encode(steps):
            writer.add_message(channel, time_ns, data, time_ns)
        writer.finish()
    return path


@pytest.mark.parametrize("text", [PLAIN, VARIABLE])
@pytest.mark.parametrize("shift", [False, True])
def test_logs_of_other_programs(tmp_path: Path, text: str, shift: bool) -> None:
    starts = [10**18, 10**18 + (0 if shift else S)]
    paths = [
        foreign_log(tmp_path / f"{number}.mcap", text, start_ns, number)
        for number, start_ns in enumerate(starts)
    ]
    mcaprl.merge(paths, tmp_path / "out.mcap", shift=shift)
    joined = mcaprl.open(tmp_path / "out.mcap")
    assert joined.fingerprint == mcaprl.open(paths).fingerprint
    mcaprl.slice(tmp_path / "out.mcap", tmp_path / "part.mcap", steps=(3, 8))
    assert mcaprl.open(tmp_path / "part.mcap").rewards.tolist() == joined.rewards[3:8].tolist()


def test_types_of_steps_that_differ_are_refused(tmp_path: Path) -> None:
    paths = [
        foreign_log(tmp_path / "0.mcap", PLAIN, 10**18, 0),
        foreign_log(tmp_path / "1.mcap", VARIABLE, 10**18 + S, 1),
    ]
    with pytest.raises(LogError, match="have messages of different types on /rl/step"):
        mcaprl.merge(paths, tmp_path / "out.mcap")
    with pytest.raises(LogError, match=r"1\.mcap has no metadata, but .*a\.mcap has"):
        mcaprl.merge([logged(tmp_path / "a.mcap", [2]), paths[1]], tmp_path / "out.mcap")


def with_info(path: Path, start_s: float, info: Any) -> Path:
    """Record an episode of one step with an info."""
    rows = [(SPACE.sample(), 0.0, False, False), (SPACE.sample(), 1.0, True, False)]
    env = ScriptedEnv(SPACE, ACTIONS, [rows], {"info": info})
    start_time_ns = 10**18 + round(start_s * S)
    with closing(mcaprl.RecordMcap(env, path, start_time_ns=start_time_ns, infos=True)) as recorder:
        recorder.reset(seed=0)
        recorder.step(1)
    return path


def test_infos_are_joined(tmp_path: Path) -> None:
    paths = [with_info(tmp_path / f"{k}.mcap", k, float(k)) for k in range(2)]
    mcaprl.merge(paths, tmp_path / "out.mcap")
    assert mcaprl.open(tmp_path / "out.mcap").infos["info"].tolist() == [None, 0.0, None, 1.0]
    mcaprl.filter("episode == 1", tmp_path / "out.mcap", tmp_path / "part.mcap")
    assert mcaprl.open(tmp_path / "part.mcap").infos["info"].tolist() == [None, 1.0]
    # The filtered part contains only episodes of log a, which has no infos.
    logged(tmp_path / "a.mcap", [1], start_s=5, step_duration_s=0.05)
    mcaprl.merge([paths[0], tmp_path / "a.mcap"], tmp_path / "some.mcap")
    mcaprl.filter("episode == 1", tmp_path / "some.mcap", tmp_path / "none.mcap")
    assert mcaprl.open(tmp_path / "none.mcap").infos == {}
    assert check_log(tmp_path / "none.mcap") == []


def test_infos_that_differ_are_named(tmp_path: Path) -> None:
    a = with_info(tmp_path / "a.mcap", 0, 1.0)
    b = with_info(tmp_path / "b.mcap", 9, np.ones(3))
    with pytest.raises(LogError, match=r"a\.mcap and .*b\.mcap have .* types on /rl/info/info"):
        mcaprl.merge([a, b], tmp_path / "out.mcap")


def test_messages_without_cdr_are_not_moved(tmp_path: Path) -> None:
    a = logged(tmp_path / "a.mcap", [3])
    sensor_log(tmp_path / "camera.mcap", [1], at_ns=10**18)
    mcaprl.merge([a, tmp_path / "camera.mcap"], tmp_path / "b.mcap")
    with pytest.raises(
        LogError, match=r"/camera/1 cannot be delayed, because their encoding is 'json'"
    ):
        mcaprl.merge([a, tmp_path / "b.mcap"], tmp_path / "out.mcap", shift=True)
    assert not (tmp_path / "out.mcap").exists()


def test_fewer_than_two_logs(tmp_path: Path) -> None:
    a = logged(tmp_path / "a.mcap", [3])
    with pytest.raises(UsageError, match="two or more logs, not 1"):
        mcaprl.merge([a, a], tmp_path / "out.mcap")


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = [str(logged(tmp_path / f"{k}.mcap", [2], start_s=9 * k)) for k in range(2)]
    assert run(["merge", *names, str(tmp_path / "out.mcap")]) == 0
    assert "out.mcap: 2 episodes, 4 steps, " in capsys.readouterr().out
    assert run(["merge", names[0], names[0], str(tmp_path / "out2.mcap")]) == 2
    message = f"merge needs two or more logs, not 1: {names[0]} was given twice"
    assert capsys.readouterr().err == f"mcaprl: {message}\n"
    assert run(["merge", *names, str(tmp_path / "out.mcap")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
