"""The dataset: transitions of whole episodes as NumPy arrays."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError, UnknownNameError, UsageError
from mcaprl.recorder.dataset.conversions import Conversions
from mcaprl.recorder.dataset.images import MappedImages, blocks_of, rows_of
from mcaprl.recorder.dataset.statistics import Statistics, describe_columns
from mcaprl.recorder.dataset.transitions import (
    STEP_COLUMNS,
    Episode,
    Origin,
    TransitionBatch,
    Transitions,
    shapes,
    with_mask,
)
from mcaprl.recorder.format.behavior import BehaviorField, behavior_field
from mcaprl.recorder.format.messages import add_up_each
from mcaprl.recorder.format.metadata import ESTIMATED, ActionCommands, LogMetadata
from mcaprl.recorder.format.spaces import nest, space_to_json

if TYPE_CHECKING:
    import pandas
    import pyarrow


class Dataset(Conversions):
    """Transitions of whole episodes, from logs or from arrays.

    Attributes:
        origin: Files that the data was read from, and the mapping and its report.
        weights: (E,) weight of each episode in training: a transition of weight 2 is drawn twice as
            often as one of weight 1. Statistics and estimates do not use the weights, and `save`
            does not write them.
        wholes: (E,) number of each episode, which parts of one episode share; see `without`.
    """

    def __init__(
        self,
        transitions: Transitions,
        description: LogMetadata,
        *,
        origin: Origin = Origin(),  # noqa: B008  (frozen)
        weights: NDArray[np.float64] | None = None,
        wholes: NDArray[np.int64] | None = None,
    ) -> None:
        """Create a dataset; use `mcaprl.open` or `Dataset.from_arrays` instead."""
        self._transitions = transitions
        self._description = description
        self._leaves = description.leaves
        self.origin = origin
        self.weights = np.ones(len(transitions.episodes)) if weights is None else weights
        self.wholes = np.arange(len(transitions.episodes)) if wholes is None else wholes

    @classmethod
    def from_arrays(
        cls,
        *,
        observations: Any,
        actions: Any,
        rewards: Any,
        terminated: Any,
        truncated: Any,
        next_observations: Any,
        behavior_probs: Any = None,
        behavior_log_probs: Any = None,
        env_id: str = "",
        observation_space: spaces.Space[Any] | None = None,
        action_space: spaces.Space[Any] | None = None,
    ) -> Dataset:
        """Create a dataset of N transitions in chronological order.

        An episode ends where `terminated` or `truncated` is set, or where a transition's next
        observation differs from the following transition's observation.

        Args:
            observations: (N, *shape) array, or nested dicts of such arrays.
            actions: (N,) integers, or (N, *shape) array.
            rewards: (N,) rewards.
            terminated: (N,) bool; whether the transition led to a terminal state.
            truncated: (N,) bool; whether the episode was truncated after the transition.
            next_observations: Next observations, in the form of `observations`.
            behavior_probs: (N,) probability of each action under the behavior policy; default: NaN
                (unknown). Not for actions of floats.
            behavior_log_probs: (N,) natural logarithm of this probability or, for actions of
                floats, of the probability density; instead of `behavior_probs`.
            env_id: Gymnasium id of the environment.
            observation_space: Space of the observations; default: the environment's space if
                `env_id` is registered, else unbounded Boxes with the arrays' shapes and dtypes.
            action_space: Space of the actions; default: the environment's space if `env_id` is
                registered, else Discrete up to the largest integer action, or an unbounded Box.

        Raises:
            SpaceError: Lengths or shapes do not agree with each other or with the spaces, or an
                action, probability or density is not possible.
        """
        from mcaprl.recorder.dataset.arrays import (
            behavior_of_arrays,
            check_finite,
            columns_of_arrays,
            description_of,
            numbers,
        )

        check_finite("actions", numbers("actions", actions))
        description = description_of(env_id, observations, actions, observation_space, action_space)
        behavior = behavior_of_arrays(
            behavior_field(description.action_space), behavior_probs, behavior_log_probs
        )
        steps = (actions, rewards, terminated, truncated, behavior)
        columns = dict(zip(STEP_COLUMNS, steps, strict=True))
        transitions = columns_of_arrays(description, observations, next_observations, columns)
        return cls(transitions, description)

    @classmethod
    def concatenate(cls, parts: Sequence[Dataset]) -> Dataset:
        """Concatenate the episodes of several datasets.

        Metadata fields that differ between the datasets are empty in the result.

        Raises:
            SpaceError: The datasets' spaces differ.
            LogError: `parts` is empty.
        """
        if not parts:
            raise LogError("no data: the list of datasets or files is empty")
        first = parts[0]
        numbers = np.cumsum([0, *(part.wholes.max(initial=-1) + 1 for part in parts)])
        for other in parts[1:]:
            for role in ("observation_space", "action_space"):
                if getattr(first, role) != getattr(other, role):
                    raise SpaceError(
                        f"{first._name()} and {other._name()} differ in {role}:"
                        f" {getattr(first, role)} and {getattr(other, role)}"
                    )
        if len(parts) == 1:
            return first
        return cls(
            Transitions.concatenate([part._transitions for part in parts]),
            LogMetadata.common([part._description for part in parts]),
            origin=Origin.common([part.origin for part in parts]),
            weights=np.concatenate([part.weights for part in parts]),
            wholes=np.concatenate([p.wholes + k for p, k in zip(parts, numbers[:-1], strict=True)]),
        )

    @property
    def sources(self) -> tuple[Path, ...]:
        """Files that the data was read from; empty for arrays."""
        return self.origin.sources

    @cached_property
    def metadata(self) -> dict[str, str]:
        """Metadata of the log, as strings by name."""
        return self._description.to_strings()

    @cached_property
    def observations(self) -> Any:
        """(N, *shape) in the space's dtype, or nested dicts of such arrays.

        Images on disk are read by indexing the array and by `batch`.
        """
        return self._frames(self.frame_of_step)

    @cached_property
    def next_observations(self) -> Any:
        """Next observation of each transition, in the form of `observations`."""
        return self._frames(self.frame_of_step + 1)

    @property
    def storage(self) -> str:
        """Storage of the observations: `memory`, or the files that contain the images."""
        mapped = [leaf for leaf in self._transitions.frames if isinstance(leaf, MappedImages)]
        names = list(dict.fromkeys(name for leaf in mapped for name in leaf.names))
        more = f" and {len(names) - 1} more" if len(names) > 1 else ""
        return f"images on disk in {names[0]}{more}" if names else "memory"

    @property
    def frames(self) -> Any:
        """(N + E, *shape) observations without duplicates, or nested dicts of such arrays.

        Each of the E episodes has T + 1 observations, in order. The arrays are not copied.
        """
        return nest(self._leaves, list(self._transitions.frames))

    @cached_property
    def frame_of_step(self) -> NDArray[np.int64]:
        """(N,) index k of each transition's observation in `frames`.

        Row k is the observation, and row k + 1 is the next observation.
        """
        return self._transitions.frame_of_step()

    @property
    def episode_lengths(self) -> NDArray[np.int64]:
        """(E,) number of transitions of each episode."""
        return self._transitions.lengths

    @property
    def actions(self) -> NDArray[Any]:
        """(N,) int64 actions for a Discrete space, otherwise (N, *shape)."""
        return self._transitions.actions

    @property
    def rewards(self) -> NDArray[np.float64]:
        """(N,) float64 rewards."""
        return self._transitions.rewards

    @property
    def terminated(self) -> NDArray[np.bool_]:
        """(N,) bool: whether the transition led to a terminal state."""
        return self._transitions.terminated

    @property
    def truncated(self) -> NDArray[np.bool_]:
        """(N,) bool: whether the episode was truncated after this transition."""
        return self._transitions.truncated

    @property
    def behavior(self) -> NDArray[np.float32]:
        """(N,) float32, what the log stores: probabilities, or for actions of floats log densities.

        NaN means unknown. `behavior_field` has the meaning of the values.
        """
        return self._transitions.behavior

    @property
    def behavior_field(self) -> BehaviorField:
        """Meaning of `behavior`: name of the field in the log, and range of its values."""
        return behavior_field(self.action_space)

    @property
    def behavior_probs(self) -> NDArray[np.float32]:
        """(N,) float32 probability of each action under the behavior policy; NaN if unknown.

        Raises:
            SpaceError: The actions are floats, which have densities: see `behavior_log_probs`.
        """
        return self.behavior_field.probs(self.behavior)

    @property
    def behavior_log_probs(self) -> NDArray[np.float32]:
        """(N,) float32 natural logarithm of the probability of each action; NaN if unknown.

        For actions of floats it is that of the probability density, in the action's own units.
        """
        return self.behavior_field.log_probs(self.behavior)

    @property
    def infos(self) -> dict[str, np.ma.MaskedArray[Any, Any]]:
        """(N + E, *shape) masked array of each info by its dotted name, such as `episode.r`.

        Row k is the info that the environment returned with row k of `frames`; the row is masked
        if the environment returned none. The mapping is empty if no infos were recorded.
        """
        return dict(self._transitions.infos)

    @property
    def has_estimated_probs(self) -> bool:
        """Whether `behavior` was estimated from the actions, not logged by the policy."""
        return bool(self._description.behavior_prob)

    @property
    def env_id(self) -> str:
        """Gymnasium id of the environment; empty if unknown."""
        return self._description.env_id

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """Keyword arguments passed to `gymnasium.make` for the environment."""
        return dict(self._description.env_kwargs)

    @property
    def unstored_kwargs(self) -> tuple[str, ...]:
        """Names of arguments of the environment that the log does not store: they are not JSON."""
        return self._description.unstored_kwargs

    @property
    def observation_space(self) -> spaces.Space[Any]:
        """Observation space of the environment."""
        return self._description.observation_space

    @property
    def action_space(self) -> spaces.Space[Any]:
        """Action space of the environment."""
        return self._description.action_space

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of a vector observation's elements; empty if unknown."""
        return self._description.observation_names

    @property
    def action_meanings(self) -> tuple[str, ...]:
        """Names of the discrete actions; empty if unknown."""
        return self._description.action_meanings

    @property
    def action_part_names(self) -> tuple[str, ...]:
        """Names of a vector action's elements, such as `steering`; empty if unknown."""
        return self._description.action_part_names

    @property
    def action_units(self) -> tuple[str, ...]:
        """Units of a vector action's elements, such as `m/s`; empty if unknown.

        A unit can also name both directions of an element, as `right | left` does: the negative
        direction is the first.
        """
        return self._description.action_units

    @property
    def relative_to(self) -> tuple[int | None, ...]:
        """Index of the observed element that each element of an action is relative to.

        It is one of the observation's vector, or None for an absolute element; empty if all are
        absolute. `actions` are absolute all the same: learning subtracts, and policies add again.
        """
        return self._description.relative_to

    @property
    def action_labels(self) -> tuple[str, ...]:
        """Names of a vector action's elements with their bounds and units; empty without names.

        A label is such as `speed (0 to 2 m/s)`, or `steering (-1 right, 1 left)`.
        """
        return self._description.action_labels()

    @property
    def robot(self) -> Mapping[str, Any]:
        """Mapping, topics and shapes of the robot from whose bag the data was made.

        A policy that was trained on the data drives this robot; see docs/drive.md. They are JSON
        types, with the keys `mapping`, `topics` and `shapes`; empty for other data.
        """
        return self._description.robot

    @property
    def action_commands(self) -> ActionCommands | None:
        """Commands that the discrete actions stand for, if the data is from a bag; else None.

        `fields` has the paths of the K fields of a command, and `commands` has K values for each
        action.
        """
        return self._description.action_commands

    @property
    def action_names(self) -> dict[int, str]:
        """Names of the discrete actions, by value; empty for other action spaces.

        If `action_meanings` does not contain a distinct name for each action, the names are the
        numbers as text, or the dict is empty if there are more than 1,000 actions.
        """
        return self._description.action_names()

    @cached_property
    def episodes(self) -> tuple[Episode, ...]:
        """All episodes, in order."""
        columns = self._transitions
        found: list[Episode] = []
        starts = zip(columns.first_steps.tolist(), columns.first_frames.tolist(), strict=True)
        for summary, (step, frame) in zip(columns.episodes, starts, strict=True):
            last = frame + summary.length
            episode = Episode(
                index=len(found),
                observations=self._frames(slice(frame, last)),
                next_observations=self._frames(slice(frame + 1, last + 1)),
                log_time_ns=columns.log_time_ns[frame : last + 1],
                summary=summary,
                infos={name: info[frame : last + 1] for name, info in columns.infos.items()},
                behavior_field=self.behavior_field,
                **columns.at(slice(step, step + summary.length)),
            )
            found.append(episode)
        return tuple(found)

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the spaces and transitions, independent of file names and compression.

        Weights are included if they are not all equal.
        """
        if len(set(self.weights.tolist())) > 1:
            return hashlib.sha256(self.content.encode() + self.weights.tobytes()).hexdigest()
        return self.content

    @cached_property
    def content(self) -> str:
        """SHA-256 of the spaces and transitions: the fingerprint without weights."""
        columns = self._transitions
        digest = hashlib.sha256(space_to_json(self.observation_space).encode())
        digest.update(space_to_json(self.action_space).encode())
        steps = [getattr(columns, name) for name in STEP_COLUMNS]
        for array in (*columns.frames, *steps, columns.lengths):
            for block in blocks_of(array):
                digest.update(block.data)
        return digest.hexdigest()

    @cached_property
    def statistics(self) -> Statistics:
        """Returns, lengths, end reasons and value ranges."""
        return describe_columns(self._transitions, self._leaves)

    def filter(self, keep: Callable[[Episode], bool]) -> Dataset:
        """Return a copy with only the episodes for which `keep` returns true."""
        return self._take([episode.index for episode in self.episodes if keep(episode)])

    def without(self, steps: Any) -> Dataset:
        """Return a copy without some steps, such as those in which a human intervened.

        An episode is divided at these steps, and the parts are episodes: no return of n steps,
        stack of frames or sequence crosses the gap. A part that ends at a gap is truncated with the
        reason `interrupted`, and a part that begins after a gap has no seed. Parts of one episode
        share a number in `wholes`, so that training holds out all of them or none.

        Args:
            steps: (N,) bool; whether the transition is left out.

        Raises:
            SpaceError: `steps` is not one flag for each transition.
            UsageError: No transition is left.
        """
        dropped = np.asarray(steps)
        if dropped.shape != (len(self),) or dropped.dtype != np.bool_:
            raise SpaceError(f"steps must be {len(self)} flags, one for each transition")
        if dropped.all():
            raise UsageError("no transition is left")
        columns, old = self._transitions.without(dropped)
        return self._changed(columns, kept=old)

    def with_behavior_probs(self, probs: NDArray[Any], *, estimated: bool = False) -> Dataset:
        """Return the same transitions with other behavior probabilities.

        Args:
            probs: (N,) probability of each action under the behavior policy; NaN if unknown.
            estimated: Whether the probabilities are estimates. This flag is saved with the
                dataset, and results that are based on such probabilities mention it.

        Raises:
            SpaceError: The length of `probs` is not the number of transitions, or the actions are
                floats.
        """
        self.behavior_field.probs(self.behavior)
        return self._with_behavior("probs", np.asarray(probs, np.float32), estimated)

    def with_behavior_log_probs(
        self, log_probs: NDArray[Any], *, estimated: bool = False
    ) -> Dataset:
        """Return the same transitions with other behavior probabilities or densities.

        Args:
            log_probs: (N,) values, as `behavior_log_probs` has them; NaN if unknown.
            estimated: Whether they are estimates; see `with_behavior_probs`.

        Raises:
            SpaceError: The length of `log_probs` is not the number of transitions.
        """
        column = self.behavior_field.column(None, log_probs)
        assert column is not None
        return self._with_behavior("log_probs", column, estimated)

    def _with_behavior(self, name: str, column: NDArray[np.float32], estimated: bool) -> Dataset:
        if column.shape != (len(self),):
            raise SpaceError(f"{name} has shape {column.shape}, expected {(len(self),)}")
        mark = ESTIMATED if estimated else ""
        columns = dataclasses.replace(self._transitions, behavior=column)
        return self._changed(columns, dataclasses.replace(self._description, behavior_prob=mark))

    def with_rewards(self, rewards: Any) -> Dataset:
        """Return the same transitions with other rewards; the returns of the episodes are theirs.

        Args:
            rewards: (N,) reward of each transition, in the order of `rewards`; finite numbers.

        Raises:
            SpaceError: The length of `rewards` is not the number of transitions, or a reward is not
                a finite number.
        """
        given = np.asarray(rewards)
        if given.shape != (len(self),):
            raise SpaceError(f"rewards has shape {given.shape}, expected {(len(self),)}")
        if given.dtype.kind not in "biuf":
            raise SpaceError(f"rewards has dtype {given.dtype}, expected numbers")
        column = given.astype(np.float64)
        if not np.isfinite(column).all():
            row = int(np.isfinite(column).argmin())
            raise SpaceError(f"rewards has {column[row]} in row {row}, expected finite numbers")
        columns = self._transitions
        stops = np.cumsum(columns.lengths)
        totals = add_up_each(column, columns.first_steps.tolist(), stops.tolist())
        episodes = tuple(
            one._replace(total_reward=total)
            for one, total in zip(columns.episodes, totals, strict=True)
        )
        return self._changed(dataclasses.replace(columns, rewards=column, episodes=episodes))

    def with_weights(self, weights: Any) -> Dataset:
        """Return the same transitions with other weights in training; see `weights`.

        Args:
            weights: (E,) weight of each episode, at least 0.

        Raises:
            UsageError: There is not one valid weight for each episode.
        """
        found, count = np.asarray(weights, np.float64), len(self.episode_lengths)
        if found.shape != (count,) or not np.isfinite(found).all() or (found < 0).any():
            raise UsageError(f"weights must be {count} numbers of at least 0, one per episode")
        return self._changed(self._transitions, weights=found)

    def with_action_mask(self, source: str) -> Dataset:
        """Return the same transitions with the flags of the allowed actions in the observations.

        The observations become `{"observation": ..., "action_mask": ...}`; learning and estimates
        use only allowed actions. `mask_from` of `mcaprl.train` does the same.

        Args:
            source: `info:NAME` for a recorded info, or the key of a part of a Dict observation,
                such as `robot/legal`; an array with a flag for each action, in each observation.

        Raises:
            SpaceError: The observations have an `action_mask` already, the values are no flags, or
                a frame in which an action was chosen has none.
            UnknownNameError: There is no such info or part.
        """
        return self._changed(*with_mask(self._transitions, self._description, source))

    def with_relative_actions(self, parts: Mapping[str | int, str | int]) -> Dataset:
        """Return the same transitions, whose actions are learned relative to observations.

        Args:
            parts: Element of a vector observation for each element of the action that is relative,
                by names or numbers, in the same units. The others, such as grippers, are absolute.

        Raises:
            SpaceError: The action space is not a Box, or there is no such element.
        """
        if not isinstance(self.action_space, spaces.Box):
            raise SpaceError(f"relative actions need a Box, not {self.action_space}")
        count = math.prod(self.action_space.shape)
        own = self.action_part_names or [f"action[{k}]" for k in range(count)]
        width = max(
            (math.prod(leaf.shape) for leaf in self._leaves if len(leaf.shape) < 2), default=0
        )
        seen = self.observation_names or [f"observation[{k}]" for k in range(width)]
        found: list[int | None] = [None] * count
        for part, name in parts.items():
            found[_place(part, own, "action")] = _place(name, seen, "observation")
        return self._changed(
            self._transitions, dataclasses.replace(self._description, relative_to=tuple(found))
        )

    def grow(self) -> Dataset:
        """Return the dataset with the episodes that have ended since it was read.

        A dataset that was not opened with `follow`, or that was changed, is returned as it is.

        Raises:
            LogError: A log was replaced, or is damaged.
        """
        grown: Dataset = self if self.origin.grow is None else self.origin.grow()
        return grown

    def batch(self, steps: NDArray[np.integer[Any]]) -> TransitionBatch:
        """Copy the transitions with indexes (B,), reading images from disk if needed.

        Raises:
            CorruptLogError: Images on disk are damaged.
        """
        columns, frames = self._transitions, self.frame_of_step[steps]
        return TransitionBatch(
            observations=nest(self._leaves, [leaf[frames] for leaf in columns.frames]),
            next_observations=nest(self._leaves, [leaf[frames + 1] for leaf in columns.frames]),
            behavior_field=self.behavior_field,
            **columns.at(steps),
        )

    def split(self, fraction: float, *, seed: int = 0) -> tuple[Dataset, Dataset]:
        """Split the episodes at random into two datasets.

        Both parts keep the order of the episodes. If there are two or more episodes, neither part
        is empty.

        Args:
            fraction: Share of the episodes in the first part, between 0 and 1 (exclusive).
            seed: Seed of the random split.

        Raises:
            UsageError: `fraction` is not between 0 and 1.
        """
        if not 0 < fraction < 1:
            raise UsageError(f"fraction {fraction}: give a number between 0 and 1")
        count = len(self.episodes)
        first_count = min(max(round(count * fraction), 1), max(count - 1, 1))
        order = np.random.default_rng(seed).permutation(count)
        first, second = np.sort(order[:first_count]), np.sort(order[first_count:])
        return self._take(first.tolist()), self._take(second.tolist())

    def save(
        self,
        path: str | Path,
        *,
        compression: str = "zstd",
        overwrite: bool = False,
        keep_topics: bool | str | Sequence[str] | None = None,
    ) -> None:
        """Write the dataset as one log; `mcaprl.open` reads back an equal dataset.

        Args:
            path: Path of the log.
            compression: `zstd`, `lz4` or `none`.
            overwrite: Whether to replace an existing file.
            keep_topics: Topics of the bag that the data was read from, to be copied beside
                `/rl/*` with their bytes, schemas and times: True for all, or names and patterns
                such as `/camera/*`; None for those of the mapping's `keep`, False for none.

        Raises:
            OutputExistsError: The file exists and `overwrite` is not set.
            LogError: The file cannot be written, or a topic cannot be kept.
            UnknownNameError: The bag has no such topic.
            UsageError: There are topics to keep, but the data was not read from a bag.
        """
        from mcaprl.recorder.dataset.save import save_log

        add_topics, copy, where = None, self.origin.copy_topics, ""
        if keep_topics is None:
            keep_topics, where = self.origin.keep, " in `keep` of the mapping"
        if keep_topics:
            if copy is None:
                raise UsageError("keep_topics is for data that were read from a bag by a mapping")
            if self.origin.is_shifted:
                raise LogError(
                    f"{path}: the topics of the bag cannot be kept, because its recordings overlap"
                    " in time: convert them one by one, or keep none"
                )
            patterns = ["*"] if keep_topics is True else keep_topics
            patterns = [patterns] if isinstance(patterns, str) else list(patterns)
            add_topics = partial(copy, patterns, where=where)
        save_log(
            path,
            self._transitions,
            self._description,
            compression=compression,
            overwrite=overwrite,
            add_topics=add_topics,
            telemetry=self.origin.telemetry,
        )

    def to_arrow(
        self,
        table: Literal["transitions", "episodes"] = "transitions",
        *,
        tensors: Literal["columns", "lists"] = "columns",
    ) -> pyarrow.Table:
        """Return a PyArrow table with one row per transition or per episode.

        This method requires the extra `tables`.

        Args:
            table: `transitions` or `episodes`.
            tensors: Form of vectors and images in the table of transitions. With `columns`, a
                tensor of up to 64 elements becomes one column per element, and a larger tensor
                becomes one column of flat lists. With `lists`, each tensor becomes one column of
                fixed-size lists, which shares its memory with the dataset where possible.

        Raises:
            MissingExtraError: PyArrow is not installed.
            UnknownNameError: There is no such table, or no such form of tensors.
        """
        from mcaprl.recorder.dataset.tables import episode_table, transition_table

        for what, name, names in (
            ("table", table, ["transitions", "episodes"]),
            ("form of tensors", tensors, ["columns", "lists"]),
        ):
            if name not in names:
                raise UnknownNameError(what, name, names)
        if table == "episodes":
            return episode_table(self._transitions)
        return transition_table(self._transitions, self._leaves, self._description, tensors=tensors)

    def to_pandas(
        self, table: Literal["transitions", "episodes"] = "transitions"
    ) -> pandas.DataFrame:
        """Return a pandas DataFrame; see `to_arrow`. Requires the extra `tables`."""
        return self.to_arrow(table).to_pandas()

    def __len__(self) -> int:
        """Return the number of transitions."""
        return len(self.rewards)

    def __repr__(self) -> str:
        """Return a summary with shapes instead of arrays."""
        columns = ", ".join(
            f"{leaf.name}={shapes(frames)[1:-1]}"
            for leaf, frames in zip(self._leaves, self._transitions.frames, strict=True)
        )
        where = "" if self.storage == "memory" else f", {self.storage}"
        return (
            f"Dataset({self.env_id or 'unknown environment'}: {len(self._transitions.episodes)}"
            f" episodes, {len(self)} transitions, {columns}, actions={self.action_space}{where})"
        )

    def _take(self, chosen: Sequence[int]) -> Dataset:
        return self._changed(self._transitions.take(chosen), kept=np.array(chosen, np.int64))

    def _changed(
        self,
        transitions: Transitions,
        description: LogMetadata | None = None,
        weights: NDArray[np.float64] | None = None,
        kept: NDArray[np.int64] | slice = slice(None),
    ) -> Dataset:
        return Dataset(
            transitions,
            description or self._description,
            origin=self.origin.changed(),
            weights=self.weights[kept] if weights is None else weights,
            wholes=self.wholes[kept],
        )

    def _frames(self, rows: Any) -> Any:
        return nest(self._leaves, [rows_of(frames, rows) for frames in self._transitions.frames])

    def _name(self) -> str:
        return str(self.sources[0]) if self.sources else repr(self)


# Reprs and pickles contain this public import path.
Dataset.__module__ = "mcaprl"


def _place(given: str | int, names: Sequence[str], what: str) -> int:
    """Return the index of an element that is given by its name or index."""
    if isinstance(given, int) and 0 <= given < len(names):
        return given
    if given not in names:
        raise SpaceError(f"the {what} has no element {given!r}; elements: {', '.join(names)}")
    return list(names).index(str(given))
