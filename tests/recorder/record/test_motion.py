"""Motion within steps on `/tf`: interpolated poses equal the poses of the sim at any moment."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mcaprl
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.format import messages
from mcaprl.recorder.record.scene import motion_transforms
from mcaprl.recorder.viewer.playback import moments_of_episode
from mcaprl.sims import make_sim
from mcaprl.sims.drawing.scene import Frame

STEPS = 8


@pytest.mark.parametrize(("sim", "parts"), [("lane", 5), ("powerline", 10), ("racer", 2)])
def test_a_log_has_the_poses_at_20_hz_within_4_cm(sim: str, parts: int, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    expected: list[Any] = []
    with closing(mcaprl.RecordMcap(make_sim(sim), path)) as env:
        env.reset(seed=1)
        inner: Any = env.unwrapped
        expected.append(inner.frames()[0].position)
        for step in range(STEPS):
            env.step(step % 2)
            within = [frames[0].position for _, frames in inner.motion()]
            expected += [*within, inner.frames()[0].position]
    (episode,) = mcaprl.open(path).episodes
    moments = list(moments_of_episode(McapReader(path), episode, parts))
    assert len(moments) == len(expected) == STEPS * parts + 1
    assert np.diff([moment.time_ns for moment in moments]).max() <= 50_000_000
    found = np.array([moment.frames[0].position for moment in moments])
    # The tolerance includes the rounding of positions to 1/256 m.
    np.testing.assert_allclose(found, expected, atol=0.045)


def test_a_step_of_another_duration_has_its_poses_within_the_step(tmp_path: Path) -> None:
    """The drone's step of 0.5 s is recorded as 0.1 s."""
    path = tmp_path / "log.mcap"
    with closing(mcaprl.RecordMcap(make_sim("powerline"), path, step_duration_s=0.1)) as env:
        env.reset(seed=1)
        for step in range(STEPS):
            env.step(step % 2)
    reader = McapReader(path)
    channel = reader.channel_of("/tf")
    assert channel is not None
    for time_ns, data in reader.messages(channel):
        tree = messages.decode(data, "tf2_msgs/msg/TFMessage")
        stamps = [each.header.stamp for each in tree.transforms]
        after_ns = [stamp.sec * 10**9 + stamp.nanosec - time_ns for stamp in stamps]
        assert after_ns[0] == 0
        assert after_ns == sorted(after_ns)
        assert after_ns[-1] in (0, 10**8)


def test_only_poses_that_interpolation_misses_are_kept() -> None:
    def moment(time_ns: int, x_m: float) -> tuple[int, list[Frame]]:
        return time_ns, [Frame("car", (x_m, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))]

    line = [moment(k, float(k)) for k in range(5)]
    bent = [*line[:4], moment(4, 9.0)]

    def stamps(data: bytes) -> list[int]:
        tree = messages.decode(data, "tf2_msgs/msg/TFMessage")
        return [each.header.stamp.nanosec for each in tree.transforms]

    assert stamps(motion_transforms(line)) == [0, 4]
    assert stamps(motion_transforms(bent)) == [0, 3, 4]
    assert stamps(motion_transforms(line, thins=False)) == [0, 1, 2, 3, 4]
    assert stamps(motion_transforms(line[:1])) == [0]
