"""Names of rays, and the encoding of their lengths as observations."""

from __future__ import annotations

import math

from mcaprl.compiled import compiled

FAR_M = 100.0
"""Length of a ray that hits nothing."""
SCALE_M = 1.0
_FARTHEST = math.log1p(FAR_M / SCALE_M)


@compiled
def log_code(length_m: float) -> float:
    """Encode a length d as a number from 0 to 1: ln(1 + d / 1 m) / ln(1 + 100 m / 1 m)."""
    return math.log1p(length_m / SCALE_M) / _FARTHEST


def ray_name(left_deg: int) -> str:
    """Return the name of a ray from its angle to the left, such as `ahead` or `left_30`."""
    if left_deg in (0, 180):
        return "behind" if left_deg else "ahead"
    return f"{'left' if left_deg > 0 else 'right'}_{abs(left_deg)}"
