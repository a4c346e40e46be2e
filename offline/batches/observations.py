"""Encoding of an environment's observations as network inputs: a vector, images, an action mask.

Everything that is not an image, at any depth of a Dict space, becomes part of one float32 vector:
discrete values are one-hot encoded, and uint8 numbers are divided by 255. Images stay uint8; those
with their channels first are transposed.

The top-level key `action_mask` of a Dict space, with one flag per action, is not an input: the mask
marks the allowed actions, as in PettingZoo. Logs contain it as part of the observation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor

from mcaprl.actions import MASK_KEY, JointActions, allowed_actions, joint_actions
from mcaprl.architecture import SMALL_EDGE
from mcaprl.errors import SpaceError
from mcaprl.networks import ImageInput
from mcaprl.recorder.dataset.images import Frames, MappedImages
from mcaprl.recorder.format.spaces import MIN_IMAGE_EDGE, Leaf, observation_leaves


@dataclass(frozen=True)
class Observations:
    """B observations as network inputs.

    Attributes:
        vector: (B, V) float32; V is 0 if there are only images.
        images: Tensors (B, height, width, channels), uint8, one per camera.
        mask: (B, A) bool, allowed actions; None if every action is always allowed.
    """

    vector: Tensor
    images: tuple[Tensor, ...] = ()
    mask: Tensor | None = None

    def __len__(self) -> int:
        """Return the number of observations, B."""
        return len(self.vector)

    def parts(self) -> list[Tensor]:
        """Return all tensors, the mask last."""
        mask = [] if self.mask is None else [self.mask]
        return [self.vector, *self.images, *mask]

    def like(self, parts: Sequence[Tensor]) -> Observations:
        """Return observations that consist of `parts`, in the order that `self.parts` returns."""
        n_images = len(self.images)
        mask = None if self.mask is None else parts[-1]
        return Observations(parts[0], tuple(parts[1 : 1 + n_images]), mask)

    def rows(self, index: Tensor) -> Observations:
        """Return a copy of the rows with these indexes (R,)."""
        if not self.images and self.mask is None:
            return Observations(self.vector.index_select(0, index))
        return self.like([part.index_select(0, index) for part in self.parts()])

    def split(self, rows: int) -> list[Observations]:
        """Split into views of `rows` observations each; the last view may have fewer."""
        columns = [torch.split(part, rows) for part in self.parts()]
        return [self.like(parts) for parts in zip(*columns, strict=True)]

    def stacked(self, count: int) -> Observations:
        """Return stacks of `count` successive observations, with the mask of the last one."""
        if count == 1:
            return self
        rows = self.vector.shape[0] // count
        images = tuple(
            image.view(rows, count, *image.shape[1:]).permute(0, 2, 3, 1, 4).flatten(3)
            for image in self.images
        )
        mask = None if self.mask is None else self.mask.view(rows, count, -1)[:, -1]
        return Observations(self.vector.reshape(rows, -1), images, mask)

    def with_actions(self, actions: Tensor) -> Observations:
        """Return the same observations with actions (B, n) after the numbers of their vectors."""
        return replace(self, vector=torch.cat((self.vector, actions), 1))

    def detached(self) -> Observations:
        """Return the same observations, through which no gradients flow."""
        return replace(self, vector=self.vector.detach())

    def to(self, device: torch.device) -> Observations:
        """Return the same observations on another device."""
        return self.like([part.to(device) for part in self.parts()])


@dataclass(frozen=True, eq=False)
class FramesOnDisk:
    """F observations whose images stay on disk until `rows` selects them."""

    numbers: Observations  # The observations without images
    # Images (F, height, width) or (F, height, width, channels), one array per camera.
    images: tuple[Frames, ...]
    # Shape (height, width, channels) of one image of each camera.
    shapes: tuple[tuple[int, ...], ...]

    def __len__(self) -> int:
        """Return the number of observations, F."""
        return len(self.numbers)

    @property
    def vector(self) -> Tensor:
        """Vectors (F, V), float32."""
        return self.numbers.vector

    @property
    def mask(self) -> Tensor | None:
        """Allowed actions (F, A), bool; None if every action is always allowed."""
        return self.numbers.mask

    def rows(self, index: Tensor) -> Observations:
        """Read the rows with these indexes (R,), onto the device of `index`."""
        places = index.cpu().numpy()
        images = tuple(
            torch.from_numpy(np.asarray(image[places])).view(-1, *shape).to(index.device)
            for image, shape in zip(self.images, self.shapes, strict=True)
        )
        return replace(self.numbers.rows(index), images=images)

    def to(self, device: torch.device) -> FramesOnDisk:
        """Return the same observations with the numbers on another device."""
        return replace(self, numbers=self.numbers.to(device))


class ObservationEncoder:
    """Encoder from observations of one space to tensors, saved with each policy."""

    layout = "C"  # Layout in memory of the arrays of images; empty for any

    def __init__(self, space: spaces.Space[Any], n_actions: int, mask_key: str = MASK_KEY) -> None:
        """Create the encoder, without normalization."""
        self.space = space
        leaves = {leaf.path: leaf for leaf in observation_leaves(space)}
        self.mask = leaves.pop((mask_key,), None)  # Leaf of the action mask, if any
        if self.mask is not None and self.mask.shape != (n_actions,):
            shape = self.mask.shape
            raise SpaceError(f"{MASK_KEY} has shape {shape}, but there are {n_actions} actions")
        kinds = [(leaf, leaf.of(space)) for leaf in leaves.values()]
        # Leaves of the space that are images.
        self.images = [leaf for leaf, part in kinds if self.is_image(part)]
        # Leaves that form the vector, with their spaces.
        self.numbers = [(leaf, part) for leaf, part in kinds if not self.is_image(part)]
        if not kinds:
            raise SpaceError(f"the observation contains only {MASK_KEY}")
        # Shape and normalization of each image.
        self.image_inputs = [ImageInput(_image_shape(leaf.shape)) for leaf in self.images]
        widths = [_width(part) for _, part in self.numbers]
        self.width = sum(widths)  # Length V of the vector
        bytes_ = [
            isinstance(part, spaces.Box) and part.dtype == np.uint8 for _, part in self.numbers
        ]
        self.shift = np.zeros(self.width, np.float32)  # (V,) float32, subtracted from the vector
        # (V,) float32, divisor of the shifted vector.
        self.scale = np.repeat(np.where(bytes_, 255, 1), widths).astype(np.float32)

    @staticmethod
    def is_image(space: spaces.Space[Any]) -> bool:
        """Return whether a space has uint8 images: (height, width), with or without channels."""
        if not isinstance(space, spaces.Box) or space.dtype != np.uint8:
            return False
        return len(space.shape) in (2, 3) and min(_image_shape(space.shape)[:2]) >= MIN_IMAGE_EDGE

    def arranged(self, observations: Any) -> Any:
        """Return observations (B, ...) of an environment in the form of `space`."""
        return observations

    def normalize_to(self, observations: Any) -> None:
        """Normalize inputs to mean 0 and deviation 1; pixels of an image share a scale."""
        # A constant input keeps its default scale and becomes 0.
        self.center_images(observations)
        self.shift, scale = np.zeros_like(self.shift), self.scale
        self.scale = np.ones_like(scale)
        vector = self._vector(observations).astype(np.float64)
        mean, deviation = vector.mean(0), vector.std(0)
        constant = deviation <= 1e-6 * np.abs(vector).max(0, initial=0)
        self.shift = mean.astype(np.float32)
        self.scale = np.where(constant, scale, deviation).astype(np.float32)

    def center_images(self, observations: Any) -> None:
        """Normalize all images to mean 0 and standard deviation 1 over these observations."""
        self.image_inputs = [
            image.normalized_to(_channels_last(leaf.of(observations), leaf))
            for image, leaf in zip(self.image_inputs, self.images, strict=True)
        ]

    def encode(self, observations: Any) -> Observations:
        """Encode B observations, whose memory the result shares if it needs no conversion."""
        for leaf in self.leaves:
            _check_shape(leaf, observations)
        images = [
            _tensor(_channels_last(leaf.of(observations), leaf), np.uint8, self.layout).reshape(
                -1, *image.shape
            )
            for leaf, image in zip(self.images, self.image_inputs, strict=True)
        ]
        vector = _tensor(self._vector(observations), np.float32)
        return Observations(vector, tuple(images), self._allowed(observations))

    def encode_frames(self, frames: Any) -> Observations | FramesOnDisk:
        """Encode all frames of a dataset; images on disk stay there."""
        images = tuple(leaf.of(frames) for leaf in self.images)
        if not any(isinstance(image, MappedImages) for image in images):
            return self.encode(frames)
        for leaf in self.leaves:
            _check_shape(leaf, frames)
        vector = _tensor(self._vector(frames), np.float32)
        numbers = Observations(vector, mask=self._allowed(frames))
        return FramesOnDisk(numbers, images, tuple(image.shape for image in self.image_inputs))

    @property
    def leaves(self) -> list[Leaf]:
        """All parts of an observation: images, numbers, mask."""
        mask = [] if self.mask is None else [self.mask]
        return [*self.images, *(leaf for leaf, _ in self.numbers), *mask]

    def _vector(self, observations: Any) -> NDArray[Any]:
        rows = len(self.leaves[0].of(observations))
        parts = [_numbers(leaf.of(observations), part) for leaf, part in self.numbers]
        if len(parts) == 1:
            vector = parts[0]
        else:
            vector = np.concatenate(parts, 1) if parts else np.empty((rows, 0), np.float32)
        if self.shift.any():
            vector = vector - self.shift
        return vector / self.scale if (self.scale != 1).any() else vector

    def _allowed(self, observations: Any) -> Tensor | None:
        allowed = None if self.mask is None else allowed_actions(observations)
        return None if allowed is None else torch.from_numpy(allowed)


def has_channels_first(shape: tuple[int, ...]) -> bool:
    """Return whether images of this shape are (channels, height, width).

    >>> has_channels_first((4, 84, 84)), has_channels_first((84, 84, 4))
    (True, False)
    """
    if len(shape) != 3:
        return False
    channels, edge = shape[0], min(shape[1:])
    # The second rule is for stacks of frames; a grid of cells with many channels has similar sizes.
    return channels < MIN_IMAGE_EDGE <= edge or (channels < SMALL_EDGE and 2 * channels <= edge)


def _image_shape(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape of images as the network receives them: (height, width, channels)."""
    return (*shape[1:], shape[0]) if has_channels_first(shape) else (*shape, 1)[:3]


def _channels_last(images: Any, leaf: Leaf) -> Any:
    """Return images (B, *shape) of a leaf with their channels last; those on disk have them so."""
    return np.moveaxis(images, 1, -1) if has_channels_first(leaf.shape) else images


def codes_of(space: spaces.Space[Any]) -> JointActions | None:
    """Return the elements of a (Multi)Discrete space, to be one-hot encoded; None of others."""
    return None if isinstance(space, spaces.MultiBinary) else joint_actions(space)


def _width(space: spaces.Space[Any]) -> int:
    codes = codes_of(space)
    return int(np.prod(space.shape or ()) if codes is None else sum(codes.sizes))


def _numbers(values: NDArray[Any], space: spaces.Space[Any]) -> NDArray[Any]:
    """Return values of a space as numbers (B, width); discrete values are one-hot encoded."""
    codes = codes_of(space)
    flat = np.asarray(values).reshape(len(values), -1)
    if codes is None:
        return flat.astype(np.float32, copy=False)
    if not codes.contain(flat).all():
        raise SpaceError(f"observations are not in their space {space}")
    columns = (flat - codes.starts).T
    return np.concatenate(
        [np.eye(n, dtype=np.float32)[one] for n, one in zip(codes.sizes, columns, strict=True)], 1
    )


def _tensor(array: Any, dtype: Any, layout: str = "C") -> Tensor:
    # Tensors have no negative strides.
    layout = layout or "C" * (min(np.asarray(array).strides, default=0) < 0)
    return torch.from_numpy(np.require(array, dtype, ["W", *layout]))


def _check_shape(leaf: Leaf, observations: Any) -> None:
    try:
        got = np.shape(leaf.of(observations))
    except (KeyError, IndexError, TypeError) as error:
        raise SpaceError(f"observations have no {'.'.join(leaf.path)}") from error
    if len(got) == 0 or got[1:] != leaf.shape:
        wanted = ", ".join(map(str, ("B", *leaf.shape)))
        where = f" of {'.'.join(leaf.path)}" if leaf.path else ""
        added = "observation[None]"
        if leaf.path:
            added = "{name: np.asarray(part)[None] for name, part in observation.items()}"
        hint = f"; add an axis to a single one: {added}" if got == leaf.shape else ""
        raise SpaceError(f"expects observations ({wanted}){where}, got {got}{hint}")
