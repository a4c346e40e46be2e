"""Tests of buffers: packing of columns into tensors, and random sampling of rows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from mcaprl.actions import MASK_KEY
from mcaprl.errors import McaprlError, SpaceError, TrainingError
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.batches.packing import Packing
from mcaprl.recorder.dataset.dataset import Dataset


def numbered(n_rows: int, **changes: Any) -> Dataset:
    """Make transitions with different values in each row.

    Row k has the observation (k, -k), the next observation (k + 100, 100 - k), the action
    3 + k % 2 and the reward k / 2.
    """
    k = np.arange(n_rows)
    observations = np.stack([k, -k], axis=1).astype(np.float32)
    columns: dict[str, Any] = {
        "observations": observations,
        "actions": 3 + k % 2,
        "rewards": k / 2,
        "terminated": k % 3 == 0,
        "truncated": k % 3 == 1,
        "next_observations": observations + 100,
        "action_space": spaces.Discrete(2, start=3),
    }
    return Dataset.from_arrays(**{**columns, **changes})


def walks(lengths: list[int], terminated: list[bool]) -> Dataset:
    """Make episodes; observation t of episode k is 10 k + t, and the reward of step t is 2^t."""
    steps = [np.arange(length) for length in lengths]
    here = np.concatenate([10 * number + t for number, t in enumerate(steps)])
    last = np.concatenate([t == length - 1 for t, length in zip(steps, lengths, strict=True)])
    ends = np.repeat(terminated, lengths)
    return Dataset.from_arrays(
        observations=here[:, None].astype(np.float32),
        actions=np.zeros(len(here), np.int64),
        rewards=np.concatenate([2.0**t for t in steps]),
        terminated=last & ends,
        truncated=last & ~ends,
        next_observations=here[:, None].astype(np.float32) + 1,
    )


def whole(buffer: TransitionBuffer) -> Any:
    return buffer.batch(torch.arange(len(buffer)))


def test_columns_become_tensors() -> None:
    batch = whole(TransitionBuffer.from_dataset(numbered(4)))
    assert batch.observations.vector.tolist() == [[0, 0], [1, -1], [2, -2], [3, -3]]
    assert batch.next_observations.vector[1].tolist() == [101, 99]
    assert batch.rewards.tolist() == [0, 0.5, 1, 1.5]
    assert batch.rewards.dtype == batch.observations.vector.dtype == torch.float32


def test_actions_are_counted_from_zero() -> None:
    assert TransitionBuffer.from_dataset(numbered(4)).actions.tolist() == [0, 1, 0, 1]


def test_only_termination_ends_the_return() -> None:
    # Rows 0 and 3 terminated, row 1 was truncated, row 2 neither.
    assert whole(TransitionBuffer.from_dataset(numbered(4))).discounts.tolist() == [0, 1, 1, 0]


def test_each_frame_is_stored_once() -> None:
    buffer = TransitionBuffer.from_dataset(walks([3, 2], [True, False]))
    assert buffer.frames.vector.flatten().tolist() == [0, 1, 2, 3, 10, 11, 12]


def test_n_step_returns_by_hand() -> None:
    buffer = TransitionBuffer.from_dataset(
        walks([3, 2], [True, False]), Packing(gamma=0.5, n_steps=2)
    )
    batch = whole(buffer)
    # The rewards are 1, 2, 4 in the first episode and 1, 2 in the second. A 2-step return sums two
    # rewards; at the last step of an episode, it has one.
    assert batch.rewards.tolist() == [1 + 0.5 * 2, 2 + 0.5 * 4, 4, 1 + 0.5 * 2, 2]
    assert batch.next_observations.vector.flatten().tolist() == [2, 3, 3, 12, 12]
    # The first episode terminated; the second was truncated.
    assert batch.discounts.tolist() == [0.25, 0, 0, 0.25, 0.5]


def test_with_gamma_zero_only_the_first_reward_counts() -> None:
    packing = Packing(gamma=0.0, n_steps=3)
    batch = whole(TransitionBuffer.from_dataset(walks([3], [False]), packing))
    assert batch.rewards.tolist() == [1, 2, 4]
    assert batch.discounts.tolist() == [0, 0, 0]


@given(
    lengths=st.lists(st.integers(1, 6), min_size=1, max_size=4),
    n_steps=st.integers(1, 7),
    gamma=st.floats(0, 1),
    data=st.data(),
)
def test_n_step_returns_equal_those_of_a_loop(
    lengths: list[int], n_steps: int, gamma: float, data: st.DataObject
) -> None:
    ends = data.draw(st.lists(st.booleans(), min_size=len(lengths), max_size=len(lengths)))
    dataset = walks(lengths, ends)
    batch = whole(TransitionBuffer.from_dataset(dataset, Packing(gamma=gamma, n_steps=n_steps)))
    expected = []
    for episode in dataset.episodes:
        for start in range(episode.length):
            total, discount, step = 0.0, 1.0, start
            while step < min(start + n_steps, episode.length):
                total += discount * episode.rewards[step]
                discount *= gamma
                step += 1
            over = step == episode.length and episode.terminated[-1]
            seen = episode.next_observations[step - 1, 0]
            expected.append((total, 0.0 if over else discount, seen))
    found = torch.stack([batch.rewards, batch.discounts, batch.next_observations.vector[:, 0]], 1)
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-5, atol=1e-7)


def test_stacks_repeat_the_first_frame_of_their_episode() -> None:
    buffer = TransitionBuffer.from_dataset(walks([3, 1], [True, True]), Packing(frame_stack=3))
    batch = whole(buffer)
    assert batch.observations.vector.tolist() == [[0, 0, 0], [0, 0, 1], [0, 1, 2], [10, 10, 10]]
    assert batch.next_observations.vector.tolist() == [
        [0, 0, 1],
        [0, 1, 2],
        [1, 2, 3],
        [10, 10, 11],
    ]
    assert buffer.vector_width == 3


def test_stacked_images_are_channels() -> None:
    images = np.arange(4, dtype=np.uint8).reshape(4, 1, 1, 1) * np.ones((36, 36, 1), np.uint8)
    dataset = Dataset.from_arrays(
        observations=images[:3],
        actions=[0, 0, 0],
        rewards=[0, 0, 0],
        terminated=[False, False, True],
        truncated=[False] * 3,
        next_observations=images[1:],
    )
    buffer = TransitionBuffer.from_dataset(dataset, Packing(frame_stack=2))
    batch = whole(buffer)
    assert [image.shape for image in buffer.image_inputs] == [(36, 36, 2)]
    assert len(buffer.frames) == 4
    assert batch.observations.images[0].dtype == torch.uint8
    assert batch.observations.images[0][:, 0, 0].tolist() == [[0, 0], [0, 1], [1, 2]]
    assert batch.next_observations.images[0][:, 0, 0].tolist() == [[0, 1], [1, 2], [2, 3]]


@given(n_rows=st.integers(1, 40), batch_size=st.integers(1, 64), seed=st.integers(0, 99))
def test_a_batch_consists_of_whole_rows(n_rows: int, batch_size: int, seed: int) -> None:
    buffer = TransitionBuffer.from_dataset(numbered(n_rows))
    batch = buffer.sample(batch_size, torch.Generator().manual_seed(seed))
    k = batch.rows
    assert k.shape == (batch_size,)
    assert 0 <= k.min() <= k.max() < n_rows
    assert torch.equal(batch.observations.vector, torch.stack([k, -k], dim=1).float())
    assert torch.equal(batch.next_observations.vector, batch.observations.vector + 100)
    assert torch.equal(batch.actions, k % 2)
    assert torch.equal(batch.rewards, k / 2)
    assert torch.equal(batch.discounts, (k % 3 != 0).float())


def test_the_generator_determines_the_sample() -> None:
    buffer = TransitionBuffer.from_dataset(numbered(50))
    draws = [buffer.sample(8, torch.Generator().manual_seed(seed)).rows for seed in (1, 1, 2)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])


def test_rows_are_sampled_uniformly() -> None:
    buffer = TransitionBuffer.from_dataset(numbered(10))
    rows = buffer.sample_rows(100_000, torch.Generator().manual_seed(0))
    # Each row is drawn 10,000 times on average, with a standard deviation of 95.
    assert (torch.bincount(rows) - 10_000).abs().max() < 5 * 95


@pytest.mark.parametrize("weights", [[3.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
def test_rows_are_sampled_by_their_episodes_weights(weights: list[float]) -> None:
    buffer = TransitionBuffer.from_dataset(walks([2, 3, 1], [True] * 3), weights=np.array(weights))
    rows = buffer.sample_rows(60_000, torch.Generator().manual_seed(0))
    share = torch.bincount(rows, minlength=6) / 60_000
    each = np.repeat(weights, [2, 3, 1])
    # The standard deviation of a frequency is at most sqrt(.25 / 60,000) = .002.
    np.testing.assert_allclose(share.numpy(), each / each.sum(), atol=0.01)
    assert share[2:5].sum() == 0


def test_weights_that_are_all_zero_are_refused() -> None:
    with pytest.raises(TrainingError, match="all weights are 0"):
        TransitionBuffer.from_dataset(walks([2], [True]), weights=np.zeros(1))


def test_normalization_counts_each_frame_once() -> None:
    buffer = TransitionBuffer.from_dataset(walks([3, 2], [True, True]), Packing(normalize=True))
    torch.testing.assert_close(buffer.frames.vector.mean(0), torch.zeros(1), atol=1e-6, rtol=0)
    torch.testing.assert_close(
        buffer.frames.vector.std(0, correction=0), torch.ones(1), atol=1e-6, rtol=0
    )


def test_a_given_encoder_keeps_its_normalization() -> None:
    packing = Packing(normalize=True)
    encoder = TransitionBuffer.from_dataset(walks([3], [True]), packing).encoder
    scale = encoder.scale.copy()
    other = TransitionBuffer.from_dataset(walks([9], [True]), packing, encoder=encoder)
    assert np.array_equal(other.encoder.scale, scale)


def masked(actions: list[int]) -> Dataset:
    """Return three states that allow only action 1, and a last state that allows no action."""
    mask = np.array([[0, 1], [0, 1], [0, 1], [0, 0]], np.int8)
    x = np.zeros((4, 1), np.float32)
    return Dataset.from_arrays(
        observations={"action_mask": mask[:3], "x": x[:3]},
        actions=actions,
        rewards=[0, 0, 1],
        terminated=[False, False, True],
        truncated=[False] * 3,
        next_observations={"action_mask": mask[1:], "x": x[1:]},
        action_space=spaces.Discrete(2),
    )


def test_masks_come_with_the_observations() -> None:
    batch = whole(TransitionBuffer.from_dataset(masked([1, 1, 1])))
    assert batch.observations.mask.tolist() == [[False, True]] * 3


def test_a_logged_action_that_is_masked_is_refused() -> None:
    with pytest.raises(TrainingError, match="action 0 of row 1 is masked out"):
        TransitionBuffer.from_dataset(masked([1, 0, 1]))


def boxed(actions: list[list[float]], space: spaces.Box, **changes: Any) -> Dataset:
    """Make transitions with these actions of a Box."""
    columns = {"actions": np.array(actions, space.dtype), "action_space": space, **changes}
    return numbered(len(actions), **columns)


WIDE = spaces.Box(np.array([0, -4], np.float32), np.array([10, 4], np.float32))


def test_actions_of_a_box_are_scaled_by_its_bounds() -> None:
    buffer = TransitionBuffer.from_dataset(boxed([[0, -4], [5, 0], [7.5, 1], [10, 4]], WIDE))
    assert whole(buffer).actions.tolist() == [[-1, -1], [0, 0], [0.5, 0.25], [1, 1]]
    assert buffer.n_actions == 2


def test_infinite_bounds_are_those_of_the_data() -> None:
    space = spaces.Box(np.array([0, -np.inf]), np.array([np.inf, 8]), dtype=np.float64)
    dataset = boxed([[1, 2], [5, 8], [3, 4], [1, 2]], space)
    text = r"action\[0\] 0 to 5, action\[1\] 2 to 8"
    with pytest.warns(UserWarning, match=text):
        buffer = TransitionBuffer.from_dataset(dataset)
    # The finite bounds are those of the space.
    expected = np.array([[-0.6, -1], [1, 1], [0.2, -1 / 3], [-0.6, -1]])
    np.testing.assert_allclose(buffer.actions.numpy(), expected, rtol=1e-6)
    # Other data in the same scale need no warning, and stay in the range.
    other = TransitionBuffer.from_dataset(boxed([[9, 8], [5, -3]], space), box=buffer.box)
    assert other.actions.tolist() == [[1, 1], [1, -1]]


@pytest.mark.parametrize(
    ("actions", "space", "message"),
    [
        ([[1, 0], [2, 0]], WIDE, r"action\[1\] is 0 in all 2 rows: .*remove it"),
        ([[1, 0], [2, 5]], WIDE, r"action\[1\] of row 1 is 5, outside its bounds -4 to 4, as are"),
        ([[1, 0], [-1, 2]], WIDE, r"action\[0\] of row 1 is -1, .* of 1 row; .*clip_actions=True"),
        ([[1], [2]], spaces.Box(1, 1, (1,)), r"action\[0\] is 1 in all 2 rows"),
        ([[1], [2]], spaces.Box(0, 9, (1,), np.int32), "has integers"),
    ],
)
def test_actions_that_cannot_be_learned_are_refused(
    actions: list[list[float]], space: spaces.Box, message: str
) -> None:
    with pytest.raises(SpaceError, match=message):
        TransitionBuffer.from_dataset(boxed(actions, space))


def test_actions_outside_a_box_are_clipped_if_wanted() -> None:
    dataset = boxed([[1, 0], [-1, 5]], WIDE)
    buffer = TransitionBuffer.from_dataset(dataset, Packing(clip_actions=True))
    expected = np.array([[-0.8, 0], [-1, 1]])
    np.testing.assert_allclose(buffer.actions.numpy(), expected, rtol=1e-6)


def test_a_mask_for_the_actions_of_a_box_is_refused() -> None:
    frames = {"a": np.zeros((2, 1), np.float32), MASK_KEY: np.ones((2, 2), np.int8)}
    dataset = boxed(
        [[1, 0], [2, 2]],
        WIDE,
        observations=frames,
        next_observations=frames,
        observation_space=spaces.Dict(
            {"a": spaces.Box(-1, 1, (1,)), MASK_KEY: spaces.MultiBinary(2)}
        ),
    )
    with pytest.raises(SpaceError, match="action_mask"):
        TransitionBuffer.from_dataset(dataset)


@pytest.mark.parametrize(("n_steps", "rows"), [(1, [1, 2, -1, 4, -1]), (2, [2, -1, -1, -1, -1])])
def test_the_next_row_is_in_the_same_episode(n_steps: int, rows: list[int]) -> None:
    observations = np.array([0, 1, 2, 10, 11], np.float32)[:, None]
    ends = np.array([False, False, True, False, True])
    dataset = boxed(
        [[k, k % 2] for k in range(5)],
        WIDE,
        observations=observations,
        next_observations=observations + 1,
        terminated=ends,
        truncated=~ends & False,
    )
    buffer = TransitionBuffer.from_dataset(dataset, Packing(n_steps=n_steps))
    assert buffer.next_rows.tolist() == rows


def test_an_action_outside_its_space_is_refused() -> None:
    dataset = numbered(4, actions=np.array([3, 4, 5, 3]))
    with pytest.raises(SpaceError, match="5"):
        TransitionBuffer.from_dataset(dataset)


def test_an_empty_dataset_is_refused() -> None:
    with pytest.raises(McaprlError):
        TransitionBuffer.from_dataset(numbered(4).filter(lambda _: False))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("column", ["observations", "rewards", "next_observations"])
def test_a_value_that_is_not_finite_is_reported(column: str, bad: float) -> None:
    values: NDArray[Any] = np.array(getattr(numbered(4), column))
    values[2] = bad
    with pytest.raises(TrainingError, match=f"{column} of row 2"):
        TransitionBuffer.from_dataset(numbered(4, **{column: values}))


@pytest.mark.parametrize("n_steps", [1, 3])
def test_a_reward_beyond_float32_is_reported(n_steps: int) -> None:
    dataset = numbered(4, rewards=[0.0, 1.0, 1e300, 1.0])
    with pytest.raises(TrainingError, match=r"reward 1e\+300 of row 2 is beyond float32"):
        TransitionBuffer.from_dataset(dataset, Packing(n_steps=n_steps))
    dataset = numbered(4, rewards=[0.0, 1.0, math.nan, 1.0])
    with pytest.raises(TrainingError, match="rewards of row 2 have NaN or infinite numbers"):
        TransitionBuffer.from_dataset(dataset, Packing(n_steps=n_steps))


def test_rewards_are_scaled_by_the_spread_of_returns() -> None:
    # With gamma .5, the returns are 1 + .5 x 2 = 2 and 2 in the first episode, and -2 + .5 x 4 = 0
    # and 4 in the second one. Their standard deviation is sqrt(2).
    data = Dataset.from_arrays(
        observations=np.zeros((4, 1), np.float32),
        actions=np.zeros(4, np.int64),
        rewards=[1.0, 2.0, -2.0, 4.0],
        terminated=[False, True, False, False],
        truncated=[False, False, False, True],
        next_observations=np.zeros((4, 1), np.float32),
    )
    packing = Packing(gamma=0.5, scale_rewards=True)
    buffer = TransitionBuffer.from_dataset(data, packing)
    assert buffer.reward_scale == pytest.approx(math.sqrt(2))
    rewards = buffer.returns[0] * math.sqrt(2)
    assert rewards.tolist() == pytest.approx([1, 2, -2, 4])
    again = TransitionBuffer.from_dataset(data, packing, reward_scale=2.0)
    assert again.returns[0].tolist() == [0.5, 1.0, -1.0, 2.0]
    unscaled = TransitionBuffer.from_dataset(data, Packing(gamma=0.5))
    assert unscaled.returns[0].tolist() == [1, 2, -2, 4]


def test_equal_returns_do_not_scale_rewards() -> None:
    data = Dataset.from_arrays(
        observations=np.zeros((2, 1), np.float32),
        actions=np.zeros(2, np.int64),
        rewards=[3.0, 3.0],
        terminated=[True, True],
        truncated=[False, False],
        next_observations=np.zeros((2, 1), np.float32),
    )
    buffer = TransitionBuffer.from_dataset(data, Packing(scale_rewards=True))
    assert (buffer.reward_scale, buffer.returns[0].tolist()) == (1.0, [3.0, 3.0])
