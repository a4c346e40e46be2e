"""Names of rays, and the encoding of their lengths as observations."""

from __future__ import annotations

import math

from mcaprl.compiled import inlined

FAR_M = 100.0
"""Length of a ray that hits nothing."""
SCALE_M = 1.0
_FARTHEST = math.log1p(FAR_M / SCALE_M)
_LN_2 = math.log(2.0)
_ROOT_2 = math.sqrt(2.0)


@inlined
def log_code(length_m: float) -> float:
    """Encode a length d as a number from 0 to 1: ln(1 + d / 1 m) / ln(1 + 100 m / 1 m)."""
    return logarithm(1.0 + length_m / SCALE_M) / _FARTHEST


@inlined
def logarithm(number: float) -> float:
    """Return the natural logarithm of a number from 1 to 181, with an error below 1e-15.

    The function has no branches or calls, so that the compiler can vectorize loops. It divides the
    number by a power of 2, so that the result q is from sqrt(1/2) to sqrt(2). With
    s = (q - 1) / (q + 1), ln q = 2 (s + s^3/3 + s^5/5 + ...); the rest is below 1e-18.
    """
    is_large = number >= 8.0 * _ROOT_2
    scaled = number * 0.0625 if is_large else number
    twos = 4.0 if is_large else 0.0
    is_large = scaled >= 2.0 * _ROOT_2
    scaled = scaled * 0.25 if is_large else scaled
    twos = twos + 2.0 if is_large else twos
    is_large = scaled >= _ROOT_2
    scaled = scaled * 0.5 if is_large else scaled
    twos = twos + 1.0 if is_large else twos
    share = (scaled - 1.0) / (scaled + 1.0)
    square = share * share
    rest = 1.0 / 19.0 + square * (1.0 / 21.0)
    rest = 1.0 / 17.0 + square * rest
    rest = 1.0 / 15.0 + square * rest
    rest = 1.0 / 13.0 + square * rest
    rest = 1.0 / 11.0 + square * rest
    rest = 1.0 / 9.0 + square * rest
    rest = 1.0 / 7.0 + square * rest
    rest = 1.0 / 5.0 + square * rest
    rest = 1.0 / 3.0 + square * rest
    return twos * _LN_2 + 2.0 * share * (1.0 + square * rest)


def ray_name(left_deg: int) -> str:
    """Return the name of a ray from its angle to the left, such as `ahead` or `left_30`."""
    if left_deg in (0, 180):
        return "behind" if left_deg else "ahead"
    return f"{'left' if left_deg > 0 else 'right'}_{abs(left_deg)}"
