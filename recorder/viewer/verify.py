"""Steps a simulator through a log again, and compares what it gives with what was logged.

A deterministic environment that is reset with the logged seed and stepped with the logged actions
gives the same observations, rewards and ends, bit for bit. An episode that was reset without a seed
goes on with the random numbers that the one before left behind, so it is stepped in its wake.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.episode import Episode
from mcaprl.recorder.format.episode_summary import INTERRUPTED
from mcaprl.recorder.format.spaces import Leaf, observation_leaves
from mcaprl.recorder.record.step_rows import as_declared

_MOST_FIELDS = 8


@dataclass(frozen=True)
class FieldDifference:
    """One number that is not what it was.

    Attributes:
        name: `reward`, `terminated`, `truncated`, or the observation's own name for it.
        logged: what the log has.
        now: what the environment gave.
    """

    name: str
    logged: str
    now: str

    def __str__(self) -> str:
        """For people."""
        return f"{self.name} logged {self.logged}, now {self.now}"


@dataclass(frozen=True)
class Difference:
    """The first record that differs.

    Attributes:
        episode: its index in the dataset.
        step: of the observation; 0 is the one that reset() gave.
        time_ns: log_time of the observation.
        time_s: the same in seconds since the episode's start.
        fields: what differs in it; of very many the first.
    """

    episode: int
    step: int
    time_ns: int
    time_s: float
    fields: tuple[FieldDifference, ...]

    def __str__(self) -> str:
        """For people."""
        return (
            f"episode {self.episode} differs first at step {self.step} ({self.time_s:.3f} s in,"
            f" log_time {self.time_ns} ns): {'; '.join(map(str, self.fields))}"
        )


@dataclass(frozen=True)
class Verification:
    """What a comparison found.

    Attributes:
        episodes: that were compared.
        steps: in them.
        unseeded: indexes of episodes that cannot be stepped again, since their start is not known.
        difference: the first one; None if all is the same.
    """

    episodes: int
    steps: int
    unseeded: tuple[int, ...]
    difference: Difference | None


def verify(
    dataset: Dataset,
    env: gym.Env[Any, Any],
    *,
    only: int | None = None,
    on_frame: Callable[[Episode, int], None] = lambda episode, step: None,
) -> Verification:
    """Step `env` through the log up to the first difference.

    Args:
        dataset: the log.
        env: a new environment of the same kind; it is reset and stepped here.
        only: index of the one episode that matters; those before it are stepped as far as its
            start depends on them.
        on_frame: called with the episode and the step after each observation that is the same,
            while the environment stands there.

    Raises:
        SpaceError: the environment has other spaces than the log.
        LogError: the environment fails on a logged action.
    """
    _check_spaces(dataset, env)
    compared = steps = 0
    unseeded: list[int] = []
    known_start = False
    for episode in _needed(dataset.episodes, only):
        goes_on = known_start and _follows(dataset.episodes, episode.index)
        known_start = episode.seed is not None or goes_on
        difference = _compare(dataset, env, episode, on_frame) if known_start else None
        if difference is not None and episode.seed is None and difference.step == 0:
            # It went on from somewhere else: nothing is known of its start, so nothing is wrong.
            known_start, difference = False, None
        if not known_start:
            unseeded.append(episode.index)
            continue
        compared += 1
        steps += episode.length if difference is None else difference.step
        if difference is not None:
            return Verification(compared, steps, tuple(unseeded), difference)
    return Verification(compared, steps, tuple(unseeded), None)


def _needed(episodes: tuple[Episode, ...], only: int | None) -> tuple[Episode, ...]:
    """The episode that matters and those that its start depends on; all if none is named."""
    if only is None:
        return episodes
    first = only
    while first > 0 and episodes[first].seed is None and _follows(episodes, first):
        first -= 1
    return episodes[first : only + 1]


def _follows(episodes: tuple[Episode, ...], index: int) -> bool:
    """Whether an episode came next in the same recording as the one before it."""
    number = episodes[index].summary.episode
    return index > 0 and number > 0 and episodes[index - 1].summary.episode == number - 1


def _compare(
    dataset: Dataset,
    env: gym.Env[Any, Any],
    episode: Episode,
    on_frame: Callable[[Episode, int], None],
) -> Difference | None:
    """Step one episode; its first difference."""
    leaves = observation_leaves(dataset.observation_space)
    for step, now in enumerate(_stepped(env, episode, dataset.action_space)):
        fields = []
        if step > 0:
            fields += _transition_differences(episode, step - 1, now)
        logged = _at(episode, step)
        for leaf in leaves:
            fields += _leaf_differences(leaf, logged, now[0], dataset.observation_names)
        if fields:
            time_ns = int(episode.log_time_ns[step])
            since_s = (time_ns - int(episode.log_time_ns[0])) / 1e9
            return Difference(episode.index, step, time_ns, since_s, tuple(fields[:_MOST_FIELDS]))
        on_frame(episode, step)
    return None


_Frame = tuple[Any, float, bool, bool]


def _stepped(
    env: gym.Env[Any, Any], episode: Episode, action_space: spaces.Space[Any]
) -> Iterator[_Frame]:
    """Yield observation, reward, terminated and truncated at each step; the first has no reward."""
    options = json.loads(episode.summary.options) if episode.summary.options else None
    step = 0
    try:
        observation, _ = env.reset(seed=episode.seed, options=options)
        yield observation, 0.0, False, False
        for logged in episode.actions:
            step += 1
            action = int(logged) if isinstance(action_space, spaces.Discrete) else logged.copy()
            observation, reward, terminated, truncated, _ = env.step(action)
            yield observation, float(reward), bool(terminated), bool(truncated)
    # An environment raises whatever it likes.
    except Exception as error:
        raise LogError(
            f"the environment fails at step {step} of episode {episode.index}, to which the log"
            f" went on: {type(error).__name__}: {error}"
        ) from error


def _transition_differences(episode: Episode, step: int, now: _Frame) -> list[FieldDifference]:
    _, reward, terminated, truncated = now
    pairs: list[tuple[str, Any, Any]] = [
        ("reward", episode.rewards[step], np.float64(reward)),
        ("terminated", episode.terminated[step], np.bool_(terminated)),
    ]
    broken_off = episode.reason == INTERRUPTED and step == episode.length - 1
    if not broken_off:
        pairs.append(("truncated", episode.truncated[step], np.bool_(truncated)))
    return [
        FieldDifference(name, str(logged), str(given))
        for name, logged, given in pairs
        if logged.tobytes() != given.tobytes()
    ]


def _leaf_differences(
    leaf: Leaf, logged: Any, now: Any, names: tuple[str, ...]
) -> list[FieldDifference]:
    old = np.asarray(leaf.of(logged))
    new = as_declared(leaf.of(now), leaf)
    if old.tobytes() == new.tobytes():
        return []
    places = np.argwhere(_bits(old) != _bits(new)).tolist()
    named = leaf.path == () and len(names) == leaf.size
    found = []
    for place in places[:_MOST_FIELDS]:
        index = tuple(place)
        label = f"{leaf.name}{place if place else ''}"
        if named:
            label = names[int(np.ravel_multi_index(index, leaf.shape)) if index else 0]
        found.append(FieldDifference(label, str(old[index]), str(new[index])))
    return found


def _bits(array: NDArray[Any]) -> NDArray[Any]:
    """The same array as integers: NaN equals itself then, and 0.0 is not -0.0."""
    return np.ascontiguousarray(array).view(f"u{array.dtype.itemsize}").reshape(array.shape)


def _at(episode: Episode, step: int) -> Any:
    """The logged observation at a step, the last one included."""
    source = episode.observations if step < episode.length else episode.next_observations
    return _row(source, min(step, episode.length - 1))


def _row(arrays: Any, row: int) -> Any:
    if isinstance(arrays, dict):
        return {key: _row(part, row) for key, part in arrays.items()}
    return arrays[row]


def _check_spaces(dataset: Dataset, env: gym.Env[Any, Any]) -> None:
    for role in ("observation_space", "action_space"):
        logged, actual = getattr(dataset, role), getattr(env, role)
        if logged != actual:
            name = env.spec.id if env.spec else "the environment"
            raise SpaceError(f"the log has {role} {logged}; {name} has {actual}")
