"""This package's networks as parts of SB3's policies, saved in plain `.zip` files of SB3.

SB3's own features extractors are used unless a setting asks for another encoder of images, for
dueling networks or for layer normalization. The networks are those of offline learning.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecTransposeImage
from stable_baselines3.dqn.policies import DQNPolicy, QNetwork
from torch import Tensor, nn

from mcaprl.architecture import Architecture
from mcaprl.frames import is_image, map_space, parts_of, parts_of_space, stack_axis
from mcaprl.networks import Convolutions, ImageInput, Trunk, make_head
from mcaprl.offline.batches.observations import Observations
from mcaprl.recorder.format.spaces import MIN_IMAGE_EDGE


class NetworkFeatures(BaseFeaturesExtractor):
    """Layers of a `Trunk` as a features extractor of SB3."""

    # The inputs are all images, channels first, and one vector that joins the other parts. The
    # normalization of the images is saved with the weights.

    def __init__(self, observation_space: spaces.Space[Any], architecture: Architecture) -> None:
        """Build the layers, with random weights."""
        parts = parts_of_space(observation_space)
        vectors, images = inputs_of(observation_space)
        trunk = Trunk(sum(int(np.prod(parts[key].shape)) for key in vectors), images, architecture)
        super().__init__(observation_space, trunk.width)
        self.trunk = trunk
        self._vectors = vectors
        self._images = [key for key in parts if key not in vectors]
        for convolutions in self.convolutions:
            convolutions.store_normalization()

    @property
    def convolutions(self) -> list[Convolutions]:
        """Convolutions of each image."""
        return [module for module in self.modules() if isinstance(module, Convolutions)]

    def forward(self, observations: Any) -> Tensor:
        """Map preprocessed observations to features."""
        parts = cast(Mapping[str, Tensor], parts_of(observations))
        images = tuple(parts[key].permute(0, 2, 3, 1) for key in self._images)
        vectors = [parts[key].flatten(1) for key in self._vectors]
        first = next(iter(parts.values()))
        vector = torch.cat(vectors, 1) if vectors else first.new_empty(len(first), 0)
        return cast(Tensor, self.trunk(Observations(vector, images)))


class NetworkDQNPolicy(DQNPolicy):
    """SB3's policy for DQN with this package's network, which may be a dueling network."""

    def make_q_net(self) -> QNetwork:
        """Create a network with random weights."""
        network = super().make_q_net()
        architecture = self.features_extractor_kwargs["architecture"]
        head = make_head(
            network.features_dim, (int(cast(spaces.Discrete, self.action_space).n),), architecture
        )
        network.q_net = nn.Sequential(head).to(self.device)
        return network


def policy_arguments(architecture: Architecture) -> dict[str, Any]:
    """Return the `policy_kwargs` with which an SB3 policy uses this package's network."""
    return {
        "net_arch": [],
        "features_extractor_class": NetworkFeatures,
        "features_extractor_kwargs": {"architecture": architecture},
        # `Convolutions` normalize the images.
        "normalize_images": False,
    }


def channels_first(space: spaces.Space[Any]) -> spaces.Space[Any]:
    """Return the space as SB3's networks receive it, with image channels first."""

    def first(box: spaces.Box) -> spaces.Space[Any]:
        is_last = is_image(box) and stack_axis(box) == -1
        return VecTransposeImage.transpose_space(box) if is_last else box

    return map_space(first, space)


def inputs_of(space: spaces.Space[Any]) -> tuple[list[str], list[ImageInput]]:
    """Return the keys of the vectors, and an `ImageInput` for each channels-first image."""
    # What SB3 takes for images of fewer than `MIN_IMAGE_EDGE` pixels are vectors.
    vectors, images = [], []
    for key, part in parts_of_space(space).items():
        if is_image(part) and min(part.shape[1:]) >= MIN_IMAGE_EDGE:
            channels, height, width = part.shape
            images.append(ImageInput((height, width, channels)))
        else:
            vectors.append(key)
    return vectors, images


def normalize_images(policy: nn.Module, images: Sequence[ImageInput], stack: int) -> None:
    """Set the image normalization of an SB3 policy with this package's networks."""
    large = [image.stacked(stack) for image in images if min(image.shape[:2]) >= MIN_IMAGE_EDGE]
    for module in policy.modules():
        if isinstance(module, NetworkFeatures):
            for convolutions, image in zip(module.convolutions, large, strict=True):
                convolutions.normalize(image)
