"""Metadata of a log, with which the log can be read without its simulator.

The metadata is stored twice: in the metadata record `mcaprl.dataset`, the first record after the
header, and as the channel metadata of `/rl/step`. Both are string maps; other values are JSON.

    format_version      "1"
    env_id              Gymnasium id; `module:Name-v0` if the import of a module registers it;
                        empty if unknown
    env_kwargs          JSON object: keyword arguments of gymnasium.make
    unstored_kwargs     JSON list: names of the arguments whose values are not JSON; absent if there
                        are none
    observation_space   JSON, see `spaces.space_to_json`
    action_space        JSON
    observation_fields  JSON list of {"path": keys in a Dict space, "field" or "topic": name};
                        derived from the space by `spaces.observation_leaves`
    observation_names   JSON list: names of the elements of a vector observation; may be empty
    action_meanings     JSON list: names of the discrete actions; may be empty
    action_part_names   JSON list: names of the elements of a vector action; absent if unknown
    action_units        JSON list: unit of each of these elements, which may be empty; absent if
                        unknown
    relative_to         JSON list: for each element of a vector action, the index of the element of
                        the observation's vector that learning subtracts, or null; absent if none
    action_commands     JSON object: "fields", the paths of the fields of a command in another
                        program's messages, and "commands", a list with the values of the fields for
                        each discrete action, or null; absent if unknown
    success_reasons     JSON list of the end reasons of successful episodes; empty if unknown
    view                JSON object of numbers for viewers; see `LogMetadata.view`
    step_duration_ns    simulated time between two records
    policy, epsilon, seed   values at the start of the recording; empty if unknown
    versions            JSON object: package -> version
    behavior_prob       "estimated" if the probabilities of the actions were not logged but
                        estimated afterwards; otherwise absent
    robot               JSON object: "mapping", "topics" (definitions) and "shapes" of the robot
                        from whose bag the log was made, so that a policy can drive it; otherwise
                        absent
    about               JSON object: description of the source dataset, such as its author, if the
                        log was converted from another tool's format; otherwise absent
    times               "none" if the data has no times, so that its times only count the steps;
                        always absent in a log, in which data without times has the times of writing
"""

from __future__ import annotations

import json
import math
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache, cached_property, lru_cache
from importlib.metadata import PackageNotFoundError, entry_points, version
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from mcaprl._version import __version__
from mcaprl.errors import LogError, UsageError
from mcaprl.files import parse_json
from mcaprl.recorder.format.messages import INTERRUPTED
from mcaprl.recorder.format.spaces import (
    Leaf,
    action_leaf,
    leaves_of,
    space_from_json,
    space_to_json,
)
from mcaprl.texts import encodable

Command = tuple[float | str, ...]  # Values of the fields of a command: numbers or texts


@dataclass(frozen=True)
class ActionCommands:
    """Command of each discrete action."""

    fields: tuple[str, ...]  # Paths of the K fields of a command, such as `/cmd_vel.linear.x`
    # K values for each action, in the order of the actions; None if unknown.
    commands: tuple[Command | None, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the fields and commands as JSON types."""
        commands = [None if each is None else list(each) for each in self.commands]
        return {"fields": list(self.fields), "commands": commands}

    @classmethod
    def from_json(cls, found: Any, count: int) -> ActionCommands:
        """Check JSON types that `to_json` returned; `count` is the number of actions."""
        fields = found.get("fields") if isinstance(found, Mapping) else None
        commands = found.get("commands") if isinstance(found, Mapping) else None
        if not (isinstance(fields, list) and all(isinstance(each, str) for each in fields)):
            raise ValueError("the fields of action_commands are not a list of texts")
        if not (isinstance(commands, list) and len(commands) == count):
            raise ValueError(f"action_commands does not have {count} commands")
        return cls(tuple(fields), tuple(_command(each, len(fields)) for each in commands))

    def by_name(self, names: Mapping[int, str]) -> dict[str, Command | None]:
        """Return the commands by the names of their actions, which `names` has by index."""
        return {names.get(k, str(k)): command for k, command in enumerate(self.commands)}


def _command(found: Any, count: int) -> Command | None:
    if found is None:
        return None
    if not (isinstance(found, list) and len(found) == count and all(map(_is_value, found))):
        raise ValueError(f"a command of action_commands is not {count} numbers or texts")
    return tuple(found)


def _is_value(found: Any) -> bool:
    if isinstance(found, bool):
        return False
    return isinstance(found, str) or (isinstance(found, int | float) and math.isfinite(found))


FORMAT_VERSION = "1"
ESTIMATED = "estimated"
NO_TIMES = "none"
# With more actions than this, a plot that labels them by numbers is not readable.
MAX_NUMBERED_ACTIONS = 1_000
METADATA_NAME = "mcaprl.dataset"
# All recordings in one file have equal values of these fields. The other fields describe the first
# recording.
SAME_WHEN_APPENDED = (
    "format_version",
    "env_id",
    "env_kwargs",
    "observation_space",
    "action_space",
    "observation_names",
    "action_meanings",
    "action_part_names",
    "action_units",
    "step_duration_ns",
)
DEFAULT_STEP_DURATION_NS = 100_000_000
# Arguments for rendering or vectorization. They do not describe one environment.
_NOT_OF_ONE_ENV = (
    "render_mode",
    "num_envs",
    "vectorization_mode",
    "vector_kwargs",
    "wrappers",
    "autoreset_mode",
)
_VERSIONED = ("gymnasium", "numpy", "numba", "highway-env")


@dataclass(frozen=True)
class LogMetadata:
    """Metadata of a log.

    Attributes:
        observation_space: Observation space of the environment.
        action_space: Action space of the environment.
        env_id: Gymnasium id of the environment; empty if unknown.
        env_kwargs: Keyword arguments of `gymnasium.make`; JSON types only.
        unstored_kwargs: Names of the arguments that differ from the environment's defaults, but
            cannot be stored because they are not JSON.
        observation_names: Names of a vector observation's elements; empty if unknown.
        action_meanings: Names of the discrete actions; empty if unknown.
        action_part_names: Names of a vector action's elements; empty if unknown.
        action_units: Units of these elements; see `Dataset.action_units`.
        relative_to: Observed elements that actions are relative to; see `Dataset.relative_to`.
        action_commands: Commands that the discrete actions stand for; None if unknown.
        success_reasons: End reasons of successful episodes; empty if unknown.
        view: Numbers for viewers, empty if unknown. `distance_m` and `tilt_deg` place the follow
            camera; `world_m`, `world_x_m` and `world_y_m` are the size and the center of the world;
            `world_turn_deg` is the angle between y and up in the view of it;
            `depth_min_m` and `depth_max_m` are the limits of the depth colors; `speed_m_s` is the
            highest speed.
        step_duration_ns: Simulated time between two records, nanoseconds.
        policy: Name of the first policy; each episode's summary contains the policy of the episode.
        epsilon: Probability of a random action, as text; empty if unknown.
        seed: Seed of the recording, as text; empty if unknown.
        versions: Versions of the packages that the recording ran with.
        behavior_prob: `ESTIMATED` if the probabilities of the actions were estimated; otherwise
            empty.
        robot: Mapping, topics and shapes of the robot from whose bag the data was made, so that a
            policy can drive it; JSON types only, empty for other data.
        about: Description of the source dataset if the log was converted from another tool's
            format; JSON types only.
        times: `NO_TIMES` if the data has no times, such as arrays; otherwise empty. The times of
            such data start at 0, but data with times may start at 0 too.
    """

    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]
    env_id: str = ""
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    observation_names: tuple[str, ...] = ()
    action_meanings: tuple[str, ...] = ()
    success_reasons: tuple[str, ...] = ()
    view: Mapping[str, float] = field(default_factory=dict)
    step_duration_ns: int = DEFAULT_STEP_DURATION_NS
    policy: str = ""
    epsilon: str = ""
    seed: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    behavior_prob: str = ""
    about: Mapping[str, Any] = field(default_factory=dict)
    times: str = ""
    action_commands: ActionCommands | None = None
    unstored_kwargs: tuple[str, ...] = ()
    action_part_names: tuple[str, ...] = ()
    action_units: tuple[str, ...] = ()
    relative_to: tuple[int | None, ...] = ()
    robot: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def leaves(self) -> tuple[Leaf, ...]:
        """Leaves of the observation space in order; empty for an empty Dict."""
        return leaves_of(self.observation_space)

    def action_names(self) -> dict[int, str]:
        """Return the names of the discrete actions by value; empty for other action spaces."""
        # Without a distinct meaning of each action, the numbers are the names, or above
        # `MAX_NUMBERED_ACTIONS` the dict is empty.
        space = self.action_space
        if not isinstance(space, spaces.Discrete):
            return {}
        values = range(int(space.start), int(space.start) + int(space.n))
        meanings = self.action_meanings
        if len(meanings) != len(values) or len(set(meanings)) != len(meanings):
            shown = values if space.n <= MAX_NUMBERED_ACTIONS else ()
            return {value: str(value) for value in shown}
        return dict(zip(values, meanings, strict=True))

    def action_labels(self) -> tuple[str, ...]:
        """Return the named parts of an action with bounds and units."""
        # Empty if they have no names. Such as `speed (0 to 2 m/s)`, or `steering (-1 right, 1
        # left)` of the unit `right | left`.
        names, space = self.action_part_names, self.action_space
        if not isinstance(space, spaces.Box) or len(names) != math.prod(space.shape):
            return ()
        units = self.action_units if len(self.action_units) == len(names) else ("",) * len(names)
        bounds = zip(space.low.flat, space.high.flat, strict=True)
        return tuple(map(_label, names, units, bounds))

    def is_failure(self, reason: str) -> bool:
        """Return whether `reason` is the end reason of a failure; False if that is unknown."""
        return bool(self.success_reasons) and reason not in (*self.success_reasons, INTERRUPTED)

    def to_strings(self) -> dict[str, str]:
        """Return the map that is written to the file."""
        commands = self.action_commands
        fields = [
            {
                "path": leaf.path,
                **({"topic": leaf.topic} if leaf.encoding else {"field": leaf.name}),
            }
            for leaf in self.leaves
        ]
        return {
            "format_version": FORMAT_VERSION,
            "env_id": encodable(self.env_id),
            "env_kwargs": json.dumps(dict(self.env_kwargs), default=repr),
            "observation_space": space_to_json(self.observation_space),
            "action_space": space_to_json(self.action_space),
            "observation_fields": json.dumps(fields),
            "observation_names": json.dumps(self.observation_names),
            "action_meanings": json.dumps(self.action_meanings),
            "success_reasons": json.dumps(self.success_reasons),
            "view": json.dumps(dict(self.view)),
            "step_duration_ns": str(self.step_duration_ns),
            "policy": encodable(self.policy),
            "epsilon": self.epsilon,
            "seed": self.seed,
            "versions": json.dumps(dict(self.versions)),
            **{
                name: json.dumps(found)
                for name in ("unstored_kwargs", "action_part_names", "action_units", "relative_to")
                if (found := getattr(self, name))
            },
            **({"behavior_prob": self.behavior_prob} if self.behavior_prob else {}),
            **({"robot": json.dumps(dict(self.robot))} if self.robot else {}),
            **({"about": json.dumps(dict(self.about))} if self.about else {}),
            **({"times": self.times} if self.times else {}),
            **({"action_commands": json.dumps(commands.to_json())} if commands else {}),
        }

    @classmethod
    def from_strings(cls, strings: Mapping[str, str]) -> LogMetadata:
        """Parse the map that was read from a file."""
        found = strings.get("format_version")
        if found is None:
            raise LogError(f"no metadata record '{METADATA_NAME}': the spaces are unknown")
        if found != FORMAT_VERSION:
            raise LogError(
                f"format version {found}; mcaprl {__version__} reads {FORMAT_VERSION}:"
                " pip install -U mcaprl"
            )
        for name, text in strings.items():
            # The map may come from the JSON of another format.
            if not isinstance(text, str):
                raise LogError(f"metadata record '{METADATA_NAME}': {name} is not a text")
        try:
            action_space = space_from_json(strings["action_space"])
            action_leaf(action_space)
            return cls(
                observation_space=space_from_json(strings["observation_space"]),
                action_space=action_space,
                env_id=strings.get("env_id", ""),
                env_kwargs=_object(strings, "env_kwargs"),
                observation_names=_texts(strings, "observation_names"),
                action_meanings=_texts(strings, "action_meanings"),
                success_reasons=_texts(strings, "success_reasons"),
                view=_numbers(_object(strings, "view")),
                step_duration_ns=int(strings.get("step_duration_ns", DEFAULT_STEP_DURATION_NS)),
                policy=strings.get("policy", ""),
                epsilon=strings.get("epsilon", ""),
                seed=strings.get("seed", ""),
                versions=_object(strings, "versions"),
                behavior_prob=strings.get("behavior_prob", ""),
                about=_object(strings, "about"),
                robot=_object(strings, "robot"),
                times=strings.get("times", ""),
                action_commands=_commands(strings, action_space),
                unstored_kwargs=_texts(strings, "unstored_kwargs"),
                action_part_names=_texts(strings, "action_part_names"),
                action_units=_texts(strings, "action_units"),
                relative_to=_relation(strings, action_space),
            )
        except (KeyError, ValueError, TypeError, MemoryError) as error:
            raise LogError(
                f"metadata record '{METADATA_NAME}' cannot be parsed: {error}"
            ) from error

    @classmethod
    def common(cls, parts: Sequence[LogMetadata]) -> LogMetadata:
        """Return metadata that describes several logs."""
        # Fields that differ have the default value. Their spaces must be equal. `ESTIMATED` and
        # `NO_TIMES` of any log hold for all. The commands are the first log's that has them, if the
        # others' fields are the same; `robot` is that of the first log, if the others differ in the
        # commands only.
        first, *others = parts
        blank = cls(first.observation_space, first.action_space)
        differing = {
            field_.name: getattr(blank, field_.name)
            for field_ in fields(cls)
            if any(getattr(other, field_.name) != getattr(first, field_.name) for other in others)
        }
        commands = [part.action_commands for part in parts if part.action_commands is not None]
        same = len({one.fields for one in commands}) == 1
        estimated, no_times = (
            any(getattr(part, name) for part in parts) for name in ("behavior_prob", "times")
        )
        differing |= {
            "behavior_prob": ESTIMATED if estimated else "",
            "times": NO_TIMES if no_times else "",
            "action_commands": commands[0] if same else None,
            "robot": _common_robot([part.robot for part in parts]),
        }
        return replace(first, **differing)

    @classmethod
    def of_env(
        cls,
        env: gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any],
        *,
        step_duration_s: float | None = None,
        policy: str = "",
        epsilon: str = "",
        seed: str = "",
    ) -> LogMetadata:
        """Create the metadata of an environment's recording, or of one of a vector's."""
        # The step duration is the first of: the argument, the environment's `step_duration_s`, 1 /
        # `metadata["render_fps"]`, 0.1 s. Arguments that are not JSON are left out with a warning.
        one = _one_of(env)
        inner = one.unwrapped
        if step_duration_s is None:
            fps = inner.metadata.get("render_fps")
            fallback = 1 / fps if fps else DEFAULT_STEP_DURATION_NS / 1e9
            step_duration_s = float(getattr(inner, "step_duration_s", fallback))
        if not math.isfinite(step_duration_s):
            raise UsageError(
                f"step_duration_s is {step_duration_s}: it must be a number of seconds"
            )
        is_vector = isinstance(one, gym.vector.VectorEnv)
        kwargs, unstored = _split_kwargs(one.spec)
        if unstored:
            warnings.warn(
                f"the log does not store {', '.join(unstored)} of {one.spec.id}, because the values"
                " are not JSON: pass the arguments again to repeat the episodes",
                stacklevel=3,
            )
        return cls(
            observation_space=one.single_observation_space if is_vector else one.observation_space,
            action_space=one.single_action_space if is_vector else one.action_space,
            env_id=_env_id(one),
            env_kwargs=kwargs,
            unstored_kwargs=unstored,
            observation_names=_names(inner, "observation_names"),
            action_meanings=_names(inner, "action_meanings"),
            action_part_names=_names(inner, "action_part_names"),
            action_units=_names(inner, "action_units"),
            success_reasons=_names(inner, "success_reasons"),
            view=_numbers(getattr(inner, "view_settings", {})),
            step_duration_ns=round(step_duration_s * 1e9),
            policy=policy,
            epsilon=epsilon,
            seed=seed,
            versions=installed_versions(),
        )


def _common_robot(found: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """Return the robot of several logs, with the commands of the first; empty if others differ."""

    def without_commands(robot: Any) -> Any:
        try:
            mapping = robot["mapping"]
            action = {**mapping["action"], "representatives": []}
            return {**robot, "mapping": {**mapping, "action": action}}
        # It is empty, or forged.
        except (KeyError, TypeError):
            return robot

    first = without_commands(found[0])
    return found[0] if all(without_commands(each) == first for each in found) else {}


def _label(name: str, unit: str, bounds: tuple[float, float]) -> str:
    """Return the name of a part of an action with its bounds and unit."""
    low, high = bounds
    ends = unit.split(" | ")
    if not (math.isfinite(low) and math.isfinite(high)):
        return f"{name} ({unit})" if unit else name
    if len(ends) == 2:
        return f"{name} ({low:g} {ends[0]}, {high:g} {ends[1]})"
    return f"{name} ({low:g} to {high:g}{unit and ' '}{unit})"


def _split_kwargs(spec: Any) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the arguments that are JSON, and the names of others that are no defaults."""
    kept: dict[str, Any] = {}
    others = []
    for name, value in (spec.kwargs if spec else {}).items():
        if name in _NOT_OF_ONE_ENV:
            continue
        try:
            kept[name] = as_json(value)
        except ValueError:
            registered = gym.registry.get(spec.id)
            if registered is None or not _is_default(value, registered.kwargs.get(name)):
                others.append(name)
    return kept, tuple(others)


def _is_default(value: Any, default: Any) -> bool:
    try:
        return value is default or np.array_equal(value, default)
    # Foreign objects may raise any exception.
    except Exception:
        return False


def as_json(value: Any) -> Any:
    """Return a value as JSON types: tuples become lists, and NumPy numbers become numbers."""
    try:
        found = _plain(value)
        parse_json(json.dumps(found))
    except RecursionError as error:
        raise ValueError("the value is nested too deeply for JSON") from error
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, str | int | float):
        return value
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {key: _plain(part) for key, part in value.items()}
    raise ValueError(f"{type(value).__name__} is not a type of JSON")


def _env_id(env: Any) -> str:
    """Return the id that `gymnasium.make` needs for an environment; empty if unknown."""
    if env.spec is None:
        return ""
    # If the caller of `make_sim` named a module whose import registers the id, `make_sim` stores
    # the name of the module in `env_module`.
    module = getattr(env.unwrapped, "env_module", "") or _registering_module(env.spec)
    return f"{module}:{env.spec.id}" if module else str(env.spec.id)


def _registering_module(spec: EnvSpec) -> str:
    """Return a module whose import registers an id; empty if none is needed, or none is known."""
    # The module of the entry point: its import also imports the packages that contain it, one of
    # which usually registers the id.
    entry = spec.entry_point
    module = entry.partition(":")[0] if isinstance(entry, str) else getattr(entry, "__module__", "")
    found = sys.modules.get(module or "")
    # A script and a notebook cannot be imported by their name.
    if found is None or module == "__main__" or getattr(found, "__spec__", None) is None:
        return ""
    return "" if module.partition(".")[0] in _self_registering() else str(module)


@cache
def _self_registering() -> frozenset[str]:
    """Return the packages whose ids Gymnasium or this package finds without an import."""
    groups = [entry_points(group=group) for group in ("gymnasium.envs", "mcaprl.sims")]
    packages = {one.module.partition(".")[0] for group in groups for one in group}
    return frozenset({"gymnasium", "mcaprl", *packages})


def same_env(first: str, second: str) -> bool:
    """Return whether two ids name the same environment: with no module, a package, or one in it.

    >>> same_env("highway_env:racetrack-v1", "racetrack-v1"), same_env("a:Env-v0", "b:Env-v0")
    (True, False)
    >>> same_env("a:Env-v0", "a.envs:Env-v0"), same_env("a:Env-v0", "ab:Env-v0")
    (True, False)
    """
    (one, _, name), (other, _, same) = first.rpartition(":"), second.rpartition(":")
    outer, inner = sorted([one, other], key=len)
    return name == same and (not outer or f"{inner}.".startswith(f"{outer}."))


def _object(strings: Mapping[str, str], name: str) -> dict[str, Any]:
    """Return a field that is a JSON object."""
    found = parse_json(strings.get(name, "{}"))
    if not isinstance(found, dict):
        raise ValueError(f"{name} is not a JSON object")
    return found


def _commands(strings: Mapping[str, str], space: spaces.Space[Any]) -> ActionCommands | None:
    """Return the commands of the actions; None if there are none."""
    if "action_commands" not in strings:
        return None
    if not isinstance(space, spaces.Discrete):
        raise ValueError("action_commands are for a Discrete action space")
    return ActionCommands.from_json(parse_json(strings["action_commands"]), int(space.n))


def _numbers(values: Any) -> dict[str, float]:
    """Return the finite numbers of a mapping by name; an empty dict for any other value."""
    pairs = values.items() if isinstance(values, Mapping) else ()
    return {
        str(name): float(value)
        for name, value in pairs
        if isinstance(value, int | float) and math.isfinite(value)
    }


def _texts(strings: Mapping[str, str], name: str) -> tuple[str, ...]:
    """Return a field that is a JSON list of strings."""
    found = parse_json(strings.get(name, "[]"))
    if not (isinstance(found, list) and all(isinstance(part, str) for part in found)):
        raise ValueError(f"{name} is not a JSON list of strings")
    return tuple(found)


def _relation(strings: Mapping[str, str], space: spaces.Space[Any]) -> tuple[int | None, ...]:
    """Return an index or None for each element of an action; empty if there is no such field."""
    found = parse_json(strings.get("relative_to", "[]"))
    are_indexes = isinstance(found, list) and all(
        each is None or (type(each) is int and each >= 0) for each in found
    )
    if not are_indexes or (found and len(found) != math.prod(space.shape or ())):
        raise ValueError("relative_to is not a JSON list with an index for each element")
    return tuple(found)


def _one_of(env: Any) -> Any:
    """Return a sub-environment of a vector environment if it describes `env`; else `env`."""
    if not isinstance(env, gym.vector.VectorEnv):
        return env
    inner = env.unwrapped
    # A vector wrapper may have changed the spaces. In this case, a sub-environment does not
    # describe `env`.
    same = inner.single_observation_space == env.single_observation_space and (
        inner.single_action_space == env.single_action_space
    )
    members = inner.envs if isinstance(inner, gym.vector.SyncVectorEnv) and same else []
    return members[0] if members else env


def _names(env: object, attribute: str) -> tuple[str, ...]:
    """Return the names in an attribute of the environment; () if there are none."""
    found = getattr(env, attribute, ())
    return tuple(map(str, found)) if isinstance(found, list | tuple) else ()


def installed_versions() -> dict[str, str]:
    """Return the versions of the packages that a recording depends on."""
    return dict(_installed_versions())


@lru_cache(maxsize=1)
def _installed_versions() -> tuple[tuple[str, str], ...]:
    # The result is cached, because reading each version from a file would take most of the time to
    # open a log.
    found = {"mcaprl": __version__}
    for package in _VERSIONED:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return tuple(found.items())
