"""Depth images: rendering, downsampling, and encoding as one byte per pixel."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled, inlined
from mcaprl.sims.drawing.camera import (
    Lens,
    draw,
    draw_wires,
    faces_of,
    focal_lengths,
    lengths,
    ray_lengths,
)

Floats = NDArray[np.float64]

NEAREST_M = 0.5  # Distance of code 0; smaller distances have the same code
FARTHEST_M = 100.0  # Distance of code 255; larger distances and infinity have the same code
_CODES_PER_E = 255.0 / math.log(FARTHEST_M / NEAREST_M)
_NO_WIRES: Floats = np.empty((0, 2, 3))


def encode_depth(depth_m: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Encode meters as bytes: 255 ln(d / 0.5 m) / ln(100 m / 0.5 m), rounded, within 0 to 255."""
    # Adjacent codes differ by 2.1 % at any distance. Infinity is 255.
    values = np.asarray(depth_m)
    if values.dtype != np.float32:
        return _computed_codes(values)
    codes = np.empty(values.shape, dtype=np.uint8)
    row = np.ascontiguousarray(values).reshape(-1)
    _look_up(row, row.view(np.int32), _code_table(), codes.reshape(-1))
    return codes


def _computed_codes(depth_m: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Encode by the formula of `encode_depth`."""
    codes = np.asarray(np.clip(depth_m, NEAREST_M, FARTHEST_M))
    codes /= NEAREST_M
    np.log(codes, out=codes)
    codes *= _CODES_PER_E
    np.rint(codes, out=codes)
    return codes.astype(np.uint8)


_TABLE_SHIFT = 15
"""Positive float32 numbers whose bits agree, except for the last 15, differ by at most 0.4 %. The
code increases at most once among them, because adjacent codes differ by 2.1 %."""


class _CodeTable(NamedTuple):
    """Codes of all float32 distances, in groups of numbers that agree except for the last bits."""

    codes: NDArray[np.uint8]  # (G,) code of the first number of each group
    increases_m: NDArray[np.float32]
    """(G,) first number of each group that has the next code; NaN if there is none."""
    first: int  # Bits that the numbers of the first group have in common


@functools.cache
def _code_table() -> _CodeTable:
    """Return the table. Looking up a code takes less than half of the time of computing it."""
    nearest, farthest = np.array([NEAREST_M, FARTHEST_M], np.float32).view(np.int32) >> _TABLE_SHIFT
    starts = np.arange(nearest, farthest + 1, dtype=np.int32) << _TABLE_SHIFT
    codes = _computed_codes(starts.view(np.float32))
    # Bisect: the code of `low` is that of the start, and the code of `high` is larger.
    low, high = starts.copy(), starts + (1 << _TABLE_SHIFT)
    while (high - low).max() > 1:
        middle = low + (high - low) // 2
        is_same = _computed_codes(middle.view(np.float32)) == codes
        low, high = np.where(is_same, middle, low), np.where(is_same, high, middle)
    increases_m = high.view(np.float32)
    increases_m[_computed_codes(increases_m) == codes] = np.nan
    return _CodeTable(codes, increases_m, int(nearest))


@compiled
def _look_up(
    depth_m: NDArray[np.float32],
    bits: NDArray[np.int32],
    table: _CodeTable,
    codes: NDArray[np.uint8],
) -> None:
    """Write the codes (N,) of distances (N,). `bits` is the memory of the distances as integers."""
    for i in range(len(depth_m)):
        near = (bits[i] >> _TABLE_SHIFT) - table.first
        group = np.uint64(min(max(near, 0), len(table.codes) - 1))
        codes[i] = table.codes[group] + (1 if depth_m[i] >= table.increases_m[group] else 0)


def decode_depth(codes: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Decode bytes to meters; 255 becomes infinity. `encode_depth` of the result equals `codes`."""
    depth_m = NEAREST_M * np.exp(codes.astype(np.float64) / _CODES_PER_E)
    return np.where(codes == 255, np.inf, depth_m).astype(np.float32)


def encode_nearness(depth_m: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Encode meters as bytes, like AirSim's examples: 255 / max(1, d), rounded down."""
    codes: NDArray[np.uint8] = (255.0 / np.maximum(1.0, depth_m)).astype(np.uint8)
    return codes


class Overlaps(NamedTuple):
    """Weights that downsample a row of old pixels to a shorter row of new pixels."""

    first: NDArray[np.uint64]
    """(new,) index of the first old pixel that overlaps each new pixel. Compiled functions do not
    compare unsigned indices with 0."""
    weights: Floats
    """(new, K) fraction of each new pixel that old pixel `first` + k covers, for k < K."""
    taps: tuple[int, ...]
    """Numbers from 0 to K - 1. In compiled functions, the length K of the tuple is a constant."""


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
    weights = np.maximum(width, 0.0) * (new_size / old_size)
    return Overlaps(first.astype(np.uint64), weights, tuple(range(count)))


class Downsampling(NamedTuple):
    """Precomputed numbers that downsample images of one size to another."""

    rows: Overlaps
    columns: Overlaps
    full: Floats
    """(h, w) covered part of each new pixel if surfaces cover all old pixels: 1, up to rounding."""


def downsampling(old: tuple[int, int], new: tuple[int, int]) -> Downsampling:
    """Return the numbers that downsample images of the shape `old` to the shape `new`."""
    rows, columns = overlaps(old[0], new[0]), overlaps(old[1], new[1])
    # The sums are added up in the same order as in `shrink`, so that the results are the same.
    covered, full = np.zeros(new[0]), np.zeros(new)
    for k in rows.taps:
        covered += rows.weights[:, k]
    for k in columns.taps:
        full += np.outer(covered, columns.weights[:, k])
    return Downsampling(rows, columns, full)


@compiled
def shrink(
    inverse: Floats, nearness: Floats, sizes: Downsampling, depth_m: NDArray[np.float32]
) -> None:
    """Downsample an image of inverse depths to a smaller image of distances."""
    # If surfaces cover at least half of a new pixel, its inverse distance is the mean over the
    # covered part, so that the sky has no effect; otherwise its distance is infinite. On a plane,
    # inverse depth is linear in image coordinates. `inverse` is overwritten.
    rows, columns = sizes.rows, sizes.columns
    covered = _to_distances(inverse, nearness)
    width, new_width = inverse.shape[1], depth_m.shape[1]
    sums, hits = np.empty(width), np.empty(width)
    totals, parts = np.empty(new_width), np.empty(new_width)
    for i in range(len(rows.first)):
        sums[:], hits[:], is_full = 0.0, 0.0, True
        for k in range(len(rows.taps)):
            # All output rows have the same number of weights. Rows that overlap fewer input rows
            # have weights of 0.
            row, weight = rows.first[i] + np.uint64(k), rows.weights[i, k]
            is_full &= (weight == 0.0) | (covered[row] == width)
        for k in range(len(rows.taps)):
            line, weight = inverse[rows.first[i] + np.uint64(k)], rows.weights[i, k]
            if weight == 0.0:
                continue
            for column in range(width):
                sums[column] += weight * line[column]
            if not is_full:
                for column in range(width):
                    hits[column] += weight if line[column] > 0.0 else 0.0
        _combine(columns, sums, totals)
        if is_full:
            parts[:] = sizes.full[i]
        else:
            _combine(columns, hits, parts)
        for j in range(new_width):
            depth_m[i, j] = parts[j] / totals[j] if parts[j] >= 0.5 else math.inf


@inlined
def _to_distances(inverse: Floats, nearness: Floats) -> NDArray[np.int64]:
    """Multiply two images in place; return the number of positive pixels in each row."""
    covered = np.zeros(len(inverse), dtype=np.int64)
    for row in range(len(inverse)):
        count = 0
        for column in range(inverse.shape[1]):
            value = inverse[row, column] * nearness[row, column]
            inverse[row, column] = value
            count += 1 if value > 0.0 else 0
        covered[row] = count
    return covered


@inlined
def _combine(columns: Overlaps, sums: Floats, totals: Floats) -> None:
    """Downsample a row."""
    for j in range(len(totals)):
        total, first = 0.0, columns.first[j]
        for k in range(len(columns.taps)):
            total += columns.weights[j, k] * sums[first + np.uint64(k)]
        totals[j] = total


class DepthCamera:
    """Depth camera in a static world."""

    def __init__(
        self, mesh: Floats, view: Lens, small: tuple[int, int], wires: Floats = _NO_WIRES
    ) -> None:
        """Prepare the rendering of triangles (T, 3, 3), and wires (S, 2, 3), meters; see `draw`."""
        self._faces = faces_of(mesh)
        self._wires = wires
        self._view = view
        self._nearness = 1.0 / ray_lengths(view)
        self._sizes = downsampling((view.height_px, view.width_px), small)
        self._small = small
        self._small_focal_px = focal_lengths(view, small)
        self._small_lengths = lengths(small, *self._small_focal_px)

    def inverse_depth(self, position_m: tuple[float, float, float], axes: Floats) -> Floats:
        """Render inverse depths at full size, 1/m, without wires; 0 without a surface."""
        # `axes` has the camera's x, y and z axes as rows, in the mesh's coordinates.
        inverse_z = np.empty((self._view.height_px, self._view.width_px))
        draw(self._faces, np.array(position_m), axes, self._view.focal_px, inverse_z)
        return inverse_z

    def inverse_distance(self, position_m: tuple[float, float, float], axes: Floats) -> Floats:
        """Render like `inverse_depth`; return inverse distances along the rays, 1/m."""
        return self.inverse_depth(position_m, axes) * self._nearness

    def image_m(self, position_m: tuple[float, float, float], axes: Floats) -> NDArray[np.float32]:
        """Render the downsampled distances (h, w) along the rays, meters."""
        # Infinite without a hit.
        small = np.empty(self._small, dtype=np.float32)
        shrink(self.inverse_depth(position_m, axes), self._nearness, self._sizes, small)
        if len(self._wires):
            wired = np.zeros(self._small)
            eye = np.array(position_m)
            draw_wires(self._wires, eye, axes, *self._small_focal_px, wired)
            shown = wired > 0.0
            wires_m = (self._small_lengths[shown] / wired[shown]).astype(np.float32)
            small[shown] = np.minimum(small[shown], wires_m)
        return small
