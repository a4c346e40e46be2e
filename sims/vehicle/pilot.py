"""Base class of the scripted policies."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

AnySim = TypeVar("AnySim")


class ScriptedPilot(ABC, Generic[AnySim]):
    """Policy that reads the full state of one environment instead of its observations."""

    name: ClassVar[str] = "pilot"

    def __init__(self, sim: AnySim) -> None:
        """Drive the vehicle of `sim`, an unwrapped environment."""
        self.sim = sim

    def act(self, observations: Any) -> NDArray[np.int64]:
        """Return the action, shape (1,), for the current state of the environment.

        Args:
            observations: Observations with a leading dimension of 1, or a dict of them.

        Raises:
            ValueError: There is not exactly one environment.
        """
        rows = next(iter(observations.values())) if isinstance(observations, dict) else observations
        if len(rows) != 1:
            raise ValueError(f"a pilot drives one environment, not {len(rows)}")
        return np.array([self.choose()], dtype=np.int64)

    @abstractmethod
    def choose(self) -> int:
        """Choose the action for the current state."""
