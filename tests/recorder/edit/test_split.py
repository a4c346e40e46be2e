"""The parts of a log have all messages of their episodes. Joined again, they equal the log."""

from __future__ import annotations

import json
import math
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import LogError, NoEpisodesError, OutputExistsError, UsageError
from mcaprl.recorder.columns.reader import McapReader, end_of
from mcaprl.recorder.repair.check import check_log
from tests.recorder.edit.contents import messages_of
from tests.support.paths import GOLDEN
from tests.support.recordings import ScriptedEnv, record
from tests.support.strategies import transitions

SPACE = spaces.Box(-1, 1, (2,), np.float32)
LENGTHS = [4, 1, 3, 2]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "log.mcap"
    record(path, SPACE, spaces.Discrete(3), LENGTHS)
    return path


def rows_of(dataset: mcaprl.Dataset) -> list[list[Any]]:
    """Return the actions of each episode."""
    return [episode.actions.tolist() for episode in dataset.episodes]


def test_parts_of_two_episodes(log: Path, tmp_path: Path) -> None:
    found = mcaprl.split(log, tmp_path / "parts", episodes=2)
    assert [part.out.name for part in found] == ["log-00000.mcap", "log-00001.mcap"]
    assert [(part.episodes, part.steps) for part in found] == [(2, 5), (2, 5)]
    whole = mcaprl.open(log)
    first, second = (mcaprl.open(part.out) for part in found)
    assert rows_of(first) + rows_of(second) == rows_of(whole)
    assert [episode.summary.episode for episode in second.episodes] == [2, 3]
    assert messages_of(found[0].out) + messages_of(found[1].out) == messages_of(log)
    for part in found:
        assert check_log(part.out) == []


def test_ratio_assigns_episodes_at_random(log: Path, tmp_path: Path) -> None:
    found = mcaprl.split(log, tmp_path / "parts", ratio=(3, 1), seed=5)
    chosen = [[e.summary.episode for e in mcaprl.open(part.out).episodes] for part in found]
    # NumPy's default_rng(5) shuffles the numbers 0 to 3 into this order.
    order = np.arange(4)
    np.random.default_rng(5).shuffle(order)
    assert chosen == [sorted(order[:3].tolist()), [order[3]]]
    again = mcaprl.split(log, tmp_path / "again", ratio=(3, 1), seed=5)
    for one, other in zip(found, again, strict=True):
        assert one.out.read_bytes() == other.out.read_bytes()


@settings(max_examples=25)
@given(given_=transitions(), data=st.data())
def test_joined_parts_equal_the_log(
    tmp_path_factory: pytest.TempPathFactory, given_: dict[str, Any], data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("split")
    compression = data.draw(st.sampled_from(["zstd", "lz4", "none"]))
    whole = mcaprl.Dataset.from_arrays(**given_)
    whole.save(folder / "log.mcap", compression=compression)
    whole = mcaprl.open(folder / "log.mcap")
    size = data.draw(st.integers(1, len(whole.episodes)))
    seed = data.draw(st.none() | st.integers(0, 9))
    parts = mcaprl.split(folder / "log.mcap", folder / "parts", episodes=size, seed=seed)
    assert sum(part.episodes for part in parts) == len(whole.episodes)
    if len(parts) < 2:
        assert mcaprl.open(parts[0].out).fingerprint == whole.fingerprint
        return
    order = data.draw(st.permutations([part.out for part in parts]))
    mcaprl.merge(order, folder / "back.mcap")
    back = mcaprl.open(folder / "back.mcap")
    assert back.fingerprint == whole.fingerprint
    assert repr([e.summary for e in back.episodes]) == repr([e.summary for e in whole.episodes])
    assert back.metadata == whole.metadata
    assert messages_of(folder / "back.mcap") == messages_of(folder / "log.mcap")


@pytest.mark.parametrize("name", ["appended", "image", "vector-of-environments", "box"])
def test_joined_parts_of_golden_logs(name: str, tmp_path: Path) -> None:
    source = GOLDEN / f"{name}.mcap"
    mcaprl.split(source, tmp_path / "parts", episodes=1)
    parts = sorted((tmp_path / "parts").iterdir())
    if len(parts) > 1:
        mcaprl.merge(parts[::-1], tmp_path / "back.mcap")
        assert messages_of(tmp_path / "back.mcap") == messages_of(source)
        assert mcaprl.open(tmp_path / "back.mcap").fingerprint == mcaprl.open(source).fingerprint


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record three episodes of the lane sim; its static scene is written in the first episode."""
    path = tmp_path_factory.mktemp("scenes") / "lane.mcap"
    env = mcaprl.RecordMcap(mcaprl.make_sim("lane"), path, start_time_ns=10**18)
    for seed in range(3):
        env.reset(seed=seed)
        for _ in range(3):
            env.step(0)
    env.close()
    return path


def test_part_keeps_the_static_scene_of_earlier_episodes(scenes: Path, tmp_path: Path) -> None:
    mcaprl.filter("episode == 2", scenes, tmp_path / "last.mcap")
    whole, part = messages_of(scenes), messages_of(tmp_path / "last.mcap")
    begin = McapReader(tmp_path / "last.mcap")
    start_ns = mcaprl.open(tmp_path / "last.mcap").episodes[0].summary.start_time_ns
    latest = max(m for m in whole if m[0] == "/scene/static" and m[1] <= start_ns)
    assert latest[1] < start_ns, "the scene of the third episode is that of an earlier one"
    assert part[latest] == 1
    earlier = {topic for topic, time_ns, _, _ in part if time_ns < start_ns}
    assert "/rl/step" not in earlier
    assert "/telemetry" not in earlier
    assert begin.channels.keys() == McapReader(scenes).channels.keys()
    mcaprl.split(scenes, tmp_path / "parts", episodes=1)
    mcaprl.merge(tmp_path / "parts", tmp_path / "back.mcap")
    assert messages_of(tmp_path / "back.mcap") == whole


def test_attachments_and_metadata_are_kept(scenes: Path, tmp_path: Path) -> None:
    mcaprl.filter("episode != 1", scenes, tmp_path / "out.mcap")
    before, after = McapReader(scenes), McapReader(tmp_path / "out.mcap")
    assert after.metadata == before.metadata
    name = "foxglove-layout.json"
    assert after.attachment(name) == before.attachment(name) is not None


class _Numbers(gym.Env[Any, Any]):
    """Environment with long random observations, so that an episode fills several chunks."""

    observation_space = spaces.Box(-np.inf, np.inf, (500,), np.float64)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.np_random.normal(size=500), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.np_random.normal(size=500), 1.0, False, False, {}


def chunks_of(path: Path) -> list[bytes]:
    """Return the bytes of each chunk with its message indexes."""
    reader = McapReader(path)
    return [bytes(reader.view[c.chunk_start_offset : end_of(c)]) for c in reader.chunks]


def test_whole_chunks_are_copied_byte_by_byte(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with_limit = gym.wrappers.TimeLimit(_Numbers(), 3000)
    env = mcaprl.RecordMcap(with_limit, path, start_time_ns=10**18)
    for seed in range(3):
        env.reset(seed=seed)
        while not env.step(0)[3]:
            pass
    env.close()
    found = mcaprl.filter("episode < 2", path, tmp_path / "out.mcap")
    before, after = set(chunks_of(path)), chunks_of(tmp_path / "out.mcap")
    same = sum(chunk in before for chunk in after)
    assert same == found.whole_chunks > 0.8 * len(after)
    assert found.rewritten_chunks == len(after) - same <= 3
    assert check_log(tmp_path / "out.mcap") == []
    assert rows_of(mcaprl.open(tmp_path / "out.mcap")) == rows_of(mcaprl.open(path))[:2]


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("length > 2", [0, 2]),
        ("terminated", [0, 2]),
        ("truncated and length == 2", [3]),
        ("reason == 'time_limit'", [1, 3]),
        ("seed >= 102", [2, 3]),
        ("not (episode == 1 or episode == 2)", [0, 3]),
        ("duration_s > 0.16", [0]),
        ("start_s < 0.3", [0, 1]),
        ("policy == ''", [0, 1, 2, 3]),
        ("isnan(epsilon)", [0, 1, 2, 3]),
        ("epsilon != 1 or episode == 1", [1]),
        ("isnan(epsilon) and 1 <= length <= 3", [1, 2, 3]),
    ],
)
def test_filters(log: Path, tmp_path: Path, expression: str, expected: list[int]) -> None:
    found = mcaprl.filter(expression, log, tmp_path / "out.mcap")
    kept = mcaprl.open(tmp_path / "out.mcap")
    assert [episode.summary.episode for episode in kept.episodes] == expected
    assert [episode.summary.seed for episode in kept.episodes] == [100 + k for k in expected]
    assert (found.episodes, found.steps) == (len(expected), sum(LENGTHS[k] for k in expected))
    assert rows_of(kept) == [rows_of(mcaprl.open(log))[k] for k in expected]


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        ("length >", "is not an expression"),
        ("rewards > 3", "did you mean total_reward"),
        ("length", "is not a condition"),
        ("next(length) > 3", r"next\(...\) has no meaning for episodes"),
        ("__import__('os')", "unknown function|not allowed"),
        ("reason > 'a'", "a string can only be compared"),
    ],
)
def test_wrong_expressions(log: Path, tmp_path: Path, expression: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        mcaprl.filter(expression, log, tmp_path / "out.mcap")
    assert list(tmp_path.iterdir()) == [log]


def test_filter_without_a_match(log: Path, tmp_path: Path) -> None:
    message = r"'length > 99' is true for no episode \(4 in the log\)"
    with pytest.raises(NoEpisodesError, match=message):
        mcaprl.filter("length > 99", log, tmp_path / "out.mcap")
    assert list(tmp_path.iterdir()) == [log]


def test_seeds_that_floats_cannot_hold_are_not_compared(tmp_path: Path) -> None:
    rows = [(SPACE.sample(), 0.0, False, False), (SPACE.sample(), 1.0, True, False)]
    env = ScriptedEnv(SPACE, spaces.Discrete(2), [rows])
    recorder = mcaprl.RecordMcap(env, tmp_path / "log.mcap")
    recorder.reset(seed=2**53 + 1)
    recorder.step(0)
    recorder.close()
    with pytest.raises(UsageError, match=f"seed {2**53 + 1} is too large to compare"):
        mcaprl.filter("seed == 1", tmp_path / "log.mcap", tmp_path / "out.mcap")
    assert mcaprl.filter("length == 1", tmp_path / "log.mcap", tmp_path / "out.mcap").episodes == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "either the episodes of each part or the ratio"),
        ({"episodes": 2, "ratio": (1, 1)}, "either the episodes of each part or the ratio"),
        ({"episodes": 0}, "episodes is 0, expected 1 or more"),
        ({"ratio": (1,)}, "two or more positive numbers"),
        ({"ratio": (1, -1)}, "two or more positive numbers"),
        ({"ratio": (1, math.inf)}, "two or more positive numbers"),
        ({"ratio": (100, 1)}, "4 episodes cannot be divided into 2 parts"),
    ],
)
def test_wrong_splits(log: Path, tmp_path: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        mcaprl.split(log, tmp_path / "parts", **options)
    assert list(tmp_path.iterdir()) == [log]


def test_existing_output_is_kept(log: Path, tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "out.mcap").write_bytes(b"mine")
    with pytest.raises(OutputExistsError):
        mcaprl.split(log, tmp_path / "parts", episodes=2)
    with pytest.raises(OutputExistsError):
        mcaprl.filter("terminated", log, tmp_path / "out.mcap")
    assert (tmp_path / "out.mcap").read_bytes() == b"mine"
    assert not list((tmp_path / "parts").iterdir())
    mcaprl.filter("terminated", log, tmp_path / "out.mcap", overwrite=True)
    mcaprl.split(log, tmp_path / "parts", episodes=2, overwrite=True)
    assert len(list((tmp_path / "parts").iterdir())) == 2


def test_a_folder_with_other_files_is_not_replaced(log: Path, tmp_path: Path) -> None:
    """Only parts that an earlier run wrote are replaced: not the log, and not the user's notes."""
    pytest.importorskip("pyarrow")
    before = log.read_bytes()
    with pytest.raises(OutputExistsError, match=r"files \(log.mcap\), which would be deleted"):
        mcaprl.split(log, tmp_path, episodes=2, overwrite=True)
    with pytest.raises(OutputExistsError, match=r"other files \(log.mcap\)"):
        mcaprl.convert(log, tmp_path, to="parquet", overwrite=True)
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [(log.name, before)]
    parts = tmp_path / "parts"
    mcaprl.split(log, parts, episodes=1)
    mcaprl.split(log, parts, episodes=2, overwrite=True)
    assert sorted(path.name for path in parts.iterdir()) == ["log-00000.mcap", "log-00001.mcap"]
    recorder = mcaprl.RecordMcap(gym.make("CartPole-v1"), parts / "log-00002.mcap")
    with closing(recorder), pytest.raises(LogError, match=r"open recorder of .*log-00002.mcap"):
        mcaprl.split(log, parts, episodes=2, overwrite=True)
    (parts / "notes").mkdir()
    (parts / "notes" / "day.txt").write_text("mine")
    with pytest.raises(OutputExistsError, match=r"other files \(notes/day.txt\)"):
        mcaprl.split(log, parts, episodes=2, overwrite=True)
    assert (parts / "notes" / "day.txt").read_text() == "mine"


def test_log_can_be_replaced_by_its_part(log: Path) -> None:
    mcaprl.filter("episode == 1", log, log, overwrite=True)
    assert [episode.summary.episode for episode in mcaprl.open(log).episodes] == [1]


def test_logs_at_urls(log: Path, tmp_path: Path) -> None:
    pytest.importorskip("fsspec")
    url = f"file://{log}"
    mcaprl.filter("episode < 2", url, tmp_path / "a.mcap")
    mcaprl.slice(url, tmp_path / "b.mcap", steps=(5, None))
    mcaprl.merge([f"file://{tmp_path / 'a.mcap'}", tmp_path / "b.mcap"], tmp_path / "out.mcap")
    assert messages_of(tmp_path / "out.mcap") == messages_of(log)
    parts = mcaprl.split(url, tmp_path / "parts", episodes=4)
    assert [part.out.name for part in parts] == ["log-00000.mcap"]
    assert messages_of(parts[0].out) == messages_of(log)


def test_unfinished_logs_are_refused(log: Path, tmp_path: Path) -> None:
    content = log.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(content[: len(content) // 2])
    with pytest.raises(LogError, match=r"cut\.mcap cannot be copied: .*run `mcaprl recover"):
        mcaprl.filter("terminated", cut, tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


def test_commands(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, parts = tmp_path / "out.mcap", tmp_path / "parts"
    assert run(["filter", "length > 2", str(log), str(out)]) == 0
    assert "out.mcap: 2 episodes, 7 steps, " in capsys.readouterr().out
    assert run(["split", str(log), str(parts), "--ratio", "1:1", "--seed", "0"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2
    (tmp_path / "out.mcap").unlink()
    assert run(["filter", "length > 2", str(log), str(out), "--json"]) == 0
    (one,) = json.loads(capsys.readouterr().out)["logs"]
    # The 2 episodes have 9 records (7 steps and 2 final observations), 2 summaries, and 8 messages:
    # the start and the end of each episode on 2 topics. Each short episode has 2 chunks.
    assert one == {
        "out": str(out),
        "episodes": 2,
        "steps": 7,
        "messages": 19,
        "whole_chunks": 4,
        "rewritten_chunks": 0,
    }
    assert run(["split", str(log), str(parts), "--ratio", "1:x"]) == 2
    assert capsys.readouterr().err == "mcaprl: --ratio has 'x', which is not a number\n"
    assert run(["filter", "nothing > 2", str(log), str(out)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
