"""Other programs read edited logs, and a killed command leaves no incomplete log."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest
from gymnasium import spaces
from mcap.reader import NonSeekingReader, make_reader
from rosbags.highlevel import AnyReader

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import CorruptLogError
from mcaprl.recorder.columns.chunks import chunk_index_record
from mcaprl.recorder.columns.reader import McapReader
from tests.conftest import need
from tests.recorder.edit.contents import messages_of
from tests.recorder.edit.test_merge import sensor_log
from tests.recorder.format.test_foreign_readers import by_node
from tests.support.paths import ROOT
from tests.support.recordings import record

Counts = dict[str, int]
S = 10**9


@pytest.fixture(scope="module")
def edited(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return one log of each editing function, by the name of the function."""
    folder = tmp_path_factory.mktemp("edited")
    space = spaces.Dict(
        {"x": spaces.Box(-1, 1, (3,), np.float64), "eye": spaces.Box(0, 255, (8, 9, 3), np.uint8)}
    )
    for number, name in enumerate(("a", "b", "c")):
        path, start_ns = folder / f"{name}.mcap", 10**18 + number // 2 * 100 * S
        record(path, space, spaces.Discrete(3), [30, 2, 9], seed=number, start_time_ns=start_ns)
    with closing(mcaprl.RecordMcap(mcaprl.make_sim("lane"), folder / "lane.mcap")) as env:
        for seed in range(2):
            env.reset(seed=seed)
            for _ in range(3):
                env.step(0)
    found = {name: folder / f"{name}-out.mcap" for name in ("merge", "shift", "filter", "slice")}
    mcaprl.merge([folder / "a.mcap", folder / "c.mcap"], found["merge"])
    mcaprl.merge([folder / "a.mcap", folder / "b.mcap"], found["shift"], shift=True)
    mcaprl.filter("length > 2", folder / "a.mcap", found["filter"])
    mcaprl.slice(folder / "a.mcap", found["slice"], steps=(5, 35))
    parts = mcaprl.split(folder / "lane.mcap", folder / "parts", episodes=1)
    return found | {"split": parts[1].out}


NAMES = ["merge", "shift", "filter", "slice", "split"]


def by_stream(path: Path) -> Counts:
    """Read the file from start to end, without seeking."""
    with path.open("rb") as file:
        found = NonSeekingReader(file, validate_crcs=True).iter_messages()
        return Counter(channel.topic for _, channel, _ in found)


def by_rosbags(path: Path) -> Counts:
    with AnyReader([path]) as bag:
        return Counter(
            connection.topic
            for connection, _, data in bag.messages()
            if bag.deserialize(data, connection.msgtype) is not None
        )


def by_foxglove(path: Path) -> Counts:
    """Read the file with @mcap/core in Node."""
    return {topic: len(messages) for topic, messages in by_node(path).items()}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("read", [by_stream, by_rosbags, by_foxglove])
def test_other_readers_find_every_message(
    edited: dict[str, Path], name: str, read: Callable[[Path], Counts]
) -> None:
    expected = Counter(topic for topic, *_ in messages_of(edited[name]).elements())
    assert expected["/rl/step"] > 3
    assert read(edited[name]) == expected


@pytest.mark.parametrize("name", NAMES)
def test_doctor_reports_no_problem(edited: dict[str, Path], name: str) -> None:
    doctor = Path(sys.executable).with_name("pymcap-cli")
    need(doctor.exists(), "pymcap-cli is not installed")
    done = subprocess.run(
        [str(doctor), "doctor", str(edited[name])],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "passed" in done.stdout


def test_header_is_that_of_a_log(edited: dict[str, Path], tmp_path: Path) -> None:
    sensor_log(tmp_path / "camera.mcap", [1])
    mcaprl.merge([tmp_path / "camera.mcap", edited["filter"]], tmp_path / "out.mcap")
    with (tmp_path / "out.mcap").open("rb") as file:
        assert make_reader(file).get_header().profile == "ros2"


def test_chunk_with_wrong_times_is_refused(edited: dict[str, Path], tmp_path: Path) -> None:
    content = edited["filter"].read_bytes()
    reader = McapReader(edited["filter"])
    chunk = reader.chunks[0]
    place = content.find(chunk_index_record(chunk)) + 9
    assert place > reader.summary_start
    wrong = bytearray(content)
    wrong[place : place + 8] = (chunk.message_start_time - 1).to_bytes(8, "little")
    wrong[-12:-8] = crc32(bytes(wrong[reader.summary_start : -12])).to_bytes(4, "little")
    (tmp_path / "wrong.mcap").write_bytes(wrong)
    with pytest.raises(CorruptLogError, match=r"chunk at byte \d+ has times that do not match"):
        mcaprl.filter("length > 0", tmp_path / "wrong.mcap", tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


def test_recording_continues_in_an_edited_log(tmp_path: Path) -> None:
    path, out = tmp_path / "log.mcap", tmp_path / "out.mcap"
    space = spaces.Box(-1, 1, (2,), np.float32)
    record(path, space, spaces.Discrete(3), [3, 4], start_time_ns=10**18)
    mcaprl.slice(path, out, steps=(1, 5))
    record(out, space, spaces.Discrete(3), [2], append=True, start_time_ns=2 * 10**18)
    assert [episode.length for episode in mcaprl.open(out).episodes] == [2, 2, 2]
    assert mcaprl.check(out).ok


def test_commands_of_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    space = spaces.Box(-1, 1, (2,), np.float32)
    for day, name in enumerate(("monday", "tuesday")):
        record(
            Path(f"{name}.mcap"),
            space,
            spaces.Discrete(3),
            [*[90] * 5, 101 + day],
            seed=day,
            start_time_ns=10**18 + day * 86_400 * S,
            step_duration_s=1.0,
        )
    page = (ROOT / "docs" / "editing.md").read_text()
    block, labels = re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    for command in block.splitlines():
        assert run(shlex.split(command)[1:]) == 0, command
    lines = capsys.readouterr().out.splitlines()
    both, *parts, long, start, minute = (line.split(", ")[:2] for line in lines)
    assert both == ["both.mcap: 12 episodes", "1103 steps"]
    # One tenth of 12 episodes is 1.2, which is rounded to 1 episode.
    assert [part[0].split(": ")[1] for part in parts] == ["10 episodes", "1 episode", "1 episode"]
    assert long == ["long.mcap: 2 episodes", "203 steps"]
    assert start == ["start.mcap: 11 episodes", "1000 steps"]
    # The part has the records from 60 s to 119 s: 30 transitions of the first episode and 28 of the
    # second, 58 steps in total.
    assert minute == ["minute.mcap: 2 episodes", "58 steps"]
    for command in labels.splitlines():
        # Rewards of these logs are infinite, from which nothing learns.
        if not command.startswith(("mcaprl relabel", "mcaprl train")):
            assert run(shlex.split(command, comments=True)[1:]) == 0, command


def test_recover_reports_the_episodes_that_a_part_does_not_have(tmp_path: Path) -> None:
    space = spaces.Box(-1, 1, (2,), np.float32)
    record(tmp_path / "log.mcap", space, spaces.Discrete(3), [3, 4, 2])
    mcaprl.filter("episode != 1", tmp_path / "log.mcap", tmp_path / "out.mcap")
    found = mcaprl.recover(tmp_path / "out.mcap", tmp_path / "again.mcap")
    assert found.episodes == 2
    assert [one.number for one in found.dropped] == [1]


_STOPPED = """
import os, signal, sys
import mcaprl
from mcaprl.recorder.columns.writer import McapWriter

def stop(*_):
    print("copying", flush=True)
    signal.pause()

McapWriter.copy_chunk = McapWriter.write_records = stop
source, out, command = sys.argv[1:]
if command == "split":
    mcaprl.split(source, out, episodes=1)
elif command == "merge":
    mcaprl.merge([source, source.replace("a.mcap", "b.mcap")], out)
else:
    mcaprl.filter("length > 1", source, out)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs signals of POSIX")
@pytest.mark.parametrize("command", ["split", "merge", "filter"])
def test_killed_command_leaves_nothing_under_the_name(tmp_path: Path, command: str) -> None:
    space = spaces.Box(-1, 1, (2,), np.float32)
    for name, start_ns in (("a", 10**18), ("b", 2 * 10**18)):
        path = tmp_path / f"{name}.mcap"
        record(path, space, spaces.Discrete(3), [3, 1], start_time_ns=start_ns)
    before = (tmp_path / "a.mcap").read_bytes()
    out = tmp_path / "out.mcap"
    program = [sys.executable, "-c", _STOPPED, str(tmp_path / "a.mcap"), str(out), command]
    with subprocess.Popen(program, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == b"copying\n"
            os.kill(process.pid, signal.SIGKILL)
            process.wait(60)
        finally:
            process.kill()
    assert not out.exists()
    assert (tmp_path / "a.mcap").read_bytes() == before
    # The next command can write to `out`, and removes the temporary files of the killed command.
    mcaprl.filter("length > 1", tmp_path / "a.mcap", out)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.mcap", "b.mcap", "out.mcap"]
