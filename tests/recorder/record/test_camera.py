"""The video of what an environment renders, read by PyAV and as an image topic of a mapping."""

from __future__ import annotations

import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import LogError, MissingExtraError, UsageError
from mcaprl.recorder.dataset.video import VideoDecoder
from tests.support.videos import scene


class Rendered(gym.Env[Any, Any]):
    """An environment of five steps whose images differ from step to step."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Discrete(2)
    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012

    def __init__(self, shape: tuple[int, int] = (48, 64), mode: str | None = "rgb_array") -> None:
        self.render_mode, self._shape, self._step = mode, shape, 0
        self.images: list[Any] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._step = 0
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> Any:
        self._step += 1
        return np.zeros(2, np.float32), 1.0, self._step == 5, False, {}

    def render(self) -> Any:
        height, width = self._shape
        self.images.append(scene(self._step, width, height))
        return self.images[-1]


def drive(env: Any, episodes: int = 2) -> None:
    for _ in range(episodes):
        env.reset()
        while not env.step(0)[2]:
            pass


def decoded(log: Path) -> tuple[list[int], list[Any]]:
    """Return the log_times and images of the video; none may be missing."""
    decoder, found = VideoDecoder(), dict[int, Any]()
    with mcaprl.open_bag(log) as bag:
        stream = bag.read("/camera/image", ["data", "format", "timestamp"])
    assert stream.columns["timestamp"].tolist() == stream.log_time_ns.tolist()
    for row, (data, kind) in enumerate(
        zip(stream.columns["data"], stream.columns["format"], strict=True)
    ):
        found |= dict(decoder.feed(row, kind, data))
    found |= dict(decoder.end())
    assert not [each for each in found.values() if isinstance(each, str)]
    images = [found[row].to_ndarray(format="rgb24").astype(int) for row in range(len(found))]
    return stream.log_time_ns.tolist(), images


@pytest.mark.parametrize("shape", [(48, 64), (49, 65)])
def test_rendered_images_are_a_video(log_path: Path, shape: tuple[int, int]) -> None:
    env = Rendered(shape)
    with closing(mcaprl.RecordMcap(env, log_path, camera="h264")) as recorder:
        drive(recorder)
    times_ns, images = decoded(log_path)
    data = mcaprl.open(log_path)
    # One image for each observation, at its time.
    assert len(env.images) == len(images) == len(data.frames) == 12
    with mcaprl.open_bag(log_path) as bag:
        assert times_ns == bag.times("/rl/step").tolist()
    for ours, theirs in zip(images, env.images, strict=True):
        # An odd edge is cut.
        assert ours.shape == (48, 64, 3)
        assert np.abs(ours - theirs[:48, :64]).mean() < 6
    assert mcaprl.check(log_path).problems == ()


def test_each_episode_begins_with_a_keyframe(log_path: Path) -> None:
    with closing(mcaprl.RecordMcap(Rendered(), log_path, camera="h264")) as recorder:
        drive(recorder, 3)
    decoder = VideoDecoder()
    with mcaprl.open_bag(log_path) as bag:
        columns = bag.read("/camera/image", ["data", "format"]).columns
    starts = [
        decoder.starts(kind, data)
        for data, kind in zip(columns["data"], columns["format"], strict=True)
    ]
    assert starts == [True, False, False, False, False, False] * 3


def test_at_most_thirty_images_a_second(log_path: Path) -> None:
    env = Rendered()
    recorder = mcaprl.RecordMcap(env, log_path, camera="h264", step_duration_s=0.01)
    with closing(recorder):
        drive(recorder, 1)
    # Steps 0 and 4 of six, 40 ms apart.
    assert len(env.images) == 2
    times_ns, _ = decoded(log_path)
    assert np.diff(times_ns).tolist() == [40_000_000]


def test_a_log_with_video_is_a_bag_with_images(log_path: Path) -> None:
    env = Rendered()
    with closing(mcaprl.RecordMcap(env, log_path, camera="h264")) as recorder:
        drive(recorder)
    mapping = {
        "clock": {"topic": "/rl/step"},
        "observation": {"camera": {"image": "/camera/image", "resize": [16, 12]}},
        "action": {"field": "/rl/step.action"},
    }
    found = mcaprl.open(log_path, mapping=mapping)
    assert found.observations.shape[1:] == (12, 16, 3)
    assert len(found) >= 10


def test_what_cannot_be_recorded_as_video(
    log_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(UsageError, match="its render_mode is None: make it with `render_mode="):
        mcaprl.RecordMcap(Rendered(mode=None), log_path, camera="h264")
    with pytest.raises(UsageError, match="camera must be True, False or h264, not 'av1'"):
        mcaprl.RecordMcap(Rendered(), log_path, camera="av1")
    assert not log_path.exists()
    env = Rendered()
    monkeypatch.setattr(env, "render", lambda: np.zeros((4, 4), np.float32))
    with (
        closing(mcaprl.RecordMcap(env, log_path, camera="h264")) as recorder,
        pytest.raises(LogError, match=r"renders float32 of shape \(4, 4\), not an image of 8 bits"),
    ):
        recorder.reset()
    env = Rendered()
    log = log_path.with_name("other.mcap")
    with closing(mcaprl.RecordMcap(env, log, camera="h264")) as recorder:
        recorder.reset()
        env._shape = (20, 30)
        with pytest.raises(LogError, match="images of 30 x 20 pixels, but its first one had 64 x"):
            recorder.step(0)
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'mcaprl\[video\]'"):
        mcaprl.RecordMcap(Rendered(), log_path, camera="h264", overwrite=True)
    record = ["record", "CartPole-v1", "--policy", "random", "--out", str(log_path)]
    assert run([*record, "--camera", "vp9"]) == 2
    assert "'depth', 'h264'" in capsys.readouterr().err


def test_the_command_renders_any_environment(tmp_path: Path) -> None:
    log = tmp_path / "cart.mcap"
    record = ["record", "CartPole-v1", "--policy", "random", "--episodes", "1", "--out", str(log)]
    assert run([*record, "--camera", "h264"]) == 0
    _, images = decoded(log)
    assert images[0].shape == (400, 600, 3)
    # The way of rendering is no property of the environment.
    assert "render_mode" not in mcaprl.open(log).env_kwargs
