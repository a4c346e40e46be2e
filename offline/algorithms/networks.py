"""Networks from observations to one or more numbers per action.

image  -> convolutions -> layer -+
vector -----------------> layer -+-> layers -> outputs
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn

from mcaprl.offline.batches.observations import ImageInput, Observations


@dataclass(frozen=True)
class Architecture:
    """Architecture of a network.

    Attributes:
        hidden: Widths of the fully connected hidden layers; each input has its own first layer.
        channels: Output channels of the three convolutions over each image.
        layer_norm: Whether the hidden layers are normalized before each ReLU
            (https://arxiv.org/abs/1607.06450).
        dueling: Whether outputs are the sum of a value and of advantages with mean 0, computed by
            separate last hidden layers (https://arxiv.org/abs/1511.06581).
    """

    hidden: tuple[int, ...]
    channels: tuple[int, ...] = (32, 64, 64)
    layer_norm: bool = False
    dueling: bool = False


class Network(nn.Module):
    """Network that maps observations to outputs (B, *output_shape)."""

    def __init__(
        self,
        vector_width: int,
        images: Sequence[ImageInput],
        output_shape: tuple[int, ...],
        architecture: Architecture,
    ) -> None:
        """Build the layers, with random weights.

        `vector_width` is 0 if there is no vector; `output_shape` is (A, ...) for A actions.
        """
        super().__init__()
        self.output_shape = output_shape
        hidden, layer_norm = architecture.hidden, architecture.layer_norm
        # The last hidden layer of a dueling network is part of its head.
        shared = hidden[:-1] if architecture.dueling else hidden
        self.stems = nn.ModuleList()
        width = 0
        for image in images:
            convolutions = NatureConvolutions(image, architecture.channels)
            layers, stem_width = _layers(convolutions.n_features, shared[:1], layer_norm)
            self.stems.append(nn.Sequential(convolutions, *layers))
            width += stem_width
        if vector_width:
            layers, stem_width = _layers(vector_width, shared[:1], layer_norm)
            self.stems.append(nn.Sequential(*layers))
            width += stem_width
        layers, width = _layers(width, shared[1:], layer_norm)
        self.body = nn.Sequential(*layers)
        self.head: nn.Module = (
            DuelingHead(width, hidden[-1:], output_shape, layer_norm)
            if architecture.dueling
            else _linear(width, output_shape)
        )

    def forward(self, observations: Observations) -> Tensor:
        """Map observations to outputs."""
        inputs = [*observations.images, observations.vector]
        features = [stem(part) for stem, part in zip(self.stems, inputs, strict=False)]
        joined = features[0] if len(features) == 1 else torch.cat(features, 1)
        outputs = cast(Tensor, self.head(self.body(joined)))
        return outputs.view(-1, *self.output_shape)


class NatureConvolutions(nn.Module):
    """Three convolutions from images (B, height, width, channels) of uint8 to (B, n_features).

    See "Human-level control through deep reinforcement learning",
    https://doi.org/10.1038/nature14236.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, image: ImageInput, channels: tuple[int, ...]) -> None:
        """Build the convolutions for an image input."""
        super().__init__()
        first, second, third = channels
        shift = np.zeros(image.shape, np.float32) if image.shift is None else image.shift
        # Not persistent, because the normalization of all observations is saved separately.
        self.register_buffer("shift", torch.from_numpy(shift), persistent=False)
        self.register_buffer("scale", torch.tensor(image.scale), persistent=False)
        self.layers = nn.Sequential(
            nn.Conv2d(image.shape[2], first, kernel_size=8, stride=4),
            nn.ReLU(),
            nn.Conv2d(first, second, kernel_size=4, stride=2),
            nn.ReLU(),
            nn.Conv2d(second, third, kernel_size=3, stride=1),
            nn.ReLU(),
            nn.Flatten(),
        )
        with torch.no_grad():
            self.n_features = self(torch.zeros(1, *image.shape, dtype=torch.uint8)).shape[1]

    def forward(self, images: Tensor) -> Tensor:
        """Map uint8 images to features."""
        normalized = (images.float() - self.shift) / self.scale
        return cast(Tensor, self.layers(normalized.permute(0, 3, 1, 2)))


class DuelingHead(nn.Module):
    """Head with separate streams for the state value and advantages: Q = V + A - mean(A)."""

    def __init__(
        self, n_inputs: int, hidden: tuple[int, ...], output_shape: tuple[int, ...], norm: bool
    ) -> None:
        """Build the two streams."""
        super().__init__()
        self.output_shape = output_shape
        layers, width = _layers(n_inputs, hidden, norm)
        self.advantages = nn.Sequential(*layers, _linear(width, output_shape))
        layers, width = _layers(n_inputs, hidden, norm)
        self.value = nn.Sequential(*layers, _linear(width, (1, *output_shape[1:])))

    def forward(self, features: Tensor) -> Tensor:
        """Map features to flat outputs."""
        advantages = cast(Tensor, self.advantages(features)).view(-1, *self.output_shape)
        value = cast(Tensor, self.value(features)).view(-1, 1, *self.output_shape[1:])
        return (value + advantages - advantages.mean(1, keepdim=True)).flatten(1)


def _layers(
    n_inputs: int, widths: tuple[int, ...], layer_norm: bool
) -> tuple[list[nn.Module], int]:
    """Return fully connected layers with ReLU, and the width of the last."""
    layers: list[nn.Module] = []
    for width in widths:
        norm = [nn.LayerNorm(width)] if layer_norm else []
        layers += [nn.Linear(n_inputs, width), *norm, nn.ReLU()]
        n_inputs = width
    return layers, n_inputs


def _linear(n_inputs: int, output_shape: tuple[int, ...]) -> nn.Linear:
    return nn.Linear(n_inputs, torch.Size(output_shape).numel())
