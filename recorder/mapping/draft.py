"""Suggestion of a mapping file, from the topics of a bag.

The likely quantities and commands are chosen by `likely` and `likely_action`. The mapping is then
tried: quantities that prevent all episodes become comments, until there is an episode.
"""

from __future__ import annotations

import json
import math
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.bags.bag import Bag, Stream
from mcaprl.recorder.bags.overview import TopicOverview, topics_of
from mcaprl.recorder.format.schema import STEP_TOPIC
from mcaprl.recorder.mapping.config import Place, parse_mapping
from mcaprl.recorder.mapping.images import ImageReader
from mcaprl.recorder.mapping.likely import (
    IMAGES,
    LIKELY,
    Candidate,
    action_spec,
    candidates,
    command_of,
    image_spec,
    is_never_observed,
    kind_of,
    likelihood,
    number_fields,
    shares_of_time,
    transforms,
)
from mcaprl.recorder.mapping.plan import Plan
from mcaprl.recorder.mapping.read import Blame
from mcaprl.recorder.mapping.spatial import why_refused
from mcaprl.recorder.mapping.steps import StepReader
from mcaprl.texts import printable

_MAX_RATE_HZ, _MIN_RATE_HZ, _GAP_S = 20.0, 1.0, 2.0
_MAX_OBSERVED, _MAX_PER_TOPIC = 12, 5
_LISTED, _MAX_OTHERS = 5, 100
# YAML reads these paths and words as text without quotes.
_PLAIN = re.compile(r"/[\w/.-]+|(?!(?i:true|false|null|yes|no|on|off|y|n)$)[a-z_]+", re.ASCII)
_SHOWN = {
    *IMAGES,
    *("sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/OccupancyGrid"),
    *("foxglove.LaserScan", "foxglove.PointCloud", "foxglove.Grid", "foxglove.FrameTransforms"),
    *("nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage", "foxglove.FrameTransform"),
}
"""Types of topics that viewers show."""
_NOTHING: dict[str, Any] = {"fields": ["/TOPIC.FIELD"], "box": {"low": [-1], "high": [1]}}


def suggested(bag: Bag, bins: int | None = None) -> str:
    """Return the text of a mapping file with the likely observations and action of a bag.

    Comments list all other numbers and images that can be read, with type and rate. If the mapping
    finds no episode, or the bag has no commands, a comment and a warning say why.
    """
    where = ", ".join(map(str, bag.paths))
    if STEP_TOPIC in bag.topics:
        raise LogError(
            f"{where} is a log already, with the topic {STEP_TOPIC}: it needs no mapping"
        )
    return _Draft(cast(Bag, _Remembered(bag)), bins).text()


class _Remembered:
    """Bag that reads each topic once, although several mappings are tried."""

    def __init__(self, bag: Bag) -> None:
        self._bag = bag
        self._known: dict[tuple[str, ...], Stream] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bag, name)

    def read(
        self, topic: str, fields: Sequence[str], rows: NDArray[np.int64] | None = None
    ) -> Stream:
        if rows is not None:
            return self._bag.read(topic, fields, rows)
        key = (topic, *fields)
        if key not in self._known:
            self._known[key] = self._bag.read(topic, fields)
        return self._known[key]


class _Entry(NamedTuple):
    """A quantity: keys and values, its topic, a comment, and whether it is one number."""

    spec: dict[str, Any]
    topic: str
    remark: str
    is_scalar: bool = False


class _Place(Place):
    """Place that stores the keys of the mapping at which an error occurred."""

    keys: tuple[Any, ...] = ()

    @contextmanager
    def named(self, *keys: Any) -> Iterator[None]:
        try:
            with super().named(*keys):
                yield
        except UsageError:
            self.keys = self.keys or keys
            raise


class _Draft:
    """Mapping that is being made for a bag."""

    def __init__(self, bag: Bag, bins: int | None) -> None:
        self._bag, self._bins = bag, bins
        self._topics = {topic.info.name: topic for topic in topics_of(bag)}
        useful = [each for each in self._topics.values() if not each.why_unusable]
        self._useful = [each for each in useful if not is_never_observed(each.info)]
        readable = [each for each in self._topics.values() if each.info.count]
        self._command = command_of(bag, [each for each in readable if not each.info.problem])
        fastest_hz = max((each.rate_hz for each in self._useful), default=1.0)
        self._gap_s = _GAP_S if fastest_hz * _GAP_S >= 2 else math.ceil(4 / fastest_hz)
        self._shares = shares_of_time(self._useful, self._gap_s)
        self.others: list[Candidate] = []
        self.observed = self._choose()
        if not self.observed:
            raise LogError(self._why_nothing())
        self._rate_hz = self._rate()
        self.dropped: list[str] = []
        self._problem = self._try()

    def _choose(self) -> dict[str, _Entry]:
        """Return the likely observations by name."""
        found = []
        for topic in self._useful:
            is_command = self._command is not None and topic is self._command.topic
            if is_command or kind_of(topic.info) in IMAGES:
                continue
            mine = candidates(self._bag, topic, self._shares.get(topic.info.name, 0.0))
            # Other topics of commands reveal the action.
            extra = 3 if self._command is not None and likelihood(topic.info) >= 4 else 0
            found += [
                each._replace(penalty=each.penalty + extra if k < _MAX_PER_TOPIC else 9)
                for k, each in enumerate(mine)
            ]
        # Topics of common types come first, because the number of quantities is limited.
        found.sort(key=lambda each: kind_of(each.topic.info) not in LIKELY)
        found[:0] = transforms(self._bag, self._topics)
        best = min((each.penalty for each in found), default=0)
        chosen = [each for each in found if each.penalty == best][:_MAX_OBSERVED]
        self.others = [each for each in found if each not in chosen]
        entries: dict[str, _Entry] = {}
        for each in chosen:
            name = _name(each.topic.info.name, each.label, entries)
            entries[name] = _Entry(each.spec, each.topic.info.name, str(each.topic), each.is_scalar)
        return entries or self._cameras(active=True)

    def _cameras(self, *, active: bool = False) -> dict[str, _Entry]:
        """Return images, clouds and grids; only the first that can be read, if it is observed."""
        found: dict[str, _Entry] = {}
        usable = [
            each
            for each in self._topics.values()
            if each in self._useful or (each.info.count and not each.info.problem)
        ]
        for topic in sorted(usable, key=lambda each: kind_of(each.info) not in IMAGES):
            if (spec := image_spec(self._bag, topic.info)) is None:
                continue
            if kind_of(topic.info) in IMAGES and topic not in self._useful:
                continue
            entry, name = _Entry(spec, topic.info.name, str(topic)), next(iter(spec))
            name = "camera" if name == "image" else name
            if active and self._is_image(topic, spec):
                return {name: entry}
            if not active:
                count = sum(each.startswith(name) for each in found)
                found[f"{name}{count or ''}"] = entry
        return found

    def _is_image(self, topic: TopicOverview, spec: dict[str, Any]) -> bool:
        mapping = parse_mapping(
            {"clock": {"rate_hz": 1}, "observation": {"camera": spec}, "action": _NOTHING}
        )
        try:
            reader = ImageReader(self._bag, topic.info.name, mapping.observation["camera"])
            # The first packets of a video may not be readable.
            first = next(row for row in range(topic.info.count) if row not in reader.failures)
            return reader.read(np.array([first])) is not None
        except (LogError, UsageError):
            return False

    def _why_nothing(self) -> str:
        """Return why no topic can be observed, in one line."""
        reasons = []
        for topic in self._topics.values():
            why = topic.why_unusable
            if not why and not topic.info.fields:
                why = "its fields are unknown, because it has no schema"
            elif not why and is_never_observed(topic.info):
                why = "is not a quantity"
            elif not why and self._command is not None and topic is self._command.topic:
                why = "is the command"
            reasons.append(f"{topic.info.name} ({why or 'has no numbers'})")
        more = f" and {len(reasons) - _LISTED} more" if len(reasons) > _LISTED else ""
        where = ", ".join(map(str, self._bag.paths))
        names = "; ".join(reasons[:_LISTED])
        return f"{where}: no topic can be observed: {names or 'there are no topics'}{more}"

    def _rate(self) -> float:
        """Return the rate of the slowest used topic, from 1 to 20 Hz if possible."""
        names = {entry.topic for entry in self.observed.values()}
        rates = [self._topics[name].rate_hz for name in names]
        if self._command is not None and self._shares.get(self._command.topic.info.name, 0) > 0.5:
            rates.append(self._command.topic.rate_hz)
        rates = [rate for rate in rates if rate > 0] or [_MIN_RATE_HZ]
        slowest = min((rate for rate in rates if rate >= _MIN_RATE_HZ), default=max(rates))
        return float(f"{min(slowest, _MAX_RATE_HZ):.2g}")

    def _tree(self, action: dict[str, Any] | None = None) -> dict[str, Any]:
        command, nothing = self._command, np.empty((0, 0))
        if action is None:
            action = self._stand_in() if command is None else action_spec(command, None, nothing)
        return {
            "clock": {"rate_hz": self._rate_hz},
            "observation": {name: entry.spec for name, entry in self.observed.items()},
            "action": action,
            "episodes": {"gap_s": self._gap_s},
        }

    def _stand_in(self) -> dict[str, Any]:
        """Return an observed number as action, with which a bag without commands is tried."""
        scalars = (each.spec for each in self.observed.values() if each.is_scalar)
        paths = [spec["field"] for spec in scalars if "as" not in spec]
        return {"fields": paths[:1], "box": {"low": [-1], "high": [1]}} if paths else _NOTHING

    def _try(self) -> str:
        """Leave out quantities that prevent all episodes; return why there is none in the end."""
        self.action = self._tree()["action"]
        while self.action != _NOTHING:
            name, problem = self._tried()
            if not problem or name is None or len(self.observed) == 1:
                return problem if self._command is not None else self._why_no_command()
            self.observed.pop(name)
            self.dropped.append(f"left out: {problem}")
            self.action = self._tree()["action"]
        return self._why_no_command()

    def _tried(self) -> tuple[str | None, str]:
        """Return the name of a quantity that prevents all episodes, and why; empty if none does."""
        place = _Place()
        try:
            plan = Plan(self._bag, parse_mapping(self._tree()), place, trust_code=False)
            reader = StepReader(plan)
            runs = [reader.read(number) for number in range(reader.count)]
            least = plan.mapping.episodes.min_steps
            used = [
                run.actions.values[each.first : each.last]
                for run in runs
                for each in run.episodes
                if each.length >= least
            ]
            if used:
                self._set_bins(np.concatenate(used))
                return None, ""
            causes = Blame(plan, runs).causes()
            name = next((each for each in causes if each in self.observed), None)
            return name, causes[name] if name is not None else "; ".join(causes.values())
        except (LogError, UsageError) as error:
            problem = str(error).removeprefix("mapping: ")
            keys = (*place.keys, "", "")
            if keys[0] == "observation":
                return keys[1], problem
            names = (name for name, each in self.observed.items() if each.topic in problem)
            return next(names, None), problem

    def _set_bins(self, used: NDArray[Any]) -> None:
        if self._bins is not None and self._command is not None and "box" in self.action:
            self.action = action_spec(self._command, self._bins, used.astype(np.float64))

    def _why_no_command(self) -> str:
        likely = max(self._topics.values(), key=lambda each: likelihood(each.info))
        info = likely.info
        if likelihood(info):
            why = f"cannot be read: {info.problem}" if info.problem else "has no numbers"
            return f"{info.name} looks like the command, but {why if info.count else 'is empty'}"
        names = ", ".join(topic.info.name for topic in self._useful[:8])
        return f"no topic looks like a command; topics: {names}"

    def text(self) -> str:
        """Return the text of the mapping, and warn if it cannot be used as it is."""
        lines = [
            "# Mapping of a bag to observations, actions and rewards. Edit it, and try it:",
            "#   mcaprl convert BAG --mapping THIS_FILE --dry-run",
        ]
        if self._problem:
            what = "finds no episode" if self._command else "has no action yet"
            lines.append(f"# This mapping {what}: {self._problem}")
            warnings.warn(f"the suggested mapping {what}: {self._problem}", stacklevel=4)
        lines += [
            "time: log_time  # or publish_time, or header",
            f"clock: {_flow({'rate_hz': self._rate_hz})}",
            "observation:",
            *self._observation_lines(),
            "action:",
            *self._action_lines(),
        ]
        scalars = (name for name, entry in self.observed.items() if entry.is_scalar)
        first = next(scalars, "")
        lines += [
            f'reward: "0"  # for example "next({first}) - {first}"' if first else 'reward: "0"',
            "episodes:",
            f"  gap_s: {self._gap_s:g}",
            "  # max_steps: 1000",
        ]
        if first:
            lines += [f'  # terminated: "{first} > 1"', f'  # begin: "{first} != 0"']
        shown = [
            name
            for name, topic in self._topics.items()
            if topic.info.count and _PLAIN.fullmatch(name) and kind_of(topic.info) in _SHOWN
        ]
        if shown:
            some = ", ".join(shown[:_LISTED])
            lines.append(f"# keep: [{some}]  # topics that `convert` copies for viewers")
        lines += [
            f"# {topic.info.name} cannot be read: {why}"
            for topic in self._topics.values()
            if (why := topic.info.problem or why_refused(topic.info))
        ]
        return "".join(f"{_one_line(line)}\n" for line in lines)

    def _observation_lines(self) -> Iterator[str]:
        for name, entry in self.observed.items():
            yield f"  {name}: {_flow(entry.spec)}  # {entry.remark}"
        used = {
            entry.topic
            for entry in self.observed.values()
            if not {"image", "cloud", "grid"}.isdisjoint(entry.spec)
        }
        for name, entry in self._cameras().items():
            if entry.topic not in used:
                yield f"  # {name}: {_flow(entry.spec)}  # {entry.remark}"
        yield from (f"  # {text}" for text in self.dropped)
        known = {str(entry.spec.get("field")).partition("[")[0] for entry in self.observed.values()}
        others = [
            f"  # other: {_flow({'field': path})}  # {remark}"
            for path, remark in self._numbers().items()
            if path not in known
        ]
        yield from others[:_MAX_OTHERS]
        if len(others) > _MAX_OTHERS:
            yield f"  # and {len(others) - _MAX_OTHERS} more, which `mcaprl info --json` lists"

    def _numbers(self) -> dict[str, str]:
        """Return all numbers by path, with the reason why they are not observed, kind and topic."""
        found = {}
        for topic in self._useful:
            info = topic.info
            if kind_of(info) not in IMAGES:
                for field in number_fields(info):
                    found[f"{info.name}.{field}"] = f"{info.fields[field]}, {topic}"
        for each in self.others:
            path = str(each.spec.get("field"))
            if path in found and each.why_not:
                found[path] = f"{each.why_not}; {found[path]}"
        return found

    def _action_lines(self) -> list[str]:
        if self._command is None:
            return [f"  field: /TOPIC.FIELD  # {self._problem}"]
        (first, value), *rest = self.action.items()
        lines = [f"  {first}: {_flow(value)}  # {self._command.topic}"]
        lines += [f"  {key}: {_flow(each)}" for key, each in rest]
        if "box" in self.action:
            zeros = [0 for _ in self._command.paths]
            lines += [
                "  # or bins: `mcaprl convert --suggest BAG --bins 3`",
                "  # or named commands, of which the nearest is the action, instead of box:",
                f"  # actions: {_flow({'stop': zeros})}",
            ]
        return lines


def _name(topic: str, field: str, used: Iterable[str]) -> str:
    """Return an unused name: the first part of the topic name and the last parts of the path."""
    words = [*topic.strip("/").split("/"), *field.split(".")]
    words = [re.sub(r"[^0-9A-Za-z]", "_", word).lower() for word in words]
    words[0] = f"t_{words[0]}" if not words[0][:1].isalpha() else words[0]
    for count in range(min(3, len(words)), len(words) + 1):
        name = "_".join([words[0], *words[len(words) - count + 1 :]])
        if name not in used:
            return name
    return f"{'_'.join(words)}_{len(list(used))}"


def _flow(value: Any) -> str:
    """Return keys and values as one line of YAML."""
    if isinstance(value, dict):
        return (
            "{" + ", ".join(f"{_quoted(key)}: {_flow(each)}" for key, each in value.items()) + "}"
        )
    if isinstance(value, list):
        return "[" + ", ".join(map(_flow, value)) + "]"
    return _quoted(value) if isinstance(value, str) else f"{value:.15g}"


def _quoted(text: str) -> str:
    """Return a text as YAML: in quotes, unless YAML reads it as this text without them."""
    return text if _PLAIN.fullmatch(text) else json.dumps(text, ensure_ascii=False)


def _one_line(text: str) -> str:
    """Return a text without control characters, in which YAML escapes and comments stay valid."""
    return printable(text.replace("\n", "\\n").replace("\t", " "))
