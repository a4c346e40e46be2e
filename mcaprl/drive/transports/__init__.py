"""Ways to a robot: DDS, ROS 1, ROS 2 and bags, with one protocol.

A transport carries bytes. `Wire` encodes and decodes them with the definitions of the bag.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.bags.decoders import decoder_of
from mcaprl.recorder.bags.source import Definition
from mcaprl.recorder.format.reading import ROS1, Definitions, definitions_of, full_name

Receive = Callable[[str, Any, int], None]
"""Function called in any thread with topic, message or its bytes, and time of arrival in ns."""


class Transport(Protocol):
    """Connection to the topics of a robot.

    Attributes:
        encoding: Encoding of the messages, `cdr` or `ros1`; empty for a bag, which is played as
            fast as possible.
    """

    encoding: str

    def open(
        self, inputs: Mapping[str, Wire], outputs: Mapping[str, Wire], receive: Receive
    ) -> None:
        """Subscribe to the inputs and advertise the outputs, by name of the topic."""

    def publish(self, topic: str, data: bytes) -> None:
        """Publish an encoded message."""

    def check(self) -> None:
        """Raise a `UsageError` if another node has another type on one of the topics."""

    def now_ns(self) -> int:
        """Return the time on the clock of arrivals, nanoseconds."""

    def close(self) -> None:
        """Deliver what was published, and disconnect."""


class Wire:
    """Type of a topic as a robot sends it: ROS 1 or ROS 2."""

    def __init__(self, topic: str, definition: Definition, encoding: str) -> None:
        """Use the definition of a bag, or of another kind of bag that of the distribution."""
        encoding = encoding or definition.encoding
        # Whether the robot's bag has the same encoding.
        self.is_own = definition.encoding == encoding
        if not self.is_own:
            definition = Definition(definition.type_name, encoding)
        forms = {"ros1": ROS1, "cdr": "ros2msg"}
        form = definition.schema_encoding or forms.get(encoding, "")
        # Definition of the type; without a text, it is that of the ROS distribution.
        self.definition, self._form = definition, form
        try:
            # Full name of the type, such as `geometry_msgs/msg/Twist`.
            self.type_name = definition.type_name
            if encoding in forms:
                self.type_name = full_name(self.type_name)
            self._decoder = decoder_of(
                encoding,
                definition.type_name,
                form,
                definition.schema,
                distribution=definition.distribution,
            )
        except LogError as error:
            raise UsageError(f"{topic} cannot be sent or received by ROS: {error}") from error

    @property
    def definitions(self) -> Definitions:
        """The type and all types that are nested in it."""
        text = self.definition.schema.decode(errors="replace")
        return definitions_of(self.type_name, text, self._form, self.definition.distribution)

    def encode(self, message: Any) -> bytes:
        """Encode a message, which may be nested dicts; fields that are left out are zero."""
        return self._decoder.encode(message)

    def decode(self, data: bytes) -> Any:
        """Decode a message."""
        return self._decoder.decode(data)

    def check(self, topic: str, type_name: str) -> None:
        """Raise a `UsageError` if a node has another type on the topic."""
        if type_name and full_name(type_name) != self.type_name:
            raise UsageError(
                f"a node has messages of {type_name} on {topic}; the mapping needs {self.type_name}"
            )
