"""Depth images: rendering, downsampling, and encoding as one byte per pixel."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled
from mcaprl.sims.drawing.camera import (
    Lens,
    draw,
    draw_wires,
    focal_lengths,
    fronts,
    lengths,
    ray_lengths,
)

Floats = NDArray[np.float64]

NEAREST_M = 0.5
"""Distance of code 0; smaller distances have the same code."""
FARTHEST_M = 100.0
"""Distance of code 255; larger distances and infinity have the same code."""
_CODES_PER_E = 255.0 / math.log(FARTHEST_M / NEAREST_M)
_NO_WIRES: Floats = np.empty((0, 2, 3))


def encode_depth(depth_m: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Encode meters as bytes: 255 ln(d / 0.5 m) / ln(100 m / 0.5 m), rounded, within 0 to 255.

    Adjacent codes differ by 2.1 % at any distance. Infinity is 255.
    """
    codes = np.asarray(np.clip(depth_m, NEAREST_M, FARTHEST_M))
    codes /= NEAREST_M
    np.log(codes, out=codes)
    codes *= _CODES_PER_E
    np.rint(codes, out=codes)
    return codes.astype(np.uint8)


def decode_depth(codes: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Decode bytes to meters; 255 becomes infinity. `encode_depth` of the result equals `codes`."""
    depth_m = NEAREST_M * np.exp(codes.astype(np.float64) / _CODES_PER_E)
    return np.where(codes == 255, np.inf, depth_m).astype(np.float32)


def encode_nearness(depth_m: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Encode meters as bytes by the formula of AirSim's examples: 255 / max(1, d), rounded down.

    Infinity is 0. Half of the codes cover distances of 1 to 2 m.
    """
    codes: NDArray[np.uint8] = (255.0 / np.maximum(1.0, depth_m)).astype(np.uint8)
    return codes


class Overlaps(NamedTuple):
    """Weights that downsample a row of old pixels to a shorter row of new pixels."""

    first: NDArray[np.int64]
    """(new,) index of the first old pixel that overlaps each new pixel."""
    weights: Floats
    """(new, K) fraction of each new pixel that old pixel `first` + k covers, for k < K."""


def overlaps(old_size: int, new_size: int) -> Overlaps:
    """Return the weights that downsample a row of `old_size` pixels to `new_size` pixels.

    >>> overlaps(3, 2).weights.round(2).tolist()
    [[0.67, 0.33, 0.0], [0.0, 0.33, 0.67]]
    """
    edges = np.arange(new_size + 1) * (old_size / new_size)
    count = min(old_size, math.floor(old_size / new_size) + 2)
    first = np.minimum(edges[:-1].astype(np.int64), old_size - count)
    old = first[:, None] + np.arange(count)
    width = np.minimum(edges[1:, None], old + 1) - np.maximum(edges[:-1, None], old)
    return Overlaps(first, np.maximum(width, 0.0) * (new_size / old_size))


@compiled
def shrink(
    inverse: Floats, rows: Overlaps, columns: Overlaps, depth_m: NDArray[np.float32]
) -> None:
    """Downsample an image of inverse distances to a smaller image of distances.

    If surfaces cover at least half of a new pixel, its inverse distance is the mean over the
    covered part. Otherwise, its distance is infinite. Thus the sky does not affect distances. On a
    plane, inverse depth is linear in image coordinates, so the mean gives the distance near the
    middle of the covered part.

    Args:
        inverse: (H, W) 1/m, 0 where there is no surface.
        rows: Result of `overlaps(H, h)`.
        columns: Result of `overlaps(W, w)`.
        depth_m: (h, w) output, meters.
    """
    width = inverse.shape[1]
    sums, hits = np.empty(width), np.empty(width)
    for i in range(len(rows.first)):
        sums[:], hits[:] = 0.0, 0.0
        for k in range(rows.weights.shape[1]):
            line, weight = inverse[rows.first[i] + k], rows.weights[i, k]
            # All output rows have the same number of weights. Rows that overlap fewer input rows
            # have weights of 0 at the end.
            if weight > 0.0:
                for column in range(width):
                    sums[column] += weight * line[column]
                    hits[column] += weight if line[column] > 0.0 else 0.0
        for j in range(len(columns.first)):
            total, hit = 0.0, 0.0
            first, weights = columns.first[j], columns.weights[j]
            for k in range(len(weights)):
                total += weights[k] * sums[first + k]
                hit += weights[k] * hits[first + k]
            depth_m[i, j] = hit / total if hit >= 0.5 else math.inf


class DepthCamera:
    """Depth camera in a static world."""

    def __init__(
        self, mesh: Floats, view: Lens, small: tuple[int, int], wires: Floats = _NO_WIRES
    ) -> None:
        """Prepare the rendering of a mesh.

        Args:
            mesh: (T, 3, 3) triangles, meters; see `draw`.
            view: Lens and size of the rendered images.
            small: Size (h, w) of the downsampled images, pixels.
            wires: (S, 2, 3) ends, meters; drawn one pixel wide into the downsampled image.
        """
        self._mesh, self._planes = mesh, fronts(mesh)
        self._wires = wires
        self._view = view
        self._nearness = 1.0 / ray_lengths(view)
        self._rows = overlaps(view.height_px, small[0])
        self._columns = overlaps(view.width_px, small[1])
        self._small = small
        self._small_focal_px = focal_lengths(view, small)
        self._small_lengths = lengths(small, *self._small_focal_px)

    def inverse_distance(self, position_m: tuple[float, float, float], axes: Floats) -> Floats:
        """Render the image at full size, without wires.

        Args:
            position_m: Position of the camera.
            axes: (3, 3) the camera's x, y and z axes as rows, in the mesh's coordinates.

        Returns:
            (height, width) inverse distance along each ray, 1/m, 0 where there is no surface.
        """
        inverse = np.empty((self._view.height_px, self._view.width_px))
        eye_m = np.array(position_m)
        draw(self._mesh, self._planes, eye_m, axes, self._view.focal_px, inverse)
        inverse *= self._nearness
        return inverse

    def image_m(self, position_m: tuple[float, float, float], axes: Floats) -> NDArray[np.float32]:
        """Render the downsampled image: the distances (h, w) along the rays in meters.

        A distance is infinite if the ray hits nothing.
        """
        small = np.empty(self._small, dtype=np.float32)
        shrink(self.inverse_distance(position_m, axes), self._rows, self._columns, small)
        if len(self._wires):
            wired = np.zeros(self._small)
            eye = np.array(position_m)
            draw_wires(self._wires, eye, axes, *self._small_focal_px, wired)
            shown = wired > 0.0
            wires_m = (self._small_lengths[shown] / wired[shown]).astype(np.float32)
            small[shown] = np.minimum(small[shown], wires_m)
        return small
