"""Environments and recordings with known values."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.behavior import LOG_DENSITY, behavior_field
from mcaprl.recorder.record.wrapper import RecordMcap

MIXED_SPACE = spaces.Dict(
    {
        "camera": spaces.Box(0, 255, (12, 9, 3), np.uint8),
        "gray": spaces.Box(0, 255, (8, 10), np.uint8),
        "joints": spaces.Dict({"q": spaces.Box(-1, 1, (2, 3), np.float64)}),
        "Ünïcode key!": spaces.Box(-np.inf, np.inf, (3,), np.float32),
        "mode": spaces.Discrete(4, start=-1),
        "flags": spaces.MultiBinary(5),
        "counts": spaces.MultiDiscrete([3, 7]),
        "small": spaces.Box(-128, 127, (2,), np.int8),
        "half": spaces.Box(-1, 1, (2,), np.float16),
    }
)


class ScriptedEnv(gym.Env[Any, Any]):
    """Environment that returns given observations, rewards and ends, episode by episode."""

    metadata: dict[str, Any] = {"render_fps": 20}  # noqa: RUF012 (as Gymnasium declares it)

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        episodes: Sequence[Sequence[tuple[Any, float, bool, bool]]],
        infos: dict[str, Any] | None = None,
    ) -> None:
        self.observation_space, self.action_space = observation_space, action_space
        self._episodes, self._infos = episodes, infos or {}
        self._episode, self._step = -1, 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._episode, self._step = self._episode + 1, 0
        return self._episodes[self._episode][0][0], {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._step += 1
        observation, reward, terminated, truncated = self._episodes[self._episode][self._step]
        return observation, reward, terminated, truncated, self._infos


class KnownCommands(ScriptedEnv):
    """Two episodes of three steps, whose actions are a steering angle and a speed."""

    action_part_names = ("steering", "speed")
    action_units = ("right | left", "m/s")

    def __init__(self) -> None:
        row = [(np.full(2, k / 4, np.float32), float(k), k == 3, False) for k in range(4)]
        commands = spaces.Box(np.array([-1, 0], np.float32), np.array([1, 2.5], np.float32))
        super().__init__(spaces.Box(-1, 1, (2,), np.float32), commands, [row, row])


@dataclass
class Truth:
    """Recorded values of each transition."""

    observations: list[Any] = field(default_factory=list)
    next_observations: list[Any] = field(default_factory=list)
    actions: list[Any] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    terminated: list[bool] = field(default_factory=list)
    truncated: list[bool] = field(default_factory=list)
    behavior: list[float] = field(default_factory=list)


def record(
    path: Path,
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    lengths: Sequence[int],
    *,
    seed: int = 0,
    **options: Any,
) -> Truth:
    """Record random values of the spaces, including NaN and infinities, and return them."""
    random = np.random.default_rng(seed)
    observation_space.seed(seed)
    action_space.seed(seed)
    episodes, truth = [], Truth()
    for number, length in enumerate(lengths):
        rows: list[tuple[Any, float, bool, bool]] = [
            (observation_space.sample(), 0.0, False, False)
        ]
        for step in range(length):
            last = step == length - 1
            reward = float(random.choice([np.nan, np.inf, -np.inf, -0.0, 1e-320, random.normal()]))
            ends = (last and number % 2 == 0, last and number % 2 == 1)
            rows.append((observation_space.sample(), reward, *ends))
        episodes.append(rows)
    env = ScriptedEnv(observation_space, action_space, episodes)
    kind = behavior_field(action_space)
    recorder = RecordMcap(
        env, path, **{"step_duration_s": 0.05, "start_time_ns": 10**18, **options}
    )
    with closing(recorder):
        for number, rows in enumerate(episodes):
            observation, _ = recorder.reset(seed=100 + number)
            for _ in rows[1:]:
                action, behavior = action_space.sample(), float(np.float32(random.random()))
                if kind is LOG_DENSITY:
                    behavior = float(np.float32(200 * behavior - 100))
                setattr(recorder, kind.name, behavior)
                truth.observations.append(observation)
                observation, earned, terminated, truncated, _ = recorder.step(action)
                truth.next_observations.append(observation)
                truth.actions.append(action)
                truth.rewards.append(float(earned))
                truth.terminated.append(terminated)
                truth.truncated.append(truncated)
                truth.behavior.append(behavior)
    return truth


def leaves_of(observation: Any) -> list[np.ndarray[Any, Any]]:
    """Return the arrays of an observation, in the order of its space."""
    if isinstance(observation, dict):
        return [leaf for part in observation.values() for leaf in leaves_of(part)]
    return [np.asarray(observation)]


def assert_same_bits(actual: Any, expected: Any) -> None:
    """Check equality of dtype, shape and every bit: NaN equals NaN, and 0.0 differs from -0.0."""
    actual, expected = np.ascontiguousarray(actual), np.ascontiguousarray(expected)
    assert actual.dtype == expected.dtype, f"{actual.dtype} is not {expected.dtype}"
    assert actual.shape == expected.shape, f"{actual.shape} is not {expected.shape}"
    assert actual.tobytes() == expected.tobytes()


def assert_holds(dataset: Any, truth: Truth) -> None:
    """Check that every column of the dataset has the recorded bits."""
    for name in ("rewards", "terminated", "truncated"):
        assert_same_bits(getattr(dataset, name), np.array(getattr(truth, name)))
    assert_same_bits(dataset.behavior, np.array(truth.behavior, np.float32))
    assert_same_bits(dataset.actions, np.stack([np.asarray(action) for action in truth.actions]))
    for name in ("observations", "next_observations"):
        rows = [leaves_of(observation) for observation in getattr(truth, name)]
        for index, column in enumerate(leaves_of(getattr(dataset, name))):
            assert_same_bits(column, np.stack([row[index] for row in rows]))


def read(path: Path, topic: str, type_name: str) -> list[tuple[int, Any]]:
    """Return the times and messages of a topic with this type."""
    reader = McapReader(path)
    channel = reader.channel_of(topic)
    assert channel is not None, f"no topic {topic}"
    assert reader.schema_of(channel).name == type_name
    return [(time, messages.decode(data, type_name)) for time, data in reader.messages(channel)]
