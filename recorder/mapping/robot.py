"""What a policy needs to drive the robot whose bag it was trained on."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from mcaprl.errors import LogError
from mcaprl.recorder.bags.source import Definition
from mcaprl.recorder.mapping.config import Mapping as RobotMapping
from mcaprl.recorder.mapping.config import Place, parse_mapping
from mcaprl.recorder.mapping.plan import Plan
from mcaprl.recorder.mapping.transforms import STATIC


class Robot(NamedTuple):
    """Mapping of a robot's bag, with the types of its topics.

    Attributes:
        mapping: Mapping of the bag.
        topics: Definition of the type of each topic that the mapping uses.
        shapes: Shape of each quantity at a step: `()`, `(K,)`, or that of an image (H, W, C).
        step_ns: Typical time between two steps.
        packets_ns: Typical interval of the packets of each topic with a video.
    """

    mapping: RobotMapping
    topics: Mapping[str, Definition]
    shapes: Mapping[str, tuple[int, ...]]
    step_ns: int
    packets_ns: Mapping[str, float] = {}

    @classmethod
    def of_plan(cls, plan: Plan, shapes: Mapping[str, tuple[int, ...]], step_ns: int) -> Robot:
        """Return the robot of a plan."""
        behavior = [] if plan.behavior is None else [plan.behavior]
        used = {
            each.source.topic for each in (*plan.quantities.values(), *plan.commands, *behavior)
        }
        used |= {stream.topic for stream in plan.streams.values()}
        for topic in plan.frames:
            base = topic.removesuffix(STATIC)
            used |= {base, base + STATIC} & plan.bag.topics.keys()
        images = plan.mapping.observation.values()
        used |= {each.undistort for each in images if each.undistort is not None}
        topics = {topic: plan.bag.definition(topic) for topic in sorted(used)}
        readers = plan.images.values()
        packets = {each.topic: each.packets_ns for each in readers if each.packets_ns is not None}
        return cls(plan.mapping, topics, shapes, step_ns, packets)

    def to_json(self) -> dict[str, Any]:
        """Return the robot as JSON types."""
        return {
            "mapping": _plain(self.mapping.model_dump(mode="json", by_alias=True)),
            "topics": {name: _to_json(each) for name, each in self.topics.items()},
            "shapes": {name: list(shape) for name, shape in self.shapes.items()},
            "step_ns": self.step_ns,
            "packets_ns": dict(self.packets_ns),
        }

    @classmethod
    def from_json(cls, found: Any, where: str) -> Robot:
        """Return the robot of JSON types that `to_json` returned; `where` is for errors."""
        try:
            topics = {str(name): _from_json(each) for name, each in found["topics"].items()}
            shapes = {str(name): tuple(map(int, shape)) for name, shape in found["shapes"].items()}
            mapping = parse_mapping(found["mapping"], Place(where))
            packets = {str(name): float(ns) for name, ns in found.get("packets_ns", {}).items()}
            return cls(mapping, topics, shapes, int(found["step_ns"]), packets)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise LogError(f"{where} does not describe a robot ({error!r}): train again") from error


def _plain(tree: Any) -> Any:
    """Return keys and values with infinite numbers as texts, because JSON lacks them."""
    if isinstance(tree, dict):
        return {key: _plain(each) for key, each in tree.items()}
    if isinstance(tree, list):
        return [_plain(each) for each in tree]
    return str(tree) if isinstance(tree, float) and math.isinf(tree) else tree


def _to_json(definition: Definition) -> dict[str, str]:
    found = {
        name: getattr(definition, name)
        for name in ("type_name", "encoding", "schema_encoding", "distribution")
    }
    # A protobuf schema is not a text.
    if definition.encoding == "protobuf":
        return {**found, "schema_base64": base64.b64encode(definition.schema).decode()}
    return {**found, "schema": definition.schema.decode(errors="replace")}


def _from_json(found: Mapping[str, str]) -> Definition:
    kept = {
        name: str(found[name])
        for name in ("type_name", "encoding", "schema_encoding", "distribution")
    }
    if "schema_base64" in found:
        return Definition(**kept, schema=base64.b64decode(found["schema_base64"]))
    return Definition(**kept, schema=str(found["schema"]).encode())
