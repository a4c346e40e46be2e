"""From what an environment shows to what networks take: one vector, pictures, an action mask.

Whatever is no picture (floats, flags, counters; at any depth of a Dict space) becomes one float32
vector: a Discrete part as a one-hot code, uint8 numbers divided by 255. Pictures stay bytes.

The key `action_mask` at the top of a Dict space, with one flag per action, is no input: it says
which actions are allowed, as in PettingZoo. Since it is part of the observation, it is in the log.
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
from mcaprl.recorder.format.spaces import MIN_IMAGE_EDGE as SMALLEST_PICTURE
from mcaprl.recorder.format.spaces import Leaf, observation_leaves

MIN_IMAGE_EDGE = 36
"""The smallest image, in pixels, that the convolutions leave a pixel of."""
MASK_KEY = "action_mask"
_MOST_IMAGES = 10_000
"""Pictures that a mean is taken over at most, evenly spaced."""
_IMAGES_AT_ONCE = 256
_SMALLEST_VARIANCE = 1e-6
"""Codes squared: less is rounding in pictures that are all alike."""


@dataclass(frozen=True)
class Observations:
    """B observations as networks take them.

    Attributes:
        vector: (B, V) float32; V is 0 where there are only pictures.
        images: (B, height, width, channels) uint8 each.
        mask: (B, A) bool, which actions are allowed; None if all always are.
    """

    vector: Tensor
    images: tuple[Tensor, ...] = ()
    mask: Tensor | None = None

    def __len__(self) -> int:
        """B."""
        return len(self.vector)

    def parts(self) -> list[Tensor]:
        """All its tensors, the mask last."""
        mask = [] if self.mask is None else [self.mask]
        return [self.vector, *self.images, *mask]

    def like(self, parts: Sequence[Tensor]) -> Observations:
        """The same kind of observations from other tensors, in the order of `parts`."""
        n_images = len(self.images)
        mask = None if self.mask is None else parts[-1]
        return Observations(parts[0], tuple(parts[1 : 1 + n_images]), mask)

    def rows(self, index: Tensor) -> Observations:
        """Copy the rows of an index (R,)."""
        if not self.images and self.mask is None:
            return Observations(self.vector.index_select(0, index))
        return self.like([part.index_select(0, index) for part in self.parts()])

    def split(self, rows: int) -> list[Observations]:
        """Views of `rows` observations each; the last may have fewer."""
        columns = [torch.split(part, rows) for part in self.parts()]
        return [self.like(parts) for parts in zip(*columns, strict=True)]

    def stacked(self, count: int) -> Observations:
        """Each `count` observations that follow each other as one; the last one's mask counts."""
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
        """The same on another device."""
        return self.like([part.to(device) for part in self.parts()])


@dataclass(frozen=True, eq=False)
class ImageInput:
    """How a network takes the pictures of one camera: (codes - shift) / scale.

    Attributes:
        shape: (height, width, channels).
        shift: (height, width, channels) float32, codes; None is 0 everywhere.
        scale: codes.
    """

    shape: tuple[int, ...]
    shift: NDArray[np.float32] | None = None
    scale: float = 255.0

    def stacked(self, count: int) -> ImageInput:
        """The same for `count` pictures in a row as one, each with its own channels."""
        height, width, channels = self.shape
        shift = None if self.shift is None else np.tile(self.shift, (1, 1, count))
        return replace(self, shape=(height, width, channels * count), shift=shift)

    def normalized_to(self, images: NDArray[np.uint8]) -> ImageInput:
        """Take the mean picture off, and divide by the root mean square of what is left.

        One scale for the whole picture: what hardly ever changes stays small.

        Args:
            images: (N, height, width) or (N, height, width, channels), N at least 1.
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
    """Turns observations of one space into tensors; saved with each policy.

    Attributes:
        space: of one observation.
        width: V, the numbers of its vector.
        image_inputs: how networks take each picture.
        images: the leaves that are pictures.
        numbers: the leaves that make the vector, and their spaces.
        mask: the leaf that is the action mask, if there is one.
        shift: (V,) float32, taken off the vector.
        scale: (V,) float32, the vector is divided by it then.
    """

    def __init__(self, space: spaces.Space[Any], n_actions: int) -> None:
        """Build for a space, without normalisation.

        Raises:
            SpaceError: no network takes such observations.
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
            raise SpaceError(f"the observation holds nothing but {MASK_KEY}")
        self.image_inputs = [ImageInput((*leaf.shape, 1)[:3]) for leaf in self.images]
        widths = [_width(part) for _, part in self.numbers]
        self.width = sum(widths)
        bytes_ = [part.dtype == np.uint8 for _, part in self.numbers]
        self.shift = np.zeros(self.width, np.float32)
        self.scale = np.repeat(np.where(bytes_, 255, 1), widths).astype(np.float32)

    def normalize_to(self, observations: Any) -> None:
        """Shift and scale all inputs to mean 0 and standard deviation 1 over these observations.

        Each number has its own scale, a picture one for all of its pixels. What never changes keeps
        its scale: it only becomes 0.
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
            observations: (B, *shape), or nested dicts of such arrays.

        Raises:
            SpaceError: they have other shapes.
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
        """Whether these are `count` observations in a row each: (B, count, *shape)."""
        return all(
            np.shape(leaf.of(observations))[1:] == (count, *leaf.shape) for leaf in self.leaves
        )

    @property
    def leaves(self) -> list[Leaf]:
        """All parts of an observation: pictures, numbers, mask."""
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
        # Behind the end of an episode nothing may be allowed; no value there is ever used.
        return torch.from_numpy(allowed | ~allowed.any(1, keepdims=True))


def _is_image(space: spaces.Space[Any]) -> bool:
    """Whether observations are pictures: uint8, (height, width) or (height, width, channels).

    Raises:
        SpaceError: they are, but of a kind that the convolutions do not take.
    """
    if not isinstance(space, spaces.Box) or space.dtype != np.uint8:
        return False
    shape = space.shape
    if len(shape) == 3 and shape[0] < SMALLEST_PICTURE <= min(shape[1:]):
        raise SpaceError(f"images need shape (height, width, channels), got {shape}: transpose")
    if len(shape) not in (2, 3) or min(shape[:2]) < SMALLEST_PICTURE:
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
    """The number of values of each counter of a discrete space; None for other spaces."""
    if isinstance(space, spaces.Discrete):
        return np.array([space.n])
    return space.nvec.ravel() if isinstance(space, spaces.MultiDiscrete) else None


def _width(space: spaces.Space[Any]) -> int:
    choices = _choices(space)
    return int(np.prod(space.shape or ()) if choices is None else choices.sum())


def _numbers(values: NDArray[Any], space: spaces.Space[Any]) -> NDArray[Any]:
    """(B, width) of a part of the space: one-hot codes of counters, else the numbers themselves."""
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
