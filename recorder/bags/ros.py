"""Decoder of ROS messages.

The definitions of the types come from the bag, or else from the user's definition files, or else
from a ROS distribution.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from mcaprl.recorder.bags.wide_strings import WideForms
from mcaprl.recorder.format.reading import (
    ROS1,
    TypeSource,
    definitions_of,
    full_name,
    leaf_kinds,
)


class RosDecoder:
    """Decoder of one ROS type.

    Attributes:
        fields: Kind of each leaf field by its dotted path; see `bag.TopicInfo`.
        constants: Constants of the type by name.
        unreadable: Reason by dotted path for each field that cannot be read.
        is_open: Whether messages can have other fields than these.
    """

    is_open = False

    def __init__(
        self,
        type_name: str,
        text: str,
        *,
        encoding: str = "ros2msg",
        distribution: str = "",
        others: TypeSource | None = None,
    ) -> None:
        """Parse the definition."""
        self._is_ros1 = encoding == ROS1
        self._name = full_name(type_name)
        self._definitions = definitions_of(self._name, text, encoding, distribution, others)
        self.constants = self._definitions.constants
        self.unreadable, types = self._definitions.unreadable, self._definitions.types
        self._wide: WideForms | None = None
        if self.unreadable and not self._is_ros1:
            with suppress(ValueError):
                self._wide = WideForms(self._definitions.whole, self._name)
        if self._wide is not None:
            # The fields after wide strings can be found.
            self.unreadable = {path: self.unreadable[path] for path in self._wide.paths}
            types = self._wide.types
        self.fields = leaf_kinds(types, self._name, inner=True)

    def decode(self, data: bytes) -> Any:
        """Decode a message to an object with an attribute for each field."""
        whole = None if self._wide is None else self._wide.decode(data)
        return self._definitions.decode(data, is_ros1=self._is_ros1) if whole is None else whole
