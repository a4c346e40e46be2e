"""Digits that values lose as float32, and offsets that keep them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_COARSE = 0.1
"""Ratio of the spacing of float32 numbers to the change from step to step that is too large.

The changes between the steps then have errors of about 4 % (the spacing times sqrt(2 / 12)).
"""
_FINE = 0.01
"""Ratio after which an offset is good."""
_QUANTILE = 0.9
"""Quantile of the changes: neither long stops nor a few jumps determine it."""
_FLOAT64_NOISE = 1e-14
"""Changes below this share of the value are rounding errors of float64."""
_MOST_DIGITS = 17
_LARGEST = 1e38


class Rounding(NamedTuple):
    """Loss of digits of a quantity.

    Attributes:
        topic: Topic that contains the quantity.
        element: Name of the element that loses most.
        elements: Number of elements that lose digits.
        values: Number of different values of the element in the bag.
        kept: Number of different values as float32.
        change: Typical change of the element from step to step.
        offset: Value of `offset` that keeps the digits of the element; None if there is none.
        is_alone: Whether the quantity has only this element, so that it can have this offset.
    """

    topic: str
    element: str
    elements: int
    values: int
    kept: int
    change: float
    offset: float | None
    is_alone: bool

    def __str__(self) -> str:
        """Return what is lost."""
        more = f" ({self.elements} elements lose digits)" if self.elements > 1 else ""
        return (
            f"float32 is too coarse for {self.element}: {self.values} different values become"
            f" {self.kept}, and {self.change:.2g} is a typical change{more}"
        )

    def advice(self) -> str:
        """Return what to do."""
        if self.offset is None:
            return "use a difference or another field, because no `offset` can keep these digits"
        where = "" if self.is_alone else f" for {self.element} in a separate entry"
        return f"set `offset: {self.offset!r}`{where}; it is added before the values are rounded"


def needed_offset(values: Floats) -> float | None:
    """Return an offset to add to values (N,) so that float32 keeps their digits.

    The offset has as few digits as possible. It is None if float32 keeps the digits without it, or
    if no offset helps. Values that are not finite are ignored.
    """
    found = values[np.isfinite(values)]
    change = _change(np.diff(found))
    return _offset(found, change) if _excess([found], change) else None


def rounding_of(
    runs: Sequence[Floats], names: Sequence[str], topic: str, offset: float = 0.0
) -> Rounding | None:
    """Return the digits that a quantity loses as float32; None if it keeps them.

    Args:
        runs: (N, K) or (N,) values of each run, after scale and offset.
        names: Names of the K elements.
        topic: Topic that contains the quantity.
        offset: Offset that has been added.
    """
    tables = [each.reshape(len(each), -1) for each in runs if each.size]
    with np.errstate(over="ignore"):
        is_exact = all(np.array_equal(t.astype(np.float32), t, equal_nan=True) for t in tables)
    if is_exact:
        return None
    worst, worst_excess, count = "", 0.0, 0
    for k, name in enumerate(names):
        parts = [table[:, k][np.isfinite(table[:, k])] for table in tables]
        excess = _excess(parts, _change(np.concatenate([np.diff(part) for part in parts])))
        count += excess > 0
        if excess > worst_excess:
            worst, worst_excess, values = name, excess, np.concatenate(parts)
            change = _change(np.concatenate([np.diff(part) for part in parts]))
    if not count:
        return None
    further = _offset(values, change)
    return Rounding(
        topic,
        worst,
        count,
        len(np.unique(values)),
        len(np.unique(values.astype(np.float32))),
        change,
        None if further is None else offset + further,
        len(names) == 1,
    )


def _change(changes: Floats) -> float:
    """Return the size of a typical change that is not 0; 0 if there is none."""
    sizes = np.abs(changes[changes != 0])
    return float(np.quantile(sizes, _QUANTILE)) if len(sizes) else 0.0


def _spacing(size: float) -> float:
    return float(np.spacing(np.float32(min(size, _LARGEST))))


def _excess(parts: Sequence[Floats], change: float) -> float:
    """Return the ratio of float32's spacing to the change; 0 if digits are kept or are noise."""
    values = np.concatenate(parts)
    size = float(np.abs(values).max(initial=0.0))
    spacing = _spacing(size)
    if change == 0 or spacing <= _COARSE * change:
        return 0.0
    if (values == np.rint(values)).all():
        return spacing / change
    if change <= _FLOAT64_NOISE * size:
        return 0.0
    # Small changes around one value, as of a sensor at rest, are noise, but clocks rise.
    signs = np.concatenate([np.sign(np.diff(part)) for part in parts])
    is_rising = abs(signs.sum()) > 0.9 * np.abs(signs).sum()
    return spacing / change if is_rising or np.ptp(values) >= spacing else 0.0


def _offset(values: Floats, change: float) -> float | None:
    """Return the offset with the fewest digits after which float32 keeps the digits of values."""
    low, high = float(values.min()), float(values.max())
    center = low + (high - low) / 2
    first = int(np.floor(np.log10(max(abs(low), abs(high)))))
    best = None
    for digits in range(-first, _MOST_DIGITS - first):
        nearest = round(center, digits)
        spacing = _spacing(max(high - nearest, nearest - low))
        if spacing <= _FINE * change:
            return -nearest
        if best is None and spacing <= _COARSE * change:
            best = -nearest
    return best
