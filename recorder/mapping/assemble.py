"""Assembly of a dataset from the episodes of a mapping, and the commands its actions stand for."""

from __future__ import annotations

import difflib
import itertools
import math
import re
import warnings
from collections.abc import Container, Sequence
from collections.abc import Mapping as MappingOf
from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.images import Frames, Storage
from mcaprl.recorder.dataset.packets import Packets
from mcaprl.recorder.dataset.transitions import Origin, Transitions
from mcaprl.recorder.format.behavior import behavior_field
from mcaprl.recorder.format.messages import EpisodeSummary, add_up
from mcaprl.recorder.format.metadata import (
    MAX_NUMBERED_ACTIONS,
    ActionCommands,
    Command,
    LogMetadata,
)
from mcaprl.recorder.format.schema import RETURN_SO_FAR
from mcaprl.recorder.format.spaces import leaves_of
from mcaprl.recorder.mapping.actions import unit_of
from mcaprl.recorder.mapping.align import NS_PER_S, as_numbers
from mcaprl.recorder.mapping.config import Action, Limits, Mapping, Quantity
from mcaprl.recorder.mapping.observe import place_of
from mcaprl.recorder.mapping.plan import Plan, Wanted
from mcaprl.recorder.mapping.robot import Robot
from mcaprl.recorder.mapping.runs import Segment
from mcaprl.recorder.mapping.steps import Steps
from mcaprl.texts import counted


def action_commands(
    action: Action,
    fields: tuple[str, ...],
    space: spaces.Space[Any],
    meanings: tuple[str, ...],
    values: NDArray[Any],
    commands: NDArray[Any],
) -> ActionCommands | None:
    """Return the command of each action; see `Action.representatives`.

    Args:
        action: Action of the mapping.
        fields: Path or expression of each element of a command.
        space: Action space of the dataset.
        meanings: Names of the actions; empty if they have none.
        values: (N,) actions of the transitions.
        commands: (N, K) logged commands of the transitions.

    Returns:
        None for a Box, and for a numeric field with too many values to list them.
    """
    if not isinstance(space, spaces.Discrete):
        return None
    count = int(space.n)
    given = _given(action, meanings, count, commands.shape[1])
    if action.field is not None:
        if not given and count > MAX_NUMBERED_ACTIONS:
            return None
        found = _of_field(action, count, is_text=commands.dtype.kind == "O")
    elif action.actions:
        found = [tuple(each) for each in action.actions.values()]
    else:
        found = _of_bins(action.edges, values, commands.astype(np.float64))
    return ActionCommands(fields, tuple(given.get(k, each) for k, each in enumerate(found)))


def _given(action: Action, meanings: tuple[str, ...], count: int, size: int) -> dict[int, Command]:
    """Return the commands that the mapping lists, by action."""
    listed = action.representatives
    if isinstance(listed, list):
        # The number of values of a field depends on the bag.
        if listed and len(listed) != count and action.field is None:
            raise UsageError(
                f"representatives has {len(listed)} commands, but there are {count} actions"
            )
        found = dict(enumerate(listed[:count]))
    else:
        numbers = {name: k for name, k in action.numbers.items() if k < count}
        numbers |= {str(k): k for k in range(count)} | {name: k for k, name in enumerate(meanings)}
        for name in listed:
            if name not in numbers:
                near = difflib.get_close_matches(name, numbers, n=3, cutoff=0.3) or list(numbers)
                raise UsageError(
                    f"representatives: no action is named '{name}'; nearest: {', '.join(near[:8])}"
                )
        found = {numbers[name]: each for name, each in listed.items()}
    commands = {k: tuple(each) if isinstance(each, list) else (each,) for k, each in found.items()}
    for command in commands.values():
        if len(command) != size:
            raise UsageError(
                f"representatives has the command {list(command)}, which does not have one value"
                f" for each of {size} fields"
            )
    return commands


def _of_field(action: Action, count: int, *, is_text: bool) -> list[Command | None]:
    """Return the value of the field for each action."""
    if not is_text:
        return [(k,) for k in range(count)]
    # If several texts have the same number, the first of them is the command.
    texts = {number: (text,) for text, number in reversed(action.numbers.items())}
    return [texts.get(k) for k in range(count)]


def _of_bins(
    edges: list[list[float]], values: NDArray[np.int64], commands: NDArray[np.float64]
) -> list[Command | None]:
    """Return the typical command of each combination of bins.

    This is the median, field by field, of the commands of the combination. If there are none, a
    field has the median of all commands in its bin, or else the middle of the bin; for an open bin,
    its edge, and for the only bin, 0.
    """
    medians = []
    for column, limits in zip(commands.T, edges, strict=True):
        bins = np.digitize(column, limits)
        middles = [(low + high) / 2 for low, high in itertools.pairwise(limits)]
        empty = [limits[0], *middles, limits[-1]] if limits else [0.0]
        medians.append(
            [
                float(np.median(column[bins == k])) if (bins == k).any() else each
                for k, each in enumerate(empty)
            ]
        )
    grid = np.stack(np.meshgrid(*medians, indexing="ij"), axis=-1).reshape(-1, len(edges))
    order = np.argsort(values, kind="stable")
    found, firsts = np.unique(values[order], return_index=True)
    for k, rows in zip(found.tolist(), np.split(order, firsts[1:]), strict=True):
        grid[k] = np.median(commands[rows], axis=0)
    return [tuple(each) for each in grid.tolist()]


Array = NDArray[Any]

_MOST_SHOWN = 8
"""Number of elements of a vector up to which viewers show them."""
_UNITS_OF_PARTS = {**dict.fromkeys("xyz", "m"), **dict.fromkeys(("roll", "pitch", "yaw"), "rad")}
_STATE = "state"
"""Key of the vector in an observation that also has images."""


class _Observations(NamedTuple):
    """Observation frames and packets by leaf path, their space, and the names of the vector."""

    frames: dict[tuple[str, ...], Frames]
    space: spaces.Space[Any]
    names: tuple[str, ...]
    packets: dict[tuple[str, ...], Packets]


def assembled(
    plan: Plan, runs: list[Steps], kept: list[list[Segment]], images: Storage
) -> Dataset | None:
    """Return the dataset of the kept episodes of all runs; `kept` must not be empty.

    Returns:
        The dataset; None if images cannot be decoded. `plan.unreadable` lists their messages then.
    """
    summaries: list[EpisodeSummary] = []
    times: list[NDArray[np.int64]] = []
    is_shifted = False
    frames, taken, offset = [], [], 0
    for run, episodes in zip(runs, kept, strict=True):
        shift_ns = _shift(run, episodes, times)
        is_shifted |= shift_ns > 0
        for each in episodes:
            times.append(run.times_ns[each.first : each.last + 1] + shift_ns)
            summaries.append(_summary(plan, run, each, len(summaries), times[-1]))
            frames.append(offset + np.arange(each.first, each.last + 1))
            taken.append(offset + np.arange(each.first, each.last))
        offset += len(run.times_ns)
    steps = np.concatenate(taken)
    lengths = np.array([each.length for each in summaries])
    observed = _observations(plan, runs, np.concatenate(frames), lengths, images)
    if observed is None:
        return None
    actions = np.concatenate([run.actions.values for run in runs])[steps]
    space, meanings = _common_space([run.actions.space for run in runs]), runs[0].actions.meanings
    if (box := plan.mapping.action.box) is not None:
        space = _limited(box, cast(spaces.Box, space), actions, runs[0].actions.names)
    with plan.place.named("action", "representatives"):
        logged = np.concatenate([run.actions.commands for run in runs])[steps]
        fields = runs[0].actions.fields
        commands = action_commands(plan.mapping.action, fields, space, meanings, actions, logged)
    metadata = LogMetadata(
        observation_space=observed.space,
        action_space=space,
        env_id=plan.mapping.meta.env_id,
        observation_names=observed.names,
        action_meanings=meanings,
        action_commands=commands,
        action_part_names=runs[0].actions.names,
        action_units=runs[0].actions.units if any(runs[0].actions.units) else (),
        relative_to=relation(
            plan,
            runs[0].actions.names,
            {
                name: max(run.quantities[name].values.shape[1:] for run in runs)
                for name in plan.mapping.observation
                if name not in plan.images
            },
        ),
        step_duration_ns=(step_ns := _step_ns(plan, times)),
        policy=plan.mapping.meta.policy,
        robot=_robot(plan, runs, observed, commands, space, step_ns),
    )
    transitions = Transitions(
        frames=tuple(observed.frames[leaf.path] for leaf in leaves_of(observed.space)),
        log_time_ns=np.concatenate(times),
        actions=actions,
        rewards=np.concatenate([run.rewards for run in runs])[steps],
        terminated=_at_ends(lengths, [each.terminated for each in summaries]),
        truncated=_at_ends(lengths, [each.truncated for each in summaries]),
        behavior=np.concatenate([run.behavior for run in runs])[steps],
        episodes=tuple(summaries),
        packets={
            k: observed.packets[leaf.path]
            for k, leaf in enumerate(leaves_of(observed.space))
            if leaf.path in observed.packets
        },
    )
    telemetry = _telemetry(plan, runs, np.concatenate(frames))
    origin = Origin(plan.bag.paths, is_shifted=is_shifted)
    if telemetry:
        origin = replace(origin, telemetry=(transitions.log_time_ns, telemetry))
    return Dataset(transitions, metadata, origin=origin)


def _telemetry(
    plan: Plan, runs: list[Steps], rows: NDArray[np.int64]
) -> dict[str, NDArray[np.float32]]:
    """Return what viewers show of the quantities at the frames (F,), by name with unit.

    These are the quantities with a known unit, in this unit, and all `fields`, which the
    observation lacks; of both, those of at most `_MOST_SHOWN` elements.
    """
    found = dict[str, NDArray[np.float32]]()
    for name, wanted in plan.quantities.items():
        parts = [run.quantities[name] for run in runs if len(run.times_ns)]
        kinds = {(part.values.dtype.kind, part.values.shape[1:]) for part in parts}
        if wanted.quantity.pixels is not None or len(kinds) > 1 or kinds.pop()[0] == "O":
            continue
        values = _joined([each.values for each in parts], rows)
        unscaled = _joined([each.unscaled for each in parts], rows)
        if wanted.quantity.as_ == "yaw":
            # Interpolated angles do not jump at pi.
            unscaled = (unscaled + math.pi) % (2 * math.pi) - math.pi
        units = _units(plan, wanted, count := values.shape[1])
        for k, element in enumerate(element_names(name, wanted.quantity, count)):
            if count <= _MOST_SHOWN and (units[k] or name in plan.mapping.fields):
                with np.errstate(over="ignore", invalid="ignore"):
                    column = (unscaled if units[k] else values)[:, k].astype(np.float32)
                found[_shown_name(element, units[k], found)] = column
    return found


def _joined(parts: Sequence[NDArray[Any] | None], rows: NDArray[np.int64]) -> NDArray[Any]:
    """Return the rows (F,) of numbers in several parts as (F, K)."""
    found = np.concatenate([each for each in parts if each is not None])[rows]
    return found.reshape(len(rows), -1)


def _units(plan: Plan, wanted: Wanted, count: int) -> list[str]:
    """Return the unit of each element of a quantity in its messages; empty if it is not known."""
    quantity, source = wanted.quantity, wanted.source
    if quantity.transform is not None:
        return [_UNITS_OF_PARTS.get(part, "") for part in quantity.parts]
    unit = quantity.unit
    if not unit and quantity.as_ is None and source.path is not None:
        field = str(source.path).removeprefix(source.topic).lstrip(".")
        unit = "m" if quantity.scan else unit_of(plan.bag.topics[source.topic].type_name, field)
    return [unit or ("rad" if quantity.as_ == "yaw" else "")] * count


def _shown_name(name: str, unit: str, taken: Container[str]) -> str:
    """Return a name of a field of `/telemetry`: the words of `name`, and its unit."""
    words, suffix = (re.sub(r"[^a-z0-9]+", "_", part.lower()).strip("_") for part in (name, unit))
    found = words if words[:1].isalpha() else f"n_{words}".rstrip("_")
    if suffix and f"_{found}".endswith(f"_{suffix}"):
        suffix = ""
    found += f"_{suffix}" if suffix else ""
    while found in taken or found == RETURN_SO_FAR:
        found += "_2"
    return found


def _robot(
    plan: Plan,
    runs: list[Steps],
    observed: _Observations,
    commands: ActionCommands | None,
    space: spaces.Space[Any],
    step_ns: int,
) -> dict[str, Any]:
    """Return the robot with a mapping that has all that was found in the data."""
    found: dict[str, Any] = {}
    if commands is not None and None not in commands.commands:
        found["representatives"] = commands.to_json()["commands"]
    if isinstance(space, spaces.Box):
        box = plan.mapping.action.box
        assert box is not None, "the action is a Box"
        low, high = space.low.tolist(), space.high.tolist()
        update = {"low": low if box.low is None else box.low}
        update["high"] = high if box.high is None else box.high
        found["box"] = box.model_copy(update=update)
    shapes = dict[str, tuple[int, ...]]()
    for name in plan.quantities:
        if name in plan.images:
            *size, channels = observed.frames[(name,) if len(observed.frames) > 1 else ()].shape[1:]
            shapes[name] = (*size, channels // plan.mapping.stack)
        else:
            shapes[name] = max(run.quantities[name].values.shape[1:] for run in runs)
    action = plan.mapping.action.model_copy(update=found)
    mapping = plan.mapping.model_copy(update={"action": action})
    return Robot.of_plan(plan, shapes, step_ns)._replace(mapping=mapping).to_json()


def _shift(run: Steps, episodes: list[Segment], times: list[NDArray[np.int64]]) -> int:
    """Return the nanoseconds to add to a run's times, so that times increase from run to run."""
    if not (times and episodes):
        return 0
    first_ns, end_ns = int(run.times_ns[episodes[0].first]), int(times[-1][-1])
    return max(0, end_ns + int(NS_PER_S) - first_ns) if first_ns <= end_ns else 0


def _summary(
    plan: Plan, run: Steps, segment: Segment, number: int, times_ns: NDArray[np.int64]
) -> EpisodeSummary:
    rewards = run.rewards[segment.first : segment.last]
    wrong = np.flatnonzero(~np.isfinite(rewards))
    if len(wrong):
        remedy = "set `missing` for the quantities in `reward`"
        if "success" in plan.labels:
            remedy += (
                ", or label the episode, or write `0 if isnan(labels.success) else labels.success`"
            )
        raise UsageError(
            f"{plan.place.of('reward')}: the reward is {rewards[wrong[0]]} at"
            f" {run.times_ns[segment.first + wrong[0]]} ns; it is not finite in {len(wrong)} of"
            f" {len(rewards)} steps of this episode: {remedy}"
        )
    values, kind = run.behavior[segment.first : segment.last], behavior_field(run.actions.space)
    wrong = np.flatnonzero(kind.is_impossible(values))
    if len(wrong):
        assert plan.behavior is not None
        (key,) = plan.behavior.keys
        raise UsageError(
            f"{plan.place.of(key)}: the {kind.what} is {values[wrong[0]]:g} at"
            f" {run.times_ns[segment.first + wrong[0]]} ns; it is not {kind.expected} in"
            f" {len(wrong)} of {len(values)} steps of this episode: use another field, `scale` or"
            f" `clip`, or remove {key}"
        )
    named = (name for name, holds in run.reasons.items() if holds[segment.last])
    end = "terminated" if segment.terminated else "truncated"
    return EpisodeSummary(
        episode=number,
        length=segment.length,
        total_reward=add_up(rewards),
        terminated=segment.terminated,
        truncated=segment.truncated,
        start_time_ns=int(times_ns[0]),
        end_time_ns=int(times_ns[-1]),
        reason=next(named, segment.reason or end),
        policy=plan.mapping.meta.policy,
    )


def _at_ends(lengths: NDArray[np.int64], flags: list[bool]) -> NDArray[np.bool_]:
    """Return (T,) flags: the flag of an episode at its last transition, False at all others."""
    found = np.zeros(int(lengths.sum()), bool)
    found[np.cumsum(lengths) - 1] = flags
    return found


def _step_ns(plan: Plan, times: list[NDArray[np.int64]]) -> int:
    rate_hz = plan.mapping.clock.rate_hz
    if rate_hz is not None:
        return round(NS_PER_S / rate_hz)
    durations = np.concatenate([np.diff(each) for each in times])
    # Steps at equal times of a slow clock are one nanosecond apart; see `runs.distinct`.
    return max(1, int(np.median(durations) if durations.min() > 1 else round(durations.mean())))


def _observations(
    plan: Plan,
    runs: list[Steps],
    rows: NDArray[np.int64],
    lengths: NDArray[np.int64],
    images: Storage,
) -> _Observations | None:
    """Return the observations; None if images cannot be decoded."""
    vectors: dict[str, Array] = {}
    parts: dict[str, spaces.Space[Any]] = {}
    names = _put_vector(plan, runs, rows, vectors, parts)
    count = plan.mapping.stack
    stacked = _stacked(lengths, count) if count > 1 else np.arange(len(rows))
    if count > 1:
        vectors = {
            name: np.concatenate([array[each] for each in stacked.T], axis=-1)
            for name, array in vectors.items()
        }
        parts = {name: _repeated(space, count) for name, space in parts.items()}
        names = _stacked_names(names, count)
    arrays: dict[str, Frames] = dict(vectors)
    packets, is_complete = dict[str, Packets](), True
    for name, reader in plan.images.items():
        places = np.concatenate([run.quantities[name].values for run in runs])[rows]
        around, poses = plan.mapping.observation[name].around, None
        with plan.place.named("observation", name):
            if around is not None:
                each = [place_of(around, run.quantities) for run in runs if len(run.times_ns)]
                poses = np.concatenate(each)[rows][stacked]
            found = reader.read(places[stacked], images, poses)
        if found is None:
            # The other images are read all the same, to find all that cannot be decoded.
            is_complete = False
        else:
            arrays[name], parts[name] = found, reader.space(found)
            if (video := reader.packets(places[stacked])) is not None:
                packets[name] = video
    if not is_complete:
        return None
    if len(parts) == 1:
        (name,) = parts
        copied: dict[tuple[str, ...], Packets] = {(): packets[name]} if packets else {}
        return _Observations({(): arrays[name]}, parts[name], tuple(names), copied)
    by_path: dict[tuple[str, ...], Frames] = {(name,): array for name, array in arrays.items()}
    return _Observations(
        by_path, spaces.Dict(parts), (), {(name,): one for name, one in packets.items()}
    )


def _put_vector(
    plan: Plan,
    runs: list[Steps],
    rows: NDArray[np.int64],
    arrays: dict[str, Array],
    parts: dict[str, spaces.Space[Any]],
) -> list[str]:
    """Add all numeric quantities, if any, as one vector; return the names of its elements."""
    vectors, limits, names = [], list[tuple[float, float]](), list[str]()
    for name, quantity in plan.mapping.observation.items():
        if quantity.pixels is None:
            values = np.concatenate([run.quantities[name].values for run in runs])[rows]
            with plan.place.named("observation", name):
                numbers = _as_float32(as_numbers(values, name), name).reshape(len(rows), -1)
            vectors.append(numbers)
            names += element_names(name, quantity, numbers.shape[1])
            limits += [_limits(quantity)] * numbers.shape[1]
    if vectors:
        arrays[_STATE] = np.concatenate(vectors, axis=1)
        low, high = np.array(limits, np.float32).T
        parts[_STATE] = spaces.Box(low, high)
    return names


def _as_float32(values: NDArray[np.float64], name: str) -> NDArray[np.float32]:
    """Round values to float32."""
    with np.errstate(over="ignore"):
        found = values.astype(np.float32)
    lost = values[np.isinf(found) & np.isfinite(values)]
    if len(lost):
        raise UsageError(f"{name} has the value {lost[0]:g}, too large for float32: use `scale`")
    return found


def vector_names(plan: Plan, runs: list[Steps]) -> list[str]:
    """Return the names of the elements of the observed vector."""
    names = []
    for name, quantity in plan.mapping.observation.items():
        if quantity.pixels is None:
            shapes = [run.quantities[name].values.shape[1:] for run in runs]
            count = max((shape[0] for shape in shapes if shape), default=1)
            names += element_names(name, quantity, count)
    return names


def observed_names(mapping: Mapping, shapes: MappingOf[str, tuple[int, ...]]) -> tuple[str, ...]:
    """Return the names of the elements of the observed vector for the shapes of the quantities.

    With images, the vector is a part of the observation, and there are no names.
    """
    if any(quantity.pixels is not None for quantity in mapping.observation.values()):
        return ()
    names = [
        each
        for name, quantity in mapping.observation.items()
        for each in element_names(name, quantity, math.prod(shapes[name]))
    ]
    return tuple(_stacked_names(names, mapping.stack))


def relation(
    plan: Plan, parts: Sequence[str], shapes: MappingOf[str, tuple[int, ...]]
) -> tuple[int | None, ...]:
    """Return `Dataset.relative_to` of a mapping, for the elements of a command and the shapes.

    Raises:
        UsageError: There is no such quantity or element, or their numbers do not fit.
    """
    action, place = plan.mapping.action, plan.place
    if action.relative_to is None:
        return ()
    unknown = [name for name in action.absolute if name not in parts]
    if unknown:
        raise UsageError(
            f"{place.of('action', 'absolute')}: the command has no element"
            f" '{unknown[0]}'; elements: {', '.join(parts)}"
        )
    names = [name for name, each in plan.mapping.observation.items() if each.image is None]
    where = place.of("action", "relative_to")
    if action.relative_to not in names:
        raise UsageError(
            f"{where}: '{action.relative_to}' is no observed vector: {', '.join(names) or 'none'}"
        )
    sizes = [math.prod(shapes[name]) for name in names]
    at = names.index(action.relative_to)
    # Of a stack, the newest frame is the last one.
    first = (plan.mapping.stack - 1) * sum(sizes) + sum(sizes[:at])
    relative = [part for part in parts if part not in action.absolute]
    if sizes[at] not in (len(parts), len(relative)):
        raise UsageError(
            f"{where}: '{action.relative_to}' has {counted(sizes[at], 'element')}, but the command"
            f" has {len(parts)}, of which {len(relative)} are relative"
        )
    paired = parts if sizes[at] == len(parts) else relative
    return tuple(None if part in action.absolute else first + paired.index(part) for part in parts)


def _stacked_names(names: list[str], count: int) -> list[str]:
    ages = [f"_{age}_ago" if age else "" for age in range(count - 1, -1, -1)]
    return [f"{name}{age}" for age in ages for name in names]


def _limits(quantity: Quantity) -> tuple[float, float]:
    """Return the lowest and highest value of a quantity, including the number for missing ones."""
    if quantity.clip is None:
        return -np.inf, np.inf
    missing = [] if quantity.missing is None else [quantity.missing]
    return min(*quantity.clip, *missing), max(*quantity.clip, *missing)


def element_names(name: str, quantity: Quantity, count: int) -> list[str]:
    """Return the names of the `count` elements of a quantity in the vector of observations."""
    if quantity.transform is not None:
        return [f"{name}_{part}" for part in quantity.parts]
    names = quantity.elements or quantity.names
    if quantity.elements and len(quantity.elements) != count:
        raise UsageError(
            f"{name}: `elements` has {counted(len(quantity.elements), 'name')}, but the value has"
            f" {counted(count, 'element')}"
        )
    if isinstance(names, list) and names:
        return [f"{name}_{element}" for element in names]
    return [name] if count == 1 else [f"{name}_{k}" for k in range(count)]


def _stacked(lengths: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return the indexes of the `count` frames in the stack of each frame.

    The shape is (frames, count), with the oldest frame first. At the beginning of an episode, its
    first frame is repeated.
    """
    firsts = np.repeat(np.cumsum(lengths + 1) - lengths - 1, lengths + 1)
    here = np.arange(len(firsts))[:, np.newaxis]
    found: NDArray[np.int64] = np.maximum(here - np.arange(count)[::-1], firsts[:, np.newaxis])
    return found


def _repeated(space: spaces.Space[Any], count: int) -> spaces.Space[Any]:
    """Return the space of `count` observations that are concatenated along the last axis."""
    assert isinstance(space, spaces.Box), "all parts are Boxes"
    low, high = (np.concatenate([limit] * count, axis=-1) for limit in (space.low, space.high))
    return spaces.Box(low, high, dtype=space.dtype.type)


def _limited(box: Limits, space: spaces.Box, actions: Array, names: tuple[str, ...]) -> spaces.Box:
    """Return a space with the limits of the actions (N, K) where the mapping has none."""
    low = actions.min(axis=0) if box.low is None else space.low
    high = actions.max(axis=0) if box.high is None else space.high
    if box.low is None or box.high is None:
        found = ", ".join(
            f"{name} from {least:g} to {most:g}"
            for name, least, most in zip(names, low, high, strict=True)
        )
        warnings.warn(
            f"the limits of the action are those of this data: {found}; give `box` a low and a"
            " high, because other data may have others",
            stacklevel=5,
        )
    return spaces.Box(low, high)


def _common_space(found: list[spaces.Space[Any]]) -> spaces.Space[Any]:
    """Return a space for all runs.

    If the runs have Discrete spaces, this is the largest one. All Box spaces are equal.
    """
    return max(found, key=lambda space: int(getattr(space, "n", 0)))
