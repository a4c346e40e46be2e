"""Commands of a driver, its log, and what it refuses; observations of the bags of many robots."""

from __future__ import annotations

import itertools
import math
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import HealthCheck, assume, given, settings
from numpy.typing import NDArray

import mcaprl
from mcaprl.base_policy import BasePolicy
from mcaprl.chunks import planned
from mcaprl.errors import LogError, McaprlError, UsageError
from mcaprl.recorder.bags.decoders import decoder_of
from mcaprl.recorder.dataset.video import LOST
from mcaprl.recorder.mapping.config import parse_mapping
from mcaprl.recorder.mapping.read import read_open_bag
from mcaprl.sims.evaluation.rollout import EpsilonGreedy
from tests.drive.test_live import (
    INFO,
    QUANTITIES,
    START_NS,
    TYPES,
    VIDEO_TYPES,
    mappings,
    odom,
    packet_sent,
    stamp,
    streams,
    videos,
)
from tests.recorder.mapping.suggest.test_suggested_robots import IMPOSSIBLE, ROBOTS
from tests.support.robots import FORMATS, Robot, vector
from tests.support.stream_bag import Sent, StreamBag
from tests.support.videos import packets

MS = 10**6
SPEED = {"speed": {"field": "/odom.twist.twist.linear.x"}}


class Fixed(BasePolicy):
    """Policy that selects an action by the step."""

    def __init__(self, data: mcaprl.Dataset, action: Callable[[int], Any] | None = None) -> None:
        """Store the spaces of the data."""
        self.observation_space, self.action_space = data.observation_space, data.action_space
        self.action_commands, self._action, self.steps = data.action_commands, action, 0
        self.name = "fixed"

    def act(self, observations: Any) -> NDArray[Any]:
        """Return the action of this step."""
        self.steps += 1
        if self._action is not None:
            return np.array([self._action(self.steps - 1)])
        assert self.action_space is not None
        found: NDArray[Any] = self.action_space.sample()[np.newaxis]
        return found


def bag_of(*sent: Sent, types: dict[str, str] | None = None) -> StreamBag:
    return StreamBag({**TYPES, **(types or {})}, sorted(sent, key=lambda each: each.time_ns))


def drive(
    action: dict[str, Any],
    commands: list[dict[str, Any]],
    act: Callable[[int], Any] | None = None,
    *,
    kind: str = "geometry_msgs/msg/Twist",
    **tree: Any,
) -> mcaprl.Driver:
    """Return a driver that learned from a bag with these commands, one each 100 ms."""
    sent = [Sent(START_NS + k * 100 * MS, "/odom", odom(k)) for k in range(len(commands) + 1)]
    sent += [Sent(START_NS + k * 100 * MS, "/do", each) for k, each in enumerate(commands)]
    mapping = {"clock": {"rate_hz": 10}, "observation": SPEED, "action": action, **tree}
    bag = bag_of(*sent, types={"/do": kind})
    data = read_open_bag(bag, parse_mapping(mapping)).dataset
    return mcaprl.Driver(Fixed(data, act), mapping=data.robot)


def commanded(driver: mcaprl.Driver, steps: int) -> list[dict[str, Any]]:
    """Return the messages of steps at 10 Hz."""
    found = []
    for k in range(steps):
        now_ns = START_NS + k * 100 * MS
        driver.push("/odom", odom(0.5), now_ns)
        command = driver.command(now_ns)
        assert not command.reason, command.reason
        found.append(command.messages["/do"])
    return found


def linear(x: float) -> dict[str, Any]:
    return {"linear": vector(x)}


BOX = {"fields": ["/do.linear.x", "/do.angular.z"], "box": {"low": [-1, -2], "high": [1, 2]}}


def test_a_box_action_is_a_whole_message() -> None:
    driver = drive(BOX, [linear(0.5), linear(-0.5)], lambda _: np.array([0.25, -1.5], np.float32))
    assert (driver.inputs, driver.outputs) == (
        {"/odom": "nav_msgs/msg/Odometry"},
        {"/do": "geometry_msgs/msg/Twist"},
    )
    assert driver.period_ns == 100 * MS
    assert commanded(driver, 1) == [{"linear": vector(0.25), "angular": vector(0, 0, -1.5)}]
    assert driver.stop == {"/do": {"linear": vector(0), "angular": vector(0)}}


def test_actions_have_the_commands_of_the_mapping() -> None:
    named = {"fields": ["/do.linear.x"], "actions": {"stop": [0], "go": [1.5]}}
    driver = drive(named, [linear(0), linear(1.4)], lambda k: k)
    assert [each["linear"]["x"] for each in commanded(driver, 2)] == [0, 1.5]
    # The median of the logged commands in each bin, and the edge of the one without any.
    edges = {"fields": ["/do.linear.x"], "edges": [[0.0, 2.0]]}
    driver = drive(edges, [linear(x) for x in (-1, -3, -2, 1)], lambda k: k)
    assert [each["linear"]["x"] for each in commanded(driver, 3)] == [-2, 1, 2]
    own = {**edges, "representatives": [[-0.5], [0.5], [3]]}
    driver = drive(own, [linear(x) for x in (-1, 1)], lambda k: k)
    assert [each["linear"]["x"] for each in commanded(driver, 3)] == [-0.5, 0.5, 3]
    with pytest.raises(UsageError, match=r"the command \[1.0\] of action 0 is that of action 1"):
        drive({**edges, "representatives": [[1], [0.5], [3]]}, [linear(-1), linear(1)])


def test_a_discrete_field_needs_a_stop() -> None:
    action = {"field": "/do.data", "names": {"halt": 0, "go": 1}}
    texts = [{"data": "halt"}, {"data": "go"}]
    with pytest.raises(UsageError, match=r"drive\.stop: 0 does not stop the robot"):
        drive(action, texts, kind="std_msgs/msg/String")
    driver = drive(action, texts, lambda k: k, kind="std_msgs/msg/String", drive={"stop": "halt"})
    assert commanded(driver, 2) == [{"data": "halt"}, {"data": "go"}]
    assert driver.stop == {"/do": {"data": "halt"}}


def test_joints_have_their_names_and_places() -> None:
    action = {"fields": ["/do.position"], "names": ["knee", "hip"], "box": {"low": -1, "high": 1}}
    logged = [{"name": ["hip", "knee"], "position": [0.1 * k, 0.2 * k]} for k in range(3)]
    kind = "sensor_msgs/msg/JointState"
    driver = drive(action, logged, lambda _: np.array([0.5, -0.5], np.float32), kind=kind)
    (message,) = commanded(driver, 1)
    assert (message["name"], message["position"]) == (["knee", "hip"], [0.5, -0.5])
    assert message["header"]["stamp"] == {"sec": START_NS // 10**9, "nanosec": 0}
    action = {"fields": ["/do.position[1:3]"], "box": {"low": -1, "high": 1}}
    logged = [{"position": [0.0, 0.1 * k, 0.2 * k]} for k in range(3)]
    driver = drive(action, logged, lambda _: np.array([0.5, -0.5], np.float32), kind=kind)
    assert commanded(driver, 1)[0]["position"] == [0, 0.5, -0.5]


ARM: dict[str, Any] = {
    "fields": ["/do.position"],
    "names": ["hip", "knee", "grip"],
    "box": {"low": -9, "high": 9},
    "relative_to": "joints",
    "absolute": ["grip"],
}


def arm(action: dict[str, Any], observed: dict[str, Any]) -> mcaprl.Dataset:
    """Return data of an arm whose joints are commanded 0.1 and 0.2 ahead of their positions."""
    sent = []
    for k in range(40):
        now_ns, name = START_NS + k * 100 * MS, ["hip", "knee", "grip"]
        here, ahead = [0.1 * k, -0.2 * k, 1.0], [0.1 * k + 0.1, -0.2 * k - 0.2, k % 2 + k / 100]
        sent += [Sent(now_ns, "/joints", {"name": name, "position": here})]
        sent += [Sent(now_ns + MS, "/do", {"name": name, "position": ahead})]
    kinds = dict.fromkeys(("/joints", "/do"), "sensor_msgs/msg/JointState")
    tree = {"clock": {"rate_hz": 10}, "stack": 2, "observation": observed, "action": action}
    return read_open_bag(bag_of(*sent, types=kinds), parse_mapping(tree)).dataset


def test_relative_actions_are_absolute_commands(tmp_path: Path) -> None:
    joints = {"field": "/joints.position", "names": ["hip", "knee"]}
    observed = {"grip": {"field": "/joints.position[2]"}, "joints": joints}
    data = arm(ARM, observed)
    # Of the stack, the second frame is the newest one: 3 numbers, then the grip, hip and knee.
    assert data.relative_to == (4, 5, None)
    assert data.observation_names[4:] == ("joints_hip", "joints_knee")
    assert arm(ARM, {"joints": {**joints, "names": ARM["names"]}}).relative_to == (3, 4, None)
    run = mcaprl.train(data, tmp_path / "run", algo="bc", updates=20, chunk=4, held_out=0.0)
    with mcaprl.Driver(run.policy, mapping=data.robot) as driver:
        driver.record(tmp_path / "drive.mcap")
        for k in range(8):
            now_ns, here = START_NS + k * 100 * MS, [5.0 - k, -6.0, 1.0]
            driver.push("/joints", {"name": ARM["names"], "position": here}, now_ns)
            command = driver.command(now_ns)
            sent = command.messages["/do"]["position"]
            assert not command.reason
            # The number k of a chunk is 0.1 (k + 1) ahead of where the joint was at its start.
            start, at = np.array([5.0 - (k - k % 2), -6.0]), k % 2 + 1
            np.testing.assert_allclose(sent[:2] - start, [0.1 * at, -0.2 * at], atol=1e-4)
            np.testing.assert_array_equal(np.float32(sent), command.action)
    again = mcaprl.open(tmp_path / "drive.mcap")
    assert again.relative_to == data.relative_to
    cases: list[tuple[dict[str, Any], str]] = [
        ({"relative_to": "arm"}, r"action\.relative_to: 'arm' is no observed vector: grip, joints"),
        (
            {"absolute": ["hand"]},
            r"action\.absolute: the command has no element 'hand'; elements: h",
        ),
        ({"absolute": []}, "'joints' has 2 elements, but the command has 3, of which 3 are relat"),
        ({"relative_to": None}, "absolute is for a command with relative_to"),
        ({"box": None, "edges": [[0.0]] * 3}, "relative_to is for a command with box"),
    ]
    for wrong, text in cases:
        with pytest.raises(UsageError, match=text):
            arm({**ARM, **wrong}, observed)


def test_commands_are_limited() -> None:
    limits = {"max_change": [1.0, 100.0], "low": [-0.2, -1], "high": 0.25}
    driver = drive(BOX, [linear(0.5)] * 3, lambda k: np.array([1, -2], np.float32), drive=limits)
    found = commanded(driver, 5)
    # From a standstill, and by at most 0.1 in 100 ms.
    assert np.allclose([each["linear"]["x"] for each in found], [0, 0.1, 0.2, 0.25, 0.25])
    assert [each["angular"]["z"] for each in found] == [0, -1, -1, -1, -1]
    with pytest.raises(UsageError, match=r"drive\.max_change has 3 entries; the command has 2"):
        drive(BOX, [linear(0.5)] * 3, drive={"max_change": [1, 2, 3]})
    positions = {"fields": ["/do.position[0]"], "box": {"low": 1, "high": 2}}
    with pytest.raises(UsageError, match=r"drive\.stop: 0 does not stop the robot"):
        drive(positions, [{"position": [1.5]}] * 3, kind="sensor_msgs/msg/JointState")


def test_nothing_moves_before_all_inputs_are_there() -> None:
    driver = drive(BOX, [linear(0.5)] * 3, drive={"timeout_s": 0.3})
    waiting = driver.command(START_NS)
    assert (waiting.reason, waiting.is_fatal) == ("speed: no message of /odom yet", False)
    assert waiting.messages == driver.stop
    assert driver.next_step_ns is None
    driver.push("/odom", odom(1), START_NS + 50 * MS)
    assert driver.next_step_ns == START_NS + 50 * MS
    assert not driver.command(START_NS + 50 * MS).reason
    assert driver.next_step_ns == START_NS + 150 * MS
    assert driver.command(START_NS + 60 * MS, enabled=False).reason == "the policy is not enabled"
    old = driver.command(START_NS + 450 * MS)
    assert old.reason == "speed: the last message of /odom is 0.4 s old"
    assert old.observation is not None
    back = driver.command(START_NS)
    assert (back.reason, back.is_fatal) == ("the clock went back by 0.45 s", True)


@pytest.mark.parametrize("own", [{"chunk": 5, "execute": 3}, {"chunk": 4, "ensemble": True}])
def test_chunks_are_executed_as_in_an_evaluation(own: dict[str, Any], tmp_path: Path) -> None:
    commands = [{**linear(0.05 * (k % 7)), "angular": vector(0, 0, k % 2)} for k in range(30)]
    sent = [Sent(START_NS + k * 100 * MS, "/odom", odom(k % 4)) for k in range(31)]
    sent += [Sent(START_NS + k * 100 * MS, "/do", each) for k, each in enumerate(commands)]
    mapping = {"clock": {"rate_hz": 10}, "observation": SPEED, "action": BOX}
    tree = {**mapping, "episodes": {"truncated": "speed > 8"}, "drive": {"timeout_s": 0.25}}
    bag = bag_of(*sent, types={"/do": "geometry_msgs/msg/Twist"})
    data = read_open_bag(bag, parse_mapping(tree)).dataset
    run = mcaprl.train(data, tmp_path / "run", algo="bc", updates=3, held_out=0.0, **own)
    driver = mcaprl.Driver(run.policy, mapping=data.robot)
    random = np.random.default_rng(0)
    speeds, found = random.uniform(0, 3, 30).astype(np.float32), list[Any]()
    # A new episode begins after step 10; from step 20 on, /odom is silent for four steps.
    speeds[10] = 9
    for k, speed in enumerate(speeds):
        now_ns = START_NS + k * 100 * MS
        if not 20 <= k < 24:
            driver.push("/odom", odom(float(speed)), now_ns)
        found.append(driver.command(now_ns))
    assert [k for k, each in enumerate(found) if each.reason] == [10, 22, 23]
    for first, stop in ((0, 10), (11, 22), (24, 30)):
        part = found[first:stop]
        seen = np.array([each.observation for each in part])
        wanted = planned(run.policy.chunk, run.policy.act_chunk(seen))
        np.testing.assert_allclose([each.action for each in part], wanted, atol=1e-6)
        # The same as in an environment with these observations.
        behavior = EpsilonGreedy(run.policy, 0.0, data.action_space)
        own_actions = [behavior.choose(each)[0] for each in seen]
        np.testing.assert_array_equal([each.action for each in part], own_actions)
        messages = [each.messages["/do"] for each in part]
        sent_ = [(each["linear"]["x"], each["angular"]["z"]) for each in messages]
        np.testing.assert_allclose(sent_, own_actions, atol=1e-6)


def test_a_terminal_state_stops_the_robot() -> None:
    episodes = {"terminated": "speed > 5"}
    for restart in (False, True):
        driver = drive(BOX, [linear(0.5)] * 3, episodes=episodes, drive={"restart": restart})
        reasons = []
        for k, speed in enumerate([1.0, 9.0, 1.0]):
            driver.push("/odom", odom(speed), START_NS + k * 100 * MS)
            reasons.append(driver.command(START_NS + k * 100 * MS).reason)
        assert reasons[0] == ""
        assert reasons[1] != ""
        assert bool(reasons[2]) != restart
    driver.begin()
    driver.push("/odom", odom(1), START_NS)
    assert driver.command(START_NS).reason == ""


class Odometry:
    """Message as of rclpy."""

    __module__ = "nav_msgs.msg._odometry"

    def __init__(self) -> None:
        self.twist = SimpleNamespace(twist=SimpleNamespace(linear=SimpleNamespace(x=0.25)))

    @classmethod
    def get_fields_and_field_types(cls) -> dict[str, str]:
        """Return the types of the fields."""
        return {"twist": "geometry_msgs/TwistWithCovariance"}


def test_messages_of_all_libraries() -> None:
    driver = drive(BOX, [linear(0.5)] * 3)
    each = driver.definitions["/odom"]
    decoder = decoder_of(each.encoding, each.type_name, each.schema_encoding, each.schema)
    data = decoder.encode(odom(0.25))
    rospy = SimpleNamespace(_type="nav_msgs/Odometry", twist=Odometry().twist)
    for k, message in enumerate([odom(0.25), data, decoder.decode(data), Odometry(), rospy]):
        driver.push("/odom", message, START_NS + k * MS)
        assert driver.command(START_NS + k * MS).observation.tolist() == [0.25]
    twist = SimpleNamespace(_type="geometry_msgs/Twist")
    for wrong, text in [
        (twist, "/odom has messages of geometry_msgs/Twist, but the mapping needs nav_msgs/msg"),
        ({"pose": 1}, r"a message of /odom \(nav_msgs/msg/Odometry\) has no field twist.twist"),
        (b"\0\1\0\0abc", "/odom: cannot decode 7 bytes as nav_msgs/msg/Odometry"),
    ]:
        with pytest.raises(UsageError, match=text):
            driver.push("/odom", wrong, START_NS)
    with pytest.raises(UsageError, match="/imu is not needed; topics: /odom"):
        driver.push("/imu", {}, START_NS)


def test_bad_numbers_and_sizes_are_fatal() -> None:
    driver = drive(BOX, [linear(0.5)] * 3, lambda _: np.array([math.nan, 0], np.float32))
    driver.push("/odom", odom(1), START_NS)
    command = driver.command(START_NS)
    assert (command.reason, command.is_fatal) == ("the policy's action is not finite", True)
    assert command.messages == driver.stop
    image = {"height": 2, "width": 3, "step": 3, "encoding": "mono8", "data": [1] * 6}
    sent = [Sent(START_NS + k * 100 * MS, "/camera", image) for k in range(3)]
    sent += [Sent(START_NS, "/cmd", linear(0.5))]
    mapping = {"clock": {"rate_hz": 10}, "observation": {"camera": {"image": "/camera"}}}
    tree = {**mapping, "action": {"fields": ["/cmd.linear.x"], "box": {"low": -1, "high": 1}}}
    data = read_open_bag(bag_of(*sent), parse_mapping(tree)).dataset
    driver = mcaprl.Driver(Fixed(data), mapping=data.robot)
    driver.push("/camera", {**image, "width": 2, "step": 2, "data": [1] * 4}, START_NS)
    command = driver.command(START_NS)
    assert command.is_fatal
    assert "/camera has an image of (2, 2, 1)" in command.reason


SEEN = {"image": "/video", "resize": [16, 12]}
STEER = {"fields": ["/cmd.linear.x"], "box": {"low": -1, "high": 1}}


def driven_by_video(image: dict[str, Any], **tree: Any) -> tuple[list[Sent], mcaprl.Dataset]:
    """Return messages of a video, and the data that a mapping makes of them."""
    sent = videos("h264", 0, {23}, set())
    mapping = {"observation": {"camera": image}, "action": STEER, "time": "log_time", **tree}
    bag = StreamBag({**TYPES, **VIDEO_TYPES}, sent)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return sent, read_open_bag(bag, parse_mapping(mapping)).dataset


def test_the_log_of_a_video_equals_what_its_topics_give(tmp_path: Path) -> None:
    """Packets are lost and come at each step: no step is taken without a frame."""
    image = {**SEEN, "undistort": "/info"}
    sent, data = driven_by_video(image, clock={"topic": "/video"}, stack=2)
    assert data.robot["packets_ns"] == {"/video": 33 * MS}
    driver = mcaprl.Driver(Fixed(data), mapping=data.robot)
    assert [*driver.inputs] == ["/video", "/info"]
    driver.record(tmp_path / "drive.mcap")
    found = list[str]()
    with driver:
        for each in sent:
            if each.topic in driver.inputs:
                driver.push(each.topic, each.message, each.time_ns)
            if each.topic == "/video":
                found.append(driver.command(each.time_ns).reason)
    lost = [k for k, reason in enumerate(found) if LOST in reason]
    # Packet 23 is lost, and frames 20 to 29 have another size than the calibration.
    assert lost == [*range(23, 29)]
    assert found[0] == ""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mapping = data.robot["mapping"]
        raw = mcaprl.open(tmp_path / "drive.mcap", mapping=mapping)
    own = mcaprl.open(tmp_path / "drive.mcap")
    assert len(own) > 30
    np.testing.assert_array_equal(own._transitions.frames[0][:10], raw._transitions.frames[0][:10])


def test_a_video_with_frames_that_come_later_is_refused() -> None:
    _, data = driven_by_video(SEEN, clock={"rate_hz": 10})
    driver = mcaprl.Driver(Fixed(data), mapping=data.robot)
    reason = ""
    for k, packet in enumerate(packets("h264 with B-frames")[:6]):
        try:
            driver.push("/video", packet_sent("h264", packet, START_NS).message, START_NS + k * MS)
        except UsageError as error:
            reason = str(error)
            break
        # Nothing moves before it is known.
        assert driver.command(START_NS + k * MS).reason
    assert reason.startswith("/video: its frames are complete with later packets only (B-frames)")
    data.robot["packets_ns"].clear()
    data.robot["topics"]["/video"]["type_name"] = "foxglove_msgs/msg/CompressedVideo"
    with pytest.raises(
        UsageError, match=r"/video: the run does not contain the interval of its pa"
    ):
        mcaprl.Driver(Fixed(data), mapping=data.robot)


def test_a_driver_waits_for_the_calibration_and_holds_it() -> None:
    sent, data = driven_by_video({**SEEN, "undistort": "/info"}, clock={"rate_hz": 10})
    driver = mcaprl.Driver(Fixed(data), mapping=data.robot)
    packet = next(each for each in sent if each.topic == "/video")
    driver.push("/video", packet.message, START_NS)
    waiting = driver.command(START_NS)
    assert (waiting.reason, waiting.is_fatal) == ("camera: no message of /info yet", False)
    driver.push("/info", INFO, START_NS + MS)
    assert not driver.command(START_NS + 2 * MS).reason
    driver.begin()
    driver.push("/info", {**INFO, "header": stamp(START_NS)}, START_NS + 3 * MS)
    driver.push("/video", packet.message, START_NS + 3 * MS)
    assert not driver.command(START_NS + 4 * MS).reason
    cases: list[tuple[dict[str, Any], str]] = [
        ({**INFO, "k": [51.0, *INFO["k"][1:]]}, "undistort: the calibration on /info changes: st"),
        ({**INFO, "k": [1.0]}, "/info has 1, 9, 12 numbers in K, R and P for 64 x 48 pixels"),
        ({**INFO, "width": 10**6, "height": 10**6}, "for 1000000 x 1000000 pixels; expected"),
        ({"width": 64}, r"a message of /info \(sensor_msgs/msg/CameraInfo\) has no field"),
    ]
    for message, text in cases:
        with pytest.raises(UsageError, match=text):
            driver.push("/info", message, START_NS + 5 * MS)
    del data.robot["topics"]["/info"]
    with pytest.raises(UsageError, match=r"camera.*undistort: the type of /info is not known"):
        mcaprl.Driver(Fixed(data), mapping=data.robot)


def episodes_of(data: mcaprl.Dataset) -> list[Any]:
    return [each._replace(policy="", epsilon=0.0) for each in data._transitions.episodes]


def assert_equal(own: mcaprl.Dataset, raw: mcaprl.Dataset) -> None:
    """Check that a log equals what its topics give by the mapping."""
    for name in ("log_time_ns", "actions", "rewards", "terminated", "truncated"):
        one, other = (getattr(each._transitions, name) for each in (own, raw))
        np.testing.assert_array_equal(one, other, name)
    for one, other in zip(own._transitions.frames, raw._transitions.frames, strict=True):
        np.testing.assert_array_equal(np.asarray(one[:]), np.asarray(other[:]))
    assert episodes_of(own) == episodes_of(raw)
    assert own.observation_names == raw.observation_names
    assert own.action_labels == raw.action_labels


REWARD = "next(total) - total + 10 * terminated"


@pytest.mark.filterwarnings("ignore:.*cannot be decoded")
@settings(max_examples=10, deadline=None, suppress_health_check=list(HealthCheck))
@given(sent=streams(), tree=mappings())
def test_the_log_equals_what_its_topics_give(
    sent: list[Sent], tree: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    tree["fields"]["total"]["missing"] = 0
    tree = {**tree, "reward": REWARD, "drive": {"restart": True}}
    # A value that is missing for a while may turn out to be in a gap only later.
    for name, quantity in tree["observation"].items():
        if "missing" not in quantity:
            tree["observation"][name] = {**quantity, "tolerance_s": None}
    # Without a required quantity, the steps of a bag go on as long as there are commands.
    tree["observation"] |= {"place": QUANTITIES["place"]}
    # No command fits between steps that are a nanosecond apart, as those of equal times are.
    ticks = [each.time_ns for each in sent if each.topic == tree["clock"].get("topic")]
    assume(len(set(ticks)) == len(ticks))
    if tree["episodes"].keys() - {"gap_s", "min_steps"}:
        # A bag has no steps after the last transform. A robot has them, and an episode that ends or
        # begins there is in the log before it turns out that no transform follows.
        last = max(k for k, each in enumerate(sent) if each.topic == "/tf")
        sent = [each for each in sent if each.time_ns <= sent[last].time_ns]
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    bag = StreamBag(TYPES, sent)
    try:
        data = read_open_bag(bag, parse_mapping(tree)).dataset
        driver = mcaprl.Driver(Fixed(data), mapping=data.robot)
    except (LogError, UsageError):
        return
    driver.record(path)
    with driver:
        drive_along(driver, bag)
    try:
        raw = mcaprl.open(path, mapping=tree)
    except McaprlError:
        return
    assert_equal(mcaprl.open(path), raw)


def drive_along(driver: mcaprl.Driver, bag: StreamBag) -> None:
    """Push the messages of a bag, and command at each step."""
    is_due = False
    for each, later in itertools.zip_longest(bag.sent, bag.sent[1:]):
        while (next_ns := driver.next_step_ns) is not None and next_ns < each.time_ns:
            driver.command(next_ns)
        if each.topic in driver.inputs:
            driver.push(each.topic, each.message, each.time_ns)
        is_due |= each.topic == driver.clock_topic
        # Messages of the same time belong to the step, up to the next one of the clock.
        if is_due and (
            later is None or later.time_ns > each.time_ns or later.topic == driver.clock_topic
        ):
            driver.command(each.time_ns)
            is_due = False
    # The last step is the first one at or after the last message.
    if (next_ns := driver.next_step_ns) is not None:
        driver.command(next_ns)


def driven(path: Path) -> mcaprl.Driver:
    """Drive for 40 steps, in episodes of at most 10, and record it; the log is still open."""
    commands = [linear(0.05 * (k % 7)) for k in range(30)]
    driver = drive(
        BOX,
        commands,
        lambda k: np.array([0.1 * (k % 5), 0.5 * (k % 2)], np.float32),
        episodes={"max_steps": 10},
        reward="speed",
        drive={"restart": True},
    )
    driver.record(path)
    commanded(driver, 40)
    return driver


def test_the_log_of_a_drive_trains_the_next_policy(tmp_path: Path) -> None:
    """The log is data as it is, and its run drives again."""
    driver = driven(tmp_path / "drive.mcap")
    driver.close()
    data = mcaprl.open(tmp_path / "drive.mcap")
    assert [episode.length for episode in data.episodes][:3] == [10, 10, 10]
    np.testing.assert_allclose(data.actions[:3], [[0.0, 0.0], [0.1, 0.5], [0.2, 0.0]], atol=1e-6)
    assert data.rewards[0] == pytest.approx(0.5)
    mcaprl.train(tmp_path / "drive.mcap", tmp_path / "next", algo="bc", updates=5, seeds=1)
    again = mcaprl.Driver(tmp_path / "next")
    again.push("/odom", odom(0.5), START_NS)
    assert again.command(START_NS).messages["/do"].keys() == {"linear", "angular"}


def test_a_killed_drive_keeps_its_finished_episodes(tmp_path: Path) -> None:
    """What is on disk when the process dies is recovered: all episodes but the open one."""
    driver = driven(tmp_path / "drive.mcap")
    (killed,) = tmp_path.glob("*drive.mcap*")
    (tmp_path / "copy.mcap").write_bytes(killed.read_bytes())
    driver.close()
    mcaprl.recover(tmp_path / "copy.mcap", tmp_path / "recovered.mcap")
    whole, found = mcaprl.open(tmp_path / "drive.mcap"), mcaprl.open(tmp_path / "recovered.mcap")
    count = len(found.episodes)
    assert count >= len(whole.episodes) - 2 > 0
    np.testing.assert_array_equal(found.actions, whole.actions[: len(found)])
    np.testing.assert_array_equal(found.rewards, whole.rewards[: len(found)])


@pytest.mark.parametrize("name", [each for each in ROBOTS if each not in IMPOSSIBLE])
def test_bags_of_many_robots(name: str, tmp_path: Path) -> None:
    form = list(FORMATS)[list(ROBOTS).index(name) % len(FORMATS)]
    robot: Robot = ROBOTS[name]()
    bag = FORMATS[form](robot, tmp_path / "robot.mcap")
    mapping = tmp_path / "robot.yaml"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mapping.write_text(mcaprl.suggest_mapping(bag))
        data = mcaprl.open(bag, mapping=mapping)
    tree = data.robot
    if isinstance(data.action_space, spaces.Box):
        tree["mapping"]["drive"]["stop"] = data.action_space.low.tolist()
    elif data.action_commands is not None and tree["mapping"]["action"]["field"]:
        tree["mapping"]["drive"]["stop"] = list(data.action_commands.commands[0] or ())
    driver = mcaprl.Driver(Fixed(data), mapping=tree)
    assert compared(driver, bag, data) == len(data._transitions.log_time_ns)


def compared(driver: mcaprl.Driver, bag: Path, data: mcaprl.Dataset) -> int:
    """Compare all observations of a bag, and return their number."""
    times = data._transitions.log_time_ns.tolist()
    rows = dict(zip(times, range(len(times)), strict=True))
    found = 0
    with mcaprl.open_bag(bag) as opened:
        messages = list(opened.messages(list(driver.inputs)))
    assert [each.log_time_ns for each in messages] == sorted(each.log_time_ns for each in messages)
    steps = iter(times)
    now_ns = next(steps)
    for k, each in enumerate(messages):
        while now_ns < each.log_time_ns and driver.clock_topic is None:
            found += check(driver.command(now_ns), data, rows[now_ns])
            now_ns = next(steps, sys.maxsize)
        driver.push(each.topic, each.message, each.log_time_ns, each.publish_time_ns)
        if each.topic == driver.clock_topic:
            # Messages with the time of the step that were recorded after it belong to it.
            for other in messages[k + 1 :]:
                if other.log_time_ns > each.log_time_ns or other.topic == each.topic:
                    break
                driver.push(other.topic, other.message, other.log_time_ns)
            command = driver.command(each.log_time_ns)
            if command.time_ns in rows:
                found += check(command, data, rows[command.time_ns])
    while now_ns < sys.maxsize and driver.clock_topic is None:
        found += check(driver.command(now_ns), data, rows[now_ns])
        now_ns = next(steps, sys.maxsize)
    return found


def check(command: Any, data: mcaprl.Dataset, row: int) -> int:
    seen = command.observation
    assert seen is not None, command.reason
    parts = seen if isinstance(seen, dict) else {"": seen}
    for leaf, column in zip(data._leaves, data._transitions.frames, strict=True):
        np.testing.assert_array_equal(parts["".join(leaf.path)], np.asarray(column[row]))
    return 1
