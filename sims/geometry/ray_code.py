"""Encoding of ray lengths as observations."""

from __future__ import annotations

import math

from mcaprl.sims.geometry.compiled import compiled

FAR_M = 100.0
"""Length of a ray that hits nothing."""
SCALE_M = 1.0
_FARTHEST = math.log1p(FAR_M / SCALE_M)


@compiled
def log_code(length_m: float) -> float:
    """Encode a length d as a number from 0 to 1: ln(1 + d / 1 m) / ln(1 + 100 m / 1 m)."""
    return math.log1p(length_m / SCALE_M) / _FARTHEST
