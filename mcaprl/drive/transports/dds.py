"""DDS without ROS, by Eclipse Cyclone DDS; ROS 2 nodes of any vendor's DDS see usual ROS topics.

The topic `/cmd_vel` is `rt/cmd_vel` in DDS, and the type `geometry_msgs/msg/Twist` is
`geometry_msgs::msg::dds_::Twist_`. Its IDL is made from the message definition, so that vendors can
compare types; the bytes are those of rosbags (XCDR1, little-endian).
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from rosbags.interfaces import Nodetype

from mcaprl.drive.transports import Receive, Wire
from mcaprl.errors import UsageError, import_extra
from mcaprl.system import bind_to_interface, udp_sockets

LOOPBACK = "lo"
_CONFIG = """<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="{interface}"/>
</Interfaces><AllowMulticast>{multicast}</AllowMulticast></General><Discovery>
<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>{peers}
</Discovery></Domain></CycloneDDS>"""
_PEERS = '<Peers><Peer Address="127.0.0.1"/></Peers>'
_MAX_DOMAIN = 232
_KEPT = 100  # Number of messages of a topic that wait until they are taken
_LATCHED = "tf_static"
_BLOCKING_NS, _ACKNOWLEDGE_NS = 100_000_000, 500_000_000
_NAMES = {"bool": bool, "string": str, "octet": "byte", "char": "uint8"}


class DdsTransport:
    """Topics of a DDS domain."""

    encoding = "cdr"

    def __init__(self, *, domain_id: int | None = None, interface: str | None = None) -> None:
        """Choose the domain, by default ROS_DOMAIN_ID or 0; no interface: this machine."""
        given = os.environ.get("ROS_DOMAIN_ID", "") or "0" if domain_id is None else str(domain_id)
        if not given.isdecimal() or int(given) > _MAX_DOMAIN:
            raise UsageError(f"a domain ID is a number from 0 to {_MAX_DOMAIN}: '{given}'")
        self._id, self._interface = int(given), interface or LOOPBACK
        if not re.fullmatch(r"[\w.:-]+", self._interface):
            raise UsageError(f"'{self._interface}' is not a network interface")
        self._domain: Any = None
        self._participant: Any = None
        self._writers: dict[str, tuple[Any, Any]] = {}

    def open(
        self, inputs: Mapping[str, Wire], outputs: Mapping[str, Wire], receive: Receive
    ) -> None:
        """Join the domain."""
        core = import_extra("cyclonedds.core", "dds")
        self._wires = {f"rt{topic}": (topic, wire) for topic, wire in {**inputs, **outputs}.items()}
        self._join(core)
        self._readers = [self._reader(core, *each, receive) for each in inputs.items()]
        self._writers = {topic: self._writer(core, topic, wire) for topic, wire in outputs.items()}
        builtin = import_extra("cyclonedds.builtin", "dds")
        kinds = (builtin.BuiltinTopicDcpsPublication, builtin.BuiltinTopicDcpsSubscription)
        self._others = [builtin.BuiltinDataReader(self._participant, kind) for kind in kinds]

    def publish(self, topic: str, data: bytes) -> None:
        """Publish an encoded message."""
        writer, sample_type = self._writers[topic]
        sample = sample_type.__new__(sample_type)
        sample.data = data
        writer.write(sample)

    def check(self) -> None:
        """Raise a `UsageError` if another participant has another type on one of the topics."""
        for reader in self._others:
            for found in reader.take(_KEPT):
                if getattr(found, "topic_name", None) in self._wires:
                    topic, wire = self._wires[found.topic_name]
                    wire.check(topic, _ros_name(found.type_name))

    def now_ns(self) -> int:
        """Return the time of this machine."""
        return time.time_ns()

    def close(self) -> None:
        """Wait for acknowledgments of the last commands, and leave the domain."""
        for writer, _ in self._writers.values():
            with suppress(Exception):
                writer.wait_for_acks(_ACKNOWLEDGE_NS)
        self._writers, self._readers, self._others = {}, [], []
        self._participant = self._domain = None

    def _join(self, core: Any) -> None:
        domains = import_extra("cyclonedds.domain", "dds")
        is_local = self._interface == LOOPBACK
        config = _CONFIG.format(
            interface=self._interface,
            multicast="false" if is_local else "spdp",
            peers=_PEERS if is_local else "",
        )
        before = udp_sockets()
        if is_local and before is None:
            raise UsageError(
                "this system cannot keep DDS on this machine: choose a network by `interface`"
            )
        try:
            self._domain = domains.Domain(self._id, config)
            self._participant = domains.DomainParticipant(self._id)
        except core.DDSException as error:
            raise UsageError(
                f"cannot join DDS domain {self._id} on {self._interface}: {error}"
            ) from error
        if is_local:
            # Cyclone receives on all addresses, also if it sends on one interface alone.
            for number in (udp_sockets() or set()) - (before or set()):
                bind_to_interface(number, LOOPBACK)

    def _reader(self, core: Any, topic: str, wire: Wire, receive: Receive) -> Any:
        found, qos, sample_type = self._topic(core, topic, wire, is_command=False)

        class Listener(core.Listener):  # type: ignore[misc]
            def on_data_available(self, reader: Any) -> None:
                for sample in reader.take(_KEPT):
                    # A sample without data says that its writer left.
                    if isinstance(sample, sample_type):
                        receive(topic, sample.data, time.time_ns())

        sub = import_extra("cyclonedds.sub", "dds")
        return sub.DataReader(self._participant, found, qos=qos, listener=Listener())

    def _writer(self, core: Any, topic: str, wire: Wire) -> tuple[Any, Any]:
        found, qos, sample_type = self._topic(core, topic, wire, is_command=True)
        pub = import_extra("cyclonedds.pub", "dds")
        return pub.DataWriter(self._participant, found, qos=qos), sample_type

    def _topic(self, core: Any, topic: str, wire: Wire, *, is_command: bool) -> Any:
        policy, is_latched = core.Policy, topic.endswith(_LATCHED)
        is_reliable = is_command or is_latched
        reliable, durability = policy.Reliability, policy.Durability
        qos = core.Qos(
            reliable.Reliable(_BLOCKING_NS) if is_reliable else reliable.BestEffort,
            durability.TransientLocal if is_latched else durability.Volatile,
            policy.History.KeepLast(1 if is_command else _KEPT),
            policy.DataRepresentation(use_cdrv0_representation=True),
        )
        sample_type = idl_type(wire)
        topics = import_extra("cyclonedds.topic", "dds")
        return topics.Topic(self._participant, f"rt{topic}", sample_type), qos, sample_type


def idl_type(wire: Wire) -> Any:
    """Return the IDL type of a topic; an object of it has the encoded message as `data`."""
    found = _idl(wire.definitions.whole, wire.type_name, {})

    def deserialize(cls: Any, data: bytes, /, **_: Any) -> Any:
        sample = cls.__new__(cls)
        sample.data = data
        return sample

    found.serialize = lambda self, **_: self.data
    found.deserialize = found.deserialize_key = classmethod(deserialize)
    return found


def _idl(types: Mapping[str, Any], name: str, known: dict[str, Any]) -> Any:
    if name not in known:
        idl = import_extra("cyclonedds.idl", "dds")
        fields = {field: _field(types, what, known) for field, what in types[name][1]}
        package, _, last = name.rpartition("/")
        typename = f"{package.replace('/', '::')}::dds_::{last}_"
        known[name] = idl.make_idl_struct(f"{last}_", typename, fields, dataclassify=False)
    return known[name]


def _field(types: Mapping[str, Any], description: Any, known: dict[str, Any]) -> Any:
    kinds = import_extra("cyclonedds.idl.types", "dds")
    kind, what = description
    if kind == Nodetype.NAME:
        return _idl(types, str(what), known)
    if kind == Nodetype.BASE:
        base, bound = what
        found = kinds.bounded_str[bound] if base == "string" and bound else _NAMES.get(base, base)
        if base == "wstring":
            raise UsageError("wide strings cannot be sent or received by DDS")
        return getattr(kinds, found) if isinstance(found, str) else found
    element, count = _field(types, what[0], known), what[1]
    if kind == Nodetype.ARRAY:
        return kinds.array[element, count]
    return kinds.sequence[element, count] if count else kinds.sequence[element]


def _ros_name(name: str) -> str:
    """Return the name in ROS of a type of DDS."""
    return name.replace("::dds_::", "::").removesuffix("_").replace("::", "/")
