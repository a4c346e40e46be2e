"""The program of an exported node; `node` bundles it with what it uses. It needs rclpy to run."""

from __future__ import annotations

import base64
import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np

from mcaprl.chunks import ChunkExecution, Chunks
from mcaprl.drive.core import CommandMessages, DriverCore
from mcaprl.errors import UsageError
from mcaprl.frames import FrameStack, parts_of
from mcaprl.recorder.bags.bag import TopicInfo
from mcaprl.recorder.mapping.align import TopicStream, path_in
from mcaprl.recorder.mapping.expression import Expression
from mcaprl.recorder.mapping.images import ImageOptions
from mcaprl.recorder.mapping.live import LiveEpisodes, LiveSteps
from mcaprl.recorder.mapping.observe import Source
from mcaprl.recorder.mapping.plan import Wanted

_SILENCE_S = 0.5  # Time without a message of the clock after which the robot is stopped


class NodeStamp(SimpleNamespace):
    """Time of a message in one of its fields."""


def node_import(module: str, extra: str) -> Any:
    """Import a package that a node needs for some mappings only."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        missing = "Pillow" if module.startswith("PIL") else module
        raise UsageError(f"{missing} is not installed, which the images need") from error


class NodePlace:
    """Names of the mapping's keys, for error messages."""

    def of(self, *keys: Any) -> str:
        """Return the name of a key."""
        return ".".join(map(str, keys))

    @contextmanager
    def named(self, *keys: Any) -> Iterator[None]:
        """Do nothing: the errors of a node name topics."""
        yield


class NodePlan:
    """A resolved mapping, as `plan.Plan`."""

    def __init__(self, spec: dict[str, Any]) -> None:
        """Read what `node` wrote."""
        topics = {name: TopicInfo(**info) for name, info in spec["topics"].items()}
        self.bag = SimpleNamespace(topics=topics)
        self.mapping = SimpleNamespace(
            **{key: SimpleNamespace(**spec[key]) for key in ("clock", "episodes", "drive")},
            stack=spec["stack"],
            observation={name: SimpleNamespace(**q) for name, q in spec["observation"].items()},
        )
        self.quantities = {name: _wanted(name, each) for name, each in spec["quantities"].items()}
        self.streams = {
            name: TopicStream(self.bag, topic, fields, _time(time))
            for name, topic, fields, time in spec["streams"]
        }
        self.conditions = {name: Expression(text) for name, text in spec["conditions"].items()}
        self.constants = {name: np.array(value) for name, value in spec["constants"].items()}
        self.frames, self._times = spec["frames"], spec["frames"]
        self.clock, self.required = spec["clock_stream"], spec["required"]
        self.observed = spec["observed"]
        self.images = {
            name: self._image(self.quantities[name], fields)
            for name, fields in spec["images"].items()
        }
        self.place = NodePlace()

    def _image(self, wanted: Wanted, fields: list[str]) -> Any:
        """Return the attributes of an `ImageReader` that decode a message."""
        topic = wanted.source.topic
        options = ImageOptions(topic, wanted.quantity)
        own = {"bag": self.bag, "topic": topic, "fields": fields, "options": options}
        return SimpleNamespace(**own, packets_ns=None)

    def transform_time(self, topic: str) -> str:
        """Return the time of the transforms of a topic."""
        return str(self._times[topic])


def _wanted(name: str, each: dict[str, Any]) -> Wanted:
    quantity: Any = SimpleNamespace(**each["quantity"])
    path = None if each["path"] is None else path_in(each["topic"], each["path"])
    source = Source(each["topic"], tuple(each["fields"]), path, each["names"])
    return Wanted((name,), quantity, source, each["stream"])


def _time(time: Any) -> Any:
    return NodeStamp(**time) if isinstance(time, dict) else time


class NodePolicy:
    """Policy as an ONNX model."""

    name = "the policy"

    def __init__(
        self, model: bytes, frame_stack: int, inputs: dict[str, str], chunk: Chunks
    ) -> None:
        """Load the model, whose `inputs` are the parts of an observation."""
        runtime = importlib.import_module("onnxruntime")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = runtime.InferenceSession(model, options)
        self.frame_stack, self._frames = frame_stack, FrameStack(frame_stack)
        self._inputs = inputs
        self._chunk, self._execution = chunk, ChunkExecution(chunk)

    def begin(self) -> None:
        """Drop the frames and chunks of the episode before."""
        self._frames.clear()
        self._execution.clear()

    def interrupt(self) -> None:
        """Drop the actions that were predicted for the next steps."""
        self._execution.clear()

    def act(self, observations: Any) -> Any:
        """Return the action (1, *shape) of an observation (1, *shape), or of a dict of them."""
        parts = parts_of(observations)
        if self.frame_stack > 1:
            parts = self._frames.see(parts)
        inputs = {name: parts[part] for name, part in self._inputs.items()}

        def predict() -> Any:
            return self._session.run(["action"], inputs)[0]

        return predict() if self._chunk.length == 1 else self._execution.act(1, predict)


def node_driver(spec: dict[str, Any], model: str) -> DriverCore:
    """Return the driver of a node; `model` is the ONNX model in base64."""
    plan: Any = NodePlan(spec)
    chunk, inputs = Chunks(**spec["chunk"]), spec["inputs"]
    policy = NodePolicy(base64.b64decode(model), spec["frame_stack"], inputs, chunk)
    shapes = {name: tuple(shape) for name, shape in spec["shapes"].items()}
    live, episodes = LiveSteps(plan, shapes), LiveEpisodes(plan, policy.frame_stack)
    return DriverCore(plan, live, episodes, CommandMessages.of_plain(spec["commands"]), policy)


class NodeProgram:
    """The node: subscriptions, steps and commands."""

    def __init__(self, driver: DriverCore, node: Any, qos: Any) -> None:
        """Subscribe to the inputs, and announce the commands."""
        self._driver, self._node, self.is_over = driver, node, False
        self._reason: str | None = None
        self._last_ns = self._now_ns()
        self._publishers = {
            topic: (node.create_publisher(_message_type(kind), topic, 10), _message_type(kind))
            for topic, kind in driver.outputs.items()
        }
        for topic, kind in driver.inputs.items():
            # Static transforms are sent once, before the node starts.
            own = qos["static"] if topic.endswith("_static") else qos["sensors"]
            kind_of = _message_type(kind)
            node.create_subscription(kind_of, topic, self._receiver(topic), own)
        period_ns = driver.period_ns
        node.create_timer(_SILENCE_S if period_ns is None else period_ns / 1e9, self._tick)

    def stop(self) -> None:
        """Publish the stop command."""
        self._publish(self._driver.stop)

    def _now_ns(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)

    def _receiver(self, topic: str) -> Any:
        def receive(message: Any) -> None:
            try:
                self._driver.push(topic, message, self._now_ns())
            except Exception as error:
                self._fail(str(error))
                return
            if topic == self._driver.clock_topic:
                self._step(self._now_ns())

        return receive

    def _tick(self) -> None:
        now_ns = self._now_ns()
        if self._driver.clock_topic is not None:
            if now_ns - self._last_ns > _SILENCE_S * 1e9:
                self._say(f"no message of {self._driver.clock_topic}")
                self.stop()
            return
        next_ns = self._driver.next_step_ns
        # Steps that were missed are left out.
        while next_ns is not None and next_ns + (self._driver.period_ns or 0) <= now_ns:
            next_ns += self._driver.period_ns or 0
        if next_ns is None or next_ns <= now_ns:
            self._step(now_ns if next_ns is None else next_ns)

    def _step(self, now_ns: int) -> None:
        self._last_ns = self._now_ns()
        command = self._driver.command(now_ns)
        self._say(command.reason)
        if command.is_fatal:
            self._fail(command.reason)
        else:
            self._publish(command.messages)

    def _say(self, reason: str) -> None:
        if reason != self._reason:
            self._reason = reason
            self._node.get_logger().info(reason or "the policy drives")

    def _fail(self, reason: str) -> None:
        self.stop()
        self._node.get_logger().error(reason)
        self.is_over = True

    def _publish(self, messages: dict[str, Any]) -> None:
        for topic, values in messages.items():
            publisher, kind = self._publishers[topic]
            publisher.publish(_filled(kind(), values))


def _message_type(name: str) -> Any:
    package, *_, last = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), last)


def _filled(message: Any, values: dict[str, Any]) -> Any:
    """Return a message of rclpy with the values of nested dicts."""
    for name, value in values.items():
        if isinstance(value, dict):
            _filled(getattr(message, name), value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            kind = message.get_fields_and_field_types()[name]
            element = _message_type(kind.partition("<")[2].rstrip(">").partition(",")[0])
            setattr(message, name, [_filled(element(), each) for each in value])
        else:
            setattr(message, name, value)
    return message


def main(spec: dict[str, Any], model: str) -> None:
    """Run the node until it is stopped, or until an error."""
    rclpy = importlib.import_module("rclpy")
    quality = importlib.import_module("rclpy.qos")
    rclpy.init()
    node = rclpy.create_node("mcaprl_driver")
    static = quality.QoSProfile(depth=100, durability=quality.DurabilityPolicy.TRANSIENT_LOCAL)
    qos = {"sensors": quality.qos_profile_sensor_data, "static": static}
    program = NodeProgram(node_driver(spec, model), node, qos)
    try:
        while rclpy.ok() and not program.is_over:
            rclpy.spin_once(node, timeout_sec=0.1)
    except KeyboardInterrupt:
        pass
    finally:
        program.stop()
        node.destroy_node()
        rclpy.try_shutdown()
    sys.exit(1 if program.is_over else 0)
