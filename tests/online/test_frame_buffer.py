"""Comparison of the buffer that stores each frame once with SB3's buffers that store it twice."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer

from mcaprl.errors import UsageError
from mcaprl.frames import FrameStack, joined, stacked_space
from mcaprl.online import Agent, Task
from mcaprl.online.frame_buffer import FrameReplayBuffer, shifted
from mcaprl.sims import Scale

IMAGE = spaces.Box(0, 255, (1, 6, 6), np.uint8)
DICT = spaces.Dict({"image": IMAGE, "vector": spaces.Box(-1, 1, (3,))})
ACTIONS = spaces.Discrete(4)


def drawn(space: spaces.Space[Any], envs: int, random: np.random.Generator) -> Any:
    """Draw an observation for each environment."""
    if isinstance(space, spaces.Dict):
        return {key: drawn(part, envs, random) for key, part in space.items()}
    values = random.integers(0, 256, (envs, *(space.shape or ())))
    return values.astype(space.dtype)


def feed(buffers: list[Any], space: spaces.Space[Any], steps: int, envs: int, seed: int) -> None:
    """Add the same steps to all buffers; some steps end episodes."""
    random = np.random.default_rng(seed)
    observation = drawn(space, envs, random)
    for _ in range(steps):
        following = drawn(space, envs, random)
        done = random.random(envs) < 0.2
        cut = done & (random.random(envs) < 0.5)
        infos = [{"TimeLimit.truncated": bool(flag)} for flag in cut]
        action, reward = random.integers(4, size=envs), random.normal(size=envs)
        for buffer in buffers:
            buffer.add(observation, following, action, reward, done, infos)
        observation = _started(following, drawn(space, envs, random), done)


def _started(following: Any, fresh: Any, done: Any) -> Any:
    """Return the next observations; an ended episode is followed by a new first observation."""
    if isinstance(following, dict):
        return {key: _started(part, fresh[key], done) for key, part in following.items()}
    return np.where(done.reshape(-1, *[1] * (following.ndim - 1)), fresh, following)


def samples(buffer: Any, seed: int, batch_size: int = 200) -> list[Any]:
    np.random.seed(seed)  # noqa: NPY002
    batch = buffer.sample(batch_size)._asdict()
    flat: list[Any] = []
    for value in batch.values():
        flat += [value[key] for key in sorted(value)] if isinstance(value, dict) else [value]
    return flat


def check_same(ours: Any, theirs: Any) -> None:
    for mine, other in zip(samples(ours, 5), samples(theirs, 5), strict=True):
        if other is None:
            assert mine is None
        else:
            np.testing.assert_allclose(mine.numpy(), other.numpy(), rtol=1e-5, atol=1e-6)


@given(steps=st.integers(1, 60), envs=st.integers(1, 3), seed=st.integers(0, 99))
def test_samples_equal_those_of_sb3s_buffer(steps: int, envs: int, seed: int) -> None:
    ours = FrameReplayBuffer(20 * envs, IMAGE, ACTIONS, "cpu", envs)
    theirs = ReplayBuffer(20 * envs, IMAGE, ACTIONS, "cpu", envs)
    feed([ours, theirs], IMAGE, steps, envs, seed)
    check_same(ours, theirs)


@given(
    steps=st.integers(1, 60),
    envs=st.integers(1, 3),
    n_steps=st.integers(2, 5),
    seed=st.integers(0, 99),
)
def test_n_step_samples_equal_those_of_sb3s_buffer(
    steps: int, envs: int, n_steps: int, seed: int
) -> None:
    extra: dict[str, Any] = {"n_steps": n_steps, "gamma": 0.9}
    ours = FrameReplayBuffer(20 * envs, IMAGE, ACTIONS, "cpu", envs, **extra)
    theirs = NStepReplayBuffer(20 * envs, IMAGE, ACTIONS, "cpu", envs, **extra)
    feed([ours, theirs], IMAGE, steps, envs, seed)
    check_same(ours, theirs)


@given(steps=st.integers(1, 60), seed=st.integers(0, 99))
def test_dict_samples_equal_those_of_sb3s_buffer(steps: int, seed: int) -> None:
    ours = FrameReplayBuffer(40, DICT, ACTIONS, "cpu", 2)
    theirs = DictReplayBuffer(40, DICT, ACTIONS, "cpu", 2)
    feed([ours, theirs], DICT, steps, 2, seed)
    check_same(ours, theirs)


class Stacking:
    """Wrapper of a buffer that stacks the added observations, like the environments' wrapper."""

    def __init__(self, buffer: Any, space: spaces.Space[Any], count: int) -> None:
        self.buffer, self.space, self.memory = buffer, space, FrameStack(count)
        self.ended: Any = None

    def add(
        self, obs: Any, following: Any, action: Any, reward: Any, done: Any, infos: Any
    ) -> None:
        if self.ended is None:
            self.memory.see({"": obs})
        else:
            self.memory.frames[""][self.ended] = obs[self.ended, None]
        stack = joined(self.memory.frames[""], self.space)
        after = joined(self.memory.see({"": following})[""], self.space)
        self.buffer.add(stack, after, action, reward, done, infos)
        self.ended = done


@given(
    steps=st.integers(1, 19),
    envs=st.integers(1, 3),
    n_steps=st.integers(2, 3),
    count=st.integers(2, 4),
    seed=st.integers(0, 99),
)
def test_stacks_equal_those_of_sb3s_buffer(
    steps: int, envs: int, n_steps: int, count: int, seed: int
) -> None:
    shown = stacked_space(IMAGE, count)
    extra: dict[str, Any] = {"n_steps": n_steps, "gamma": 0.9}
    ours = FrameReplayBuffer(20 * envs, shown, ACTIONS, "cpu", envs, **extra, frame_stack=count)
    theirs = NStepReplayBuffer(20 * envs, shown, ACTIONS, "cpu", envs, **extra)
    assert ours.frames[""].shape[2:] == IMAGE.shape
    feed([Stacking(b, IMAGE, count) for b in (ours, theirs)], IMAGE, steps, envs, seed)
    check_same(ours, theirs)


@pytest.mark.parametrize("space", [IMAGE, DICT], ids=["image", "dict"])
@pytest.mark.parametrize("steps", [7, 50])
def test_a_saved_buffer_can_be_restored(space: spaces.Space[Any], steps: int) -> None:
    first = FrameReplayBuffer(40, space, ACTIONS, "cpu", 2, n_steps=3, gamma=0.9)
    feed([first], space, steps, 2, 1)
    second = FrameReplayBuffer(40, space, ACTIONS, "cpu", 2, n_steps=3, gamma=0.9)
    second.pos, second.full = first.pos, first.full
    second.restore({name: column.copy() for name, column in first.columns().items()})
    check_same(second, first)
    feed([first, second], space, 30, 2, 2)
    check_same(second, first)


def test_overwritten_frames_are_replaced_by_the_oldest() -> None:
    """The buffer has four rows. The frames of one long episode are numbered."""
    shown = stacked_space(IMAGE, 3)
    buffer = FrameReplayBuffer(4, shown, ACTIONS, "cpu", 1, frame_stack=3)
    frames = np.arange(7, dtype=np.uint8)[:, None, None, None, None] * np.ones((1, 1, 6, 6))
    for now, following in itertools.pairwise(frames):
        buffer.add(now, following, np.zeros(1), np.zeros(1), np.zeros(1), [{}])
    batch = buffer._get_samples(np.arange(4))
    # Frames 2 to 5 are in rows 2, 3, 0, 1. Frame 6 is the last next observation.
    assert batch.observations[:, :, 0, 0].tolist() == [[2, 3, 4], [3, 4, 5], [2, 2, 2], [2, 2, 3]]
    assert batch.next_observations[:, :, 0, 0].tolist() == [
        [3, 4, 5],
        [4, 5, 6],
        [2, 2, 3],
        [2, 3, 4],
    ]


def test_a_frame_is_stored_once() -> None:
    ours = FrameReplayBuffer(1_000, IMAGE, ACTIONS, "cpu", 1)
    theirs = ReplayBuffer(1_000, IMAGE, ACTIONS, "cpu", 1)
    feed([ours, theirs], IMAGE, 300, 1, 0)
    kept = sum(part.nbytes for part in (*ours.frames.values(), *ours.finals.values()))
    twice = theirs.observations.nbytes + theirs.next_observations.nbytes
    assert kept < 0.6 * twice


def test_half_a_million_depth_images_fit_in_four_gigabytes() -> None:
    space = spaces.Box(0, 255, (1, 84, 84), np.uint8)
    buffer = FrameReplayBuffer(500_000, space, ACTIONS, "cpu", 8)
    arrays = [*buffer.columns().values(), *buffer.frames.values(), buffer.rewards, buffer.dones]
    assert buffer.buffer_size * buffer.n_envs == 500_000
    assert sum(array.nbytes for array in arrays) < 4e9


@pytest.mark.parametrize("frame_stack", [1, 3])
def test_images_are_stored_at_the_networks_size(frame_stack: int) -> None:
    """Squares of 2 x 2 pixels are averaged and rounded; an odd last row or column is dropped."""
    frame = spaces.Box(0, 255, (1, 7, 7), np.uint8)
    one = spaces.Dict({"image": frame, "vector": DICT["vector"]})
    space = stacked_space(one, frame_stack)
    arguments: dict[str, Any] = {"frame_stack": frame_stack}
    whole = FrameReplayBuffer(40, space, ACTIONS, "cpu", 2, **arguments)
    small = FrameReplayBuffer(40, space, ACTIONS, "cpu", 2, **arguments, pools={"image": 2})
    feed([whole, small], space, 30, 2, 0)
    assert small.frames["image"].shape == (20, 2, 1, 3, 3)
    for mine, other in zip(samples(small, 5), samples(whole, 5), strict=True):
        if other is not None and other.ndim == 4:
            squares = other[..., :6, :6].double().unflatten(2, (3, 2)).unflatten(4, (3, 2))
            expected = (squares.mean((3, 5)) + 0.5).floor().numpy()
        else:
            expected = other
        np.testing.assert_array_equal(mine, expected)


def test_a_shift_repeats_the_edge() -> None:
    image = np.arange(9).reshape(1, 1, 3, 3)
    assert shifted(image, 1, 0)[0, 0].tolist() == [[0, 1, 2], [0, 1, 2], [3, 4, 5]]
    assert shifted(image, 0, -2)[0, 0].tolist() == [[2, 2, 2], [5, 5, 5], [8, 8, 8]]


def test_all_images_of_a_batch_are_shifted_alike_and_vectors_are_not() -> None:
    plain = FrameReplayBuffer(40, DICT, ACTIONS, "cpu", 2)
    moved = FrameReplayBuffer(40, DICT, ACTIONS, "cpu", 2, image_shift=2)
    feed([plain, moved], DICT, 30, 2, 0)
    rows = np.arange(10)
    shifts = set()
    for seed in range(60):
        np.random.seed(seed)  # noqa: NPY002
        expected = plain._get_samples(rows).observations
        np.random.seed(seed)  # noqa: NPY002
        found = moved._get_samples(rows).observations
        for key, part in expected.items():
            if part.ndim != 4:
                assert torch.equal(found[key], part)
                continue
            same = [
                (down, right)
                for down in range(-2, 3)
                for right in range(-2, 3)
                if np.array_equal(found[key].numpy(), shifted(part.numpy(), down, right))
            ]
            assert len(same) == 1
            shifts.add(same[0])
    assert {down for down, _ in shifts} == {right for _, right in shifts} == set(range(-2, 3))


def test_a_shift_needs_images(tmp_path: Path) -> None:
    task = Task.for_sim("lane", steps=20, image_shift=2)
    with pytest.raises(UsageError, match="image_shift is for images"):
        Agent(task, "lane", tmp_path, 0, Scale(0.0, 1.0))
