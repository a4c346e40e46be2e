"""Parts of a log between two steps or times; episodes at the bounds become shorter."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import NoEpisodesError, UsageError
from mcaprl.recorder.repair.check import IMPOSSIBLE_ACTION, check_log
from tests.recorder.edit.contents import messages_of
from tests.recorder.edit.test_merge import sensor_log
from tests.support.recordings import assert_same_bits, leaves_of, record
from tests.support.strategies import transitions

SPACE = spaces.Dict(
    {"x": spaces.Box(-1, 1, (2,), np.float32), "image": spaces.Box(0, 255, (8, 9), np.uint8)}
)
# Records are at intervals of 0.05 s. The episodes begin at 0 s, 0.25 s and 0.35 s, and the last one
# ends at 0.5 s.
LENGTHS = [4, 1, 3]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "log.mcap"
    record(path, SPACE, spaces.Discrete(3), LENGTHS, start_time_ns=10**18)
    return path


def assert_same_rows(part: mcaprl.Dataset, whole: mcaprl.Dataset, start: int, stop: int) -> None:
    for name in ("actions", "rewards", "terminated", "behavior"):
        assert_same_bits(getattr(part, name), getattr(whole, name)[start:stop])
    for name in ("observations", "next_observations"):
        pairs = zip(leaves_of(getattr(part, name)), leaves_of(getattr(whole, name)), strict=True)
        for found, expected in pairs:
            assert_same_bits(found, expected[start:stop])


def test_part_within_two_episodes(log: Path, tmp_path: Path) -> None:
    found = mcaprl.slice(log, tmp_path / "out.mcap", steps=(2, 7))
    assert (found.episodes, found.steps) == (3, 5)
    part, whole = mcaprl.open(tmp_path / "out.mcap"), mcaprl.open(log)
    assert_same_rows(part, whole, 2, 7)
    assert check_log(tmp_path / "out.mcap") == []
    first, second, third = (episode.summary for episode in part.episodes)
    assert (first.length, first.seed, first.terminated, first.reason) == (
        2,
        None,
        True,
        "terminated",
    )
    assert (first.start_time_ns, first.end_time_ns) == (10**18 + 10**8, 10**18 + 2 * 10**8)
    assert repr(second) == repr(whole.episodes[1].summary)
    assert (third.length, third.seed, third.truncated, third.reason) == (
        2,
        102,
        True,
        "interrupted",
    )
    # The last record of the part is a final record: it has only an observation.
    assert part.truncated.tolist() == [False, False, True, False, True]
    assert part.terminated.tolist() == [False, True, False, False, False]


def test_part_within_one_episode(log: Path, tmp_path: Path) -> None:
    mcaprl.slice(log, tmp_path / "out.mcap", steps=(1, 3))
    part = mcaprl.open(tmp_path / "out.mcap")
    assert_same_rows(part, mcaprl.open(log), 1, 3)
    (episode,) = part.episodes
    assert (episode.summary.seed, episode.summary.reason) == (None, "interrupted")
    counts: dict[str, int] = {}
    for topic, *_ in messages_of(tmp_path / "out.mcap").elements():
        counts[topic] = counts.get(topic, 0) + 1
    # The only phase message in the part is `running`, from the start of the episode.
    assert counts.pop("/rl/phase") == 1
    assert counts == {"/rl/step": 3, "/rl/observation/image": 3, "/rl/episode": 1}


def test_part_of_whole_episodes_changes_no_message(log: Path, tmp_path: Path) -> None:
    mcaprl.slice(log, tmp_path / "out.mcap", steps=(4, 8))
    assert not messages_of(tmp_path / "out.mcap") - messages_of(log)
    mcaprl.filter("episode > 0", log, tmp_path / "other.mcap")
    assert messages_of(tmp_path / "out.mcap") == messages_of(tmp_path / "other.mcap")
    mcaprl.slice(log, tmp_path / "all.mcap", steps=(None, None))
    assert messages_of(tmp_path / "all.mcap") == messages_of(log)


@pytest.mark.parametrize(
    ("time", "expected"),
    [
        # The records at 0.05, 0.10 and 0.15 s are two transitions.
        ((0.05, 0.2), [(0, 1, 3)]),
        ((0.04, 0.1999), [(0, 1, 3)]),
        # The final record of the first episode is left out, because it is not a transition.
        ((0.2, None), [(1, 0, 1), (2, 0, 3)]),
        ((None, 0.25), [(0, 0, 4)]),
        # The part ends after the first record of the last episode, which alone is not a transition.
        ((0.25, 0.4), [(1, 0, 1)]),
        ((None, None), [(0, 0, 4), (1, 0, 1), (2, 0, 3)]),
        ((-1e300, 1e300), [(0, 0, 4), (1, 0, 1), (2, 0, 3)]),
    ],
)
def test_parts_in_time(
    log: Path,
    tmp_path: Path,
    time: tuple[float | None, float | None],
    expected: list[tuple[int, int, int]],
) -> None:
    mcaprl.slice(log, tmp_path / "out.mcap", time=time)
    part, whole = mcaprl.open(tmp_path / "out.mcap"), mcaprl.open(log)
    assert check_log(tmp_path / "out.mcap") == []
    rewards = [whole.episodes[k].rewards[start:stop].tolist() for k, start, stop in expected]
    assert repr([episode.rewards.tolist() for episode in part.episodes]) == repr(rewards)


@settings(max_examples=40)
@given(given_=transitions(), data=st.data())
def test_any_part_has_the_rows_of_the_log(
    tmp_path_factory: pytest.TempPathFactory, given_: dict[str, Any], data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("slice")
    mcaprl.Dataset.from_arrays(**given_).save(folder / "log.mcap")
    whole = mcaprl.open(folder / "log.mcap")
    start = data.draw(st.integers(0, len(whole) - 1))
    stop = data.draw(st.integers(start + 1, len(whole) + 2))
    mcaprl.slice(folder / "log.mcap", folder / "out.mcap", steps=(start, stop))
    problems = check_log(folder / "out.mcap")
    assert [one for one in problems if one.next != IMPOSSIBLE_ACTION] == []
    assert_same_rows(mcaprl.open(folder / "out.mcap"), whole, start, min(stop, len(whole)))


def test_part_of_a_file_without_steps(tmp_path: Path) -> None:
    sensor_log(tmp_path / "camera.mcap", [1, 2, 4], at_ns=10**18)
    # The messages are 1, 2 and 4 ns after `at_ns`, and thus 0, 1 and 3 ns after the first message.
    mcaprl.slice(tmp_path / "camera.mcap", tmp_path / "out.mcap", time=(1e-9, 3e-9))
    assert [message[:2] for message in messages_of(tmp_path / "out.mcap")] == [
        ("/camera/2", 10**18 + 2)
    ]


@pytest.mark.parametrize(
    ("metadata", "is_kept"),
    [
        ({"offered_qos_profiles": "- history: 3\n  durability: 1\n  depth: 1\n"}, True),
        ({"offered_qos_profiles": "- durability: transient_local\n"}, True),
        ({"latching": "1"}, True),
        ({"offered_qos_profiles": "- history: 3\n  durability: 2\n  depth: 1\n"}, False),
        ({}, False),
    ],
)
def test_latched_messages_before_the_part(
    tmp_path: Path, metadata: dict[str, str], is_kept: bool
) -> None:
    with (tmp_path / "robot.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        robot = writer.register_channel("/robot_description", "json", 0, metadata)
        speed = writer.register_channel("/speed", "json", 0)
        for time_s in range(6):
            writer.add_message(speed, 10**18 + time_s * 10**9, b"%d" % time_s, 0)
            if time_s in (0, 1, 5):
                writer.add_message(robot, 10**18 + time_s * 10**9, b"robot %d" % time_s, 0)
        writer.finish()
    mcaprl.slice(tmp_path / "robot.mcap", tmp_path / "out.mcap", time=(3, 5))
    # Of the three descriptions, the second is valid at 3 s.
    robots = [b"robot 1"] if is_kept else []
    found = sorted(data for _, _, _, data in messages_of(tmp_path / "out.mcap"))
    assert found == sorted([b"3", b"4", *robots])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "give either steps or time"),
        ({"steps": (0, 1), "time": (0, 1)}, "give either steps or time"),
        ({"steps": (8, None)}, "has the steps 0 to 7: none of them"),
        ({"steps": (3, 3)}, "has the steps 0 to 7: none of them"),
        ({"steps": (-1, 3)}, "has the steps 0 to 7: none of them"),
        ({"time": (0.6, None)}, r"lasts 0\.5 s: no message is in this part"),
        ({"steps": (0.5, 3)}, "steps are 0.5 and 3, expected integers"),
        ({"steps": (math.nan, 3)}, "a bound is nan, expected a number"),
        ({"time": (0, math.inf)}, "a bound is inf, expected a number"),
        ({"time": (2, 1)}, r"lasts 0\.5 s: no message is in this part"),
    ],
)
def test_wrong_parts(log: Path, tmp_path: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        mcaprl.slice(log, tmp_path / "out.mcap", **options)
    assert list(tmp_path.iterdir()) == [log]


def test_part_without_a_whole_transition(log: Path, tmp_path: Path) -> None:
    with pytest.raises(NoEpisodesError, match="has no whole transition in this part"):
        mcaprl.slice(log, tmp_path / "out.mcap", time=(0.06, 0.14))


def test_command(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "out.mcap")
    assert run(["slice", str(log), out, "--steps", "2:"]) == 0
    assert "out.mcap: 3 episodes, 6 steps, " in capsys.readouterr().out
    for wrong in ("5", "a:b", "1.5:2", "-1:2", "1:2:3", "nan:"):
        assert run(["slice", str(log), out, f"--steps={wrong}", "--overwrite"]) == 2
        assert capsys.readouterr().err.startswith("mcaprl: --steps ")
