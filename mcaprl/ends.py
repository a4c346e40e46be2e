"""Reasons of the ends of episodes that several packages know."""

from __future__ import annotations

from typing import Final

STEP_LIMIT: Final = "step_limit"
"""The caller's limit on the steps of an episode, rather than the environment, ended it."""
