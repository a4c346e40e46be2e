"""ROS 1 by rospy, and ROS 2 by rclpy; both pass the bytes of messages on as they are."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from importlib import import_module
from typing import Any

from mcaprl.drive.transports import Receive, Wire
from mcaprl.errors import UsageError

_NODE = "mcaprl_drive"
_KEPT = 100
_LATCHED = "tf_static"
_ACKNOWLEDGE_S = 0.5


class Ros2Transport:
    """Topics of ROS 2, by rclpy of the distribution that is sourced."""

    encoding = "cdr"

    def open(
        self, inputs: Mapping[str, Wire], outputs: Mapping[str, Wire], receive: Receive
    ) -> None:
        """Start a node."""
        rclpy = _imported("rclpy", "source a ROS 2, or drive by DDS, which needs none")
        signals, executors = import_module("rclpy.signals"), import_module("rclpy.executors")
        types = {topic: _ros2_type(wire) for topic, wire in {**inputs, **outputs}.items()}
        self._rclpy, self._context = rclpy, rclpy.Context()
        # The stop command is still to be published after a signal.
        options = signals.SignalHandlerOptions.NO
        rclpy.init(context=self._context, signal_handler_options=options)
        self._node = rclpy.create_node(_NODE, context=self._context)
        for topic in inputs:

            def on_message(data: bytes, topic: str = topic) -> None:
                receive(topic, data, time.time_ns())

            self._node.create_subscription(
                types[topic], topic, on_message, self._qos(topic), raw=True
            )
        self._publishers = {
            topic: self._node.create_publisher(types[topic], topic, self._qos(topic, depth=1))
            for topic in outputs
        }
        self._wires = {**inputs, **outputs}
        self._executor = executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def publish(self, topic: str, data: bytes) -> None:
        """Publish an encoded message."""
        self._publishers[topic].publish(data)

    def check(self) -> None:
        """Raise a `UsageError` if another node has another type on one of the topics."""
        for topic, wire in self._wires.items():
            for each in (
                *self._node.get_publishers_info_by_topic(topic),
                *self._node.get_subscriptions_info_by_topic(topic),
            ):
                wire.check(topic, each.topic_type)

    def now_ns(self) -> int:
        """Return the time of this machine."""
        return time.time_ns()

    def close(self) -> None:
        """Wait for acknowledgments of the last commands, and end the node."""
        wait = self._rclpy.duration.Duration(seconds=_ACKNOWLEDGE_S)
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(wait)
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()
        self._rclpy.shutdown(context=self._context)

    def _qos(self, topic: str, depth: int = 0) -> Any:
        """Return the usual QoS: reliable for commands and static transforms, else best effort."""
        qos, is_latched = import_module("rclpy.qos"), topic.endswith(_LATCHED)
        kind, durability = qos.ReliabilityPolicy, qos.DurabilityPolicy
        return qos.QoSProfile(
            depth=depth or _KEPT,
            reliability=kind.RELIABLE if depth or is_latched else kind.BEST_EFFORT,
            durability=durability.TRANSIENT_LOCAL if is_latched else durability.VOLATILE,
        )


class Ros1Transport:
    """Topics of ROS 1, by rospy and the master of ROS_MASTER_URI."""

    encoding = "ros1"

    def open(
        self, inputs: Mapping[str, Wire], outputs: Mapping[str, Wire], receive: Receive
    ) -> None:
        """Start a node."""
        rospy = _imported("rospy", "source a ROS 1, or install python3-rospy")
        rosgraph = import_module("rosgraph")
        if not rosgraph.is_master_online():
            raise UsageError(f"no ROS master answers at {rosgraph.get_master_uri()}: run roscore")
        rospy.init_node(_NODE, anonymous=True, disable_signals=True)
        self._rospy, self._wires = rospy, {**inputs, **outputs}
        self._types: dict[str, str] = {}

        def on_message(message: Any, topic: str) -> None:
            self._types[topic] = message._connection_header["type"]
            receive(topic, message._buff, time.time_ns())

        for topic in inputs:
            rospy.Subscriber(
                topic, rospy.AnyMsg, on_message, callback_args=topic, queue_size=_KEPT,
                tcp_nodelay=True,
            )  # fmt: skip
        self._publishers = {
            topic: rospy.Publisher(topic, _ros1_type(wire), queue_size=1, tcp_nodelay=True)
            for topic, wire in outputs.items()
        }

    def publish(self, topic: str, data: bytes) -> None:
        """Publish an encoded message."""
        publisher = self._publishers[topic]
        message = publisher.data_class()
        message.data = data
        with suppress(self._rospy.ROSException):  # The node was shut down by another one.
            publisher.publish(message)

    def check(self) -> None:
        """Raise a `UsageError` if another node has another type on one of the topics."""
        for topic, name in list(self._types.items()):
            self._wires[topic].check(topic, name)
        if self._rospy.is_shutdown():
            raise UsageError("the ROS master shut this node down")

    def now_ns(self) -> int:
        """Return the time of this machine."""
        return time.time_ns()

    def close(self) -> None:
        """Let the last commands go out, and end the node."""
        time.sleep(_ACKNOWLEDGE_S / 5)
        self._rospy.signal_shutdown("done")


def _imported(name: str, hint: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise UsageError(f"{name} cannot be imported ({error}): {hint}") from error


def _ros2_type(wire: Wire) -> Any:
    package, _, name = wire.type_name.split("/")
    module = _imported(f"{package}.msg", f"install and source the ROS package {package}")
    return getattr(module, name)


def _ros1_type(wire: Wire) -> Any:
    """Return a class of messages that are published as the bytes in their `data`."""
    text, md5 = wire.definitions.text(is_ros1=True), wire.definitions.md5()
    package, _, name = wire.type_name.split("/")

    def serialize(self: Any, buffer: Any) -> None:
        buffer.write(self.data)

    attributes = {
        "_type": f"{package}/{name}", "_md5sum": md5, "_full_text": text, "_has_header": False,
        "__slots__": ["data"], "_slot_types": ["uint8[]"], "serialize": serialize,
    }  # fmt: skip
    return type(name, (import_module("genpy").Message,), attributes)
