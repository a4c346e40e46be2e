"""Encoding of observations as network inputs: one vector, images and an action mask.

All parts that are not images (floats, flags, counters, at any depth of a Dict space) become one
float32 vector: a Discrete part is one-hot encoded, uint8 values are divided by 255. Images stay
uint8.

The top-level key `action_mask` of a Dict space, with one flag per action, is not a network input:
it marks the allowed actions, as in PettingZoo. It is part of the observation, so logs contain it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor

from mcaprl.errors import SpaceError
from mcaprl.recorder.format.spaces import MIN_IMAGE_EDGE as SMALLEST_IMAGE
from mcaprl.recorder.format.spaces import Leaf, observation_leaves

MIN_IMAGE_EDGE = 36
"""Smallest height and width in pixels for which the output of the convolutions is not empty."""
MASK_KEY = "action_mask"
_MOST_IMAGES = 10_000
"""Largest number of images, evenly spaced, used to compute the mean and the scale."""
_IMAGES_AT_ONCE = 256
_SMALLEST_VARIANCE = 1e-6
"""Variance at or below which all images are considered equal up to rounding."""


@dataclass(frozen=True)
class Observations:
    """B observations as network inputs.

    Attributes:
        vector: Vector inputs, (B, V) float32; V is 0 if there are only images.
        images: Image inputs, (B, height, width, channels) uint8 each.
        mask: Allowed actions, (B, A) bool; None if all actions are always allowed.
    """

    vector: Tensor
    images: tuple[Tensor, ...] = ()
    mask: Tensor | None = None

    def __len__(self) -> int:
        """Return B, the number of observations."""
        return len(self.vector)

    def parts(self) -> list[Tensor]:
        """Return all tensors, the mask last."""
        mask = [] if self.mask is None else [self.mask]
        return [self.vector, *self.images, *mask]

    def like(self, parts: Sequence[Tensor]) -> Observations:
        """Create observations with the same layout from other tensors, in the order of `parts`."""
        n_images = len(self.images)
        mask = None if self.mask is None else parts[-1]
        return Observations(parts[0], tuple(parts[1 : 1 + n_images]), mask)

    def rows(self, index: Tensor) -> Observations:
        """Copy the rows with these indices (R,)."""
        if not self.images and self.mask is None:
            return Observations(self.vector.index_select(0, index))
        return self.like([part.index_select(0, index) for part in self.parts()])

    def split(self, rows: int) -> list[Observations]:
        """Split into views of `rows` observations each; the last may have fewer."""
        columns = [torch.split(part, rows) for part in self.parts()]
        return [self.like(parts) for parts in zip(*columns, strict=True)]

    def stacked(self, count: int) -> Observations:
        """Stack each `count` successive observations into one, which has the mask of the last."""
        if count == 1:
            return self
        rows = self.vector.shape[0] // count
        images = tuple(
            image.view(rows, count, *image.shape[1:]).permute(0, 2, 3, 1, 4).flatten(3)
            for image in self.images
        )
        mask = None if self.mask is None else self.mask.view(rows, count, -1)[:, -1]
        return Observations(self.vector.reshape(rows, -1), images, mask)

    def to(self, device: torch.device) -> Observations:
        """Return the same observations on a device."""
        return self.like([part.to(device) for part in self.parts()])


@dataclass(frozen=True, eq=False)
class ImageInput:
    """Normalization of the images of one leaf: (values - shift) / scale.

    Attributes:
        shape: Shape (height, width, channels) of one image.
        shift: Mean image, (height, width, channels) float32; None for 0.
        scale: Divisor of all pixels.
    """

    shape: tuple[int, ...]
    shift: NDArray[np.float32] | None = None
    scale: float = 255.0

    def stacked(self, count: int) -> ImageInput:
        """Return the normalization of `count` images stacked along the channels."""
        height, width, channels = self.shape
        shift = None if self.shift is None else np.tile(self.shift, (1, 1, count))
        return replace(self, shape=(height, width, channels * count), shift=shift)

    def normalized_to(self, images: NDArray[np.uint8]) -> ImageInput:
        """Return a normalization with the mean image and the standard deviation over all pixels.

        All pixels share one scale, so pixels that hardly change stay small.

        Args:
            images: Images, (N, height, width) or (N, height, width, channels), N at least 1.
        """
        chosen = np.linspace(0, len(images) - 1, min(len(images), _MOST_IMAGES)).astype(np.int64)
        total = np.zeros(self.shape)
        squares = 0.0
        for rows in np.split(chosen, range(_IMAGES_AT_ONCE, len(chosen), _IMAGES_AT_ONCE)):
            codes = np.asarray(images[rows]).reshape(-1, *self.shape).astype(np.float64)
            total += codes.sum(0)
            squares += float(np.square(codes).sum())
        mean = total / len(chosen)
        variance = squares / (len(chosen) * mean.size) - float(np.square(mean).mean())
        scale = math.sqrt(variance) if variance > _SMALLEST_VARIANCE else self.scale
        return replace(self, shift=mean.astype(np.float32), scale=scale)


class ObservationEncoder:
    """Encoder that converts observations of one space to tensors; saved with each policy.

    Attributes:
        space: Space of one observation.
        width: Length V of the vector.
        image_inputs: Normalization of each image leaf.
        images: Leaves that are images.
        numbers: Leaves of the vector, with their spaces.
        mask: Leaf of the action mask; None if there is no mask.
        shift: Subtrahend of the vector, (V,) float32.
        scale: Divisor of the shifted vector, (V,) float32.
    """

    def __init__(self, space: spaces.Space[Any], n_actions: int) -> None:
        """Create the encoder of a space, without normalization.

        Raises:
            SpaceError: The networks do not support such observations.
        """
        self.space = space
        leaves = {leaf.path: leaf for leaf in observation_leaves(space)}
        self.mask = leaves.pop((MASK_KEY,), None)
        if self.mask is not None and self.mask.shape != (n_actions,):
            shape = self.mask.shape
            raise SpaceError(f"{MASK_KEY} has shape {shape}, there are {n_actions} actions")
        kinds = [(leaf, _part_of(space, leaf.path)) for leaf in leaves.values()]
        self.images = [leaf for leaf, part in kinds if _is_image(part)]
        self.numbers = [(leaf, part) for leaf, part in kinds if not _is_image(part)]
        if not kinds:
            raise SpaceError(f"the observation has only {MASK_KEY}")
        self.image_inputs = [ImageInput((*leaf.shape, 1)[:3]) for leaf in self.images]
        widths = [_width(part) for _, part in self.numbers]
        self.width = sum(widths)
        bytes_ = [part.dtype == np.uint8 for _, part in self.numbers]
        self.shift = np.zeros(self.width, np.float32)
        self.scale = np.repeat(np.where(bytes_, 255, 1), widths).astype(np.float32)

    def normalize_to(self, observations: Any) -> None:
        """Normalize all inputs to mean 0 and standard deviation 1 over these observations.

        Each element of the vector has a separate scale; all pixels of an image share one. Constant
        elements keep their scale and become 0.
        """
        self.image_inputs = [
            image.normalized_to(leaf.of(observations))
            for image, leaf in zip(self.image_inputs, self.images, strict=True)
        ]
        self.shift, scale = np.zeros_like(self.shift), self.scale
        self.scale = np.ones_like(scale)
        vector = self._vector(observations).astype(np.float64)
        deviation = vector.std(0)
        constant = deviation <= 1e-6 * np.abs(vector).max(0, initial=0)
        self.shift = vector.mean(0).astype(np.float32)
        self.scale = np.where(constant, scale, deviation).astype(np.float32)

    def encode(self, observations: Any) -> Observations:
        """Encode B observations of the space.

        Args:
            observations: Arrays (B, *shape), or nested dicts of such arrays.

        Raises:
            SpaceError: The observations do not have the shapes of the space.
        """
        for leaf in self.leaves:
            _check_shape(leaf, observations)
        images = [
            torch.from_numpy(np.require(leaf.of(observations), np.uint8, ["C", "W"]))
            for leaf in self.images
        ]
        shaped = zip(images, self.image_inputs, strict=True)
        return Observations(
            torch.from_numpy(np.require(self._vector(observations), np.float32, ["C", "W"])),
            tuple(image.reshape(-1, *wanted.shape) for image, wanted in shaped),
            self._allowed(observations),
        )

    def is_stack(self, observations: Any, count: int) -> bool:
        """Return whether these are stacks of `count` observations, (B, count, *shape)."""
        return all(
            np.shape(leaf.of(observations))[1:] == (count, *leaf.shape) for leaf in self.leaves
        )

    @property
    def leaves(self) -> list[Leaf]:
        """All leaves of an observation: images, then numbers, then the mask."""
        mask = [] if self.mask is None else [self.mask]
        return [*self.images, *(leaf for leaf, _ in self.numbers), *mask]

    def _vector(self, observations: Any) -> NDArray[Any]:
        rows = len(self.leaves[0].of(observations))
        parts = [_numbers(leaf.of(observations), part) for leaf, part in self.numbers]
        vector = np.concatenate(parts, 1) if parts else np.empty((rows, 0), np.float32)
        if self.shift.any():
            vector = vector - self.shift
        return vector / self.scale if (self.scale != 1).any() else vector

    def _allowed(self, observations: Any) -> Tensor | None:
        if self.mask is None:
            return None
        allowed = np.asarray(self.mask.of(observations)).astype(bool)
        # After the end of an episode, all actions can be masked; values there are never used.
        return torch.from_numpy(allowed | ~allowed.any(1, keepdims=True))


def _is_image(space: spaces.Space[Any]) -> bool:
    """Return whether a space is an image: uint8, (height, width) or (height, width, channels).

    Raises:
        SpaceError: It is an image that the convolutions do not support.
    """
    if not isinstance(space, spaces.Box) or space.dtype != np.uint8:
        return False
    shape = space.shape
    if len(shape) == 3 and shape[0] < SMALLEST_IMAGE <= min(shape[1:]):
        raise SpaceError(f"images need shape (height, width, channels), got {shape}: transpose")
    if len(shape) not in (2, 3) or min(shape[:2]) < SMALLEST_IMAGE:
        return False
    if min(shape[:2]) < MIN_IMAGE_EDGE:
        least = f"{MIN_IMAGE_EDGE}x{MIN_IMAGE_EDGE}"
        raise SpaceError(f"image observations need at least {least} pixels, got {shape}")
    return True


def _part_of(space: spaces.Space[Any], path: tuple[str, ...]) -> spaces.Space[Any]:
    for key in path:
        assert isinstance(space, spaces.Dict)
        space = space[key]
    return space


def _choices(space: spaces.Space[Any]) -> NDArray[np.int64] | None:
    """Return the number of values of each element of a discrete space; None for other spaces."""
    if isinstance(space, spaces.Discrete):
        return np.array([space.n])
    return space.nvec.ravel() if isinstance(space, spaces.MultiDiscrete) else None


def _width(space: spaces.Space[Any]) -> int:
    choices = _choices(space)
    return int(np.prod(space.shape or ()) if choices is None else choices.sum())


def _numbers(values: NDArray[Any], space: spaces.Space[Any]) -> NDArray[Any]:
    """Encode one part of the space as (B, width): discrete values one-hot, others unchanged."""
    choices = _choices(space)
    flat = np.asarray(values).reshape(len(values), -1)
    if choices is None:
        return flat.astype(np.float32, copy=False)
    assert isinstance(space, spaces.Discrete | spaces.MultiDiscrete)
    counted = flat - np.ravel(space.start)
    if ((counted < 0) | (counted >= choices)).any():
        raise SpaceError(f"observations are not in their space {space}")
    codes = [
        np.eye(n, dtype=np.float32)[column] for n, column in zip(choices, counted.T, strict=True)
    ]
    return np.concatenate(codes, 1)


def _check_shape(leaf: Leaf, observations: Any) -> None:
    try:
        got = np.shape(leaf.of(observations))
    except (KeyError, IndexError, TypeError) as error:
        raise SpaceError(f"observations have no {'.'.join(leaf.path)}") from error
    if len(got) == 0 or got[1:] != leaf.shape:
        wanted = ", ".join(map(str, ("B", *leaf.shape)))
        where = f" of {'.'.join(leaf.path)}" if leaf.path else ""
        raise SpaceError(f"takes observations ({wanted}){where}, got {got}")
