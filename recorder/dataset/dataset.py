"""Transitions as arrays, and what one does with them before learning."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError, UnknownNameError
from mcaprl.recorder.dataset.batch import Batch
from mcaprl.recorder.dataset.episode import Episode, shapes
from mcaprl.recorder.dataset.mapped import MappedImages, rows_of
from mcaprl.recorder.dataset.statistics import Statistics, describe_columns
from mcaprl.recorder.dataset.transitions import Transitions
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import leaves_of, nest, space_to_json

if TYPE_CHECKING:
    import pandas
    import pyarrow


# Rows that are hashed at a time: images on disk need not fit into memory.
_BLOCK_ROWS = 1024


class Dataset:
    """Transitions of whole episodes, from logs or from arrays.

    Attributes:
        sources: the files that it was read from; empty if it was not.
    """

    def __init__(
        self,
        transitions: Transitions,
        description: LogMetadata,
        *,
        sources: tuple[Path, ...] = (),
    ) -> None:
        """Use `mcaprl.open` or `Dataset.from_arrays`."""
        self._transitions = transitions
        self._description = description
        self._leaves = leaves_of(description.observation_space)
        self.sources = sources

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
        env_id: str = "",
        observation_space: spaces.Space[Any] | None = None,
        action_space: spaces.Space[Any] | None = None,
    ) -> Dataset:
        """Make a dataset of N transitions in the order in which they happened.

        An episode ends where `terminated` or `truncated` is set, or where the next transition does
        not begin with this one's next observation.

        Args:
            observations: (N, *shape), or nested dicts of such arrays.
            actions: (N,) integers, or (N, *shape).
            rewards: (N,).
            terminated: (N,) bool.
            truncated: (N,) bool.
            next_observations: like `observations`.
            behavior_probs: (N,) probability of each action under the policy that took it; default:
                unknown.
            env_id: Gymnasium id of the environment.
            observation_space: default: unbounded Boxes of the arrays' shapes and dtypes.
            action_space: default: Discrete up to the largest action, or an unbounded Box.

        Raises:
            SpaceError: lengths or shapes do not agree with each other or with the spaces.
        """
        from mcaprl.recorder.dataset.arrays import columns_of_arrays

        transitions, description = columns_of_arrays(
            observations=observations,
            actions=actions,
            rewards=rewards,
            terminated=terminated,
            truncated=truncated,
            next_observations=next_observations,
            behavior_probs=behavior_probs,
            env_id=env_id,
            observation_space=observation_space,
            action_space=action_space,
        )
        return cls(transitions, description)

    @classmethod
    def concatenate(cls, parts: Sequence[Dataset]) -> Dataset:
        """Several datasets as one; their episodes follow each other.

        Metadata on which they do not agree is left empty.

        Raises:
            SpaceError: their spaces differ.
            LogError: there are none.
        """
        if not parts:
            raise LogError("no data: the list of datasets or files is empty")
        first = parts[0]
        for other in parts[1:]:
            for role in ("observation_space", "action_space"):
                if getattr(first, role) != getattr(other, role):
                    raise SpaceError(
                        f"{first._name()} and {other._name()} do not fit together: {role}"
                        f" {getattr(first, role)} against {getattr(other, role)}"
                    )
        if len(parts) == 1:
            return first
        return cls(
            Transitions.concatenate([part._transitions for part in parts]),
            LogMetadata.common([part._description for part in parts]),
            sources=tuple(path for part in parts for path in part.sources),
        )

    @cached_property
    def metadata(self) -> dict[str, str]:
        """The log's own description of itself, strings by name."""
        return self._description.to_strings()

    @cached_property
    def observations(self) -> Any:
        """(N, *shape) in the space's dtype, or nested dicts of such arrays.

        Images that are on disk are read by indexing this, or by `batch`.
        """
        return self._frames(self._frame_of_step)

    @cached_property
    def next_observations(self) -> Any:
        """Like `observations`, one step on; at an episode's end its last observation."""
        return self._frames(self._frame_of_step + 1)

    @property
    def storage(self) -> str:
        """Where the observations are: `memory`, or the files that images are read from."""
        mapped = [leaf for leaf in self._transitions.frames if isinstance(leaf, MappedImages)]
        names = list(dict.fromkeys(name for leaf in mapped for name in leaf.names))
        more = f" and {len(names) - 1} more" if len(names) > 1 else ""
        return f"images on disk in {names[0]}{more}" if names else "memory"

    @property
    def frames(self) -> Any:
        """(N + E, *shape), each observation once: an episode's, its last one, the next episode's.

        Like `observations`, in nested dicts for a Dict space; not copied.
        """
        return nest(self._leaves, list(self._transitions.frames))

    @property
    def frame_of_step(self) -> NDArray[np.int64]:
        """(N,) which of `frames` each transition's observation is; the next one is one more."""
        return self._transitions.frame_of_step()

    @property
    def episode_lengths(self) -> NDArray[np.int64]:
        """(E,) transitions of each episode."""
        return self._transitions.lengths

    @property
    def actions(self) -> NDArray[Any]:
        """(N,) int64 of a Discrete space, else (N, *shape)."""
        return self._transitions.actions

    @property
    def rewards(self) -> NDArray[np.float64]:
        """(N,) float64."""
        return self._transitions.rewards

    @property
    def terminated(self) -> NDArray[np.bool_]:
        """(N,) bool: the transition led to a terminal state."""
        return self._transitions.terminated

    @property
    def truncated(self) -> NDArray[np.bool_]:
        """(N,) bool: the episode was cut off behind this transition."""
        return self._transitions.truncated

    @property
    def behavior_probs(self) -> NDArray[np.float32]:
        """(N,) float32: probability of the action under the policy that took it, or NaN."""
        return self._transitions.behavior_probs

    @property
    def env_id(self) -> str:
        """Gymnasium id of the environment; empty if unknown."""
        return self._description.env_id

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """Arguments to `gymnasium.make` that made it."""
        return dict(self._description.env_kwargs)

    @property
    def observation_space(self) -> spaces.Space[Any]:
        """Of the environment."""
        return self._description.observation_space

    @property
    def action_space(self) -> spaces.Space[Any]:
        """Of the environment."""
        return self._description.action_space

    @property
    def observation_names(self) -> tuple[str, ...]:
        """A name for each number of a vector observation, or empty."""
        return self._description.observation_names

    @property
    def action_meanings(self) -> tuple[str, ...]:
        """A name for each discrete action, or empty."""
        return self._description.action_meanings

    @property
    def action_names(self) -> dict[int, str]:
        """A name for each discrete action, by its value; empty for other actions."""
        return self._description.action_names()

    @cached_property
    def episodes(self) -> tuple[Episode, ...]:
        """All episodes, in order."""
        columns = self._transitions
        starts = zip(columns.first_steps.tolist(), columns.first_frames.tolist(), strict=True)
        return tuple(
            self._episode(index, step, frame) for index, (step, frame) in enumerate(starts)
        )

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of spaces and transitions: the same for the same data, whatever the file."""
        columns = self._transitions
        digest = hashlib.sha256(space_to_json(self.observation_space).encode())
        digest.update(space_to_json(self.action_space).encode())
        names = ("actions", "rewards", "terminated", "truncated", "behavior_probs", "lengths")
        for array in (*columns.frames, *(getattr(columns, name) for name in names)):
            for start in range(0, len(array), _BLOCK_ROWS):
                digest.update(np.ascontiguousarray(array[start : start + _BLOCK_ROWS]).data)
        return digest.hexdigest()

    @cached_property
    def statistics(self) -> Statistics:
        """Returns, lengths, ends and ranges of the columns."""
        return describe_columns(self._transitions, self._leaves)

    def filter(self, keep: Callable[[Episode], bool]) -> Dataset:
        """The episodes for which `keep` is true, as a dataset of copies."""
        return self._take([episode.index for episode in self.episodes if keep(episode)])

    def batch(self, steps: NDArray[np.integer[Any]]) -> Batch:
        """Copy some transitions, by their numbers; images that are on disk are read.

        Args:
            steps: (B,) which.

        Raises:
            CorruptLogError: images on disk are damaged.
        """
        columns, frames = self._transitions, self._frame_of_step[steps]
        return Batch(
            observations=nest(self._leaves, [leaf[frames] for leaf in columns.frames]),
            actions=columns.actions[steps],
            rewards=columns.rewards[steps],
            terminated=columns.terminated[steps],
            truncated=columns.truncated[steps],
            next_observations=nest(self._leaves, [leaf[frames + 1] for leaf in columns.frames]),
            behavior_probs=columns.behavior_probs[steps],
        )

    def split(self, fraction: float, *, seed: int = 0) -> tuple[Dataset, Dataset]:
        """Divide the episodes at random: about `fraction` of them, and the rest.

        Each part keeps the order of the log. With two episodes or more, neither part is empty.

        Raises:
            ValueError: `fraction` is not between 0 and 1.
        """
        if not 0 < fraction < 1:
            raise ValueError(f"fraction {fraction}: give a number between 0 and 1")
        count = len(self.episodes)
        first_count = min(max(round(count * fraction), 1), max(count - 1, 1))
        order = np.random.default_rng(seed).permutation(count)
        first, second = np.sort(order[:first_count]), np.sort(order[first_count:])
        return self._take(first.tolist()), self._take(second.tolist())

    def save(self, path: str | Path, *, compression: str = "zstd", overwrite: bool = False) -> None:
        """Write the dataset as one log; `mcaprl.open` gives an equal one back.

        Raises:
            OutputExistsError: there is a file, and `overwrite` is not set.
            LogError: it cannot be written.
        """
        from mcaprl.recorder.dataset.save import save_log

        save_log(
            path, self._transitions, self._description, compression=compression, overwrite=overwrite
        )

    def to_arrow(self, table: Literal["transitions", "episodes"] = "transitions") -> pyarrow.Table:
        """A PyArrow table: one row per transition, or one per episode. Extra: `tables`.

        Raises:
            MissingExtraError: pyarrow is not installed.
            UnknownNameError: there is no such table.
        """
        from mcaprl.recorder.dataset.tables import episode_table, transition_table

        if table not in ("transitions", "episodes"):
            raise UnknownNameError("table", table, ["transitions", "episodes"])
        if table == "episodes":
            return episode_table(self._transitions)
        return transition_table(self._transitions, self._leaves, self._description)

    def to_pandas(
        self, table: Literal["transitions", "episodes"] = "transitions"
    ) -> pandas.DataFrame:
        """A pandas DataFrame: see `to_arrow`. Extra: `tables`."""
        return self.to_arrow(table).to_pandas()

    def __len__(self) -> int:
        """Transitions."""
        return len(self.rewards)

    def __repr__(self) -> str:
        """Shapes, not arrays."""
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
        return Dataset(
            self._transitions.take(chosen),
            self._description,
            sources=self.sources,
        )

    def _episode(self, index: int, step: int, frame: int) -> Episode:
        columns = self._transitions
        summary = columns.episodes[index]
        steps = slice(step, step + summary.length)
        frames = slice(frame, frame + summary.length)
        return Episode(
            index=index,
            observations=self._frames(frames),
            actions=columns.actions[steps],
            rewards=columns.rewards[steps],
            terminated=columns.terminated[steps],
            truncated=columns.truncated[steps],
            next_observations=self._frames(slice(frames.start + 1, frames.stop + 1)),
            behavior_probs=columns.behavior_probs[steps],
            log_time_ns=columns.log_time_ns[frame : frames.stop + 1],
            summary=summary,
        )

    def _frames(self, rows: Any) -> Any:
        return nest(self._leaves, [rows_of(frames, rows) for frames in self._transitions.frames])

    @cached_property
    def _frame_of_step(self) -> NDArray[np.int64]:
        return self._transitions.frame_of_step()

    def _name(self) -> str:
        return str(self.sources[0]) if self.sources else repr(self)
