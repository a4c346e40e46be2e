"""Settings of `auto`. Importing this module loads no torch."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from mcaprl.lazy import installed
from mcaprl.offline.algorithms.config import (
    BOX_CONFIGS,
    CONFIGS,
    ENTRY_POINT_GROUP,
    BootstrapConfig,
    TrainingConfig,
)

AUTO: Final = "auto"  # Name of the algorithm that chooses among the others
ALL: Final = "all"  # Value of `finalists` that allows the choice of every candidate


@dataclass(frozen=True)
class AutoConfig(BootstrapConfig):
    """Settings of `auto`: those that the candidates share, and those of the choice."""

    target_interval: int = 150
    """updates between two updates of the target network"""
    finalists: str = "iql,cql-alpha-0.1"
    """candidates among which the choice is made, separated by commas; `all` for all of them, which
    is the default for a Box"""
    survivors: int = 4
    """maximum number of finalists that are trained with all updates"""
    short_fraction: float = 0.25
    """fraction of the updates after which the candidates are first compared"""
    model_updates: int = 2_000
    """gradient updates of each model that evaluates the candidates"""
    budget_minutes: float = math.inf
    """wall time after which no update is started, minutes"""
    report: str | Path = ""
    """output folder of the HTML page on the choice"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require_positive("survivors", "model_updates")
        self._require("budget_minutes", self.budget_minutes > 0, "above 0")
        self._require("frame_stack", self.frame_stack == 1, f"1 for {AUTO}")
        self._require("short_fraction", 0 < self.short_fraction <= 1, "within (0, 1]")

    def to_json(self) -> dict[str, Any]:
        """Return the settings that a resumed run must have; its time and report may differ."""
        found = super().to_json()
        del found["budget_minutes"], found["report"]
        return found

    @property
    def short_updates(self) -> int:
        """Number of updates after which the candidates are first compared."""
        return self.candidate_interval * max(
            1, round(self.updates * self.short_fraction / self.candidate_interval)
        )

    @property
    def candidate_interval(self) -> int:
        """Number of updates between checkpoints of a candidate."""
        # At most a quarter of the short training, so that it has a policy when its time is up.
        quarter = round(self.updates * self.short_fraction / 4)
        return max(1, min(self.checkpoint_interval, quarter))


def default_configs() -> dict[str, TrainingConfig]:
    """Return the default settings of all algorithms; others for a Box as `NAME (Box)`."""
    configs = dict(CONFIGS)
    for name, config_type in BOX_CONFIGS.items():
        configs[f"{name} (Box)" if name in CONFIGS else name] = config_type
    if installed(ENTRY_POINT_GROUP):
        # This module imports torch.
        from mcaprl.offline.algorithms.registry import all_algorithms

        for learner in all_algorithms():
            configs.setdefault(learner.name, learner.config_type)
    return {**{name: config_type() for name, config_type in configs.items()}, AUTO: AutoConfig()}
