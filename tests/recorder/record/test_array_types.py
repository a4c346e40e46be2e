"""Vector environments that return tensors and other arrays, and last observations in many forms."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import mcaprl
from mcaprl.errors import SpaceError, UsageError
from mcaprl.recorder.record.recordable import as_array, as_arrays
from mcaprl.recorder.record.vector_wrapper import VectorWrapper
from tests.recorder.record.test_vector_wrapper import Wanderer, check_against_members, members
from tests.support.recordings import MIXED_SPACE

LENGTHS = [[3, 1, 5], [2], [4, 4, 1]]
MODES = list(AutoresetMode)
VECTOR = spaces.Box(-1, 1, (3,), np.float32)
NESTED = spaces.Dict({"a": VECTOR, "b": spaces.Dict({"c": spaces.Discrete(4)})})
PAIR = spaces.Tuple([VECTOR, spaces.Dict({"c": spaces.Discrete(4)})])


class Gpu(torch.Tensor):
    """A tensor that NumPy cannot read before `cpu` is called, like a tensor on a GPU."""

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    def cpu(self, *_: Any, **__: Any) -> torch.Tensor:
        return self.as_subclass(torch.Tensor)


class OnlyDlpack:
    """An array that only has the interface of DLPack."""

    def __init__(self, values: Any) -> None:
        self._values = np.asarray(values)

    def __dlpack__(self, **options: Any) -> Any:
        return self._values.__dlpack__(**options)

    def __dlpack_device__(self) -> Any:
        return self._values.__dlpack_device__()


class Cupy:
    """An array that refuses implicit copies, like CuPy's."""

    def __init__(self, values: Any) -> None:
        self._values = np.asarray(values)

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        raise TypeError("Implicit conversion to a NumPy array is not allowed")

    def get(self) -> Any:
        return self._values


class Jax:
    """An array that NumPy reads with `__array__`, like JAX's.

    JAX itself is not imported, because it warns when a later test starts a process.
    """

    def __init__(self, values: Any) -> None:
        self._values = np.asarray(values)
        self._values.flags.writeable = False

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        return self._values if dtype is None else self._values.astype(dtype)


TYPES: dict[str, Callable[[Any], Any]] = {
    "torch": lambda value: torch.from_numpy(np.array(value)),
    "gradient": lambda value: _with_gradient(torch.from_numpy(np.array(value))),
    "gpu": lambda value: torch.from_numpy(np.array(value)).as_subclass(Gpu),
}


def _with_gradient(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.requires_grad_() if tensor.is_floating_point() else tensor


def mapped(tree: Any, convert: Callable[[Any], Any]) -> Any:
    """Convert the arrays in nested dicts and tuples."""
    if isinstance(tree, dict):
        return {key: mapped(part, convert) for key, part in tree.items()}
    if isinstance(tree, tuple):
        return tuple(mapped(part, convert) for part in tree)
    is_plain = isinstance(tree, np.ndarray | np.generic) and np.asarray(tree).dtype.kind in "biuf"
    return convert(tree) if is_plain else tree


class Converted(VectorWrapper):
    """A vector environment with another type of arrays, and another form of last observations."""

    def __init__(self, env: Any, convert: Callable[[Any], Any], form: str = "array") -> None:
        super().__init__(env)
        self._convert, self._form = convert, form
        self.returned: Any = None

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.returned = mapped(self.env.reset(seed=seed, options=options), self._convert)
        return self.returned

    def step(self, actions: Any) -> Any:
        *outcome, infos = self.env.step(actions)
        last = infos.pop("final_obs", None)
        self.returned = (*(mapped(each, self._convert) for each in outcome), {**infos})
        if last is not None:
            name = "final_observation" if self._form == "old name" else "final_obs"
            self.returned[-1][name] = self._in_form(last)
            self.returned[-1][f"_{name}"] = self._convert(infos.pop("_final_obs"))
            self.returned[-1].pop("_final_obs", None) if name != "final_obs" else None
        return self.returned

    def _in_form(self, last: Any) -> Any:
        rows = [None if each is None else mapped(each, self._convert) for each in last]
        if self._form == "list":
            return rows
        if self._form == "tuple":
            return tuple(rows)
        if self._form == "stacked":
            return mapped(stacked(last), self._convert)
        array = np.full(len(rows), None, object)
        for number, row in enumerate(rows):
            array[number] = row
        return array


def stacked(rows: Any) -> Any:
    """Stack observations, with zeros for missing ones."""
    known = next(row for row in rows if row is not None)
    if isinstance(known, dict):
        return {key: stacked([None if row is None else row[key] for row in rows]) for key in known}
    if isinstance(known, tuple):
        return tuple(
            stacked([None if row is None else row[index] for row in rows])
            for index in range(len(known))
        )
    return np.stack([np.zeros_like(known) if row is None else np.asarray(row) for row in rows])


def play(env: mcaprl.RecordVecMcap, steps: int, convert: Callable[[Any], Any]) -> None:
    """Take random actions, and reset if required; check that the results of `env` are returned."""
    env.reset(seed=0)
    random = np.random.default_rng(0)
    for _ in range(steps):
        actions = random.integers(-2, 3, env.num_envs)
        env.behavior_probs = convert(0.5 + actions / 10)
        outcome = env.step(actions)
        inner: Any = env.env
        assert outcome is inner.returned
        over = as_array(outcome[2]) | as_array(outcome[3])
        if env.metadata["autoreset_mode"] is AutoresetMode.DISABLED and over.any():
            env.reset(options={"reset_mask": over})


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("space", [VECTOR, NESTED, MIXED_SPACE], ids=["box", "nested", "mixed"])
def test_tensors_are_recorded_like_the_sub_environments(
    tmp_path: Path, space: spaces.Space[Any], kind: str, mode: AutoresetMode
) -> None:
    convert = TYPES[kind]
    envs = SyncVectorEnv(members(tmp_path, space, LENGTHS), autoreset_mode=mode)
    recorder = mcaprl.RecordVecMcap(Converted(envs, convert), tmp_path / "vector.mcap")
    with closing(recorder):
        play(recorder, 12, convert)
    check_against_members(tmp_path)


@pytest.mark.parametrize("form", ["array", "list", "tuple", "stacked", "old name"])
@pytest.mark.parametrize("kind", ["numpy", "torch", "gpu"])
@pytest.mark.parametrize("space", [VECTOR, NESTED, PAIR], ids=["box", "nested", "pair"])
def test_every_form_of_the_last_observations_is_read(
    tmp_path: Path, space: spaces.Space[Any], kind: str, form: str
) -> None:
    convert = TYPES.get(kind, np.array)
    envs = SyncVectorEnv(members(tmp_path, space, LENGTHS), autoreset_mode=AutoresetMode.SAME_STEP)
    recorder = mcaprl.RecordVecMcap(Converted(envs, convert, form), tmp_path / "vector.mcap")
    with closing(recorder):
        play(recorder, 12, convert)
    check_against_members(tmp_path)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_the_wrapper_of_gymnasium(tmp_path: Path, mode: AutoresetMode) -> None:
    pytest.importorskip("array_api_compat")
    to_torch = importlib.import_module("gymnasium.wrappers.vector").NumpyToTorch
    logs = []
    for name, wrap in (("numpy", lambda env: env), ("torch", to_torch)):
        envs = SyncVectorEnv([lambda: gym.make("CartPole-v1")] * 3, autoreset_mode=mode)
        path = tmp_path / f"{name}.mcap"
        with closing(mcaprl.RecordVecMcap(wrap(envs), path, start_time_ns=0)) as recorder:
            recorder.reset(seed=0)
            for step in range(60):
                actions = np.array([1, 0, step % 3 % 2])
                outcome = recorder.step(torch.from_numpy(actions) if name == "torch" else actions)
                over = as_array(outcome[2]) | as_array(outcome[3])
                if mode is AutoresetMode.DISABLED and over.any():
                    recorder.reset(options={"reset_mask": over})
        assert isinstance(outcome[0], torch.Tensor) == (name == "torch")
        logs.append(mcaprl.open(path))
    assert logs[0].fingerprint == logs[1].fingerprint
    assert len(logs[0].episodes) > 6


class Flags(VectorWrapper):
    """A vector environment with given rewards and flags."""

    def __init__(self, env: Any, rewards: Any, flags: Any, infos: Any = None) -> None:
        super().__init__(env)
        self._rewards, self._flags, self._infos_of_step = rewards, flags, infos

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        options = {key: np.asarray(value) for key, value in (options or {}).items()}
        return self.env.reset(seed=seed, options=options)

    def step(self, actions: Any) -> Any:
        observations, *_ = self.env.step(actions)
        return observations, self._rewards, self._flags, self._flags, self._infos_of_step or {}


def two(path: Path, *given: Any, **options: Any) -> mcaprl.RecordVecMcap:
    envs = SyncVectorEnv(
        [lambda: Wanderer(VECTOR, [99], 1)] * 2, autoreset_mode=AutoresetMode.DISABLED
    )
    recorder = mcaprl.RecordVecMcap(Flags(envs, *given), path, **options)
    recorder.reset(seed=0)
    return recorder


@pytest.mark.parametrize(
    ("rewards", "flags"),
    [
        (np.array([[1.0], [2.0]]), np.array([[True], [False]])),
        (torch.tensor([1.0, 2.0], dtype=torch.bfloat16), torch.tensor([1, 0], dtype=torch.uint8)),
        ([1, 2.0], [True, False]),
        ([torch.tensor(1.0, requires_grad=True), torch.tensor(2.0)], (1, 0)),
        (Jax([1.0, 2.0]), Jax([True, False])),
        (OnlyDlpack([1.0, 2.0]), np.array([True, False])),
        (Cupy([1.0, 2.0]), Cupy([True, False])),
        (np.array([1.0, 2.0]), torch.tensor([True, False])),
    ],
)
def test_rewards_and_flags_of_other_types_and_shapes(
    log_path: Path, rewards: Any, flags: Any
) -> None:
    with closing(two(log_path, rewards, flags)) as recorder:
        recorder.step(np.array([0, 1]))
        recorder.reset(options={"reset_mask": torch.tensor([True, False])})
        assert recorder.episodes == 1
    data = mcaprl.open(log_path)
    assert data.rewards.tolist() == [1.0, 2.0]
    assert data.terminated.tolist() == [True, False]
    assert [episode.reason for episode in data.episodes] == ["terminated", "interrupted"]


@pytest.mark.parametrize(
    ("rewards", "flags", "message"),
    [
        (np.ones((2, 3)), np.zeros(2, bool), r"one reward.*shape \(2, 3\); combine several"),
        (torch.ones(2, 3), torch.zeros(2).bool(), r"one reward.*shape \(2, 3\)"),
        (np.ones(2), np.zeros((2, 2), bool), r"one end flag.*shape \(2, 2\)"),
        (np.ones(3), np.zeros(2, bool), r"one reward.*shape \(3,\)"),
    ],
)
def test_other_numbers_of_rewards_are_refused(
    log_path: Path, rewards: Any, flags: Any, message: str
) -> None:
    recorder = two(log_path, rewards, flags)
    with closing(recorder), pytest.raises(SpaceError, match=message):
        recorder.step(np.array([0, 1]))


def test_the_last_infos_may_be_missing(log_path: Path) -> None:
    envs = SyncVectorEnv(
        [lambda: Wanderer(VECTOR, [99], 1)] * 2, autoreset_mode=AutoresetMode.SAME_STEP
    )
    last = {"final_obs": np.ones((2, 3), np.float32), "final_info": None}
    flagged = Flags(envs, np.ones(2), np.array([True, True]), last)
    with closing(mcaprl.RecordVecMcap(flagged, log_path, infos=True)) as recorder:
        recorder.reset(seed=0)
        recorder.step(np.array([0, 1]))
    assert [one.reason for one in mcaprl.open(log_path).episodes] == ["terminated"] * 2


def test_infos_may_be_tensors_or_one_dict_for_each_environment(log_path: Path) -> None:
    infos = {"speed": torch.tensor([1.5, 2.5]).as_subclass(Gpu), "_speed": torch.tensor([1, 0])}
    with closing(two(log_path, np.ones(2), np.array([True, True]), infos, infos=True)) as recorder:
        recorder.step(np.array([0, 1]))
    found = mcaprl.open(log_path).infos["speed"]
    assert found.tolist() == [None, 1.5, None, None]
    path = log_path.with_name("list.mcap")
    envs = SyncVectorEnv(
        [lambda: Wanderer(VECTOR, [99], 1)] * 2, autoreset_mode=AutoresetMode.SAME_STEP
    )
    last = {
        "final_obs": np.ones((2, 3), np.float32),
        "final_info": [{"reason": "left", "k": 1}, {"reason": "right", "k": 2}],
    }
    flagged = Flags(envs, np.ones(2), np.array([True, True]), last)
    with closing(mcaprl.RecordVecMcap(flagged, path, infos=["k"])) as recorder:
        recorder.reset(seed=0)
        recorder.step(np.array([0, 1]))
    data = mcaprl.open(path)
    assert [episode.reason for episode in data.episodes] == ["left", "right"]
    assert data.infos["k"].compressed().tolist() == [1, 2]


@pytest.mark.parametrize(
    ("last", "message"),
    [
        ({}, "does not contain"),
        ({"final_obs": None}, "does not contain"),
        ({"final_obs": torch.ones(1, 3)}, "one item for each of the 2"),
        ({"final_obs": 3.0}, "one item for each of the 2"),
        ({"final_obs": np.ones((2, 4), np.float32)}, r"shape \(4,\)"),
    ],
)
def test_last_observations_that_are_missing_are_refused(
    log_path: Path, last: Any, message: str
) -> None:
    envs = SyncVectorEnv(
        [lambda: Wanderer(VECTOR, [99], 1)] * 2, autoreset_mode=AutoresetMode.SAME_STEP
    )
    flagged = Flags(envs, np.ones(2), np.array([True, True]), last)
    with closing(mcaprl.RecordVecMcap(flagged, log_path)) as recorder:
        recorder.reset(seed=0)
        with pytest.raises(SpaceError, match=message):
            recorder.step(np.array([0, 1]))


def test_a_single_environment_may_return_tensors(log_path: Path) -> None:
    class Tensors(gym.Wrapper[Any, Any, Any, Any]):
        def step(self, action: Any) -> Any:
            observation, reward, *others, info = self.env.step(action)
            tensor = torch.from_numpy(observation).as_subclass(Gpu)
            info = {"speed": torch.tensor([1.0, 2.0]).as_subclass(Gpu)}
            return tensor, torch.tensor([float(reward)]).as_subclass(Gpu), *others, info

    with closing(mcaprl.RecordMcap(Tensors(Wanderer(VECTOR, [2], 1)), log_path, infos=True)) as env:
        env.reset(seed=0)
        tensor = env.step(0)[0]
        assert isinstance(tensor, Gpu)
        env.step(torch.tensor(1))
    data = mcaprl.open(log_path)
    assert data.next_observations[0].tolist() == tensor.cpu().tolist()
    assert data.actions.tolist() == [0, 1]
    assert data.infos["speed"][1].tolist() == [1.0, 2.0]


def test_arrays_in_nested_dicts() -> None:
    tree = {"a": torch.tensor([1, 2]), "b": {"c": Jax([3.0])}, "d": "text", "e": [1]}
    found = as_arrays(tree)
    assert type(found["a"]) is type(found["b"]["c"]) is np.ndarray
    assert (found["d"], found["e"]) == ("text", [1])


class OtherVecEnv:
    """Named like the base class of Stable-Baselines3's vector environments."""


OtherVecEnv.__name__, OtherVecEnv.__module__ = "VecEnv", "stable_baselines3.common.vec_env"


class Batch(Wanderer):
    """A single environment by its class, which steps several environments, like Isaac Lab's."""

    num_envs = 4


class Agents:
    """Has the attribute that PettingZoo's environments have."""

    possible_agents = ("a", "b")


@pytest.mark.parametrize("wrapper", [mcaprl.RecordMcap, mcaprl.RecordVecMcap])
@pytest.mark.parametrize(
    ("env", "message"),
    [
        (OtherVecEnv(), r"not stable_baselines3.*VecEnv: record with RecordVecMcap\(gymnasium"),
        (Agents(), "several agents"),
        (Batch(VECTOR, [1], 1), "steps several environments, but is not a gymnasium.vector.Vec"),
        (object(), r"not builtins.object: wrap it in a class derived from gymnasium.Env"),
    ],
)
def test_environments_of_other_packages_are_refused_with_advice(
    log_path: Path, wrapper: Any, env: Any, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        wrapper(env, log_path)
    assert not log_path.exists()
