"""A mapping resolved against a bag: topics, fields and expressions."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from collections.abc import Mapping as MappingOf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.bags.bag import Bag
from mcaprl.recorder.mapping.align import TopicStream, topic_of
from mcaprl.recorder.mapping.config import (
    Clock,
    Mapping,
    Place,
    Quantity,
    Stamp,
    TimeSource,
)
from mcaprl.recorder.mapping.expression import Expression
from mcaprl.recorder.mapping.images import ImageReader
from mcaprl.recorder.mapping.observe import Source, source_of

Columns = MappingOf[str, NDArray[Any]]
Reward = Callable[[Columns, NDArray[np.int64]], NDArray[np.float64]]
"""Function that returns all rewards, given the columns and the row that follows each step."""


class Wanted(NamedTuple):
    """A quantity that is read from the bag.

    Attributes:
        keys: Keys of the quantity in the mapping.
        quantity: Quantity of the mapping.
        source: Topic and fields of the quantity.
        stream: Name of the stream with the messages; not used for transforms.
        is_during: Whether each step uses the last message before the next step.
    """

    keys: tuple[str, ...]
    quantity: Quantity
    source: Source
    stream: str
    is_during: bool = False


class Plan:
    """A mapping resolved against a bag.

    Attributes:
        bag: Bag to read.
        mapping: Mapping of the bag's topics.
        place: Positions of the mapping's keys in its file, for error messages.
        quantities: Observed and other quantities, by name.
        images: Readers of the observed images, by name.
        behavior: Probability or log density of the action; None if unknown.
        commands: Fields of the action; empty if it consists of expressions.
        expressions: Expressions of the action.
        conditions: Conditions of the episodes: `begin`, `end`, `terminated`, `truncated`.
        reasons: Conditions of the end reasons, by reason.
        reward: Function that computes the rewards.
        labels: Names of the labels that reward, conditions and reasons use, such as `success`.
        streams: Messages of the used topics by the name of the stream, without those of transforms.
        clock: Name of the stream with a message for each step; None for a fixed rate.
        frames: Coordinate frames of the transforms, by topic.
        constants: Constants of the message types, by name; names with several values are omitted.
    """

    def __init__(
        self,
        bag: Bag,
        mapping: Mapping,
        place: Place,
        *,
        trust_code: bool,
        packets_ns: MappingOf[str, float] | None = None,
    ) -> None:
        """Resolve all paths and parse all expressions; for `packets_ns`, see `ImageReader`."""
        self._packets_ns = packets_ns
        self.bag, self.mapping, self.place = bag, mapping, place
        self.quantities = {
            name: self._wanted((section, name), quantity)
            for section in ("observation", "fields")
            for name, quantity in getattr(mapping, section).items()
        }
        self.images = {
            name: self._image_reader(name)
            for name, quantity in mapping.observation.items()
            if quantity.pixels is not None
        }
        action = mapping.action
        is_during = action.align == "during"
        align = action.align if action.align != "during" else "last"
        paths = [action.field] if action.field is not None else action.fields
        self.commands = [
            self._wanted(
                ("action",),
                Quantity(
                    field=path,
                    align=align,
                    tolerance_s=action.tolerance_s,
                    time=action.time,
                    names=action.selected,
                    names_from=action.names_from,
                ),
                is_during=is_during,
            )
            for path in paths
        ]
        self.expressions = [
            self._expression(("action", "expressions", number), text)
            for number, text in enumerate(action.expressions)
        ]
        for number, expression in enumerate(self.expressions):
            if expression.labels:
                raise UsageError(
                    f"{place.of('action', 'expressions', number)}: an action cannot depend on"
                    " labels, which a robot does not have: use them in `reward` or `episodes`"
                )
        self.behavior = None
        if (behavior := mapping.behavior) is not None:
            key, quantity = behavior
            has_align = "align" in quantity.model_fields_set
            same = {} if has_align else {"align": align}
            self.behavior = self._wanted(
                (key,),
                quantity.model_copy(update={**same, "time": quantity.time or action.time}),
                is_during=is_during and not has_align,
            )
        episodes = mapping.episodes
        self.conditions = {
            name: self._expression(("episodes", name), getattr(episodes, name))
            for name in ("begin", "end", "terminated", "truncated")
            if getattr(episodes, name) is not None
        }
        self.reasons = {
            name: self._expression(("episodes", "reasons", name), text)
            for name, text in episodes.reasons.items()
        }
        with place.named("reward"):
            self.reward, reward = _reward_of(mapping.reward, trust_code=trust_code)
        parsed = (*self.conditions.values(), *self.reasons.values(), *filter(None, (reward,)))
        self.labels = frozenset().union(*(each.labels for each in parsed))
        self.streams: dict[str, TopicStream] = {}
        self.clock: str | None = None
        self._open_streams()
        self.frames: dict[str, set[str]] = {}
        for _, quantity, source, *_ in self.quantities.values():
            if quantity.transform is not None:
                frames = self.frames.setdefault(source.topic, set())
                frames |= {quantity.transform, quantity.in_}
        self.constants = self._constants()

    def _wanted(
        self, keys: tuple[str, ...], quantity: Quantity, *, is_during: bool = False
    ) -> Wanted:
        with self.place.named(*keys):
            source = source_of(self.bag, quantity)
            return Wanted(keys, quantity, source, self._name(source.topic, quantity), is_during)

    def _name(self, topic: str, part: Quantity | Clock) -> str:
        """Return the name of the stream of a topic, whose times a part of the mapping chooses."""
        time = part.time or self.mapping.time
        return topic if time == self.mapping.time else f"{topic} by {_text(time)}"

    @property
    def required(self) -> list[str]:
        """Names of the observed quantities, and of poses, without which there is no step."""
        found = self.mapping.observation
        names = [n for n, each in found.items() if each.missing is None or each.pixels is not None]
        return list(dict.fromkeys([*names, *self._poses]))

    @property
    def observed(self) -> list[str]:
        """Names of the quantities that an observation is made of."""
        return list(dict.fromkeys([*self.mapping.observation, *self._poses]))

    @property
    def _poses(self) -> list[str]:
        return [name for each in self.mapping.observation.values() for name in each.around or ()]

    def transform_time(self, topic: str) -> TimeSource:
        """Return the time of the transforms of a topic."""
        times = {
            wanted.quantity.time or self.mapping.time
            for wanted in self.quantities.values()
            if wanted.quantity.transform is not None and wanted.source.topic == topic
        }
        time = times.pop()
        if times or isinstance(time, Stamp):
            raise UsageError(
                f"{self.place.of('observation')}: all transforms of {topic} need the same"
                " time: log_time, publish_time or header (the stamp of each transform)"
            )
        return time

    def leave_out_images(self) -> None:
        """Leave out the messages without a readable image, as far as known."""
        for name, reader in self.images.items():
            self.streams[self.quantities[name].stream].leave_out(reader.failures)

    def _image_reader(self, name: str) -> ImageReader:
        keys, quantity, source, *_ = self.quantities[name]
        with self.place.named(*keys):
            return ImageReader(
                self.bag,
                source.topic,
                quantity,
                name=name,
                strict=self.mapping.strict,
                packets_ns=self._packets_ns,
            )

    def _expression(self, keys: tuple[str | int, ...], text: str) -> Expression:
        with self.place.named(*keys):
            return Expression(text)

    def _constants(self) -> dict[str, NDArray[Any]]:
        found: dict[str, set[int]] = {}
        for stream in self.streams.values():
            for name, value in self.bag.topics[stream.topic].constants.items():
                found.setdefault(name, set()).add(value)
        return {name: np.array(min(each)) for name, each in found.items() if len(each) == 1}

    def _open_streams(self) -> None:
        behavior = [] if self.behavior is None else [self.behavior]
        every = [*self.quantities.values(), *self.commands, *behavior]
        fields: dict[str, set[str]] = {}
        for wanted in every:
            fields.setdefault(wanted.stream, set()).update(wanted.source.fields)
        for wanted in every:
            if wanted.quantity.transform is None:
                names = fields[wanted.stream]
                self._open(wanted.keys, wanted.stream, wanted.source.topic, wanted.quantity, names)
        clock = self.mapping.clock
        if clock.topic is not None:
            with self.place.named("clock", "topic"):
                self.clock = self._name(topic_of(self.bag, clock.topic), clock)
            self._open(("clock",), self.clock, clock.topic, clock, ())

    def _open(
        self,
        keys: tuple[str, ...],
        name: str,
        topic: str,
        part: Quantity | Clock,
        fields: Iterable[str],
    ) -> None:
        if name not in self.streams:
            with self.place.named(*keys):
                time = part.time or self.mapping.time
                self.streams[name] = TopicStream(self.bag, topic, fields, time)


def _text(time: TimeSource | Stamp) -> str:
    return f"{time.field} in {time.unit}" if isinstance(time, Stamp) else time


def _reward_of(text: str, *, trust_code: bool) -> tuple[Reward, Expression | None]:
    """Return the function that computes the rewards of all steps, and its expression if any."""
    module, colon, name = text.partition(":")
    if not colon or not module.replace(".", "").isidentifier():
        expression = Expression(text)

        def evaluated(columns: Columns, following: NDArray[np.int64]) -> NDArray[np.float64]:
            return expression.evaluate(columns, following).astype(np.float64)

        return evaluated, expression
    if not trust_code:
        raise UsageError(
            f"the function '{text}' is Python code: pass `trust_code=True` if you trust the mapping"
        )
    try:
        function = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise UsageError(f"the function '{text}' cannot be imported: {error}") from error

    def rewards(columns: Columns, following: NDArray[np.int64]) -> NDArray[np.float64]:
        found = np.asarray(function(columns, following), np.float64)
        if found.shape != following.shape:
            raise UsageError(
                f"the function '{text}' returned shape {found.shape}, expected"
                f" {following.shape}: one reward for each step"
            )
        return found

    return rewards, None
