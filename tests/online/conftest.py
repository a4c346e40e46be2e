"""Fixture that makes training with images start sooner."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def _few_centering_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Determine the normalization of images from fewer random steps."""
    monkeypatch.setattr("mcaprl.online.agent.CENTERING_STEPS", 100)
