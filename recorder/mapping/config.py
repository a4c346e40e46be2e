"""The mapping file: which fields of a bag are observations, actions, rewards and ends."""

from __future__ import annotations

import difflib
import keyword
from collections.abc import Iterator
from collections.abc import Mapping as MappingOf
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from mcaprl.errors import UsageError, import_extra
from mcaprl.files import read_file

TimeSource = Literal["log_time", "publish_time", "header"]
Alignment = Literal["last", "nearest", "linear"]
_EXPRESSION_NAMES = ("action", "terminated", "truncated")
"""Names in expressions that are not quantities."""
Positive = Annotated[float, Field(gt=0)]


class _Part(BaseModel):
    """A part of the mapping; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Clock(_Part):
    """Times of the steps: a fixed rate, or the messages of a topic."""

    rate_hz: Positive | None = Field(default=None, description="Steps per second.")
    topic: str | None = Field(default=None, description="Topic with one message for each step.")

    @model_validator(mode="after")
    def _has_one(self) -> Clock:
        if (self.rate_hz is None) == (self.topic is None):
            raise ValueError("give either rate_hz or topic")
        return self


class Quantity(_Part):
    """A named quantity: a field, an image or a transform, aligned with the steps."""

    field: str | None = Field(
        default=None, description="Path of a field, such as `/odom.twist.twist.linear.x`."
    )
    image: str | None = Field(
        default=None, description="Topic of Image or CompressedImage messages."
    )
    transform: str | None = Field(
        default=None, description="Frame whose pose is looked up in `/tf`."
    )
    in_: str = Field(default="map", alias="in", description="Frame in which the pose is given.")
    as_: Literal["yaw", "count"] | None = Field(
        default=None,
        alias="as",
        description="`yaw` converts a quaternion to its angle about z, radians; `count` counts the"
        " messages so far on the topic that `field` names, for example a topic of events.",
    )
    align: Alignment = Field(
        default="last",
        description="`last`: last message up to the step's time; `nearest`: nearest message;"
        " `linear`: linear interpolation. `nearest` and `linear` also use messages after the step.",
    )
    tolerance_s: Positive | None = Field(
        default=None, description="Age in seconds beyond which a value is missing."
    )
    missing: float | None = Field(
        default=None,
        description="Number that replaces missing values. Without it, a step is left out if an"
        " observed value is missing.",
    )
    scale: float = Field(default=1.0, description="Factor of the value.")
    offset: float = Field(default=0.0, description="Number added after scaling.")
    clip: tuple[float, float] | None = Field(default=None, description="Lowest and highest value.")
    wrap_angle: bool = Field(default=False, description="Whether to wrap radians into [-pi, pi).")
    crop: tuple[int, int, int, int] | None = Field(
        default=None, description="Left, top, width and height of the cropped image, pixels."
    )
    resize: tuple[int, int] | None = Field(default=None, description="Width and height, pixels.")
    gray: bool = Field(default=False, description="Whether to convert colors to gray.")
    range_m: tuple[float, float] | None = Field(
        default=None,
        description="Depths in meters that become 0 and 255; without it, depth stays in meters.",
    )

    @model_validator(mode="after")
    def _has_one_source(self) -> Quantity:
        given = [name for name in ("field", "image", "transform") if getattr(self, name)]
        if len(given) != 1:
            raise ValueError("give one of field, image and transform")
        for name in ("crop", "resize", "range_m", "gray"):
            if getattr(self, name) and given != ["image"]:
                raise ValueError(f"{name} is for images only")
        if given == ["image"] and self.align == "linear":
            raise ValueError("images cannot be interpolated: use last or nearest")
        if self.clip is not None and self.clip[0] >= self.clip[1]:
            raise ValueError("clip must be the lowest value, then the highest value")
        return self


class Limits(_Part):
    """Limits of continuous actions."""

    low: list[float] = Field(description="Lowest value of each field.")
    high: list[float] = Field(description="Highest value of each field.")


class Action(_Part):
    """The action of each step: a discrete field, or fields with `actions`, `edges` or `box`."""

    field: str | None = Field(
        default=None, description="Path of an integer, boolean or string field."
    )
    fields: list[str] = Field(
        default=[], description="Paths of the fields of a continuous command."
    )
    names: dict[str, Annotated[int, Field(ge=0)]] = Field(
        default={},
        description="Number of each action by its name. For a string field, the names are the"
        " values of the field.",
    )
    actions: dict[str, list[float]] = Field(
        default={}, description="Named commands. The action is the nearest named command."
    )
    edges: list[list[float]] = Field(
        default=[],
        description="Bin edges of each field, increasing. An action is a combination of bins, one"
        " for each field.",
    )
    box: Limits | None = Field(
        default=None, description="Limits of a Box action; commands are clipped to them."
    )
    far: Positive = Field(
        default=0.25,
        description="Distance to the nearest named command above which a command is counted as far."
        " The difference in each field is divided by the field's range in the named commands. The"
        " largest of these ratios is the distance.",
    )
    align: Literal["during", "last", "nearest"] = Field(
        default="during",
        description="`during`: last command before the next step; `last`: last command up to the"
        " step's time; `nearest`: command nearest to the step's time.",
    )
    tolerance_s: Positive | None = Field(
        default=None, description="Age in seconds beyond which the command is missing."
    )

    @model_validator(mode="after")
    def _has_one_kind(self) -> Action:
        if bool(self.field) == bool(self.fields):
            raise ValueError("give either field or fields")
        kinds = [bool(self.actions), bool(self.edges), self.box is not None]
        if self.fields and sum(kinds) != 1:
            raise ValueError("fields need one of actions, edges and box")
        if self.field and any(kinds):
            raise ValueError("use actions, edges and box with `fields`, not with `field`")
        count = len(self.fields)
        lengths = [len(command) for command in self.actions.values()]
        lengths += [len(self.edges)] if self.edges else []
        lengths += [len(self.box.low), len(self.box.high)] if self.box else []
        if any(length != count for length in lengths):
            raise ValueError(
                f"each command, low, high and edges need {count} entries, one for each field"
            )
        if any(sorted(set(each)) != each for each in self.edges):
            raise ValueError("edges must rise")
        return self


class Episodes(_Part):
    """Begin and end of the episodes; each condition is an expression, see `reward`."""

    begin: str | None = Field(
        default=None,
        description="Condition whose rising edge begins an episode. Without it, an episode begins"
        " at the next step with an observation and an action.",
    )
    end: str | None = Field(default=None, description="Condition that truncates the episode.")
    terminated: str | None = Field(default=None, description="Condition of a terminal state.")
    truncated: str | None = Field(default=None, description="Condition that truncates the episode.")
    reasons: dict[str, str] = Field(
        default={},
        description="Conditions by end reason. The first condition that is true at the end of an"
        " episode determines the reason of the episode.",
    )
    gap_s: Positive = Field(
        default=2.0, description="Longest gap, in seconds, in an observed topic within an episode."
    )
    max_steps: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="Number of steps after which an episode is truncated."
    )
    min_steps: Annotated[int, Field(ge=1)] = Field(
        default=2, description="Minimum number of steps; shorter episodes are dropped."
    )


class Meta(_Part):
    """Facts that a bag does not contain."""

    env_id: str = Field(
        default="", description="Gymnasium id of an environment that simulates the robot."
    )
    policy: str = Field(default="", description="Name of the policy that acted.")


class Mapping(_Part):
    """Mapping of a bag's topics to transitions."""

    time: TimeSource = Field(
        default="log_time", description="Time of a message: `log_time`, `publish_time` or `header`."
    )
    clock: Clock = Field(description="Times of the steps.")
    observation: dict[str, Quantity] = Field(description="Observed quantities by name.")
    stack: Annotated[int, Field(ge=1)] = Field(
        default=1, description="Number of observations that are stacked, the oldest first."
    )
    fields: dict[str, Quantity] = Field(
        default={}, description="Quantities that are used in expressions but not observed."
    )
    action: Action = Field(description="Action of each step.")
    reward: str = Field(
        default="0",
        description="Expression that can use the names of quantities, `next(NAME)` for the value at"
        " the next step, and `action`; or a Python function `module:function`, with --trust-code.",
    )
    episodes: Episodes = Field(default=Episodes(), description="Begin and end of the episodes.")
    behavior_prob: Quantity | None = Field(
        default=None,
        description="Probability of the action under the policy that acted, above 0 and at most 1."
        " Its `align` is that of the action by default.",
    )
    meta: Meta = Field(default=Meta(), description="Facts that the bag does not contain.")

    @model_validator(mode="after")
    def _names_are_words(self) -> Mapping:
        if not self.observation:
            raise ValueError("observation has no entry")
        for name in (*self.observation, *self.fields):
            if not name.isidentifier():
                raise ValueError(f"'{name}' cannot be used in expressions: use letters, digits, _")
            if name in _EXPRESSION_NAMES or keyword.iskeyword(name):
                raise ValueError(f"'{name}' has another meaning in expressions: use another name")
        both = set(self.observation) & set(self.fields)
        if both:
            raise ValueError(f"'{min(both)}' is both in observation and in fields")
        if self.behavior_prob is not None and self.behavior_prob.field is None:
            raise ValueError("behavior_prob must be a field")
        return self

    @property
    def quantities(self) -> dict[str, Quantity]:
        """All named quantities, beginning with the observed quantities."""
        return {**self.observation, **self.fields}


MAPPING_SECTIONS: dict[str, type[BaseModel]] = {
    "The file": Mapping,
    "clock": Clock,
    "An entry of observation or fields, and behavior_prob": Quantity,
    "action": Action,
    "action.box": Limits,
    "episodes": Episodes,
    "meta": Meta,
}
"""Pydantic models of the parts of a mapping, by section title of the reference documentation."""


class Place:
    """Line numbers of the keys of a mapping file, for error messages."""

    def __init__(self, path: str = "mapping", tree: Any = None) -> None:
        """Store the path of the file and its YAML tree. If the tree is None, keys have no line."""
        self.path, self._tree = path, tree

    @contextmanager
    def named(self, *keys: Any) -> Iterator[None]:
        """Add the position of a key to errors of the `with` block that have no position yet."""
        try:
            yield
        except UsageError as error:
            if str(error).startswith(self.path):
                raise
            raise UsageError(f"{self.of(*keys)}: {error}") from error

    def of(self, *keys: Any) -> str:
        """Return `FILE:LINE: key.key`.

        For a missing key, LINE is that of the closest existing parent.
        """
        tree: Any = self._tree
        line = None
        for key in keys:
            try:
                lines = getattr(tree, "lc")  # noqa: B009
                row, _ = lines.key(key) if isinstance(tree, dict) else lines.item(key)
                tree, line = tree[key], row + 1
            except (AttributeError, KeyError, IndexError, TypeError):
                break
        where = self.path if line is None else f"{self.path}:{line}"
        return f"{where}: {'.'.join(map(str, keys))}" if keys else where


def load_mapping(source: str | Path | MappingOf[str, Any]) -> tuple[Mapping, Place]:
    """Read and validate a mapping; return it with the positions of its keys.

    Raises:
        UsageError: The file cannot be read, is not YAML, or has an unknown key or a wrong value;
            the message names file, line and key.
        MissingExtraError: The packages of the `bags` extra are not installed.
    """
    if not isinstance(source, str | Path):
        return parse_mapping(source), Place()
    path, yaml = source, import_extra("ruamel.yaml", "bags")
    try:
        tree = yaml.YAML(typ="rt").load(read_file(path).decode())
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{path} is not UTF-8 text: {error.reason}") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{path}:{mark.line + 1}" if mark else str(path)
        raise UsageError(f"{where}: not YAML: {getattr(error, 'problem', error)}") from error
    place = Place(str(path), tree)
    if not isinstance(tree, dict):
        raise UsageError(f"{path}: a mapping has keys and values, such as `clock: {{rate_hz: 10}}`")
    return parse_mapping(tree, place), place


def parse_mapping(tree: MappingOf[str, Any], place: Place | None = None) -> Mapping:
    """Validate the keys and values of a mapping.

    Raises:
        UsageError: A key is unknown, or a value is wrong; the message lists all errors.
    """
    place = place or Place()
    try:
        return Mapping.model_validate(tree)
    except ValidationError as error:
        texts = [_text(found, place) for found in error.errors()]
        raise UsageError("; ".join(texts)) from error


def _text(error: Any, place: Place) -> str:
    keys = tuple(error["loc"])
    if error["type"] == "extra_forbidden":
        known = _keys_of(keys[:-1])
        near = difflib.get_close_matches(str(keys[-1]), known, n=3, cutoff=0.4) or known
        return f"{place.of(*keys)}: unknown key; nearest: {', '.join(near)}"
    if error["type"] == "missing":
        return f"{place.of(*keys)}: this key is missing"
    return f"{place.of(*keys)}: {error['msg'].removeprefix('Value error, ')}"


def _keys_of(parents: tuple[Any, ...]) -> list[str]:
    """Return the keys that a part of the mapping may have."""
    model: Any = Mapping
    for key in parents:
        field = model.model_fields.get(key) if hasattr(model, "model_fields") else None
        model = _model_in(field.annotation) if field is not None else model
    fields = getattr(model, "model_fields", {})
    return [found.alias or name for name, found in fields.items()]


def _model_in(annotation: Any) -> Any:
    """Return the model in an annotation such as `dict[str, Quantity]`."""
    parts = [annotation, *getattr(annotation, "__args__", ())]
    models = [part for part in parts if isinstance(part, type) and issubclass(part, _Part)]
    return models[0] if models else None
