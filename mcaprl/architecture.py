"""Architecture of networks, and the settings that select it. Importing this module loads no torch.

Three encoders of images are available, which `ENCODERS` describes. `nature` has the convolutions of
"Human-level control through deep reinforcement learning" (https://doi.org/10.1038/nature14236).
`compact` first averages squares of pixels, so that the image's shorter edge has about 42 pixels; it
has two small convolutions. A gradient step with `compact` takes a fraction of the time of a step
with `nature`. `small` has two convolutions of 3 x 3 pixels, for grids of cells; images that are
too small for the others, with an edge of 8 to 35 pixels, always have it. Arrays with a smaller
edge, such as the 7 x 7 cells of MiniGrid, are numbers of the vector: all layers see every cell.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from mcaprl.settings import Settings

AUTO = "auto"
"""Setting of the encoder that selects `compact` for images with one channel, else `nature`."""


@dataclass(frozen=True)
class Encoder:
    """Convolutions of an encoder."""

    channels: tuple[int, ...]  # Default output channels of the convolutions
    kernels: tuple[tuple[int, int], ...]  # Kernel size and stride of each convolution, in pixels
    # Approximate length in pixels of an image's shorter edge after average pooling by an integer
    # factor; None for no pooling.
    edge: int | None = None

    def pool(self, image_shape: Sequence[int]) -> int:
        """Return the average-pooling factor for images (height, width, ...). 1 means no pooling."""
        return 1 if self.edge is None else max(1, round(min(image_shape[:2]) / self.edge))

    def pixels(self, image_shape: Sequence[int]) -> int:
        """Return the number of pixels after the last convolution; 0 if the image is too small."""
        pool, count = self.pool(image_shape), 1
        for edge in image_shape[:2]:
            left = edge // pool
            for kernel, stride in self.kernels:
                left = (left - kernel) // stride + 1 if left >= kernel else 0
            count *= left
        return count


ENCODERS: Final[dict[str, Encoder]] = {
    "nature": Encoder((32, 64, 64), ((8, 4), (4, 2), (3, 1))),
    "compact": Encoder((16, 32), ((4, 4), (3, 2)), edge=42),
    "small": Encoder((16, 32), ((3, 1), (3, 2))),
}
_DEFAULTS: Final = ("nature", "compact")
"""Encoders that `auto` chooses from for images that are not small."""
SMALL_EDGE: Final = 36
"""Edge in pixels below which the encoder is `small`: the output of the others would be empty."""


def choose_encoder(name: str, widths: Sequence[int], channels: Iterable[int]) -> str:
    """Return the encoder that a setting selects."""
    if name != AUTO:
        return name
    if widths:
        counts = {len(ENCODERS[key].kernels): key for key in _DEFAULTS}
        return counts[len(widths)]
    return "compact" if all(count == 1 for count in channels) else "nature"


@dataclass(frozen=True)
class Architecture:
    """Architecture of a network."""

    # Widths of the fully connected hidden layers; each input has its own first layer.
    hidden: tuple[int, ...]
    # Output channels of the convolutions over each image; empty selects those of the encoder.
    channels: tuple[int, ...] = ()
    # Whether the hidden layers are normalized before each ReLU (https://arxiv.org/abs/1607.06450).
    layer_norm: bool = False
    # Whether outputs are the sum of a value and of advantages with mean 0, computed by separate
    # last hidden layers (https://arxiv.org/abs/1511.06581).
    dueling: bool = False
    encoder: str = "nature"  # Key of `ENCODERS`, for images that are not small

    def encoder_of(self, image_shape: Sequence[int]) -> Encoder:
        """Return the encoder for an image (height, width, ...), with its output channels."""
        is_small = min(image_shape[:2]) < SMALL_EDGE
        encoder = ENCODERS["small" if is_small else self.encoder]
        channels = self.channels[: len(encoder.kernels)] or encoder.channels
        return replace(encoder, channels=channels)

    def of_encoder(self) -> Architecture:
        """Return the architecture of an encoder that several networks share."""
        return Architecture((), self.channels, encoder=self.encoder)

    def features(self, image_shape: Sequence[int]) -> int:
        """Return the number of features of the convolutions for an image (height, width, ...)."""
        encoder = self.encoder_of(image_shape)
        return encoder.pixels(image_shape) * encoder.channels[-1]


def architecture_of(found: Mapping[str, Any]) -> Architecture:
    """Return the architecture that a file describes."""
    lists = {key: tuple(value) for key, value in found.items() if isinstance(value, list)}
    return Architecture(**{**found, **lists})


@dataclass(frozen=True)
class NetworkSettings(Settings):
    """Settings of all algorithms with networks; each algorithm adds its own in a subclass.

    Raises:
        UsageError: A setting is outside its range.
    """

    encoder: str = AUTO
    """convolutions over images: nature, compact, small, or auto, which selects by the image"""
    channels: tuple[int, ...] = ()
    """output channels of the convolutions; by default, nature has 32,64,64, the others 16,32"""
    center_images: bool = True
    """subtract the mean image, and divide by the standard deviation of all pixels"""
    layer_norm: bool = False
    """normalize the hidden layers"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        known = (AUTO, *ENCODERS)
        self._require("encoder", self.encoder in known, f"one of {', '.join(known)}")
        encoders = ENCODERS.values() if self.encoder == AUTO else [ENCODERS[self.encoder]]
        counts = {len(encoder.kernels) for encoder in encoders}
        fits = len(self.channels) in counts and all(count >= 1 for count in self.channels)
        allowed = f"{' or '.join(map(str, sorted(counts)))} numbers of at least 1"
        self._require("channels", fits or not self.channels, allowed)

    def architecture_for(self, channels: Iterable[int]) -> Architecture:
        """Return the architecture of the networks."""
        encoder = choose_encoder(self.encoder, self.channels, channels)
        return Architecture(self.hidden, self.channels, self.layer_norm, encoder=encoder)
