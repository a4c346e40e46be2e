"""Networks that output one or more numbers per action, for offline and online learning.

image  -> convolutions -> layer -+
vector -----------------> layer -+-> layers -> outputs

The encoders of images are described in `mcaprl.architecture`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mcaprl.architecture import ENCODERS, Architecture
from mcaprl.storage.tensor_files import check_widths

_MAX_IMAGES = 10_000  # Maximum number of images, evenly spaced, for computing a mean image
_IMAGES_AT_ONCE = 256
_SMALLEST_VARIANCE = 1e-6
"""Images count as equal up to this variance of their pixels (0 to 255). Because of rounding errors,
the computed variance of equal images may be above 0."""


@dataclass(frozen=True, eq=False)
class ImageInput:
    """Shape and normalization of one camera's images: (pixels - shift) / scale."""

    shape: tuple[int, ...]  # (height, width, channels)
    # (height, width, channels) float32, from 0 to 255; None is all zeros.
    shift: NDArray[np.float32] | None = None
    scale: float = 255.0  # Divisor of the shifted pixels

    def stacked(self, count: int) -> ImageInput:
        """Return the input for `count` images that are stacked along the channel axis."""
        height, width, channels = self.shape
        shift = None if self.shift is None else np.tile(self.shift, (1, 1, count))
        return replace(self, shape=(height, width, channels * count), shift=shift)

    def normalized_to(self, images: NDArray[np.uint8]) -> ImageInput:
        """Return the input with the mean image as shift and the standard deviation as scale."""
        # All pixels share one scale. Pixels that hardly change therefore keep small values.
        number = len(images)
        used = np.linspace(0, number - 1, min(number, _MAX_IMAGES)).astype(np.int64)
        total = np.zeros(self.shape)
        squares = 0.0
        for rows in np.split(used, range(_IMAGES_AT_ONCE, len(used), _IMAGES_AT_ONCE)):
            pixels = np.asarray(images[rows]).reshape(-1, *self.shape).astype(np.float64)
            total += pixels.sum(0)
            squares += float(np.square(pixels).sum())
        mean = total / len(used)
        variance = squares / (len(used) * mean.size) - float(np.square(mean).mean())
        scale = math.sqrt(variance) if variance > _SMALLEST_VARIANCE else self.scale
        return replace(self, shift=mean.astype(np.float32), scale=scale)


class Inputs(Protocol):
    """Observations as network inputs."""

    @property
    def vector(self) -> Tensor:
        """Joined vectors (B, V), float32; V is 0 if there are only images."""

    @property
    def images(self) -> tuple[Tensor, ...]:
        """Tensors (B, height, width, channels), uint8 or float32, one per camera."""


class Trunk(nn.Module):
    """Layers before the head of a network; they map observations to features (B, width)."""

    def __init__(
        self, vector_width: int, images: Sequence[ImageInput], architecture: Architecture
    ) -> None:
        """Build the layers, with random weights; `vector_width` is 0 if there is no vector."""
        super().__init__()
        layer_norm = architecture.layer_norm
        shared = architecture.hidden
        # The last hidden layer of a dueling network is part of its head.
        shared = shared[:-1] if architecture.dueling else shared
        self.stems = nn.ModuleList()
        width = 0
        for image in images:
            convolutions = Convolutions(image, architecture)
            layers, stem_width = _layers(convolutions.n_features, shared[:1], layer_norm)
            self.stems.append(nn.Sequential(convolutions, *layers))
            width += stem_width
        if vector_width:
            layers, stem_width = _layers(vector_width, shared[:1], layer_norm)
            self.stems.append(nn.Sequential(*layers))
            width += stem_width
        layers, self.width = _layers(width, shared[1:], layer_norm)
        self.body = nn.Sequential(*layers)

    def forward(self, observations: Inputs) -> Tensor:
        """Map observations to features."""
        inputs = [*observations.images, observations.vector]
        features = [stem(part) for stem, part in zip(self.stems, inputs, strict=False)]
        joined = features[0] if len(features) == 1 else torch.cat(features, 1)
        return cast(Tensor, self.body(joined))


class Network(Trunk):
    """Network that maps observations to outputs (B, *output_shape)."""

    def __init__(
        self,
        vector_width: int,
        images: Sequence[ImageInput],
        output_shape: tuple[int, ...],
        architecture: Architecture,
    ) -> None:
        """Build the layers; `vector_width` may be 0, `output_shape` is (A, ...) for A actions."""
        super().__init__(vector_width, images, architecture)
        self.output_shape = output_shape
        self.head: nn.Module = make_head(self.width, output_shape, architecture)

    def forward(self, observations: Inputs) -> Tensor:
        """Map observations to outputs."""
        return cast(Tensor, self.head(super().forward(observations))).view(-1, *self.output_shape)

    @torch.no_grad()
    def scale_outputs(self, factor: float) -> None:
        """Multiply all outputs by a factor, by scaling the weights of the last layers."""
        for layer in last_layers(self.head):
            layer.weight.mul_(factor)
            layer.bias.mul_(factor)


class Convolutions(nn.Module):
    """Convolutions of an encoder: images (B, height, width, channels) to features (B, n)."""

    # Images are first averaged over squares of pixels, unless they have the averaged size.

    shift: Tensor  # Tensor (channels, height, width) that is subtracted from the averaged pixels
    scale: Tensor  # Divisor of the shifted pixels

    def __init__(self, image: ImageInput, architecture: Architecture) -> None:
        """Build the convolutions for an image input."""
        super().__init__()
        encoder = architecture.encoder_of(image.shape)
        self._pool = encoder.pool(image.shape)
        # These buffers are not persistent, because the normalization is saved separately.
        self.register_buffer("shift", self._shift_of(image), persistent=False)
        self.register_buffer("scale", torch.tensor(image.scale), persistent=False)
        layers: list[nn.Module] = []
        depth = image.shape[2]
        for width, (kernel, stride) in zip(encoder.channels, encoder.kernels, strict=True):
            layers += [nn.Conv2d(depth, width, kernel_size=kernel, stride=stride), nn.ReLU()]
            depth = width
        self.layers = nn.Sequential(*layers, nn.Flatten())
        self.n_features = architecture.features(image.shape)

    def normalize(self, image: ImageInput) -> None:
        """Copy shift and scale from an image input of the same shape."""
        self.shift.copy_(self._shift_of(image))
        self.scale.fill_(image.scale)

    def store_normalization(self) -> None:
        """Make shift and scale part of the state dict."""
        self.register_buffer("shift", self.shift)
        self.register_buffer("scale", self.scale)

    def forward(self, images: Tensor) -> Tensor:
        """Map images to features."""
        pixels = images.permute(0, 3, 1, 2)
        if pixels.shape[2:] != self.shift.shape[1:]:
            pixels = self._averaged(pixels.float())
        return cast(Tensor, self.layers((pixels - self.shift) / self.scale))

    def _averaged(self, pixels: Tensor) -> Tensor:
        """Average squares of pixels, in a fifth of the time that torch's average pooling takes."""
        pool = self._pool
        height, width = (edge // pool * pool for edge in pixels.shape[-2:])
        rows = pixels[..., 0:height:pool, :]
        for row in range(1, pool):
            rows = rows + pixels[..., row:height:pool, :]
        sums = rows[..., 0:width:pool]
        for column in range(1, pool):
            sums = sums + rows[..., column:width:pool]
        return sums / pool**2

    def _shift_of(self, image: ImageInput) -> Tensor:
        shift = np.zeros(image.shape, np.float32) if image.shift is None else image.shift
        return self._averaged(torch.from_numpy(shift).permute(2, 0, 1).contiguous())


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


def check_size(
    architecture: Architecture,
    vector_width: int,
    images: Sequence[ImageInput],
    n_outputs: int,
    weights: Mapping[str, Tensor],
) -> None:
    """Check that a file has enough weights for a network, before the network is created."""
    if architecture.encoder not in ENCODERS:
        raise ValueError(f"encoder {architecture.encoder!r} is not supported")
    for image in images:
        check_widths(architecture.encoder_of(image.shape).channels, weights)
    widths = [architecture.features(image.shape) for image in images]
    for width in [*widths, *([vector_width] if vector_width else [])]:
        check_widths([width, *architecture.hidden, n_outputs], weights)


def make_head(
    n_inputs: int, output_shape: tuple[int, ...], architecture: Architecture
) -> nn.Module:
    """Return the layers from the features of a `Trunk` to flat outputs."""
    if not architecture.dueling:
        return _linear(n_inputs, output_shape)
    return DuelingHead(n_inputs, architecture.hidden[-1:], output_shape, architecture.layer_norm)


def last_layers(head: nn.Module) -> list[nn.Linear]:
    """Return the last layer of a head, or the last layers of the two streams of a dueling head."""
    if isinstance(head, DuelingHead):
        return [cast(nn.Linear, stream[-1]) for stream in (head.advantages, head.value)]
    return [cast(nn.Linear, head)]


def _layers(
    n_inputs: int, widths: tuple[int, ...], layer_norm: bool
) -> tuple[list[nn.Module], int]:
    """Return fully connected layers with ReLU, and the number of their outputs."""
    layers: list[nn.Module] = []
    for width in widths:
        norm = [nn.LayerNorm(width)] if layer_norm else []
        layers += [nn.Linear(n_inputs, width), *norm, nn.ReLU()]
        n_inputs = width
    return layers, n_inputs


def _linear(n_inputs: int, output_shape: tuple[int, ...]) -> nn.Linear:
    return nn.Linear(n_inputs, torch.Size(output_shape).numel())
