"""Networks from observations to one number per action, chosen by the observation space."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor, nn

from mcaprl.errors import SpaceError

MIN_IMAGE_EDGE = 36
"""The smallest image, in pixels, that the convolutions leave a pixel of."""


def is_image(space: spaces.Space[Any]) -> bool:
    """Whether observations are pictures: uint8, (height, width) or (height, width, channels)."""
    return isinstance(space, spaces.Box) and space.dtype == np.uint8 and len(space.shape) in (2, 3)


def observation_tensor(observations: NDArray[Any], space: spaces.Space[Any]) -> Tensor:
    """Observations as the networks take them: images as uint8, everything else as float32."""
    dtype = np.uint8 if is_image(space) else np.float32
    return torch.from_numpy(np.require(observations, dtype, ["C", "W"]))


def box_observations(space: spaces.Space[Any]) -> spaces.Box:
    """The observation space, if there is a network for it.

    Raises:
        SpaceError: it is not a Box, or one of images that are smaller than the convolutions.
    """
    if not isinstance(space, spaces.Box):
        kind = type(space).__name__
        raise SpaceError(f"offline learning needs Box observations, got a {kind} space")
    if is_image(space) and min(space.shape[:2]) < MIN_IMAGE_EDGE:
        least = f"{MIN_IMAGE_EDGE}x{MIN_IMAGE_EDGE}"
        raise SpaceError(f"image observations need at least {least} pixels, got {space.shape}")
    return space


def discrete_actions(space: spaces.Space[Any]) -> spaces.Discrete:
    """The action space, if the algorithms here can learn with it.

    Raises:
        SpaceError: it is not Discrete.
    """
    if not isinstance(space, spaces.Discrete):
        raise SpaceError(f"offline learning needs discrete actions, got {space}")
    return space


def build_network(
    observation_space: spaces.Space[Any], n_outputs: int, hidden: tuple[int, ...]
) -> nn.Module:
    """Build a network with outputs (B, n_outputs).

    An image goes through the convolutions of the Nature DQN, anything else is flattened; then
    come fully connected layers with ReLU. The DQN paper has one such layer of 512.

    Args:
        observation_space: of one observation, a Box.
        n_outputs: numbers per observation, one per action.
        hidden: widths of the fully connected hidden layers.

    Raises:
        SpaceError: no network takes such observations.
    """
    shape = box_observations(observation_space).shape
    if is_image(observation_space):
        torso: nn.Module = NatureConvolutions(shape)
        with torch.no_grad():
            blank = torch.zeros(1, *shape, dtype=torch.uint8)
            n_features = cast(Tensor, torso(blank)).shape[1]
    else:
        torso, n_features = nn.Flatten(), math.prod(shape)
    return nn.Sequential(torso, *_connected_layers(n_features, hidden, n_outputs))


class NatureConvolutions(nn.Module):
    """Three convolutions from images (B, height, width[, channels]) of uint8 to (B, features).

    See "Human-level control through deep reinforcement learning",
    https://doi.org/10.1038/nature14236.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        """Build for images of `shape`: (height, width) or (height, width, channels)."""
        super().__init__()
        self.shape = (*shape, 1) if len(shape) == 2 else shape
        self.layers = nn.Sequential(
            nn.Conv2d(self.shape[2], 32, kernel_size=8, stride=4),
            nn.ReLU(),
            nn.Conv2d(32, 64, kernel_size=4, stride=2),
            nn.ReLU(),
            nn.Conv2d(64, 64, kernel_size=3, stride=1),
            nn.ReLU(),
            nn.Flatten(),
        )

    def forward(self, images: Tensor) -> Tensor:
        """Map uint8 images to features."""
        channels_first = images.reshape(-1, *self.shape).permute(0, 3, 1, 2)
        return cast(Tensor, self.layers(channels_first.float() / 255))


def _connected_layers(n_inputs: int, hidden: tuple[int, ...], n_outputs: int) -> list[nn.Module]:
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(n_inputs, width), nn.ReLU()]
        n_inputs = width
    return [*layers, nn.Linear(n_inputs, n_outputs)]
