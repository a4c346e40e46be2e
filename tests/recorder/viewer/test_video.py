"""Videos and contact sheets of logged episodes."""

from __future__ import annotations

import importlib.util
import weakref
from contextlib import closing
from pathlib import Path
from typing import Any, get_args

import gymnasium as gym
import numpy as np
import pytest

import mcaprl
from mcaprl.cli import run
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.viewer.playback import moments_of_episode
from mcaprl.recorder.viewer.video import (
    VIDEO_KINDS,
    contact_sheet,
    evenly_spaced,
    parts_of_step,
    shown_steps,
    write_video,
)
from mcaprl.sims import make_sim
from mcaprl.sims.drawing.chase_view import HEIGHT_PX, ChaseView, Dial, chase_eye, poses_of
from mcaprl.sims.drawing.scene import Frame, Kind, Shape, yaw_rotation
from mcaprl.sims.geometry import box_mesh
from mcaprl.sims.lane.scene import static_shapes
from tests.conftest import need

RED, GREEN = (1.0, 0.0, 0.0, 1.0), (0.0, 1.0, 0.0, 1.0)
WIDTH, HEIGHT = 960, HEIGHT_PX


@pytest.fixture(autouse=True)
def _has_writers() -> None:
    for name in ("imageio", "av", "pygame"):
        need(importlib.util.find_spec(name) is not None, f"{name} is not installed")


@pytest.fixture
def view() -> Any:
    with closing(ChaseView()) as found:
        yield found


def car_at(x_m: float, y_m: float = 0.0, yaw_rad: float = 0.0) -> list[Frame]:
    return [Frame("car", (x_m, y_m, 0.0), yaw_rotation(yaw_rad))]


def test_a_dial_marks_a_number_on_a_bar(view: Any) -> None:
    """The bar is 160 pixels wide, with its left end at 1 and its right end at -1."""
    places = []
    for value in (1.0, 0.0, -0.5, 7.0):
        image = view.draw([], [], [], "", [], [Dial("turn", value, 1.0, -1.0)])
        row = image[16, :, 2].astype(int) - image[16, :, 0]
        places.append(round(float(np.flatnonzero(row[:300] > 100).mean())))
    bar = 24 + 9 * len("turn")
    assert places == pytest.approx([bar, bar + 80, bar + 120, bar], abs=1)


def test_images_are_converted_for_the_encoder() -> None:
    """Red is Y 82, Cb 90 and Cr 240 in BT.601; PyAV's conversion is at most one level different."""
    import av

    from mcaprl.recorder.viewer.yuv import fill_frame

    x, y = np.meshgrid(np.arange(50), np.arange(36))
    image = np.stack([5 * x, 7 * y, 2 * (x + y)], axis=-1).astype(np.uint8)
    image[:2, :2] = 255, 0, 0
    frame = av.VideoFrame(50, 36, "yuv420p")
    fill_frame(image, frame)
    theirs = av.VideoFrame.from_ndarray(image, format="rgb24")
    expected = theirs.reformat(format="yuv420p", interpolation="BILINEAR")
    pairs: list[tuple[Any, Any]] = list(zip(frame.planes, expected.planes, strict=True))
    for pair, red in zip(pairs, (82, 90, 240), strict=True):
        values, others = (
            np.frombuffer(one, np.uint8).reshape(-1, one.line_size)[:, : one.width].astype(int)
            for one in pair
        )
        assert values[0, 0] == red
        assert abs(values - others)[4:, 4:].max() <= 1


def box(color: Any, x_m: float, frame: str = "map", **others: Any) -> Shape:
    size = (1.0, 1.0, 1.0)
    return Shape("box", "box", color, size=size, position=(x_m, 0.0, 0.5), frame=frame, **others)


def share(image: Any, channel: int) -> float:
    """Return the share of the pixels that have one pure color at any brightness."""
    others = [c for c in range(3) if c != channel]
    pure = (image[..., channel] > 100) & (image[..., others].max(-1) < 60)
    return float(pure.mean())


def test_the_followed_frame_is_in_the_image_center(view: ChaseView) -> None:
    images = [
        view.draw([box(RED, 0.0, "car")], [], car_at(*place), "car", [])
        for place in ((0.0, 0.0, 0.0), (500.0, -80.0, 2.0))
    ]
    assert images[0].shape == (HEIGHT, WIDTH, 3)
    for image in images:
        rows, columns = np.nonzero(image[..., 0] > image[..., 2].astype(int) + 60)
        assert abs(columns.mean() - WIDTH / 2) < 5
        assert HEIGHT / 2 < rows.mean() < HEIGHT
    assert abs(share(images[0], 0) - share(images[1], 0)) < 2e-3


def test_nearer_shapes_hide_farther_ones(view: ChaseView) -> None:
    wall = Shape("wall", "box", GREEN, size=(0.5, 9.0, 9.0), position=(-4.0, 0.0, 2.0))
    for scene in ([box(RED, 0.0), wall], [wall, box(RED, 0.0)]):
        image = view.draw(scene, [], car_at(0.0), "car", [])
        assert share(image, 0) == 0.0
        assert share(image, 1) > 0.2
    assert share(view.draw([box(RED, -100.0)], [], car_at(0.0), "car", []), 0) == 0.0
    assert share(view.draw([box(RED, 900.0)], [], car_at(0.0), "car", []), 0) == 0.0


def test_a_box_looks_like_its_triangles(view: ChaseView) -> None:
    size, position, turn_rad = (3.0, 1.0, 2.0), (0.5, 0.25, 1.0), 0.6
    mesh = box_mesh((0.0, 0.0, 0.0), size).reshape(-1, 3)
    place: Any = {"position": position, "yaw_rad": turn_rad}
    whole = view.draw([Shape("it", "box", RED, size=size, **place)], [], [], "", [])
    parts = view.draw([Shape("it", "triangles", RED, points=mesh, **place)], [], [], "", [])
    differs = (abs(whole.astype(int) - parts) > 8).any(-1)
    assert share(whole, 0) > 5e-3
    # Only at the diagonals of the faces, the background shines through the triangles' edges.
    assert differs.mean() < 0.1 * share(whole, 0)


def test_every_kind_of_shape_is_visible(view: ChaseView) -> None:
    points = np.array([[0.0, -1.0, 0.2], [0.0, 1.0, 0.2], [0.0, 0.0, 2.0]])
    for kind in get_args(Kind):
        if kind == "text":
            continue
        some = points[:2] if kind == "segments" else points
        shape = Shape("it", kind, RED, points=some, size=(0.5, 0.5, 0.5))
        assert share(view.draw([], [shape], [], "", []), 0) > 1e-4, kind
    empty = view.draw([], [], [], "", [])
    assert (view.draw([], [], [], "", ["a line"]) != empty).any()
    label = Shape("it", "text", RED, text="here")
    assert (view.draw([], [label], [], "", []) != empty).any()


def test_frames_are_relative_to_their_parents() -> None:
    quarter = yaw_rotation(np.pi / 2)
    frames = [Frame("b", (1.0, 0.0, 0.0), quarter, "a"), Frame("a", (5.0, 0.0, 0.0), quarter)]
    poses = poses_of(frames)
    np.testing.assert_allclose(poses["b"].at_m, [5.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(poses["b"].axes[:, 0], [-1.0, 0.0, 0.0], atol=1e-12)
    round_about = [Frame("a", (1.0, 0.0, 0.0), quarter, "b"), Frame("b", (0, 0, 0), quarter, "a")]
    assert set(poses_of(round_about)) == {"a", "b"}
    eye = chase_eye(poses["a"])
    np.testing.assert_allclose(eye.axes.T @ eye.axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(eye.axes) == pytest.approx(1.0)


def test_a_log_reproduces_the_recorded_scene(tmp_path: Path) -> None:
    path, env = tmp_path / "lane.mcap", make_sim("lane")
    with closing(mcaprl.RecordMcap(env, path)) as recorder:
        recorder.reset(seed=0)
        for _ in range(3):
            recorder.step(1)
        sim: Any = env.unwrapped
        scene, static, frames = sim.scene(), sim.static_scene(), sim.frames()
    *_, last = moments_of_episode(McapReader(path), mcaprl.open(path).episodes[0])
    assert last.follow == "car"
    for seen, shapes in ((last.moving, scene), (last.static, static)):
        assert len(seen) == len(shapes)
        for one, shape in zip(seen, shapes, strict=True):
            for name in ("name", "kind", "frame", "text"):
                assert getattr(one, name) == getattr(shape, name)
            np.testing.assert_allclose(one.points, shape.points, atol=1 / 64)
            np.testing.assert_allclose(one.position, shape.position)
            np.testing.assert_allclose(one.size, shape.size)
            np.testing.assert_allclose(one.color, shape.color, atol=1e-6)
            assert np.sin(one.yaw_rad) == pytest.approx(np.sin(shape.yaw_rad), abs=1e-9)
    np.testing.assert_allclose(last.frames[0].position, frames[0].position, atol=2**-8)


def test_sheet() -> None:
    images = [np.full((40, 60, 3), value, np.uint8) for value in (10, 20, 30, 40)]
    sheet = contact_sheet(images)
    assert sheet.shape == (46, 102, 3)
    assert [sheet[0, 0, 0], sheet[0, 36, 0], sheet[0, 72, 0], sheet[26, 0, 0]] == [10, 20, 30, 40]
    assert sheet[26, 36, 0] == 255
    assert evenly_spaced(2, 12) == [0, 1, 2]


def test_a_fast_video_skips_steps() -> None:
    assert shown_steps(3, 50.0) == (range(4), 50.0)
    steps, images_per_s = shown_steps(7, 120.0)
    assert list(steps) == [1, 4, 7], "the end is shown"
    assert images_per_s == 40.0


def test_a_slow_video_shows_moments_between_steps(tmp_path: Path) -> None:
    """At four steps per second, a video has five images for each step, with the car in motion."""
    assert [parts_of_step(per_s) for per_s in (2.0, 4.0, 19.0, 20.0, 50.0)] == [10, 5, 2, 1, 1]
    path, env = tmp_path / "lane.mcap", make_sim("lane")
    with closing(mcaprl.RecordMcap(env, path)) as recorder:
        recorder.reset(options={"pose": (20.0, 1.0, 0.0, 10.0)})
        recorder.step(1)
    seen = list(moments_of_episode(McapReader(path), mcaprl.open(path).episodes[0], parts=5))
    assert [moment.step for moment in seen] == [0, 0, 0, 0, 0, 1]
    ms = [round((moment.time_ns - seen[0].time_ns) / 1e6) for moment in seen]
    assert ms == [0, 50, 100, 150, 200, 250]
    # At a speed of 10 m/s and an acceleration of 4 (1 - 10 / 30) m/s^2, the car moves at most 0.51
    # m in 0.05 s.
    x_m = [moment.frames[0].position[0] for moment in seen]
    np.testing.assert_allclose(np.diff(x_m), 0.505, atol=0.01)


def test_videos_of_a_scene_and_of_a_sim(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import imageio.v3 as imageio

    monkeypatch.chdir(tmp_path)
    for sim, name in (("lane", "lane.mcap"), ("CartPole-v1", "cart.mcap")):
        assert run(["record", sim, "--policy", "random", "--steps", "5", "--out", name]) == 0
    for name, size in (("lane", (HEIGHT, WIDTH)), ("cart", (400, 600))):
        arguments = ["replay", f"{name}.mcap", "--contact-sheet", f"{name}.png"]
        assert run([*arguments, "--video", f"{name}.mp4"]) == 0
        for kind in ("gif", "webp"):
            assert run(["replay", f"{name}.mcap", "--video", f"{name}.{kind}"]) == 0
        for kind, plugin in (("mp4", "pyav"), ("gif", "pillow"), ("webp", "pillow")):
            video = np.stack(list(imageio.imiter(f"{name}.{kind}", plugin=plugin)))
            # If an image equals the previous image, a GIF or WebP stores only a longer duration of
            # the previous image.
            # The last image is held for a second: 20 images of lane, 50 of CartPole.
            count = 26 + 20 if name == "lane" else 6 + 50
            assert len(video) == count if kind == "mp4" else 2 <= len(video) <= count
            assert video.shape[1:3] == size
            assert (video[0] != video[-1]).any()
        assert imageio.imread(f"{name}.png").shape[2] == 3
    capsys.readouterr()
    for arguments, why in (
        (["--video", "lane.mp4"], "lane.mp4 exists"),
        (["--video", "lane.avi"], "unknown kind of output '.avi'"),
        (["--video", "new.mp4", "--episode", "7"], "has episodes 0 to 0"),
        (["cart.mcap", "--video", "new.mp4"], "a page or video shows one log"),
        (["--video", "new.mp4", "--height", "15"], "height is 15, expected 16 to 4320 pixels"),
    ):
        assert run(["replay", "lane.mcap", *arguments]) == 2
        assert why in capsys.readouterr().err
    assert run(["replay", "cart.mcap", "--video", "new.mp4", "--height", "480"]) == 2
    assert "cart.mcap has no scene" in capsys.readouterr().err
    small = ["--video", "small.mp4", "--contact-sheet", "small.png", "--height", "480"]
    assert run(["replay", "lane.mcap", *small]) == 0
    assert imageio.imread("small.mp4", plugin="pyav", index=0).shape == (480, 854, 3)
    # The sheet shows the images at half their size, in three columns.
    assert imageio.imread("small.png").shape[1] - 3 * 427 in range(40)
    assert not Path("new.mp4").exists()


def test_an_encoded_video_looks_like_its_images(view: ChaseView, tmp_path: Path) -> None:
    import imageio.v3 as imageio

    path, static = tmp_path / "lane.mp4", list(static_shapes())
    images = [view.draw(static, [], car_at(x_m), "car", ["a line"]) for x_m in (20.0, 20.5, 21.0)]
    assert write_video(path, iter(images), 12.5) == 3
    assert imageio.immeta(path, plugin="pyav")["fps"] == 12.5
    for seen, image in zip(imageio.imiter(path, plugin="pyav"), images, strict=True):
        error = seen.astype(float) - image
        # A video has one color for 2x2 pixels, so edges between colors differ.
        assert np.abs(error).mean() < 2.0
        assert 10 * np.log10(255**2 / (error**2).mean()) > 33, "dB"


class LiveImages:
    """Images of which the largest number in memory is counted."""

    def __init__(self) -> None:
        self.most = 0
        self._made: list[weakref.ref[Any]] = []

    def make(self) -> Any:
        image = np.full((40, 60, 3), len(self._made), np.uint8)
        self._made.append(weakref.ref(image))
        self.most = max(self.most, sum(made() is not None for made in self._made))
        return image


@pytest.mark.parametrize("kind", VIDEO_KINDS)
def test_images_are_written_one_by_one(tmp_path: Path, kind: str) -> None:
    images = LiveImages()
    assert write_video(tmp_path / f"video{kind}", (images.make() for _ in range(20)), 20.0) == 20
    assert images.most <= 3


def test_images_of_a_sim_are_written_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gymnasium.envs.classic_control.cartpole import CartPoleEnv

    log, images = tmp_path / "cart.mcap", LiveImages()
    mcaprl.record("CartPole-v1", log, policy="random", episodes=1)
    monkeypatch.setattr(CartPoleEnv, "render", lambda env: images.make())
    result = mcaprl.render(log, video=tmp_path / "cart.mp4")
    assert result.frames > 5
    assert images.most <= 3


def test_frames_of_a_gif(tmp_path: Path) -> None:
    """Each frame has its own palette: up to 255 colors are exact, and others are close."""
    from PIL import Image as pillow

    x, y = np.meshgrid(np.arange(51), np.arange(41))
    smooth = np.stack([4 * x, 5 * y, 0 * x], -1).astype(np.uint8)
    few = np.stack([16 * (x // 4), 0 * x, 16 * (y // 4)], -1).astype(np.uint8)
    flat = np.full((3, 41, 51, 3), 90, np.uint8)
    flat[1:, 5:9, 7:20] = 20, 40, 60
    flat[2, 30:, :3] = 200
    images = [smooth, few, *flat[[0, 0, 1, 2]]]
    path = tmp_path / "video.gif"
    assert write_video(path, iter(images), 25.0) == 6
    with pillow.open(path) as video:
        assert video.info["loop"] == 0
        for number, image in enumerate(images):
            video.seek(number)
            assert video.info["duration"] == 40
            error = np.asarray(video.convert("RGB")).astype(float) - image
            assert np.abs(error).mean() < (5.0 if image is smooth else 0.01), number
        with pytest.raises(EOFError):
            video.seek(6)


def test_frames_of_a_webp(tmp_path: Path) -> None:
    from PIL import Image as pillow

    x, y = np.meshgrid(np.arange(51), np.arange(41))
    images = [np.stack([4 * x, 5 * y, 0 * x + shade], -1).astype(np.uint8) for shade in (0, 99, 0)]
    path = tmp_path / "video.webp"
    assert write_video(path, iter(images), 25.0) == 3
    with pillow.open(path) as video:
        assert video.info["loop"] == 0
        for number, image in enumerate(images):
            video.seek(number)
            video.load()
            assert video.info["duration"] == 40
            error = np.asarray(video.convert("RGB")).astype(float) - image
            assert np.abs(error).mean() < 5.0
        with pytest.raises(EOFError):
            video.seek(3)


def test_a_video_needs_frames(tmp_path: Path) -> None:
    for kind in ("mp4", "gif", "webp"):
        path = tmp_path / f"video.{kind}"
        with pytest.raises(mcaprl.errors.UsageError, match="no frames"):
            write_video(path, [], 20.0)
        assert not path.exists()


def test_images_of_an_odd_size_lose_a_row_and_a_column(tmp_path: Path) -> None:
    import imageio.v3 as imageio

    image = np.full((41, 51, 3), (0, 255, 0), np.uint8)
    assert write_video(tmp_path / "video.mp4", [image], 20.0) == 1
    (seen,) = imageio.imiter(tmp_path / "video.mp4", plugin="pyav")
    assert seen.shape == (40, 50, 3)
    assert np.abs(seen.astype(int) - (0, 255, 0)).max() < 10


def test_images_of_different_sizes_are_refused(tmp_path: Path) -> None:
    images = [np.zeros((size, 50, 3), np.uint8) for size in (40, 20)]
    for kind in VIDEO_KINDS:
        with pytest.raises(mcaprl.errors.UsageError, match=r"\(40, 50, 3\) and \(20, 50, 3\)"):
            write_video(tmp_path / f"video{kind}", images, 20.0)
    assert list(tmp_path.iterdir()) == []


def test_a_log_without_a_scene_has_no_video(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "cart.mcap"
    with closing(mcaprl.RecordMcap(gym.make("CartPole-v1"), path)) as env:
        env.reset()
        env.step(0)
    video = ["replay", str(path), "--video", str(tmp_path / "video.mp4")]
    assert run(video) == 1
    assert "has no scene, and episode 0 has no seed" in capsys.readouterr().err
    assert not (tmp_path / "video.mp4").exists()
