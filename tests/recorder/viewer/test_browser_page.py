"""Tests of the page of `mcaprl replay`: its data, its server, and its content in a browser."""

from __future__ import annotations

import base64
import gzip
import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import mcaprl
from mcaprl import limits
from mcaprl.cli import run
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.format.schema import COMMAND_VALUES
from mcaprl.recorder.record.display import SCENE
from mcaprl.recorder.viewer.annotate import annotated_copy
from mcaprl.recorder.viewer.page import log_page
from mcaprl.recorder.viewer.page.log_page import LogPage, pack
from mcaprl.recorder.viewer.playback import moments_of_episode
from mcaprl.sims import make_sim
from mcaprl.sims.drawing.scene import Frame, Shape, yaw_rotation
from tests.recorder.viewer.browser import Browser, browsing

ROOT = Path(__file__).parents[3]
VENDOR = ROOT / "recorder/viewer/page/vendor"
EVIL = "<img src=x onerror=window.hit=1></script><script>window.hit=1</script>"
STEPS = 5


class Driver(gym.Env[Any, Any]):
    """A red box that drives 10 m ahead in each step, and turns by a right angle."""

    observation_space = spaces.Dict(
        {
            "image": spaces.Box(0, 255, (8, 12, 3), np.uint8),
            "place": spaces.Box(-100, 100, (2,), np.float32),
        }
    )
    action_space = spaces.Discrete(3, start=5)
    step_duration_s = 0.5

    def __init__(self, word: str = "") -> None:
        self.action_meanings = tuple(f"{name} {word}".strip() for name in ("left", "on", "right"))
        self._word = word

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        super().reset(seed=seed)
        self._step = 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._step += 1
        reason = f"goal {self._word}".strip()
        done = self._step == STEPS
        return self._observation(), 0.5 * self._step, done, False, {"reason": reason}

    def _observation(self) -> dict[str, Any]:
        image = np.zeros((8, 12, 3), np.uint8)
        image[2, 3] = (255, 10 * self._step, 7)
        return {"image": image, "place": np.array([self._step, -self._step], np.float32)}

    def static_scene(self) -> list[Shape]:
        ground = (200.0, 200.0, 0.2)
        return [Shape("ground", "box", (0.0, 0.4, 0.0, 1.0), size=ground, position=(0, 0, -3))]

    def scene(self) -> list[Shape]:
        red, blue = (1.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 1.0)
        corner = np.array([(0.0, 0.0, 5.0), (0.0, 3.0, 5.0), (0.0, 0.0, 9.0)])
        return [
            Shape("car", "box", red, size=(4.0, 4.0, 4.0), frame="car"),
            Shape("label", "text", blue, size=(0, 0, 1), position=(0, 0, 9), text=self._word),
            *(Shape(k, k, blue, corner, (0.3, 0.6, 0)) for k in ("line", "segments", "triangles")),
            *(Shape(k, k, blue, corner, (0.3, 0.6, 0)) for k in ("points", "spheres")),
            Shape("arrow", "arrow", blue, corner[:2], (0.3, 0.6, 0)),
            Shape("to x", "arrow", blue, size=(2.0, 0.2, 0.2)),
            Shape("ball", "sphere", blue, size=(1.0, 1.0, 1.0), position=(0, 9, 0)),
            Shape("post", "cylinder", blue, size=(1.0, 1.0, 5.0), position=(0, -9, 0)),
        ]

    def static_frames(self) -> list[Frame]:
        return [Frame("camera", (1.0, 0.0, 0.0), yaw_rotation(0.0), "car")]

    def frames(self) -> list[Frame]:
        return [Frame("car", (10.0 * self._step, 0.0, 0.0), yaw_rotation(self._step * np.pi / 2))]

    def telemetry(self) -> dict[str, float]:
        return {"speed_m_s": 20.0, "x_m": 10.0 * self._step}

    def depth_image_m(self) -> Any:
        depth = np.full((4, 6), np.inf, np.float32)
        depth[1, 2], depth[0, 0] = 50.0, 0.001
        return depth


def record(path: Path, env: gym.Env[Any, Any], episodes: int = 2) -> Path:
    with closing(mcaprl.RecordMcap(env, path, camera=True, policy="p")) as recorder:
        for seed in range(episodes):
            recorder.reset(seed=seed)
            for step in range(STEPS):
                recorder.step(5 + step % 3)
    return path


def with_values(path: Path) -> Path:
    """Add Q-values of two policies: the value of action k at step t is 10 k + t."""
    episodes = mcaprl.open(path).episodes
    out = path.with_name(f"values-{path.name}")
    q = 10.0 * np.arange(3)[None] + np.arange(STEPS)[:, None]
    numbers = {name: np.zeros(STEPS) for name in ("value", "advantage", "td_error", "entropy")}
    columns = {"q": q, "preference": q, **numbers, "policy_action": np.full(STEPS, 7)}
    columns["agrees"] = np.zeros(STEPS, bool)
    with annotated_copy(path, out) as copy:
        for topic in ("/rl/values/cql", "/rl/values/iql"):
            copy.add_values(topic, [(episode.log_time_ns[:-1], columns) for episode in episodes])
    return out


def unpacked(data: bytes) -> Any:
    """Decode packed data as packed.py describes it."""
    raw = gzip.decompress(data)
    length = int.from_bytes(raw[:4], "little")
    start = 4 + length + -(4 + length) % 8

    def array(found: dict[str, Any]) -> Any:
        if "dtype" not in found:
            return found
        count, at = int(np.prod(found["shape"])), start + found["at"]
        assert at % 8 == 0
        return np.frombuffer(raw, found["dtype"], count, at).reshape(found["shape"])

    return json.loads(raw[4 : 4 + length], object_hook=array)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return with_values(record(tmp_path_factory.mktemp("page") / "log.mcap", Driver("word")))


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browsing(tmp_path_factory.mktemp("profile")) as found:
        yield found


@contextmanager
def served(path: Path, **options: Any) -> Iterator[str]:
    """Serve the page of a log; yield its URL."""
    stop, is_open, urls = threading.Event(), threading.Event(), list[str]()

    def opened(url: str) -> None:
        urls.append(url)
        is_open.set()

    options |= {"show": False, "stop": stop, "on_open": opened}
    thread = threading.Thread(target=mcaprl.browse, args=(path,), kwargs=options)
    thread.start()
    assert is_open.wait(30)
    try:
        yield urls[0]
    finally:
        stop.set()
        thread.join()


def wait_for_episode(browser: Browser) -> None:
    browser.wait("!!episode && state.step >= 0")


def center_color(browser: Browser) -> Any:
    """Return the color in the middle of the 3D view, where the followed frame is."""
    return browser.run(
        """(() => {
          scene.render();
          const gl = scene.renderer.getContext(), pixel = new Uint8Array(4);
          const [x, y] = [gl.drawingBufferWidth >> 1, gl.drawingBufferHeight >> 1];
          gl.readPixels(x, y, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
          return [...pixel];
        })()"""
    )


def is_red(color: list[int]) -> bool:
    return color[0] > 100 and max(color[1:3]) < 40


values = st.recursive(
    st.one_of(
        st.text(),
        st.integers(-(2**53), 2**53),
        st.booleans(),
        arrays.arrays(
            st.sampled_from([np.uint8, np.int32, np.float32, np.float64]),
            arrays.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=4),
        ),
    ),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text("abc"), inner, max_size=4),
    max_leaves=8,
)


@given(values)
def test_packed_values_are_read_back(value: Any) -> None:
    def check(found: Any, expected: Any) -> None:
        if isinstance(expected, np.ndarray):
            assert found.dtype == expected.dtype
            np.testing.assert_array_equal(found, expected)
        elif isinstance(expected, dict | list):
            assert len(found) == len(expected)
            for key in expected if isinstance(expected, dict) else range(len(expected)):
                check(found[key], expected[key])
        else:
            assert found == expected

    check(unpacked(pack(value)), value)


def test_the_index_lists_all_episodes(log: Path) -> None:
    found = unpacked(LogPage(log).index(first=1))
    assert (found["name"], found["first"]) == ("values-log.mcap", 1)
    assert found["actions"] == ["left word", "on word", "right word"]
    assert found["first_action"] == 5
    assert found["returns"].tolist() == [7.5, 7.5]
    assert found["lengths"].tolist() == [5, 5]
    assert [found["reasons"][code] for code in found["reason"]] == ["goal word"] * 2


def test_an_episode_has_the_values_of_the_log(log: Path) -> None:
    found = unpacked(LogPage(log).episode(1))
    episode = mcaprl.open(log).episodes[1]
    assert found["times"].tolist() == [0, 0.5, 1, 1.5, 2, 2.5]
    np.testing.assert_array_equal(found["rewards"], episode.rewards)
    np.testing.assert_array_equal(found["actions"], episode.actions[None])
    plots = {plot["title"]: plot for plot in found["plots"]}
    place = plots["observation/place"]
    assert place["values"].tolist() == [[0, 1, 2, 3, 4, 5], [0, -1, -2, -3, -4, -5]]
    # Numbers of one unit share a plot.
    assert (plots["speeds"]["names"], plots["positions"]["names"]) == (["speed_m_s"], ["x_m"])
    assert plots["speeds"]["values"].tolist() == [[20] * 6]
    assert plots["positions"]["values"].tolist() == [[0, 10, 20, 30, 40, 50]]
    cql, iql = found["policies"]
    assert (cql["name"], iql["name"]) == ("cql", "iql")
    assert cql["q"][:, :STEPS].tolist() == [
        [0, 1, 2, 3, 4],
        [10, 11, 12, 13, 14],
        [20, 21, 22, 23, 24],
    ]
    image, depth = found["images"]
    assert image["pixels"][3, 2, 3].tolist() == [255, 30, 7]
    # The colors of depth range from 0 to 50 m. Infinite depth is shown as unknown.
    assert depth["title"] == "depth, 0 to 50 m"
    assert depth["pixels"][:, 1, 2, 0].tolist() == [255] * 6
    assert depth["pixels"][0, :2, :2, 0].tolist() == [[1, 0], [0, 0]]
    assert "episode 1 ends after 5 steps" in found["lines"]["texts"][-1]


@pytest.mark.parametrize("sim", ["lane", "powerline"])
def test_the_scene_is_that_of_the_log(tmp_path: Path, sim: str) -> None:
    with closing(mcaprl.RecordMcap(make_sim(sim), tmp_path / "log.mcap")) as env:
        for seed in (3, 4):
            env.reset(seed=seed)
            for _ in range(4):
                env.step(1)
    reader, episode = (
        McapReader(tmp_path / "log.mcap"),
        mcaprl.open(tmp_path / "log.mcap").episodes[1],
    )
    found = unpacked(LogPage(tmp_path / "log.mcap").episode(1))["scene"]
    frames = {frame["name"]: frame for frame in found["frames"]}
    moments = list(moments_of_episode(reader, episode))
    assert found["follow"] == moments[0].follow
    for moment in moments:
        time_s = (moment.time_ns - moments[0].time_ns) / 1e9
        for frame in moment.frames:
            row = max(np.searchsorted(frames[frame.name]["times"], time_s + 1e-9) - 1, 0)
            pose = frames[frame.name]["poses"][row]
            np.testing.assert_allclose(pose[:3], frame.position, rtol=1e-6)
        shown = np.searchsorted(found["moments"]["times"], time_s + 1e-9) - 1
        first, stop = found["moments"]["starts"][shown : shown + 2]
        for indexes, shapes in (
            (found["static"], moment.static),
            (found["moments"]["indexes"][first:stop], moment.moving),
        ):
            assert [found["shapes"]["kinds"][k] for k in indexes] == [s.kind for s in shapes]
            assert [found["shapes"]["frames"][k] for k in indexes] == [s.frame for s in shapes]
            for index, shape in zip(indexes, shapes, strict=True):
                start, end = found["shapes"]["starts"][index : index + 2]
                points = found["shapes"]["points"][start:end]
                np.testing.assert_array_equal(points, shape.points.astype(np.float32))


def test_many_images_are_thinned_out(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "mcaprl.recorder.viewer.page.log_page._MOST_IMAGE_BYTES"
    monkeypatch.setattr(name, 2 * 8 * 12 * 3)
    image = unpacked(LogPage(log).episode(0))["images"][0]
    assert image["steps"].tolist() == [0, 3]
    assert image["pixels"][:, 2, 3, 1].tolist() == [0, 30]


@pytest.fixture(scope="module")
def commands(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of commands (gas from 0 to 4, turn from -1 to 1) with a policy's commands."""
    folder = tmp_path_factory.mktemp("commands")
    actions = np.stack([np.arange(5), [1, 0, -1, 0.5, 0]], 1).astype(np.float32)
    env: Any = Driver()
    env.action_space = spaces.Box(np.array([0, -1], np.float32), np.array([4, 1], np.float32))
    env.action_part_names, env.action_units = ("gas", "turn"), ("", "right | left")
    del env.action_meanings
    with closing(mcaprl.RecordMcap(env, folder / "plain.mcap")) as recorder:
        recorder.reset(seed=0)
        for action in actions:
            recorder.step(action)
    data = mcaprl.open(folder / "plain.mcap")
    values = {"policy_action": actions[::-1], "difference": actions[::-1] - actions}
    values |= {name: np.arange(5.0) for name in COMMAND_VALUES}
    with annotated_copy(folder / "plain.mcap", folder / "log.mcap") as copy:
        copy.add_values("/rl/values", [(data.episodes[0].log_time_ns[:-1], values)])
    return folder / "log.mcap"


def test_commands_have_names_and_limits(commands: Path) -> None:
    """A dial has the direction of its name: the highest number of a turn to the left is left."""
    found = unpacked(LogPage(commands).index())
    assert found["parts"] == ["gas", "turn"]
    assert found["limits"] == {"gas": [0, 4], "turn": [1, -1]}
    (policy,) = unpacked(LogPage(commands).episode(0))["policies"]
    assert "preference" not in policy
    assert policy["policy_action"].tolist() == [[4, 3, 2, 1, 0], [0, 0.5, -1, 0, 1]]


def test_the_browser_shows_commands_as_dials(browser: Browser, commands: Path) -> None:
    with served(commands) as url:
        browser.show(url)
        wait_for_episode(browser)
        browser.run("seek(episode.times[1])")
        assert browser.problems == []
        text = browser.run("document.body.innerText").lower()
        for expected in ("action: gas", "action: turn", "q-values of both commands", "td error"):
            assert expected in text, expected
        places = browser.run(
            "[...document.querySelectorAll('.dial i:not(.zero)')].map((i) => i.style.left)"
        )
        # Step 1: gas 1 of 4 and policy 3; turn 0 and policy .5, which is left.
        assert places == ["25%", "75%", "50%", "25%"]
        assert browser.run("document.querySelectorAll('.dial .zero').length") == 1
        assert "action" not in browser.run("get('facts').innerText").lower()
        browser.run("seek(episode.times[5])")
        assert browser.run("document.querySelectorAll('.dial i[hidden]').length") == 4
        assert browser.problems == []


def test_the_browser_shows_an_episode(browser: Browser, log: Path) -> None:
    with served(log, episode=1, speed=2.0) as url:
        browser.show(url)
        wait_for_episode(browser)
        assert browser.problems == []
        assert {each.removeprefix(url) for each in browser.requests} == {"", "episode/1"}
        assert browser.run("state.speed") == 2
        text = browser.run("document.body.innerText")
        for expected in (
            "values-log.mcap",
            "goal word",
            "Q-values: cql",
            "TD error",
            "observation/",
        ):
            assert expected.lower() in text.lower(), expected
        # Step 2 takes action 7 and has the reward 1.5. The return so far is the sum of the earlier
        # rewards, 0.5 and 1.
        browser.run("seek(1.1)")
        assert browser.run("get('facts').innerText").split() == (
            ["action", "right", "word", "reward", "1.5", "return", "so", "far", "1.5"]
        )
        cells = browser.run(
            "[...document.querySelectorAll('.bars .number')].map((e) => e.innerText)"
        )
        assert cells == ["2", "12", "22"] * 2
        assert browser.run("document.querySelectorAll('.taken').length") == 2
        assert browser.run("getComputedStyle(document.querySelector('.best')).width") != "0px"
        title = "values-log.mcap, episode 1: return 7.5, goal word, 5 steps"
        assert browser.run("[document.title, get('name').innerText]") == [title, title]
        # The bars of a step range from its worst action to its best.
        widths = browser.run("[...document.querySelectorAll('.bar')].map((e) => e.style.width)")
        assert widths == ["0%", "50%", "100%"] * 2
        # Names of bins differ in their ends.
        assert browser.run("cut('x from 0.9 and z from 0.2', 22)") == "x from 0.9\u2026 z from 0.2"
        # The last reward has a width: it lasts until the end of the episode.
        assert browser.run("[...plots[0].plot.data[1]]") == [0.5, 1, 1.5, 2, 2.5, 2.5]


def test_the_page_lists_steps_to_look_at(browser: Browser, log: Path) -> None:
    with served(log) as url:
        browser.show(url)
        wait_for_episode(browser)
        # Each policy prefers action 7, by 20 over action 5 and by 10 over action 6. All TD errors
        # are 0, and no reward is below the one before.
        lines = browser.run("get('places').innerText.trim().split(String.fromCharCode(10))")
        assert lines == [
            f"step {step} disagreement: {policy}: would take right word"
            for policy in ("cql", "iql")
            for step in (0, 3, 1, 4)
        ]
        browser.run("get('places').querySelectorAll('button')[3].click()")
        assert browser.run("state.step") == 4
        assert browser.problems == []


def test_the_world_is_seen_from_above(browser: Browser, log: Path) -> None:
    pressed = "['follow', 'above'].map((id) => get(id).getAttribute('aria-pressed'))"
    with served(log) as url:
        browser.show(url)
        wait_for_episode(browser)
        browser.press("a")
        assert browser.run(pressed) == ["false", "true"]
        for time_s in (0.0, 2.0):
            browser.run(f"seek({time_s})")
            vehicle = browser.run("scene.marker.visible && scene.marker.position.x")
            assert vehicle == pytest.approx(20 * time_s)
        assert browser.run("scene.camera.position.z") > browser.run("scene.camera.position.y") + 50
        browser.press("f")
        assert browser.run(pressed) == ["true", "false"]
        assert browser.run("scene.marker.visible") is False
        assert is_red(center_color(browser))
        assert browser.problems == []


def test_the_camera_follows_the_vehicle(browser: Browser, log: Path) -> None:
    with served(log) as url:
        browser.show(url)
        wait_for_episode(browser)
        for time_s in (0.0, 1.1, 2.5):
            browser.run(f"seek({time_s})")
            assert is_red(center_color(browser)), time_s
        browser.press("f")
        assert browser.run("get('follow').getAttribute('aria-pressed')") == "false"
        browser.run("seek(0)")
        assert not is_red(center_color(browser)), "the vehicle leaves a camera at rest"
        browser.press("f")
        assert is_red(center_color(browser))
        # After a drag, the camera is turned back at the first press, and goes on to follow.
        browser.run("scene.camera.position.x += 40; scene.controls.dispatchEvent({ type: 'end' })")
        browser.press("f")
        assert is_red(center_color(browser))
        assert browser.run("get('follow').getAttribute('aria-pressed')") == "true"
        # The walls of a building around the camera do not hide the vehicle.
        browser.run("""(() => {
          const building = mesh(UNIT.box, { color: new libraries.Color("#00f"), opacity: 1 });
          building.position.copy(scene.camera.position);
          scene.scene.add(building);
        })()""")
        assert is_red(center_color(browser))
        assert browser.problems == []


def test_images_have_the_pixels_of_the_log(browser: Browser, log: Path) -> None:
    with served(log) as url:
        browser.show(url)
        wait_for_episode(browser)
        browser.run("seek(2)")
        pixel = "images[{}].canvas.getContext('2d').getImageData({}, {}, 1, 1).data"
        assert browser.run(f"[...{pixel.format(0, 3, 2)}]") == [255, 40, 7, 255]
        near, far, unknown = (
            browser.run(f"[...{pixel.format(1, *place)}]") for place in ((0, 0), (2, 1), (5, 3))
        )
        assert near[2] > near[0]
        assert far[0] > far[2]
        assert unknown == [0, 0, 0, 255]


class Rendered(Driver):
    """A driver whose image of 400 x 200 pixels is gray, brighter by 40 in each step."""

    metadata: Any = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    render_mode = "rgb_array"

    def render(self) -> Any:
        return np.full((200, 400, 3), 20 + 40 * self._step, np.uint8)


def test_the_video_of_the_log_is_in_step_with_the_slider(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(mcaprl.RecordMcap(Rendered(), tmp_path / "log.mcap", camera="h264")) as recorder:
        for seed in (0, 1):
            recorder.reset(seed=seed)
            for _ in range(STEPS):
                recorder.step(6)
    page = LogPage(tmp_path / "log.mcap")
    image = unpacked(page.episode(1))["images"][0]
    assert (image["title"], image["pixels"].shape) == ("rendered", (STEPS + 1, 160, 320, 3))
    assert image["steps"].tolist() == list(range(STEPS + 1))
    shades = image["pixels"].reshape(STEPS + 1, -1).astype(int)
    assert np.abs(shades - (20 + 40 * np.arange(STEPS + 1))[:, None]).max() <= 6
    with served(tmp_path / "log.mcap") as url:
        browser.show(url)
        wait_for_episode(browser)
        for step in (0, 5, 1, 3):
            browser.run(f"seek(episode.times[{step}])")
            assert browser.run("images[0].index") == step
        pixel = "images[0].canvas.getContext('2d').getImageData(160, 80, 1, 1).data"
        assert np.abs(np.array(browser.run(f"[...{pixel}]")[:3]) - 140).max() <= 6
        assert browser.problems == []
    # Without a decoder, the page says so, and shows everything else.
    monkeypatch.setitem(sys.modules, "av", None)
    found = unpacked(page.episode(0))
    (note,) = found["notes"]
    assert note.startswith("the video of /camera/image cannot be shown: ")
    assert "mcaprl[video]" in note
    assert [one["title"] for one in found["images"]] == ["observation/image", "depth, 0 to 50 m"]


def test_keys_and_the_slider_move_the_time(browser: Browser, log: Path) -> None:
    with served(log) as url:
        browser.show(url)
        wait_for_episode(browser)
        for key, step in (("ArrowRight", 1), ("ArrowRight", 2), ("ArrowLeft", 1), ("End", 5)):
            browser.press(key)
            assert browser.run("state.step") == step
        browser.run("get('time').value = 1.2; get('time').dispatchEvent(new Event('input'))")
        assert browser.run("state.step") == 2
        assert "1.20 of 2.50 s, step 2 of 5" in browser.run("get('clock').value")
        browser.press("PageDown")
        browser.wait("state.index === 1 && state.time === 0")
        browser.run("get('speed').value = '16'; get('speed').dispatchEvent(new Event('change'))")
        browser.press(" ")
        browser.wait("state.step === 5 && !state.playing")
        browser.run("get('loop').checked = true")
        browser.run("globalThis.sought = []; globalThis.before = seek")
        browser.run("seek = (time) => { sought.push(time); before(time); }")
        browser.press(" ")
        browser.wait("sought.filter((time) => time === 0).length > 2")
        browser.press(" ")
        assert browser.run("state.playing") is False
        assert browser.problems == []


def test_a_click_on_a_plot_moves_the_time(browser: Browser, log: Path) -> None:
    with served(log) as url:
        browser.show(url, height=2000)
        wait_for_episode(browser)
        browser.run(
            """(() => {
              const { over } = plots[0].plot, box = over.getBoundingClientRect();
              const clientX = box.left + 0.8 * box.width;
              over.dispatchEvent(new PointerEvent("pointerdown", { clientX, buttons: 1 }));
            })()"""
        )
        assert browser.run("state.time") == pytest.approx(0.8 * 2.5, abs=0.02)


def test_a_chip_hides_a_series(browser: Browser, log: Path) -> None:
    with served(log) as url:
        browser.show(url)
        wait_for_episode(browser)
        browser.run("document.querySelector('.chips button').click()")
        assert browser.run("plots[0].plot.series[1].show") is False


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [390, 1280])
def test_the_page_fits_phones_and_color_schemes(
    browser: Browser, log: Path, width: int, dark: bool
) -> None:
    with served(log) as url:
        browser.show(url, width=width, dark=dark)
        wait_for_episode(browser)
        assert browser.run("document.documentElement.scrollWidth") <= width
        style = "getComputedStyle(document.body)"
        ink, back = (
            sum(map(int, re.findall(r"\d+", browser.run(f"{style}.{name}"))[:3])) / 3
            for name in ("color", "backgroundColor")
        )
        assert ink - back > 150 if dark else back - ink > 150
        unnamed = browser.run(
            "[...document.querySelectorAll('button, input, select')].filter((e) =>"
            " !(e.innerText || e.labels?.length || e.ariaLabel)).map((e) => e.id)"
        )
        assert unnamed == []
        assert browser.problems == []


def test_a_log_without_a_scene_has_plots(browser: Browser, tmp_path: Path) -> None:
    with closing(mcaprl.RecordMcap(gym.make("Pendulum-v1"), tmp_path / "p.mcap")) as env:
        env.reset(seed=0)
        while not env.step(np.array([0.5], np.float32))[3]:
            pass
    with served(tmp_path / "p.mcap") as url:
        browser.show(url)
        wait_for_episode(browser)
        assert browser.run("get('view').hidden") is True
        assert browser.run("plots.map((plot) => plot.options.title)") == [
            "Reward",
            "Return so far",
            "Action",
            "Observation",
        ]
        assert "0.5" in browser.run("document.querySelector('.bars').innerText")
        # The name of a bar is not far from the bar.
        assert browser.run("document.querySelector('.bars').clientWidth") < 300
        assert browser.problems == []


def test_a_log_of_many_episodes_is_listed_in_part(browser: Browser, tmp_path: Path) -> None:
    with closing(mcaprl.RecordMcap(gym.make("CartPole-v1"), tmp_path / "many.mcap")) as env:
        for seed in range(520):
            env.reset(seed=seed)
            while not env.step(seed % 2)[2]:
                pass
    lengths = mcaprl.open(tmp_path / "many.mcap").episode_lengths
    with served(tmp_path / "many.mcap") as url:
        browser.show(url)
        wait_for_episode(browser)
        assert browser.run("document.querySelectorAll('#list button').length") == 500
        assert browser.run("get('more').innerText") == "500 of 520 episodes"
        browser.run("get('number').value = '519'; get('number').dispatchEvent(new Event('change'))")
        browser.wait(f"episode.rewards.length === {lengths[519]} && state.step === 0")
        assert browser.run("document.querySelector('[aria-current]').innerText").split()[0] == "519"
        browser.run(
            "get('order').value = 'lengths'; get('order').dispatchEvent(new Event('change'))"
        )
        sizes = browser.run("state.order.map((index) => log.lengths[index])")
        assert sizes == sorted(lengths.tolist())
        assert browser.problems == []


def test_a_saved_page_needs_no_network(browser: Browser, log: Path, tmp_path: Path) -> None:
    page = tmp_path / "episode.html"
    size = mcaprl.save_page(log, page, episode=1)
    assert page.stat().st_size == size
    assert not re.search(
        r"(src|href)=.?(https?:)?//|@import", page.read_text().split("<script>")[0]
    )
    browser.show(page.as_uri())
    wait_for_episode(browser)
    assert browser.requests == [page.as_uri(), "data:,"][: len(browser.requests)]
    assert browser.run("log.numbers.length") == 1
    assert browser.run("log.numbers[0]") == 1
    browser.run("seek(1.1)")
    assert is_red(center_color(browser))
    assert "three.js authors" in page.read_text()
    assert browser.problems == []


def test_texts_of_a_log_are_not_html(browser: Browser, tmp_path: Path) -> None:
    path = with_values(record(tmp_path / "log.mcap", Driver(EVIL)))
    path = path.rename(tmp_path / "<img src=x onerror=window.hit=1>.mcap")
    mcaprl.save_page(path, tmp_path / "page.html")
    assert "window.hit" not in (tmp_path / "page.html").read_text()
    with served(path) as url:
        for address in (url, (tmp_path / "page.html").as_uri()):
            browser.show(address)
            wait_for_episode(browser)
            browser.run("seek(2.5)")
            text = browser.run("document.body.innerText")
            assert "onerror=window.hit" in text
            assert f"right {EVIL}"[:60] in text
            assert browser.run("document.images.length") == 0
            assert browser.run("window.hit") is None
            assert browser.problems == []
        # If a text became a script nevertheless, the browser would not run it.
        script = "Object.assign(document.createElement('script'), {textContent: 'window.hit = 1'})"
        browser.run(f"document.body.append({script})")
        assert browser.run("window.hit") is None
        assert "Content Security Policy" in browser.problems[0]


def test_frames_in_a_circle_are_shown(browser: Browser, tmp_path: Path) -> None:
    class Circle(Driver):
        def frames(self) -> list[Frame]:
            still = (0.0, 0.0, 0.0), yaw_rotation(0.0)
            return [Frame("car", *still, "b"), Frame("b", *still, "car")]

    mcaprl.save_page(record(tmp_path / "c.mcap", Circle()), tmp_path / "c.html")
    browser.show((tmp_path / "c.html").as_uri())
    wait_for_episode(browser)
    assert browser.run("get('view').hidden") is False
    assert browser.problems == []


def test_a_damaged_episode_is_reported(browser: Browser, tmp_path: Path) -> None:
    path = record(tmp_path / "log.mcap", Driver("x" * 50), episodes=3)
    reader = McapReader(path)
    last = list(reader.message_ranges(reader.channels_of(SCENE)[0]))[-1].chunk
    assert last is not None
    raw = bytearray(path.read_bytes())
    raw[last.chunk_start_offset + last.chunk_length // 2] ^= 255
    path.write_bytes(raw)
    with served(path) as url:
        browser.show(url)
        browser.wait("!get('problem').hidden")
        assert "episode 0 cannot be shown: " in browser.run("get('problem').innerText")
        assert str(path) in browser.run("get('problem').innerText")


@pytest.fixture
def labeled(log: Path, tmp_path: Path) -> Path:
    """A log of two episodes, of which the second has an interval."""
    copy = tmp_path / "labeled.mcap"
    copy.write_bytes(log.read_bytes())
    mcaprl.label(copy, episode=1, interval="bad data", steps=(0, 2))
    return copy


def test_keys_label_episodes_and_steps(browser: Browser, labeled: Path) -> None:
    with served(labeled) as url:
        browser.show(url)
        wait_for_episode(browser)
        browser.press("s")
        browser.wait("log.labels.success[0] === true")
        # The interval is from step 3 to the last one, 4, also if the replay is after the last step.
        browser.run("seek(episode.times[3])")
        browser.press("b")
        browser.press("End")
        browser.press("e")
        browser.wait("log.labels.intervals.length === 2")
        browser.press("n")
        browser.run("get('note').value = '<b>clean</b>'")
        # Letters in the field of the note are no keys of the replay.
        browser.press("x")
        browser.press("Enter")
        browser.wait("log.labels.notes[0]")
        assert mcaprl.label(labeled).rows() == [
            ["0", "success", "<b>clean</b>x", "intervention 3:5"],
            ["1", "", "", "bad data 0:2"],
        ]
        listed = browser.run(
            "[...document.querySelectorAll('#list button')].map((e) => e.innerText)"
        )
        assert "label: success, <b>clean</b>x, 1 interval" in listed[0]
        assert "label: 1 interval" in listed[1]
        marks = "[...get('marks').children].map(({ style }) => [style.left, style.width])"
        assert browser.run(marks) == [["60%", "40%"]]
        browser.press("PageDown")
        browser.wait(
            "state.index === 1 && state.step === 0 && get('marks').innerText === 'bad data'"
        )
        assert browser.run(marks) == [["0%", "40%"]]
        browser.press("x")
        browser.wait("log.labels.success[1] === false")
        browser.run("get('unlabel').click()")
        browser.wait("log.labels.intervals.length === 1")
        assert browser.run("get('failure').getAttribute('aria-pressed')") == "false"
        browser.press("e")
        assert "begins with the key B" in browser.run("get('problem').innerText")
        browser.show(url)
        wait_for_episode(browser)
        assert browser.run("get('success').getAttribute('aria-pressed')") == "true"
        assert browser.problems == []


def test_a_page_without_its_server_shows_labels(
    browser: Browser, labeled: Path, tmp_path: Path
) -> None:
    mcaprl.save_page(labeled, tmp_path / "page.html", episode=1)
    browser.show((tmp_path / "page.html").as_uri())
    wait_for_episode(browser)
    assert browser.run("get('marks').innerText") == "bad data"
    text = browser.run("get('labels').innerText")
    assert "To save labels, open the log by: mcaprl replay LOG --browser" in text
    assert browser.run("get('label-tools').hidden") is True
    browser.press("s")
    assert "To save labels" in browser.run("get('problem').innerText")
    assert browser.problems == []


def test_labels_of_other_data_are_not_shown(browser: Browser, labeled: Path, log: Path) -> None:
    labeled.write_bytes(log.with_name("log.mcap").read_bytes())
    with served(labeled) as url:
        browser.show(url)
        wait_for_episode(browser)
        assert "labels of other data" in browser.run("get('problem').innerText")
        browser.press("s")
        browser.wait("get('problem').innerText.includes('was not saved')")


def test_only_the_page_saves_labels(labeled: Path) -> None:
    """A request needs the origin and the token of the page, a small body, and a valid change."""
    file = labeled.with_name("labeled.mcap.labels.json")
    before = file.read_bytes()
    with served(labeled) as url:
        html = answer(url)[2].decode()
        embedded = re.search(r'id="log-data">([^<]*)<', html)
        assert embedded is not None
        token = unpacked(base64.b64decode(embedded[1]))["token"]
        good = {
            "Origin": url.removesuffix("/"),
            "X-Label-Token": token,
            "Content-Type": "application/json",
        }
        change = json.dumps({"episode": 0, "success": True}).encode()
        for status, changed, body in (
            (403, {"Origin": "http://evil.example"}, change),
            (403, {"Origin": ""}, change),
            (403, {"Host": "evil.example"}, change),
            (403, {"X-Label-Token": token + "x"}, change),
            (403, {"X-Label-Token": "é"}, change),
            (415, {"Content-Type": "text/plain"}, change),
            (413, {"Content-Length": str(limits.MAX_LABEL_BYTES + 1)}, change),
            (413, {"Content-Length": "-1"}, change),
            (413, {"Content-Length": "9" * 30}, change),
            (400, {}, b"{"),
            (400, {}, b"[]"),
            (400, {}, b'{"success": true}'),
            (400, {}, b'{"episode": 9, "success": true}'),
            (400, {}, b'{"episode": 0, "interval": "x", "steps": [3, 99]}'),
            (400, {}, b'{"episode": 0, "success": "yes"}'),
        ):
            found = answer(url, "/label", body=body, **{**good, **changed})
            assert found[0] == status, (changed, body, found)
            assert b"\n" not in found[2]
        assert answer(url, "/episode/0", body=change, **good)[0] == 404
        assert file.read_bytes() == before
        # Further keys of the object, such as a file to read, have no effect.
        change = json.dumps({"episode": 0, "success": True, "file": "/etc/passwd"}).encode()
        status, _, body = answer(url, "/label", body=change, **good)
        assert (status, json.loads(body)["success"]) == (200, {"0": True})
    assert mcaprl.label(labeled).success == {"0": True}


def answer(
    url: str, path: str = "/", body: bytes | None = None, **headers: str
) -> tuple[int, dict[str, str], bytes]:
    host, port = url.removeprefix("http://").removesuffix("/").split(":")
    with closing(HTTPConnection(host, int(port), timeout=30)) as connection:
        connection.putrequest("GET" if body is None else "POST", path, skip_host="Host" in headers)
        lengths = {} if body is None else {"Content-Length": str(len(body))}
        for name, value in {**lengths, **headers}.items():
            connection.putheader(name, value)
        connection.endheaders(body)
        found = connection.getresponse()
        return found.status, dict(found.getheaders()), found.read()


@pytest.mark.parametrize("start", [b"", b"GET / HTTP/1.0\r\nHost: 127.0.0.1\r\n", b"drip"])
def test_slow_clients_are_disconnected(
    log: Path, start: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A client must send its whole request in time, even if it sends a byte now and then."""
    monkeypatch.setattr(limits, "CLIENT_TIMEOUT_S", 0.3)
    with served(log) as url:
        port = urlsplit(url).port
        with socket.create_connection(("127.0.0.1", port), timeout=2) as connection:
            connection.sendall(start)
            if start == b"drip":
                connection.settimeout(0.05)
                began_s = time.monotonic()
                while time.monotonic() - began_s < 2:
                    with suppress(TimeoutError):
                        with suppress(ConnectionError):
                            connection.sendall(b"x")
                            assert connection.recv(1) == b""
                        break
                else:
                    pytest.fail("the client is still connected")
            else:
                assert connection.recv(1) == b""
        assert answer(url)[0] == 200


def test_a_client_that_reads_nothing_is_disconnected(
    log: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(limits, "CLIENT_TIMEOUT_S", 0.3)
    monkeypatch.setattr(LogPage, "episode", lambda *_: bytes(2**26))
    left, finish = threading.Event(), log_page._Handler.finish
    ports = list[int]()

    def note(handler: log_page._Handler) -> None:
        finish(handler)
        # The browser of an earlier test may still have a connection to this port.
        if handler.client_address[1] in ports:
            left.set()

    monkeypatch.setattr(log_page._Handler, "finish", note)
    with served(log) as url:
        with socket.create_connection(("127.0.0.1", urlsplit(url).port), timeout=2) as connection:
            ports.append(connection.getsockname()[1])
            connection.sendall(b"GET /episode/1 HTTP/1.0\r\nHost: 127.0.0.1\r\n\r\n")
            assert left.wait(2)
            received = 0
            while part := connection.recv(2**20):
                received += len(part)
        assert received < 2**26
    assert "Traceback" not in capfd.readouterr().err


def test_the_server_answers_this_machine_alone(log: Path) -> None:
    with served(log) as url:
        status, headers, body = answer(url, "/episode/1")
        assert status == 200
        assert unpacked(body)["rewards"].tolist() == [0.5, 1, 1.5, 2, 2.5]
        assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert answer(url, Origin=url.removesuffix("/"))[0] == 200
        assert answer(url, Host="localhost")[0] == 200
        for refused in (
            {"Host": "evil.example"},
            {"Host": "127.0.0.1.evil.example"},
            {"Origin": "http://evil.example"},
            {"Origin": "null"},
            {"Origin": "http://127.0.0.1:1"},
        ):
            assert answer(url, "/", None, **refused)[0] == 403, refused
        for path in ("/episode/2", "/episode/-1", "/../log.mcap", f"/{log}", "/episode/1/..", "*"):
            assert answer(url, path)[0] == 404, path


def test_mistakes_are_one_line(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.html"
    assert run(["replay", str(log), "--save", str(page), "--episode", "1"]) == 0
    assert re.fullmatch(rf"{page}: episode 1, [\d.]+ kB\n", capsys.readouterr().out)
    content = page.read_bytes()
    for command, expected in (
        (["--save", str(page)], "pass --overwrite"),
        (["--save", "page.pdf"], "known: .htm, .html"),
        (["--save", str(tmp_path / "b.html"), "--episode", "2"], "has episodes 0 to 1"),
        (["--save", str(tmp_path / "b.html"), "--browser"], "run replay once for each"),
        ([str(log.with_name("log.mcap")), "--browser"], "a page or video shows one log"),
    ):
        assert run(["replay", str(log), *command]) != 0, command
        error = capsys.readouterr().err
        assert expected in error
        assert error.count("\n") == 1
    assert page.read_bytes() == content
    assert not (tmp_path / "b.html").exists()


def test_the_command_serves_until_it_is_interrupted(log: Path) -> None:
    command = [sys.executable, "-m", "mcaprl.cli", "replay", str(log), "--browser"]
    default = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)  # noqa: E731
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=default,
        env={"PATH": "", "HOME": "/"},
    ) as server:
        assert server.stdout is not None
        url = server.stdout.readline().removeprefix("open ").strip()
        assert "Ctrl-C" in server.stdout.readline()
        assert answer(url)[0] == 200
        server.send_signal(signal.SIGINT)
        rest, _ = server.communicate(timeout=30)
    assert (server.returncode, rest) == (0, "ended\n")


@pytest.mark.parametrize("display", ["", ":0"])
def test_the_browser_is_opened_if_there_is_a_display(
    log: Path, monkeypatch: pytest.MonkeyPatch, display: str
) -> None:
    opened: list[str] = []
    stop = threading.Event()
    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    urls: list[str] = []
    stop.set()
    mcaprl.browse(log, stop=stop, on_open=urls.append)
    assert opened == (urls if display else [])


def test_the_bundle_is_of_the_locked_versions() -> None:
    packages = json.loads((VENDOR / "package-lock.json").read_text())["packages"]
    wanted = json.loads((VENDOR / "package.json").read_text())["devDependencies"]
    banner = (VENDOR / "libraries.min.js").read_text().splitlines()[0]
    licenses = (VENDOR / "LICENSES.txt").read_text()
    for name in ("three", "uplot"):
        version = packages[f"node_modules/{name}"]["version"]
        assert wanted[name] == version
        for text in (banner, licenses):
            assert f"{name} {version} (MIT)" in text


def test_the_scripts_of_the_page_are_short() -> None:
    for path in (VENDOR.parent / "assets").glob("*.js"):
        lines = path.read_text().splitlines()
        assert len(lines) <= 400, path
        assert max(map(len, lines)) <= 120, path
