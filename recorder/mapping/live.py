"""Observations of a robot that is running, message by message, as a mapping specifies.

At each step, the observation equals that of `read_bag` for the messages up to the step's time: the
values of messages and their scaling, missing values and names are computed by the same functions.
Only alignments that look ahead are impossible.

Memory is bounded: a quantity has its last value, and each topic the messages after the last step,
of which the oldest ones are used early if there are too many.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.bags.bag import Stream, TopicInfo
from mcaprl.recorder.bags.decoders import MessageDecoder, decoder_of
from mcaprl.recorder.bags.source import Definition
from mcaprl.recorder.bags.values import (
    ABSENT,
    Lack,
    as_array,
    converted,
    element_of,
    kind_at,
    value_at,
    without_lacks,
)
from mcaprl.recorder.mapping.align import NS_PER_S, padded, pooled
from mcaprl.recorder.mapping.calibration import HeldCalibration
from mcaprl.recorder.mapping.config import TimeSource
from mcaprl.recorder.mapping.images import ImageReader, LiveVideo, kinds_of, parts_of
from mcaprl.recorder.mapping.observe import (
    Values,
    by_names,
    check_order,
    place_of,
    pose_of,
    scan_columns,
    shaped,
)
from mcaprl.recorder.mapping.plan import Plan, Wanted
from mcaprl.recorder.mapping.runs import GAP, NO_ACTION, RESTARTED, TIME_LIMIT
from mcaprl.recorder.mapping.transforms import (
    STATIC,
    Edge,
    Transform,
    Transforms,
    transforms_in,
    unit,
    yaw_of,
)

Floats = NDArray[np.float64]
Shapes = Mapping[str, tuple[int, ...]]
"""Shape of each quantity at a step: `()` for a number, `(K,)` for a vector; of images (H, W, C)."""

_MOST_PENDING = 1000
"""Largest number of messages of a topic that are newer than the last step."""
_MOST_IMAGES = 16
_MOST_FRAMES = 1000
_ROW = np.zeros(1, np.int64)
STATE = "state"
"""Key of the vector in an observation that also has images."""


class Topics:
    """A bag without messages: only the types of its topics."""

    paths: tuple[Path, ...] = ()
    recordings: tuple[int, ...] = ()
    cut: tuple[Path, ...] = ()

    def __init__(self, definitions: Mapping[str, Definition]) -> None:
        """Parse the definitions of the topics."""
        self.definitions = dict(definitions)
        self.decoders: dict[str, MessageDecoder] = {
            topic: decoder_of(
                each.encoding,
                each.type_name,
                each.schema_encoding,
                each.schema,
                distribution=each.distribution,
            )
            for topic, each in definitions.items()
        }
        self.topics: dict[str, TopicInfo] = {
            name: TopicInfo(
                name=name,
                type_name=self.definitions[name].type_name,
                encoding=self.definitions[name].encoding,
                count=1,
                first_ns=0,
                last_ns=0,
                fields=each.fields,
                constants=each.constants,
                is_open=each.is_open,
                unreadable=each.unreadable,
            )
            for name, each in self.decoders.items()
        }

    def times(self, topic: str) -> NDArray[np.int64]:
        """Return the times of no messages."""
        return np.empty(0, np.int64)

    def places(self, topic: str) -> NDArray[np.int64]:
        """Return the places of no messages."""
        return np.empty((0, 2), np.int64)

    def read(
        self, topic: str, fields: Sequence[str], rows: NDArray[np.int64] | None = None
    ) -> Stream:
        """Return no messages."""
        return Stream(np.empty(0, np.int64), {name: np.empty(0) for name in fields}, _ROW[:0])

    def failures(self, topic: str) -> Any:
        """Return no failures."""
        return iter(())

    def definition(self, topic: str) -> Definition:
        """Return the type of a topic's messages."""
        return self.definitions[topic]

    def again(self) -> Topics:
        """Return the topics."""
        return self

    def close(self) -> None:
        """Do nothing."""


class _Value:
    """Last value of a quantity."""

    def __init__(self, wanted: Wanted, kinds: Mapping[str, str], shape: tuple[int, ...] | None):
        self.wanted, self.shape = wanted, shape
        self._kinds = {name: kind_at(kinds, name) for name in wanted.source.fields}
        self.time_ns: int | None = None
        self._now: Values | None = None
        self._absent: Values | None = None

    def raw(self, message: Any) -> Any:
        """Return what is kept of a message."""
        return [converted(value_at(message, name), kind) for name, kind in self._kinds.items()]

    def take(self, time_ns: int, raw: Any) -> None:
        """Use a message, unless a later one was used."""
        if any(part is ABSENT for part in raw) or (
            self.time_ns is not None and time_ns < self.time_ns
        ):
            return
        self.time_ns, self._now = time_ns, None
        self._raw = raw

    def drop(self) -> None:
        """Drop the value, as if there had been no message."""
        self.time_ns = self._now = None

    def at(self, time_ns: int) -> Values:
        """Return the value at a step."""
        tolerance_s = self.wanted.quantity.tolerance_s
        if self.time_ns is None or self.time_ns > time_ns:
            return self.missing()
        age_s = (time_ns - self.time_ns) / NS_PER_S
        if tolerance_s is not None and age_s > tolerance_s:
            return self.missing()
        if self._now is None:
            self._now = self._shaped(self._converted(self._raw))
        return self._now._replace(age_s=np.array([age_s]))

    def missing(self) -> Values:
        """Return the value of a step without a message."""
        if self._absent is None:
            nothing = np.full((1, *(self.shape or ())), np.nan)
            self._absent = shaped(
                self.wanted.quantity, nothing, np.ones(1, np.bool_), np.full(1, np.nan)
            )
        return self._absent

    def _shaped(self, found: NDArray[Any]) -> Values:
        if found.dtype.kind == "O":
            return Values(found, np.array([found[0] is None]), np.zeros(1))
        if self.shape is None:
            self.shape, self._absent = found.shape[1:], None
        return shaped(self.wanted.quantity, found, np.zeros(1, np.bool_), np.zeros(1))

    def _converted(self, raw: Any) -> NDArray[Any]:
        """Return a message's number (1,) or numbers (1, K), NaN where missing, or text (1,)."""
        quantity, path = self.wanted.quantity, self.wanted.source.path
        assert path is not None, "the quantity is a field"
        if quantity.as_ == "yaw":
            return yaw_of(np.column_stack([_number(part, str(path)) for part in raw]))
        if quantity.scan is not None:
            return self._scanned(raw)
        value = raw[0]
        if len(raw) > 1:
            self._check_names(raw)
        if path.elements is not None and value is not None and not isinstance(value, Lack):
            value = element_of(value, path.elements)
        if value is None or isinstance(value, Lack):
            return np.full((1, *(self.shape or ())), np.nan)
        if isinstance(value, str):
            return without_lacks([value])
        row = as_array(value)
        if row is None:
            raise UsageError(f"{path} is not a number")
        if quantity.pad is not None:
            return padded([row], quantity.pad)
        if quantity.pool is not None:
            return pooled([row], quantity.pool, quantity.to or 0)
        return self._fitted(row)

    def _scanned(self, raw: Any) -> Floats:
        source, quantity = self.wanted.source, self.wanted.quantity
        assert source.path is not None, "a scan has a path"
        (row,) = scan_columns(source.fields, [without_lacks([part]) for part in raw], source.path)
        if quantity.to is not None:
            return pooled([row], quantity.pool or "min", quantity.to)
        return np.full((1, *(self.shape or ())), np.nan) if row is None else self._fitted(row)

    def _fitted(self, row: Floats) -> Floats:
        path = self.wanted.source.path
        shape = row.shape and (row.size,) if self.shape is None else self.shape
        if not row.size:
            return np.full((1, *shape), np.nan)
        if shape and row.ndim:
            flat, found = row.reshape(-1), np.full((1, *shape), np.nan)
            assert path is not None, "the quantity is a field"
            if len(flat) == shape[0] or (path.is_bounded and len(flat) < shape[0]):
                found[0, : len(flat)] = flat
                return found
        elif not shape and not row.ndim:
            return row.reshape(1)
        raise UsageError(
            f"{path} has the shape {row.shape}, but the policy was trained with {shape}"
        )

    def _check_names(self, raw: Any) -> None:
        path, before = self.wanted.source.path, getattr(self, "_named", raw)
        assert path is not None, "the quantity is a field"
        if raw[1] != before[1]:
            both = [before, raw]
            check_order(path, *(without_lacks([each[k] for each in both]) for k in range(2)))
        self._named = raw


class _NamedValue(_Value):
    """Last values of the elements with certain names, of which each may be in other messages."""

    def __init__(self, wanted: Wanted, kinds: Mapping[str, str], shape: tuple[int, ...] | None):
        names = wanted.quantity.names
        super().__init__(wanted, kinds, () if isinstance(names, str) else (len(names or ()),))
        self._count = 1 if isinstance(names, str) else len(names or ())
        self.drop()

    def drop(self) -> None:
        self._times: list[int | None] = [None] * self._count
        self._values = np.full(self._count, np.nan)
        self.time_ns = None

    def take(self, time_ns: int, raw: Any) -> None:
        path, quantity = self.wanted.source.path, self.wanted.quantity
        assert path is not None, "the quantity is a field"
        assert quantity.names, "elements are selected by names"
        if isinstance(raw[0], Lack) or isinstance(raw[1], Lack):
            return
        column, texts = (without_lacks([part]) for part in raw)
        found = by_names(path, column, texts, quantity.names, is_whole=False)
        assert found.present is not None
        values, present = found.values.reshape(-1), found.present.reshape(-1)
        for k in np.flatnonzero(present).tolist():
            before = self._times[k]
            if before is None or time_ns >= before:
                self._times[k], self._values[k] = time_ns, values[k]
        known = [each for each in self._times if each is not None]
        self.time_ns = max(known, default=None)

    def at(self, time_ns: int) -> Values:
        tolerance_s, values, ages_s = self.wanted.quantity.tolerance_s, self._values.copy(), []
        for k, each in enumerate(self._times):
            age_s = math.nan if each is None or each > time_ns else (time_ns - each) / NS_PER_S
            if tolerance_s is not None and age_s > tolerance_s:
                age_s = math.nan
            if math.isnan(age_s):
                values[k] = math.nan
            ages_s.append(age_s)
        is_missing = any(map(math.isnan, ages_s))
        oldest = max(ages_s, key=lambda age: -1.0 if math.isnan(age) else age)
        shape = (1, *cast(Any, self.shape))
        return shaped(
            self.wanted.quantity,
            values.reshape(shape),
            np.array([is_missing]),
            np.array([oldest]),
        )


class _Count(_Value):
    """Number of messages."""

    count = 0

    def raw(self, message: Any) -> Any:
        return None

    def take(self, time_ns: int, raw: Any) -> None:
        self.count += 1
        self.time_ns = max(time_ns, self.time_ns or time_ns)

    def drop(self) -> None:
        self.count, self.time_ns = 0, None

    def at(self, time_ns: int) -> Values:
        count = np.array([float(self.count)])
        return shaped(self.wanted.quantity, count, np.zeros(1, np.bool_), np.zeros(1))


class _Image(_Value):
    """Last image that can be decoded."""

    def __init__(
        self,
        wanted: Wanted,
        reader: ImageReader,
        shape: tuple[int, ...] | None,
        video: LiveVideo | None,
        camera: HeldCalibration | None,
    ) -> None:
        super().__init__(wanted, {}, shape)
        self._kinds = kinds_of(reader.bag.topics[reader.topic], reader.fields)
        self._reader, self.video, self._camera = reader, video, camera
        self._waiting: list[tuple[int, Any]] = []
        self._reason = ""
        # With `around`, this is a grid.
        self.image: Any = None
        if wanted.quantity.around is not None:
            assert wanted.quantity.size, "validated"
            self.shape = (*wanted.quantity.size[::-1], 1)

    def raw(self, message: Any) -> Any:
        return parts_of(message, self._kinds) if self.video is None else self.video.frame

    @property
    def lack(self) -> str:
        """Why there may be no image; empty if no reason is known."""
        if self._camera is not None and self._camera.rectifier is None:
            return f"no message of {self.wanted.quantity.undistort} yet"
        return (self.video.lack if self.video else "") or self._reason

    def take(self, time_ns: int, raw: Any) -> None:
        bisect.insort(self._waiting, (time_ns, raw), key=_first)
        del self._waiting[:-_MOST_IMAGES]

    def drop(self) -> None:
        self._waiting, self.time_ns, self.image, self._reason = [], None, None, ""

    def at(self, time_ns: int) -> Values:
        reader, camera, video = self._reader, self._camera, self.video
        if camera is not None:
            reader.options.rectifier = camera.rectifier
            if camera.rectifier is None:
                return Values(_ROW, np.ones(1, np.bool_), np.full(1, np.nan))
        while self._waiting:
            own_ns, raw = self._waiting.pop()
            if own_ns > time_ns:
                continue
            if self.time_ns is not None and own_ns < self.time_ns:
                break
            try:
                if self.wanted.quantity.around is not None:
                    self.time_ns, self.image = own_ns, reader.options.grid(raw)
                    self._reason = ""
                    break
                image = reader.options.image(raw) if video is None else reader.of_frame(raw)
            except LogError as error:
                self._reason = f"a message of {self.wanted.source.topic} cannot be used: {error}"
                continue
            if self.shape is not None and image.shape != self.shape:
                # Like in a bag, a video may have other frames between those of this size.
                if video is not None:
                    continue
                raise UsageError(
                    f"{self.wanted.source.topic} has an image of {image.shape} after crop and"
                    f" resize, but the policy was trained with {self.shape}"
                )
            self.time_ns, self.image, self.shape = own_ns, image, image.shape
            self._reason = ""
            break
        self._waiting = []
        tolerance_s = self.wanted.quantity.tolerance_s
        age_s = math.nan if self.time_ns is None else (time_ns - self.time_ns) / NS_PER_S
        if tolerance_s is not None and age_s > tolerance_s:
            age_s = math.nan
        return Values(_ROW, np.array([math.isnan(age_s)]), np.array([age_s]))


def _first(pair: tuple[int, Any]) -> int:
    return pair[0]


def _number(value: Any, name: str) -> Floats:
    """Return a number (1,), NaN where it is missing."""
    row = None if value is None or isinstance(value, Lack) else as_array(value)
    if row is None:
        return np.full(1, np.nan)
    if row.ndim:
        raise UsageError(f"{name} is not one quaternion; choose one of them by an index")
    return row.reshape(1)


class _Waiting:
    """Messages of a stream that are newer than the last step, in the order of time.

    Attributes:
        newest_ns: Time of the newest message; None before the first.
        first_ns: Time of the oldest message so far; None before the first.
        start_ns: Time of the last message that came after a gap; None if there was no gap.
        last_ns: Time of the last message up to the last step; None before the first.
        gap_ns: Times of the messages before and after a gap that ended since the step before; None
            if no gap did.
    """

    def __init__(
        self, take: Callable[[int, Any], None], gap_ns: float, most: int = _MOST_PENDING
    ) -> None:
        self._take, self._gap_ns, self._most = take, gap_ns, most
        self.drop()

    def drop(self) -> None:
        """Drop all messages."""
        self._pending: list[tuple[int, Any]] = []
        self.newest_ns: int | None = None
        self.first_ns: int | None = None
        self.start_ns: int | None = None
        self.last_ns: int | None = None
        self.gap_ns: tuple[int, int] | None = None

    def put(self, time_ns: int, content: Any) -> None:
        """Add a message."""
        if not self._pending or time_ns >= self._pending[-1][0]:
            self._pending.append((time_ns, content))
        else:
            bisect.insort(self._pending, (time_ns, content), key=_first)
        if self.newest_ns is not None and time_ns - self.newest_ns > self._gap_ns:
            self.start_ns = time_ns
        self.newest_ns = max(time_ns, self.newest_ns or time_ns)
        self.first_ns = min(time_ns, self.first_ns or time_ns)
        if len(self._pending) > self._most:
            self._take(*self._pending.pop(0))

    def pass_on(self, time_ns: int) -> None:
        """Pass on the messages up to a step, and find a gap between them."""
        count = bisect.bisect_right(self._pending, time_ns, key=_first)
        self.gap_ns = None
        for own_ns, content in self._pending[:count]:
            self._take(own_ns, content)
            if self.last_ns is not None and own_ns - self.last_ns > self._gap_ns:
                self.gap_ns = (self.last_ns, own_ns)
            self.last_ns = max(own_ns, self.last_ns or own_ns)
        del self._pending[:count]


class _Frames(Transforms):
    """Last transform of each frame of a topic."""

    def __init__(self, topic: str, time: TimeSource, gap_ns: float) -> None:
        self._gap_ns = gap_ns
        self.topic, self._time = topic.removesuffix(STATIC), time
        self.waiting: dict[str, _Waiting] = {}
        self.drop()

    def drop(self) -> None:
        """Drop all transforms but the static ones, which are sent once."""
        for waiting in self.waiting.values():
            waiting.drop()
        edges: dict[str, Edge] = getattr(self, "_edges", {})
        self._edges = {child: edge for child, edge in edges.items() if edge.is_static}
        parents: dict[str, list[str]] = getattr(self, "_parents", {})
        self._parents = {child: parents[child] for child in self._edges}

    def put(self, topic: str, message: Any, time_ns: int) -> list[int]:
        """Add the transforms of a message; return the times of those that are not static."""
        times_ns = []
        for each in transforms_in(message, topic, self._time, time_ns):
            parents = self._parents.setdefault(each.child, [])
            if each.parent not in parents:
                parents.append(each.parent)
            if len(self._parents) > _MOST_FRAMES:
                raise UsageError(f"{topic} has more than {_MOST_FRAMES} frames")
            now, edge = _edge(each), self._edges.get(each.child)
            if topic.endswith(STATIC) and (edge is None or edge.is_static):
                self._edges[each.child] = now._replace(is_static=True)
                continue
            if edge is None:
                self._edges[each.child] = now._replace(times_ns=_ROW[:0])
            elif edge.is_static:
                self._edges[each.child] = edge._replace(is_static=False)
            if each.child not in self.waiting:
                self.waiting[each.child] = _Waiting(self._taker(each.child), self._gap_ns)
            self.waiting[each.child].put(each.time_ns, now)
            times_ns.append(each.time_ns)
        return times_ns

    def moving(self, frame: str, fixed: str) -> list[_Waiting]:
        """Return the moving transforms between two frames."""
        path = [child for part in self._path(frame, fixed) for child in part]
        return [self.waiting[each] for each in path if not self._edges[each].is_static]

    def _taker(self, child: str) -> Callable[[int, Any], None]:
        def take(time_ns: int, now: Edge) -> None:
            edge = self._edges[child]
            if not len(edge.times_ns) or time_ns >= edge.times_ns[0]:
                self._edges[child] = now

        return take


def _edge(each: Transform) -> Edge:
    pose = np.array([each.pose()])
    position, quaternion = pose[:, :3], unit(pose[:, 3:])
    if not (np.isfinite(position).all() and np.isfinite(quaternion).all()):
        position, quaternion = np.full((1, 3), np.nan), np.full((1, 4), np.nan)
    return Edge(np.array([each.time_ns]), np.empty((1, 2), np.int64), position, quaternion, False)


class LiveStep(NamedTuple):
    """One step of a running robot.

    Attributes:
        time_ns: Time of the step.
        quantities: Values of each quantity by name, with one row.
        columns: Values in expressions by name, with one row.
        frame: Vector (D,) and images (H, W, C) of the observation by key, without a stack; None if
            it is not usable.
        reason: Why the observation is not usable; empty if it is.
        is_fatal: Whether the reason is an error, so that waiting does not help.
        gap_before: Whether there is a gap between the step and the one before it.
        gap_ns: Time of the last message before a gap; None if there is none.
    """

    time_ns: int
    quantities: dict[str, Values]
    columns: dict[str, NDArray[Any]]
    frame: dict[str, NDArray[Any]] | None
    reason: str
    is_fatal: bool
    gap_before: bool
    gap_ns: int | None


class LiveSteps:
    """Steps of a running robot.

    Attributes:
        topics: Topics whose messages are used.
        clock_ns: Time of the last message of the clock's topic; None before the first.
        lack: Why the last message of the clock's topic is no step; empty if it is.
        fields: Paths of the fields of each topic.
    """

    def __init__(self, plan: Plan, shapes: Shapes | None = None) -> None:
        """Prepare the quantities of a plan for `Topics`.

        Args:
            plan: Mapping, and types of the topics.
            shapes: Shapes of the quantities in the training; default: those of the first messages.

        Raises:
            UsageError: A quantity looks ahead.
        """
        _check_looks_back(plan)
        self._plan, self._gap_ns = plan, plan.mapping.episodes.gap_s * NS_PER_S
        self._videos: dict[str, LiveVideo] = {}
        self._cameras: dict[str, HeldCalibration] = {}
        self._frames = {
            topic: _Frames(topic, plan.transform_time(topic), self._gap_ns) for topic in plan.frames
        }
        self._values: dict[str, _Value] = {}
        self._members: dict[str, list[_Value]] = {name: [] for name in plan.streams}
        for name, wanted in plan.quantities.items():
            if wanted.quantity.transform is None:
                self._values[name] = self._value_of(name, wanted, (shapes or {}).get(name))
                self._members[wanted.stream].append(self._values[name])
        self._streams: dict[str, _Waiting] = {}
        self._with_frames: set[str] = set()
        self._any = _Waiting(lambda *_: None, self._gap_ns)
        self._of_topic: dict[str, list[str]] = {}
        used = {wanted.stream for wanted in plan.quantities.values()} | {plan.clock or ""}
        # The messages of the clock come first, because they shift those of the other streams.
        for name in sorted(used & plan.streams.keys(), key=lambda each: each != plan.clock):
            members = self._members[name]
            images = [each for each in members if isinstance(each, _Image)]
            self._with_frames |= {name} if any(each.video for each in images) else set()
            most = _MOST_IMAGES if images else _MOST_PENDING
            self._streams[name] = _Waiting(_taker(members), self._gap_ns, most)
            self._of_topic.setdefault(plan.streams[name].topic, []).append(name)
        tf = [each for one in self._frames.values() for each in (one.topic, one.topic + STATIC)]
        others = (*(each for each in tf if each in plan.bag.topics), *self._cameras)
        self.topics = tuple(dict.fromkeys((*self._of_topic, *others)))
        self.fields = {
            topic: sorted({path for name in names for path in plan.streams[name].fields})
            for topic, names in self._of_topic.items()
        }
        for topic, camera in self._cameras.items():
            self.fields[topic] = sorted({*self.fields.get(topic, ()), *camera.fields})
        self.clock_ns: int | None = None
        self.lack = ""
        self._raw_ns: int | None = None
        self._last_ns: int | None = None
        self._nth, self._problem = 0, ""

    def push(
        self, topic: str, message: Any, log_time_ns: int, publish_time_ns: int | None = None
    ) -> None:
        """Use a decoded message of one of the `topics`."""
        publish_ns = log_time_ns if publish_time_ns is None else publish_time_ns
        if topic in self._cameras:
            self._cameras[topic].push(message)
        if (video := self._videos.get(topic)) is not None:
            video.push(message, log_time_ns)
        for name in self._of_topic.get(topic, ()):
            time_ns = self._plan.streams[name].time_of(message, log_time_ns, publish_ns)
            lack = "" if video is None or name not in self._with_frames else video.lack
            if name == self._plan.clock:
                self.lack = lack
            # A packet without a frame is left out, as in a bag.
            if time_ns is None or lack:
                continue
            if name == self._plan.clock:
                time_ns = self._tick(time_ns)
            elif self._raw_ns == time_ns:
                time_ns += self._nth
            self._put(name, time_ns, [value.raw(message) for value in self._members[name]])
        for frames in self._frames.values():
            if topic in (frames.topic, frames.topic + STATIC):
                for time_ns in frames.put(topic, message, log_time_ns):
                    self._any.put(time_ns, None)

    def _put(self, name: str, time_ns: int, content: Any) -> None:
        stream = self._streams[name]
        if stream.newest_ns is not None and time_ns < stream.newest_ns - self._gap_ns:
            back_s = (stream.newest_ns - time_ns) / NS_PER_S
            self._problem = f"the clock of {name} went back by {back_s:.3g} s"
            return
        stream.put(time_ns, content)
        self._any.put(time_ns, None)

    def _tick(self, time_ns: int) -> int:
        """Return the time of a message of the clock; of equal times, each one is 1 ns later."""
        self._nth = self._nth + 1 if self._raw_ns == time_ns else 0
        self._raw_ns, tick_ns = time_ns, time_ns + self._nth
        before_ns = self.clock_ns
        if before_ns is not None and before_ns - self._gap_ns <= tick_ns <= before_ns:
            tick_ns = before_ns + 1
        self.clock_ns = tick_ns
        return tick_ns

    @property
    def anchor_ns(self) -> int | None:
        """Time of the first step at a fixed rate; None before the first message.

        It is that of the first message, or of the one that ended the last gap.
        """
        first_ns = self._any.first_ns
        if first_ns is None:
            return None
        found = [first_ns]
        for stream in self._required:
            if stream.first_ns is not None and stream.first_ns - first_ns > self._gap_ns:
                found.append(stream.first_ns)
            if stream.start_ns is not None:
                found.append(stream.start_ns)
        return max(found)

    @property
    def last_ns(self) -> int | None:
        """Time of the last message of an observed topic up to the last step; None if unknown.

        If no quantity is required, that of any topic.
        """
        required = self._streams_of(self._plan.required)
        every = self._streams_of(self._plan.observed) if required else [self._any]
        found = [each.last_ns for each in every]
        return max((each for each in found if each is not None), default=None)

    def reset(self) -> None:
        """Drop all values, as at the start of a recording; videos and calibrations go on."""
        parts: list[_Value | _Waiting | _Frames] = [*self._values.values(), *self._frames.values()]
        for part in [*parts, *self._streams.values(), self._any]:
            part.drop()
        self.clock_ns = self._raw_ns = self._last_ns = None
        self._nth, self._problem, self.lack = 0, "", ""

    def step(self, time_ns: int) -> LiveStep:
        """Return the quantities and the observation at a time after that of the last step.

        If a clock went back, all messages so far are dropped.

        Raises:
            UsageError: A message does not fit the training, such as an image of another size.
        """
        before_ns, self._last_ns = self._last_ns, time_ns
        if before_ns is not None and time_ns <= before_ns and not self._problem:
            self._problem = f"the clock went back by {(before_ns - time_ns) / NS_PER_S:.3g} s"
        if problem := self._problem:
            self.reset()
            return LiveStep(time_ns, {}, {}, None, problem, True, True, None)
        for stream in self._streams.values():
            stream.pass_on(time_ns)
        for frames in self._frames.values():
            for stream in frames.waiting.values():
                stream.pass_on(time_ns)
        quantities = {name: self._at(name, time_ns) for name in self._plan.quantities}
        reason, is_fatal = self._why_not(quantities, time_ns)
        images = self._plan.images
        columns = {name: each.values for name, each in quantities.items() if name not in images}
        self._any.pass_on(time_ns)
        required = self._required
        ended = [each.gap_ns for each in required if each.gap_ns is not None]
        silent = [
            each.last_ns
            for each in required
            if each.last_ns is not None and time_ns - each.last_ns > self._gap_ns
        ]
        is_late = before_ns is not None and time_ns - before_ns > self._gap_ns
        return LiveStep(
            time_ns,
            quantities,
            {**self._plan.constants, **columns},
            None if reason else self._frame(quantities),
            reason,
            is_fatal,
            is_late or bool(ended),
            min([*(low for low, _ in ended), *silent], default=None),
        )

    def _value_of(self, name: str, wanted: Wanted, shape: tuple[int, ...] | None) -> _Value:
        topics, topic = self._plan.bag.topics, wanted.source.topic
        kinds, quantity = topics[topic].fields, wanted.quantity
        if (reader := self._plan.images.get(name)) is not None:
            camera = None
            if quantity.undistort is not None:
                with self._plan.place.named(*wanted.keys):
                    camera = HeldCalibration(topics, quantity.undistort)
                camera = self._cameras.setdefault(quantity.undistort, camera)
            video = None
            if reader.packets_ns is not None:
                video = self._videos.setdefault(topic, reader.live_video())
            return _Image(wanted, reader, shape, video, camera)
        if quantity.as_ == "count":
            return _Count(wanted, {}, ())
        has_names = bool(quantity.names and wanted.source.names)
        return (_NamedValue if has_names else _Value)(wanted, kinds, shape)

    def _streams_of(self, names: Iterable[str]) -> list[_Waiting]:
        """Return the streams of quantities."""
        found = []
        for name in names:
            wanted = self._plan.quantities[name]
            if wanted.quantity.transform is None:
                found.append(self._streams[wanted.stream])
                continue
            with suppress(UsageError):
                frames = self._frames[wanted.source.topic]
                found += frames.moving(wanted.quantity.transform, wanted.quantity.in_)
        return found

    @property
    def _required(self) -> list[_Waiting]:
        """Streams without whose messages there is no step; if there are none, that of all."""
        return self._streams_of(self._plan.required) or [self._any]

    def _at(self, name: str, time_ns: int) -> Values:
        wanted = self._plan.quantities[name]
        with self._plan.place.named(*wanted.keys):
            if wanted.quantity.transform is None:
                return self._values[name].at(time_ns)
            try:
                frames, gap_s = self._frames[wanted.source.topic], self._gap_ns / NS_PER_S
                return pose_of(wanted.quantity, frames, np.array([time_ns]), gap_s)
            # There is no path between the frames yet.
            except UsageError:
                nothing = np.full((1, len(wanted.quantity.parts)), np.nan)
                return shaped(wanted.quantity, nothing, np.ones(1, np.bool_), nothing[:, 0])

    def _why_not(self, quantities: dict[str, Values], time_ns: int) -> tuple[str, bool]:
        """Return why there is no observation, and whether waiting does not help."""
        for name in self._plan.required:
            found, topic = quantities[name], self._plan.quantities[name].source.topic
            age_s = abs(float(found.age_s[0]))
            if age_s * NS_PER_S > self._gap_ns:
                return f"{name}: the last message of {topic} is {age_s:.3g} s old", False
            if found.missing[0]:
                if not math.isnan(age_s):
                    return f"{name} of {topic} has no number, or one that is not finite", True
                return f"{name}: {self._waits_for(name, time_ns)}", False
        for name, value in self._values.items():
            if name in self._plan.mapping.observation and value.shape is None:
                return f"{name}: no message of {value.wanted.source.topic} yet", False
        return "", False

    def _waits_for(self, name: str, time_ns: int) -> str:
        wanted, image = self._plan.quantities[name], self._values.get(name)
        topic, quantity = wanted.source.topic, wanted.quantity
        if isinstance(image, _Image) and image.lack:
            return image.lack
        if quantity.transform is not None:
            return f"{topic} has no new pose of '{quantity.transform}' in '{quantity.in_}'"
        last_ns, newest_ns = self._values[name].time_ns, self._streams[wanted.stream].newest_ns
        if last_ns is not None:
            return f"the last message of {topic} is {(time_ns - last_ns) / NS_PER_S:.3g} s old"
        if newest_ns is not None and newest_ns > time_ns:
            ahead_s = (newest_ns - time_ns) / NS_PER_S
            return f"the messages of {topic} are {ahead_s:.3g} s ahead of the clock"
        return f"no message of {topic}{'' if newest_ns is None else ' with a value'} yet"

    def _frame(self, quantities: dict[str, Values]) -> dict[str, NDArray[Any]]:
        """Return the vector (D,) and the images of an observation, without a stack."""
        names = self._plan.mapping.observation.keys()
        images = {name: self._values[name] for name in names if name in self._plan.images}
        vector = [quantities[name].values.reshape(-1) for name in names if name not in images]
        found = {name: value.image for name, value in images.items() if isinstance(value, _Image)}
        for name in images:
            around = self._plan.mapping.observation[name].around
            if around is not None:
                (pose,) = place_of(around, quantities)
                found[name] = self._plan.images[name].options.around(found[name], pose)
        assert all(image is not None for image in found.values()), "the observation is usable"
        state = {STATE: np.concatenate(vector).astype(np.float32)} if vector else {}
        return cast("dict[str, NDArray[Any]]", {**state, **found})


def _taker(values: list[_Value]) -> Callable[[int, Any], None]:
    def take(time_ns: int, parts: Any) -> None:
        for value, part in zip(values, parts, strict=True):
            value.take(time_ns, part)

    return take


def _check_looks_back(plan: Plan) -> None:
    """Check that no quantity needs messages after the step."""
    for wanted in plan.quantities.values():
        if wanted.quantity.align != "last":
            raise UsageError(
                f"{plan.place.of(*wanted.keys, 'align')}: `{wanted.quantity.align}` looks ahead,"
                " and a robot lacks the messages after the step: use `last`, and train again"
            )


class Ending(NamedTuple):
    """End of an episode.

    Attributes:
        steps_ago: Number of steps since the final observation: 0 or 1, or 2 if the conditions of
            the episodes use `next`.
        terminated: Whether the final observation is a terminal state.
        truncated: Whether the episode was truncated.
        reason: Reason of the end; empty if a condition of the mapping ended the episode.
    """

    steps_ago: int
    terminated: bool
    truncated: bool
    reason: str


class EpisodeState(NamedTuple):
    """State of the episodes at a step.

    Attributes:
        is_open: Whether an episode goes on after this step.
        began: Whether an episode began, with the observation of this step, or with the one before
            if the conditions use `next`.
        ended: End of the episode before; None if none ended.
        observation: Observation as in a dataset, with its stack; None if it is not usable.
    """

    is_open: bool
    began: bool
    ended: Ending | None
    observation: Any


class LiveEpisodes:
    """Division of a running robot's steps into episodes, as by `runs.segments`.

    Attributes:
        is_late: Whether the conditions use `next`, so that they are known one step later.
    """

    def __init__(self, plan: Plan, frame_stack: int = 1) -> None:
        """Prepare the conditions; `frame_stack` is that of the policy."""
        self._plan, self._count = plan, plan.mapping.stack
        late = next((name for name, each in plan.conditions.items() if each.uses_next), None)
        self.is_late = late is not None
        if late is not None and max(self._count, frame_stack) > 1:
            raise UsageError(
                f"{plan.place.of('episodes', late)}: `next` looks ahead, but a stack has to begin"
                " with its episode: use a condition of the step itself, and train again"
            )
        self.reset()

    def reset(self) -> None:
        """Drop the episode."""
        self._frames: list[dict[str, NDArray[Any]]] = []
        self._steps: int | None = None
        self._had_begin = False
        self._before: tuple[LiveStep, bool] | None = None

    def see(self, step: LiveStep, acts: bool) -> EpisodeState:
        """Return the state at a step, whose action is known to follow or not."""
        known, self._before = (self._before, (step, acts)) if self.is_late else ((step, acts), None)
        began, ended = False, None
        if known is not None:
            began, ended = self._next(*known, step)
        if step.frame is None:
            self._frames = []
            return EpisodeState(self._steps is not None, began, ended, None)
        if began or (self._steps is None and ended is None):
            self._frames = []
        self._frames = [*self._frames, step.frame][-self._count :]
        return EpisodeState(self._steps is not None, began, ended, self._stacked())

    def _stacked(self) -> Any:
        """Return the last frames as one observation, the oldest first."""
        frames = [self._frames[0]] * (self._count - len(self._frames)) + self._frames
        if self._count == 1:
            found = frames[0]
        else:
            found = {
                key: np.concatenate([frame[key] for frame in frames], axis=-1) for key in frames[0]
            }
        return found if len(found) > 1 else next(iter(found.values()))

    def _next(self, step: LiveStep, acts: bool, following: LiveStep) -> tuple[bool, Ending | None]:
        is_usable, holds = step.frame is not None, self._conditions(step, following)
        begin, has_begin = holds.get("begin", False), "begin" in self._plan.conditions
        terminated = holds.get("terminated", False)
        truncated = holds.get("truncated", False) or holds.get("end", False)
        begins = is_usable and (not has_begin or (begin and not self._had_begin))
        self._had_begin = begin
        late, ended = int(self.is_late), None
        if self._steps is not None:
            if step.gap_before or not is_usable or (has_begin and begins):
                is_gap = step.gap_before or not is_usable
                ended = Ending(1 + late, False, True, GAP if is_gap else RESTARTED)
            else:
                self._steps += 1
                is_full = self._steps == self._plan.mapping.episodes.max_steps
                if terminated or truncated:
                    ended = Ending(late, terminated, truncated, "")
                elif is_full or not acts:
                    ended = Ending(late, False, True, TIME_LIMIT if is_full else NO_ACTION)
                if ended is not None:
                    self._steps = None
                return False, ended
            self._steps = None
        if begins and acts and not terminated and not truncated:
            self._steps = 0
        return self._steps is not None, ended

    def _conditions(self, step: LiveStep, following: LiveStep) -> dict[str, bool]:
        if not step.columns:
            return {}
        is_same = following is step or not following.columns
        columns = step.columns if is_same else joined([step.columns, following.columns])
        rows = np.zeros(1, np.int64) if is_same else np.ones(2, np.int64)
        found = {}
        for name, expression in self._plan.conditions.items():
            with self._plan.place.named("episodes", name):
                value = expression.evaluate(columns, rows).astype(np.float64)[0]
            # A condition on a missing value (NaN) is false.
            found[name] = bool(value == value and value != 0)
        return found


def joined(columns: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Return the columns of several steps as one; constants have no axis."""
    first = columns[0]
    return {
        name: np.concatenate([each[name] for each in columns]) if column.ndim else column
        for name, column in first.items()
    }
