"""Observations of a running robot equal those of its bag, bit for bit, at every step."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.dataset.video import _h265
from mcaprl.recorder.mapping.config import Place, parse_mapping
from mcaprl.recorder.mapping.images import LiveVideo
from mcaprl.recorder.mapping.live import STATE, LiveEpisodes, LiveSteps, Topics
from mcaprl.recorder.mapping.plan import Plan
from mcaprl.recorder.mapping.read import read_open_bag
from mcaprl.recorder.mapping.robot import Robot
from mcaprl.recorder.mapping.steps import StepReader
from tests.support.stream_bag import Sent, StreamBag
from tests.support.videos import packets

TYPES = {
    "/odom": "nav_msgs/msg/Odometry",
    "/joints": "sensor_msgs/msg/JointState",
    "/scan": "sensor_msgs/msg/LaserScan",
    "/mode": "std_msgs/msg/String",
    "/goal": "geometry_msgs/msg/Vector3",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/camera": "sensor_msgs/msg/Image",
    "/points": "sensor_msgs/msg/PointCloud2",
    "/map": "nav_msgs/msg/OccupancyGrid",
    "/layers": "foxglove_msgs/msg/Grid",
    "/tick": "std_msgs/msg/Header",
    "/cmd": "geometry_msgs/msg/Twist",
}
VIDEO_TYPES = {
    "/video": "sensor_msgs/msg/CompressedImage",
    "/info": "sensor_msgs/msg/CameraInfo",
}
START_NS, MS = 1_700_000_000 * 10**9, 10**6
GAP_S = 2.0

numbers = st.floats(-1e3, 1e3, width=32)
odd = st.one_of(*[numbers] * 6, st.sampled_from([math.nan, math.inf, -math.inf]))
NAMES = ("hip", "knee", "foot")


def stamp(time_ns: int) -> dict[str, Any]:
    return {"stamp": {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9}}


@st.composite
def contents(draw: st.DrawFn, topic: str, time_ns: int) -> dict[str, Any]:
    """Return a message; its header is up to 30 ms older than its log_time."""
    header = stamp(time_ns - draw(st.integers(0, 30)) * MS)
    match topic:
        case "/odom":
            q = dict(zip("xyzw", draw(st.tuples(*[st.floats(-1, 1, width=32)] * 4)), strict=True))
            twist = {"twist": {"linear": {"x": draw(odd)}}}
            return {"header": header, "twist": twist, "pose": {"pose": {"orientation": q}}}
        case "/joints":
            names = draw(st.permutations(NAMES))[: draw(st.integers(1, 3))]
            position = [draw(numbers) for _ in names]
            return {"header": header, "name": names, "position": position}
        case "/scan":
            low = draw(st.sampled_from([0.0, 5.0]))
            ranges = draw(st.lists(odd, max_size=9))
            return {"header": header, "ranges": ranges, "range_min": low, "range_max": 500.0}
        case "/points":
            points = draw(st.lists(st.tuples(*[odd] * 3), min_size=1, max_size=4))
            packed = list(np.array(points, "<f4").tobytes())
            # Some clouds are damaged.
            step = 12 if draw(st.integers(0, 4)) else 11
            fields = [
                {"name": axis, "offset": 4 * k, "datatype": 7, "count": 1}
                for k, axis in enumerate("xyz")
            ]
            sizes = {"height": 1, "width": len(points), "point_step": step}
            return {
                "header": header,
                **sizes,
                "row_step": len(packed),
                "fields": fields,
                "data": packed,
            }
        case "/map":
            info: dict[str, Any] = {
                "width": 3,
                "height": 2,
                "resolution": draw(st.sampled_from([0.5, 0.5, 0.0])),
            }
            info["origin"] = {"position": {"x": draw(numbers)}, "orientation": {"w": 1.0}}
            cells = draw(st.lists(st.integers(-1, 100), min_size=6, max_size=6))
            return {"header": header, "info": info, "data": cells}
        case "/layers":
            kind = np.dtype([("cost", "<f4"), ("flag", "u1")])
            costs = np.zeros((2, 3), kind)
            costs["cost"] = np.reshape(draw(st.tuples(*[odd] * 6)), (2, 3))
            fields = [{"name": "flag", "offset": 4, "type": 1}]
            # Some have no costs.
            if draw(st.integers(0, 4)):
                fields.append({"name": "cost", "offset": 0, "type": 7})
            return {
                **{"timestamp": header["stamp"], "fields": fields, "column_count": 3},
                **{"cell_size": {"x": 0.5, "y": 1.0}, "row_stride": 15, "cell_stride": 5},
                "pose": {"position": {"x": draw(numbers)}, "orientation": {"w": 1.0}},
                "data": list(costs.tobytes()),
            }
        case "/mode":
            return {"data": draw(st.sampled_from(["drive", "drive", "park"]))}
        case "/goal":
            return {"x": draw(numbers), "y": draw(odd), "z": 0.0}
        case "/tf" | "/tf_static":
            parent, child = ("base", "cam") if topic == "/tf_static" else ("map", "base")
            rotation = dict(zip("xyzw", draw(st.tuples(*[numbers] * 4)), strict=True))
            translation = {"x": draw(numbers), "y": draw(numbers), "z": draw(odd)}
            if topic == "/tf_static":
                # A bag has the last one from the start.
                translation, rotation = {"x": 0.5, "y": -1.0, "z": 2.0}, {"z": 0.6, "w": 0.8}
            each = {"translation": translation, "rotation": rotation}
            one = {"header": {**header, "frame_id": parent}, "child_frame_id": child}
            return {"transforms": [{**one, "transform": each}]}
        case "/camera":
            data = draw(st.binary(min_size=6, max_size=6))
            # Some images are damaged.
            width = 3 if draw(st.integers(0, 4)) else 4
            sizes = {"height": 2, "width": width, "step": 3}
            return {"header": header, **sizes, "encoding": "mono8", "data": list(data)}
        case "/cmd":
            return {"linear": {"x": draw(numbers)}}
    return header


@st.composite
def streams(draw: st.DrawFn) -> list[Sent]:
    """Return messages of all topics, with gaps, in the order of recording."""
    found = [Sent(START_NS, topic, draw(contents(topic, START_NS))) for topic in TYPES]
    time_ns = START_NS
    for _ in range(draw(st.integers(3, 12))):
        pause = draw(st.sampled_from([50, 120, 400, 400, 2500])) * MS
        for topic in [*draw(st.lists(st.sampled_from(list(TYPES)), max_size=4)), "/odom", "/tick"]:
            time_ns += draw(st.sampled_from([0, 1, 7])) * MS
            found.append(Sent(time_ns, topic, draw(contents(topic, time_ns))))
        time_ns += pause
    return found


QUANTITIES: dict[str, dict[str, Any]] = {
    "speed": {"field": "/odom.twist.twist.linear.x", "clip": [-500, 500], "scale": 0.1},
    "yaw": {"field": "/odom.pose.pose.orientation", "as": "yaw", "missing": 0},
    "late": {"field": "/odom.twist.twist.linear.x", "tolerance_s": 0.2, "missing": -1},
    "joints": {"field": "/joints.position", "names": ["knee", "hip"], "missing": 5},
    "foot": {"field": "/joints.position", "names": "foot", "wrap_angle": True, "missing": 0},
    "first": {"field": "/scan.ranges[0]", "missing": 9, "clip": [0, 10]},
    "sectors": {"field": "/scan.ranges", "pool": "min", "to": 3, "missing": 9},
    "padded": {"field": "/scan.ranges[1:]", "pad": 4, "missing": -2, "offset": 1},
    "beams": {"scan": "/scan", "to": 4, "missing": 30},
    "near": {"scan": "/scan", "to": 2, "pool": "mean", "clip": [0, 30], "missing": 30},
    "cloud": {"cloud": "/points", "as": "range", "size": [6, 4], "elevation_deg": [-60, 60]},
    "top": {
        **{"cloud": "/points", "as": "height", "size": [3, 3], "tolerance_s": 1.0},
        **{"x_m": [-600, 600], "y_m": [-600, 600], "z_m": [-900, 900]},
    },
    "map": {"grid": "/map", "x_m": [-500, 500], "y_m": [-1, 1], "size": [4, 3]},
    "around": {"grid": "/map", "size": [5, 4], "around": ["place"], "outside": 100},
    "ahead": {
        **{"grid": "/map", "size": [4, 3], "around": ["fresh", "total", "yaw"]},
        **{"x_m": [-5, 900], "y_m": [-500, 500], "unknown": 10, "tolerance_s": 1.0},
    },
    "layer": {
        **{"grid": "/layers", "field": "cost", "range": [-500, 900], "clip": [-600, 900]},
        **{"x_m": [-500, 500], "y_m": [-1, 1], "size": [4, 3]},
    },
    "beside": {
        **{"grid": "/layers", "field": "cost", "range": [100, -100], "around": ["place"]},
        **{"size": [5, 4], "outside": 0, "tolerance_s": 2.0},
    },
    "goal": {"field": "/goal.x", "tolerance_s": 0.5, "missing": 0},
    "side": {"field": "/goal.y"},
    "count": {"field": "/goal", "as": "count"},
    "pose": {"transform": "cam", "in": "map", "parts": ["x", "yaw", "qw"], "missing": 0},
    "place": {"transform": "base", "in": "map"},
    "camera": {"image": "/camera"},
    "small": {"image": "/camera", "resize": [2, 1], "tolerance_s": 1.0},
}


@st.composite
def mappings(draw: st.DrawFn) -> dict[str, Any]:
    observed = draw(
        st.lists(st.sampled_from(list(QUANTITIES)), min_size=1, max_size=5, unique=True)
    )
    clock = draw(
        st.sampled_from(
            [{"rate_hz": 4}, {"topic": "/tick", "time": "log_time"}, {"topic": "/odom"}]
        )
    )
    episodes: dict[str, Any] = {"gap_s": GAP_S, "min_steps": 1}
    if draw(st.booleans()):
        episodes["terminated"] = "mode == 'park' and total > 0"
    if draw(st.booleans()):
        episodes["begin"] = "total > 0 and mode == 'drive'"
    if draw(st.booleans()):
        episodes["max_steps"] = draw(st.integers(1, 4))
    return {
        "clock": clock,
        "time": "log_time",
        "observation": {name: QUANTITIES[name] for name in observed},
        "stack": draw(st.integers(1, 3)),
        "fields": {
            "mode": {"field": "/mode.data"},
            "total": {"field": "/odom.twist.twist.linear.x"},
            "fresh": {"field": "/goal.x", "tolerance_s": 1.0},
            **{name: QUANTITIES[name] for name in ("place", "yaw") if name not in observed},
        },
        "action": {"fields": ["/cmd.linear.x"], "box": {"low": -1000, "high": 1000}},
        "episodes": episodes,
    }


def sent_until(bag: StreamBag, time_ns: int, live: LiveSteps, at: int, clock: str | None) -> int:
    """Push the messages up to a step; of equal times, those before the next one of the clock."""
    ticks = 0
    while at < len(bag.sent) and bag.sent[at].time_ns <= time_ns:
        each = bag.sent[at]
        ticks += each.topic == clock
        if ticks > 1 and live.clock_ns == time_ns:
            break
        live.push(each.topic, each.message, each.time_ns)
        at += 1
    return at


@settings(max_examples=15, deadline=None, suppress_health_check=list(HealthCheck))
@given(streams(), mappings())
def test_every_step_equals_that_of_the_bag(sent: list[Sent], tree: dict[str, Any]) -> None:
    compare(sent, tree)


def compare(sent: list[Sent], tree: dict[str, Any]) -> int:
    """Compare all steps with those of a bag, and return how many observations are equal."""
    bag, mapping = StreamBag({**TYPES, **VIDEO_TYPES}, sent), parse_mapping(tree)
    try:
        dataset = read_open_bag(bag, mapping).dataset
    except (LogError, UsageError):
        return 0
    frames = dict(zip(dataset._transitions.log_time_ns.tolist(), range(10**6), strict=False))
    plan = Plan(bag, mapping, Place(), trust_code=False)
    for name, reader in plan.images.items():
        rows = np.arange(len(bag.times(reader.topic)))
        list(reader.images(rows))
        if reader.packets_ns is not None:
            # Frames of another size are found as they are put into an array.
            reader.read(rows)
        plan.streams[plan.quantities[name].stream].leave_out(reader.failures)
    (steps,) = [StepReader(plan).read(0)]
    robot = Robot.from_json(dataset.robot, "robot")
    live = LiveSteps(running(robot), robot.shapes)
    episodes, at, compared = LiveEpisodes(live._plan), 0, 0
    for row, time_ns in enumerate(steps.times_ns.tolist()):
        at = sent_until(bag, time_ns, live, at, mapping.clock.topic)
        step = live.step(time_ns)
        for name, values in steps.quantities.items():
            found = step.quantities[name]
            if name not in plan.images:
                np.testing.assert_array_equal(found.values[0], values.values[row], name)
            np.testing.assert_array_equal(found.age_s[0], values.age_s[row], name)
            assert found.missing[0] == values.missing[row], name
        state = episodes.see(step, acts=True)
        if time_ns in frames:
            compared += 1
            place = frames[time_ns]
            seen = (
                state.observation
                if isinstance(state.observation, dict)
                else {"": state.observation}
            )
            for leaf, column in zip(dataset._leaves, dataset._transitions.frames, strict=True):
                part = seen["".join(leaf.path)]
                assert part.dtype == column.dtype
                np.testing.assert_array_equal(part, column[place])
    assert compared == len(frames)
    return compared


def running(robot: Robot) -> Plan:
    """Return the plan of a robot without a bag."""
    options: dict[str, Any] = {"trust_code": False, "packets_ns": robot.packets_ns}
    return Plan(Topics(robot.topics), robot.mapping, Place(), **options)


INFO: dict[str, Any] = {
    **{"width": 64, "height": 48, "distortion_model": "plumb_bob", "d": [-0.3, 0.1, 0, 0, 0]},
    **{
        "k": [50.0, 0, 31.5, 0, 52, 23.5, 0, 0, 1],
        "r": [0.0] * 9,
        "p": [48.0, 0, 32, 0, 0, 49, 24, 0, 0, 0, 1, 0],
    },
}
VIEWS: dict[str, dict[str, Any]] = {
    "whole": {"image": "/video"},
    "tiny": {"image": "/video", "resize": [8, 6]},
    "part": {"image": "/video", "crop": [8, 4, 32, 24], "resize": [8, 6], "gray": True},
    "flat": {"image": "/video", "undistort": "/info", "resize": [16, 12]},
    "turned": {"image": "/video", "undistort": "/info", "tolerance_s": 0.2},
}


def packet_sent(codec: str, data: bytes, time_ns: int) -> Sent:
    message = {"header": stamp(time_ns), "format": codec, "data": list(data)}
    return Sent(time_ns, "/video", message)


def videos(codec: str, first: int, lost: set[int], damaged: set[int]) -> list[Sent]:
    """Return a video of two sizes from a packet on, and what is beside it."""
    stream = [*packets(codec, 20), *packets(codec, 10, 96, 80), *packets(codec, 10)]
    sent = []
    for k in range(first, 40):
        time_ns = START_NS + k * 33 * MS
        sent += [Sent(time_ns, "/odom", odom(k)), Sent(time_ns, "/info", INFO)]
        sent += [Sent(time_ns, "/cmd", {"linear": {"x": k / 40}})]
        data = stream[k][:9] if k in damaged else stream[k]
        sent += [] if k in lost else [packet_sent(codec, data, time_ns)]
    return sent


@settings(max_examples=6, deadline=None, phases=[Phase.generate])
@given(
    codec=st.sampled_from(["h264", "vp9"]),
    first=st.integers(0, 6),
    lost=st.sets(st.integers(11, 39), max_size=4),
    damaged=st.sets(st.integers(11, 39), max_size=2),
    # Images of one topic whose frames may have the same sizes.
    names=st.sampled_from([["whole", "turned"], ["tiny", "part"], ["flat"], ["whole"]]),
    clock=st.sampled_from([{"rate_hz": 20}, {"topic": "/video"}]),
)
def test_frames_of_a_video_equal_those_of_the_bag(
    codec: str,
    first: int,
    lost: set[int],
    damaged: set[int],
    names: list[str],
    clock: dict[str, Any],
) -> None:
    mapping = {
        "clock": clock,
        "time": "log_time",
        "observation": {**SPEED, **{name: VIEWS[name] for name in names}},
        "stack": 2,
        "action": {"fields": ["/cmd.linear.x"], "box": {"low": -1, "high": 1}},
        "episodes": {"gap_s": GAP_S},
    }
    found = compare(videos(codec, first, lost, damaged), mapping)
    assert found > 5 or len(lost | damaged) > 2


AROUND = {"map": {"grid": "/map", "size": [3, 1], "around": ["x", "y", "yaw"], "outside": 100}}
POSE = {
    **{axis: {"field": f"/odom.pose.pose.position.{axis}", "tolerance_s": 0.3} for axis in "xy"},
    "yaw": {"field": "/odom.pose.pose.orientation", "as": "yaw"},
}


def placed(x: float, y: float, z: float, w: float) -> dict[str, Any]:
    pose = {"position": {"x": x, "y": y}, "orientation": {"x": 0, "y": 0, "z": z, "w": w}}
    return {"pose": {"pose": pose}}


def occupancy(width: int, cells: list[int]) -> dict[str, Any]:
    origin = {"position": {"x": 0, "y": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    info = {"width": width, "height": len(cells) // width, "resolution": 1.0, "origin": origin}
    return {"info": info, "data": cells}


@pytest.mark.parametrize("stack", [1, 2])
def test_a_map_around_the_robot_equals_that_of_the_bag(stack: int) -> None:
    """The map comes twice, the pose at each step but for a pause of .5 s."""
    half, sent = math.sqrt(0.5), list[Sent]()
    poses = [(0.5, 1.5, 0, 1), (1.5, 0.5, half, half), (1.5, 0.5, 1, 0), (9, 9, 0, 1)]
    for k in range(20):
        time_ns = START_NS + k * 100 * MS
        if k in (0, 10):
            sent.append(Sent(time_ns, "/map", occupancy(3, [k, 20, 40, 60, 80, 100])))
        if not 12 <= k < 17:
            sent.append(Sent(time_ns, "/odom", placed(*poses[k % 4])))
        sent.append(Sent(time_ns, "/cmd", {"linear": {"x": k / 20}}))
    mapping = {
        "clock": {"rate_hz": 10},
        "observation": AROUND,
        "fields": POSE,
        "stack": stack,
        "action": {"fields": ["/cmd.linear.x"], "box": {"low": -1, "high": 1}},
        "episodes": {"gap_s": GAP_S, "min_steps": 1},
    }
    data = read_open_bag(StreamBag(TYPES, sent), parse_mapping(mapping)).dataset
    (images,) = data._transitions.frames
    # The cells to the left of the robot, at it, and to its right.
    seen = np.asarray(images)[:4, 0, :, -1].tolist()
    assert seen == [[255, 153, 0], [0, 51, 102], [255, 51, 204], [255] * 3]
    # Without a pose for more than .3 s, there is no step.
    assert [each.length for each in data.episodes] == [14, 2]
    assert compare(sent, mapping) == 18


def test_a_map_needs_the_pose_of_the_robot() -> None:
    live = LiveSteps(plan_of(AROUND, fields=POSE))
    live.push("/map", occupancy(1, [100]), START_NS)
    assert live.step(START_NS + MS).reason == "x: no message of /odom yet"
    live.push("/odom", placed(0.5, 0.5, 0, 1), START_NS + 2 * MS)
    step = live.step(START_NS + 3 * MS)
    assert step.frame is not None
    assert step.frame["map"].tolist() == [[[255], [255], [255]]]
    late = live.step(START_NS + 400 * MS)
    assert late.reason == "x: the last message of /odom is 0.398 s old"
    with pytest.raises(UsageError, match="around of map: no quantity with numbers is named x"):
        plan_of(AROUND)
    alone = {"map": {**AROUND["map"], "around": ["x"]}}
    live = LiveSteps(plan_of(alone, fields={"x": POSE["x"]}))
    live.push("/map", occupancy(1, [100]), START_NS)
    live.push("/odom", placed(0.5, 0.5, 0, 1), START_NS)
    with pytest.raises(UsageError, match="around: x must be 2 or 3 numbers, x, y and yaw, not 1"):
        live.step(START_NS)


def plan_of(observation: dict[str, Any], **tree: Any) -> Plan:
    mapping = {
        "clock": {"rate_hz": 10},
        "observation": observation,
        "action": {"fields": ["/cmd.linear.x"], "box": {"low": -1, "high": 1}},
        **tree,
    }
    return Plan(StreamBag(TYPES, []), parse_mapping(mapping), Place(), trust_code=False)


def test_a_damaged_image_is_named_until_another_comes() -> None:
    live = LiveSteps(plan_of({"camera": {"image": "/camera"}}))
    image = {"height": 2, "width": 4, "step": 3, "encoding": "mono8", "data": [0] * 6}
    live.push("/camera", image, START_NS)
    reason = live.step(START_NS + MS).reason
    assert reason.startswith("camera: a message of /camera cannot be used: "), reason
    live.push("/camera", {**image, "width": 3}, START_NS + 2 * MS)
    assert live.step(START_NS + 3 * MS).reason == ""


SPEED = {"speed": {"field": "/odom.twist.twist.linear.x"}}


@pytest.mark.parametrize("align", ["nearest", "linear"])
def test_looking_ahead_is_refused(align: str) -> None:
    plan = plan_of({"speed": {**SPEED["speed"], "align": align}})
    with pytest.raises(UsageError, match=f"speed.align: `{align}` looks ahead"):
        LiveSteps(plan)


def test_a_stack_whose_episode_begins_late_is_refused() -> None:
    plan = plan_of(SPEED, stack=2, episodes={"begin": "next(speed) > speed"})
    with pytest.raises(UsageError, match=r"episodes\.begin: `next` looks ahead"):
        LiveEpisodes(plan)
    assert LiveEpisodes(plan_of(SPEED, episodes={"begin": "next(speed) > speed"})).is_late


def odom(speed: float) -> dict[str, Any]:
    return {"twist": {"twist": {"linear": {"x": speed}}}}


def test_why_there_is_no_observation() -> None:
    live = LiveSteps(plan_of(SPEED, episodes={"gap_s": 1.0}))
    assert live.step(START_NS).reason == "speed: no message of /odom yet"
    live.push("/odom", odom(0.5), START_NS + 100 * MS)
    step = live.step(START_NS + 200 * MS)
    assert step.reason == ""
    assert step.frame is not None
    assert step.frame[STATE].tolist() == [0.5]
    late = live.step(START_NS + 1500 * MS)
    assert late.reason == "speed: the last message of /odom is 1.4 s old"
    assert not late.is_fatal
    live.push("/odom", odom(math.nan), START_NS + 1600 * MS)
    nothing = live.step(START_NS + 1700 * MS)
    assert nothing.reason == "speed of /odom has no number, or one that is not finite"
    assert nothing.is_fatal
    assert nothing.gap_before
    live.push("/odom", odom(0.0), START_NS + 9000 * MS)
    assert live.step(START_NS + 8800 * MS).reason.startswith("speed: the last message of /odom is")


def test_a_clock_that_goes_back_drops_all_messages() -> None:
    live = LiveSteps(plan_of(SPEED, episodes={"gap_s": 1.0}))
    live.push("/odom", odom(0.5), START_NS + 5000 * MS)
    live.push("/odom", odom(0.5), START_NS)
    step = live.step(START_NS + 5100 * MS)
    assert (step.reason, step.is_fatal) == ("the clock of /odom went back by 5 s", True)
    assert live.step(START_NS + 5200 * MS).reason == "speed: no message of /odom yet"
    assert live.step(START_NS + 5200 * MS).reason == "the clock went back by 0 s"


def test_packets_of_parameter_sets_alone_are_forgotten() -> None:
    stream = packets("h265", 10)
    video = LiveVideo("/video", {"format": "string", "data": "uint8[]"}, 0.0)
    sets = _h265(stream[0], b"").parameters
    for k, data in enumerate([*stream[:5], *[sets] * 200, *stream[5:]]):
        video.push({"format": "h265", "data": data}, START_NS + k * MS)
        assert bool(video.lack) == (5 <= k < 205)
    assert len(video._decoder._waiting) <= 64


def test_memory_is_bounded() -> None:
    live = LiveSteps(plan_of({**SPEED, "camera": {"image": "/camera"}}))
    image = {"height": 1, "width": 1, "step": 1, "encoding": "mono8", "data": [7]}
    for k in range(5000):
        live.push("/odom", odom(k), START_NS + k)
        live.push("/camera", image, START_NS + k)
    assert max(len(each._pending) for each in live._streams.values()) <= 1000
    assert len(live._streams["/camera"]._pending) <= 16
    step = live.step(START_NS + 5000)
    assert step.frame is not None
    assert step.frame[STATE].tolist() == [4999]
