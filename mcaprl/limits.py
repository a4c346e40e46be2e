"""Limits on what a foreign file may ask for, each with its reason."""

from __future__ import annotations

from typing import Final

MAX_IMAGE_PIXELS: Final = 64_000_000
"""Pixels of one image: more than any camera of a robot has; a few kB of PNG can declare 10^9."""
