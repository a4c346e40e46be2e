"""Networks: what they take, what they give, what they refuse."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium import spaces

from mcaprl.errors import SpaceError
from mcaprl.offline.networks import build_network, observation_tensor


def weights_of(network: torch.nn.Module) -> list[tuple[int, ...]]:
    return [tuple(p.shape) for p in network.parameters() if p.ndim > 1]


def test_vectors_go_through_the_hidden_layers() -> None:
    network = build_network(spaces.Box(-1, 1, (12,)), 9, (256, 128))
    assert weights_of(network) == [(256, 12), (128, 256), (9, 128)]
    assert network(torch.zeros(5, 12)).shape == (5, 9)


def test_without_hidden_layers_the_network_is_linear() -> None:
    network = build_network(spaces.Box(-1, 1, (3,)), 2, ())
    left, right = torch.randn(2, 4, 3)
    torch.testing.assert_close(
        network(left) + network(right), network(left + right) + network(torch.zeros(4, 3))
    )


def test_arrays_of_floats_are_flattened() -> None:
    network = build_network(spaces.Box(-1, 1, (3, 4)), 2, (8,))
    assert network(torch.zeros(5, 3, 4)).shape == (5, 2)


@pytest.mark.parametrize("shape", [(84, 84), (84, 84, 1), (84, 84, 4), (36, 48, 3)])
def test_images_go_through_convolutions(shape: tuple[int, ...]) -> None:
    network = build_network(spaces.Box(0, 255, shape, np.uint8), 4, (512,))
    channels = shape[2] if len(shape) == 3 else 1
    assert weights_of(network)[:3] == [(32, channels, 8, 8), (64, 32, 4, 4), (64, 64, 3, 3)]
    assert network(torch.zeros(2, *shape, dtype=torch.uint8)).shape == (2, 4)


def test_the_nature_network_has_its_published_size() -> None:
    network = build_network(spaces.Box(0, 255, (84, 84, 4), np.uint8), 18, (512,))
    assert weights_of(network)[3:] == [(512, 3136), (18, 512)]


def test_channels_are_kept_apart_from_rows() -> None:
    # A network on (height, width, channels) must give the same for equal channels in any order.
    space = spaces.Box(0, 255, (36, 36, 2), np.uint8)
    network = build_network(space, 3, (16,))
    image = torch.randint(0, 256, (1, 36, 36, 1), dtype=torch.uint8)
    twice = torch.cat([image, image], dim=3)
    first = next(network.parameters())
    with torch.no_grad():
        before = network(twice)
        first.copy_(first.flip(1))
        torch.testing.assert_close(network(twice), before)


def test_images_stay_bytes_and_all_else_becomes_float32() -> None:
    image_space = spaces.Box(0, 255, (36, 36), np.uint8)
    assert observation_tensor(np.zeros((2, 36, 36), np.uint8), image_space).dtype == torch.uint8
    vector_space = spaces.Box(-1, 1, (3,), np.float64)
    assert observation_tensor(np.zeros((2, 3)), vector_space).dtype == torch.float32


def test_arrays_that_may_not_be_written_to_are_taken() -> None:
    frozen = np.zeros((2, 3), np.float32)
    frozen.flags.writeable = False
    assert observation_tensor(frozen, spaces.Box(-1, 1, (3,))).shape == (2, 3)


def test_images_too_small_for_the_convolutions_are_refused() -> None:
    with pytest.raises(SpaceError, match=r"36x36.*\(35, 84, 1\)"):
        build_network(spaces.Box(0, 255, (35, 84, 1), np.uint8), 2, (8,))


@pytest.mark.parametrize(
    "space",
    [spaces.Dict({"depth": spaces.Box(0, 1, (3,))}), spaces.Discrete(4)],
    ids=["Dict", "Discrete"],
)
def test_other_observations_are_refused(space: spaces.Space[object]) -> None:
    with pytest.raises(SpaceError, match=f"Box observations, got a {type(space).__name__}"):
        build_network(space, 2, (8,))
