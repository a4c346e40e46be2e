"""Tests of observations of any space, encoded as a vector, images and an action mask."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.spaces import utils
from hypothesis import given
from hypothesis import strategies as st

from mcaprl.errors import SpaceError
from mcaprl.networks import ImageInput
from mcaprl.offline.batches.observations import ObservationEncoder, Observations

IMAGE = spaces.Box(0, 255, (36, 40, 1), np.uint8)
CAR = spaces.Dict(
    {
        "camera": IMAGE,
        "speed": spaces.Box(-np.inf, np.inf, (2,), np.float64),
        "gear": spaces.Discrete(3, start=-1),
    }
)


def batch(space: spaces.Space[Any], rows: int, seed: int = 0) -> Any:
    """Return samples (rows, *shape) of a space, in nested dicts."""
    if isinstance(space, spaces.Dict):
        return {key: batch(part, rows, seed) for key, part in space.spaces.items()}
    space.seed(seed)
    return np.stack([space.sample() for _ in range(rows)])


def test_a_vector_stays_as_it_is() -> None:
    values = np.array([[1.5, -2.0], [3.0, 4.0]], np.float32)
    seen = ObservationEncoder(spaces.Box(-9, 9, (2,)), 2).encode(values)
    assert seen.vector.tolist() == values.tolist()
    assert seen.images == ()
    assert seen.mask is None


def test_float64_becomes_float32_and_arrays_are_flattened() -> None:
    encoder = ObservationEncoder(spaces.Box(-9, 9, (3, 4), np.float64), 2)
    assert encoder.encode(np.ones((5, 3, 4))).vector.shape == (5, 12)
    assert encoder.encode(np.ones((5, 3, 4))).vector.dtype == torch.float32


def test_uint8_vectors_are_scaled_to_one() -> None:
    encoder = ObservationEncoder(spaces.Box(0, 255, (3,), np.uint8), 2)
    seen = encoder.encode(np.array([[0, 51, 255]], np.uint8))
    torch.testing.assert_close(seen.vector, torch.tensor([[0.0, 0.2, 1.0]]))


def test_one_hot_codes_of_bytes_are_not_scaled() -> None:
    encoder = ObservationEncoder(spaces.MultiDiscrete([3, 2], dtype=np.uint8), 2)
    seen = encoder.encode(np.array([[2, 0]], np.uint8))
    assert seen.vector.tolist() == [[0, 0, 1, 1, 0]]


def test_images_stay_bytes_and_get_a_channel_axis() -> None:
    space = spaces.Box(0, 255, (36, 40), np.uint8)
    images = batch(space, 2)
    seen = ObservationEncoder(space, 2).encode(images)
    assert seen.vector.shape == (2, 0)
    assert seen.images[0].shape == (2, 36, 40, 1)
    assert np.array_equal(seen.images[0].numpy()[..., 0], images)


def test_a_dict_becomes_a_vector_and_images() -> None:
    encoder = ObservationEncoder(CAR, 2)
    observations = batch(CAR, 4)
    seen = encoder.encode(observations)
    assert encoder.width == 5
    assert [image.shape for image in encoder.image_inputs] == [(36, 40, 1)]
    # In the order of the space's keys: camera, gear (one-hot), speed.
    assert seen.vector[:, :3].argmax(1).tolist() == (observations["gear"] + 1).tolist()
    np.testing.assert_array_equal(
        seen.vector[:, 3:].numpy(), observations["speed"].astype(np.float32)
    )


@given(seed=st.integers(0, 99))
def test_counters_and_flags_are_flattened_as_gymnasium_does(seed: int) -> None:
    space = spaces.Dict(
        {
            "a": spaces.Discrete(4, start=2),
            "b": spaces.MultiDiscrete([2, 5], start=[0, -3]),
            "c": spaces.MultiBinary(3),
            "d": spaces.Dict({"e": spaces.Box(-1, 1, (2, 2))}),
        }
    )
    space.seed(seed)
    sample = space.sample()
    one = {key: np.asarray(sample[key])[None] for key in "abc"} | {
        "d": {"e": sample["d"]["e"][None]}
    }
    encoded = ObservationEncoder(space, 2).encode(one).vector[0].numpy()
    expected: Any = utils.flatten(space, sample)
    np.testing.assert_allclose(encoded, expected)


def test_normalization_has_mean_zero_and_standard_deviation_one() -> None:
    values = np.random.default_rng(0).normal([100, -3], [20, 0.01], (500, 2)).astype(np.float32)
    encoder = ObservationEncoder(spaces.Box(-np.inf, np.inf, (2,)), 2)
    encoder.normalize_to(values)
    vector = encoder.encode(values).vector.numpy()
    np.testing.assert_allclose(vector.mean(0), 0, atol=2e-3)
    np.testing.assert_allclose(vector.std(0), 1, atol=2e-3)


@pytest.mark.parametrize("constant", [0.0, 7.0, -1e6])
def test_a_constant_column_becomes_zero_and_new_values_stay_finite(constant: float) -> None:
    values = np.full((50, 1), constant, np.float32)
    encoder = ObservationEncoder(spaces.Box(-np.inf, np.inf, (1,)), 2)
    encoder.normalize_to(values)
    assert encoder.encode(values).vector.abs().max() == 0
    assert encoder.encode(values + 1).vector.abs().max() == 1


def test_images_are_centered_and_scaled_by_one_number() -> None:
    encoder = ObservationEncoder(CAR, 2)
    images = np.zeros((4, 36, 40, 1), np.uint8)
    images[:, 0, 0, 0] = [10, 10, 30, 30]
    images[:, 1, 1] = 255
    observations = {**batch(CAR, 4), "camera": images}
    encoder.normalize_to(observations)
    (image,) = encoder.image_inputs
    assert image.shift is not None
    assert image.shift[0, 0, 0] == 20
    assert image.shift[1, 1, 0] == 255, "what never changes becomes 0, however bright"
    assert np.count_nonzero(image.shift) == 2
    # Only one of 1,440 pixels differs from its mean, always by 10. The standard deviation is
    # sqrt(100 / 1440).
    assert image.scale == pytest.approx(math.sqrt(100 / 1440))
    assert encoder.encode(observations).images[0].dtype == torch.uint8, "frames stay small"


def test_identical_images_keep_their_scale() -> None:
    alike = np.full((300, 36, 36, 3), 77, np.uint8)
    image = ImageInput((36, 36, 3)).normalized_to(alike)
    assert image.scale == 255
    assert image.shift is not None
    assert (image.shift == 77).all()


def test_a_stack_of_images_is_centered_frame_by_frame() -> None:
    shift = np.arange(36 * 36 * 2, dtype=np.float32).reshape(36, 36, 2)
    stacked = ImageInput((36, 36, 2), shift, 7.0).stacked(3)
    assert (stacked.shape, stacked.scale) == ((36, 36, 6), 7)
    assert stacked.shift is not None
    for frame in range(3):
        np.testing.assert_array_equal(stacked.shift[:, :, 2 * frame : 2 * frame + 2], shift)


def test_a_mask_is_not_a_network_input() -> None:
    space = spaces.Dict({"action_mask": spaces.MultiBinary(3), "x": spaces.Box(-1, 1, (2,))})
    encoder = ObservationEncoder(space, 3)
    mask = np.array([[1, 0, 1], [0, 0, 0]], np.int8)
    seen = encoder.encode({"action_mask": mask, "x": np.zeros((2, 2), np.float32)})
    assert encoder.width == 2
    assert seen.mask is not None
    # After the last step, the mask allows no action, so all actions count as allowed.
    assert seen.mask.tolist() == [[True, False, True], [True, True, True]]


def test_a_mask_of_another_length_is_refused() -> None:
    space = spaces.Dict({"action_mask": spaces.MultiBinary(3), "x": spaces.Box(-1, 1, (2,))})
    with pytest.raises(SpaceError, match=r"action_mask has shape \(3,\), but there are 2 actions"):
        ObservationEncoder(space, 2)


@pytest.mark.parametrize(
    ("shape", "seen"),
    [
        ((35, 84, 1), (35, 84, 1)),
        ((8, 8, 3), (8, 8, 3)),
        ((10, 10), (10, 10, 1)),
        ((10, 10, 16), (10, 10, 16)),
        ((10, 12, 12), (10, 12, 12)),
        ((4, 84, 84), (84, 84, 4)),
        ((12, 84, 96), (84, 96, 12)),
        ((3, 8, 9), (8, 9, 3)),
        ((7, 7, 3), None),
        ((4, 7, 7), None),
        ((64,), None),
    ],
)
def test_images_are_small_or_have_their_channels_first(
    shape: tuple[int, ...], seen: tuple[int, ...] | None
) -> None:
    encoder = ObservationEncoder(spaces.Box(0, 255, shape, np.uint8), 2)
    assert [image.shape for image in encoder.image_inputs] == ([] if seen is None else [seen])


def test_images_with_channels_first_are_those_with_channels_last() -> None:
    last = batch(spaces.Box(0, 255, (9, 8, 3), np.uint8), rows=5)
    first = np.moveaxis(last, -1, 1)
    encoders = []
    for images in (last, first):
        encoder = ObservationEncoder(spaces.Box(0, 255, images.shape[1:], np.uint8), 2)
        encoder.center_images(images)
        encoders.append(encoder)
    encoded = [
        encoder.encode(images).images[0]
        for encoder, images in zip(encoders, (last, first), strict=True)
    ]
    assert torch.equal(encoded[0], encoded[1])
    inputs = [encoder.image_inputs[0] for encoder in encoders]
    assert inputs[0].shift is not None
    assert inputs[1].shift is not None
    np.testing.assert_array_equal(inputs[0].shift, inputs[1].shift)
    assert inputs[0].scale == inputs[1].scale


@pytest.mark.parametrize("shape", [(2,), (3, 3), (3, 1, 2), ()])
def test_other_shapes_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(SpaceError, match=r"expects observations \(B, 2\), got"):
        ObservationEncoder(spaces.Box(-1, 1, (2,)), 2).encode(np.zeros(shape, np.float32))


def test_a_missing_part_is_named() -> None:
    with pytest.raises(SpaceError, match="no gear"):
        ObservationEncoder(CAR, 2).encode({"camera": batch(IMAGE, 1), "speed": np.zeros((1, 2))})


def test_counters_outside_their_space_are_refused() -> None:
    encoder = ObservationEncoder(spaces.Discrete(3, start=-1), 2)
    with pytest.raises(SpaceError, match="not in their space"):
        encoder.encode(np.array([2]))


def test_stacked_vectors_are_concatenated() -> None:
    vector = torch.arange(8.0).view(4, 2)
    image = torch.arange(4, dtype=torch.uint8).view(4, 1, 1, 1).expand(4, 36, 36, 2)
    mask = torch.tensor([[True, False], [False, True]]).repeat(2, 1)
    stacked = Observations(vector, (image,), mask).stacked(2)
    assert stacked.vector.tolist() == [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert stacked.images[0].shape == (2, 36, 36, 4)
    assert stacked.images[0][1, 0, 0].tolist() == [2, 2, 3, 3]
    assert stacked.mask is not None
    assert stacked.mask.tolist() == [[False, True], [False, True]]


def test_read_only_arrays_are_accepted() -> None:
    frozen = np.zeros((2, 2), np.float32)
    frozen.flags.writeable = False
    assert len(ObservationEncoder(spaces.Box(-1, 1, (2,)), 2).encode(frozen)) == 2
