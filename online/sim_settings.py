"""Settings with which each sim was seen to be learnt, from vectors and with its default rules.

What they reach, on every one of four seeds, is in docs/results.md beside the command. What made
the difference, for those who tune:

- A learning rate that falls to 4 % of itself. With a constant one the policy swings to the end.
- `n_steps` 3 for powerline and racer, whose rewards are far apart or late, and with it a target
  network that is copied every 4,000 steps only, or 2,000 where a nearer horizon will do.
- Checkpoints dip on the way nonetheless, so the best one is kept, by episodes of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Final

from mcaprl.sims import SIMS

_STEADY: Final[dict[str, Any]] = {
    "learning_rate": 5e-4,
    "final_learning_rate_fraction": 0.04,
    "hidden": (256, 256),
    "batch_size": 128,
    "learning_starts": 2_000,
    "exploration_fraction": 0.3,
}
_FAR_SIGHTED: Final[dict[str, Any]] = {
    **_STEADY,
    "gamma": 0.98,
    "n_steps": 3,
    "target_update_interval": 4_000,
}

SIM_SETTINGS: Final[dict[str, dict[str, Any]]] = {
    SIMS["lane"]: {
        **_STEADY,
        "steps": 80_000,
        "gamma": 0.97,
        "buffer_size": 100_000,
        "target_update_interval": 1_000,
    },
    SIMS["powerline"]: {
        **_FAR_SIGHTED,
        "steps": 150_000,
        "gamma": 0.95,
        "target_update_interval": 2_000,
        "buffer_size": 150_000,
    },
    SIMS["racer"]: {**_FAR_SIGHTED, "steps": 100_000, "buffer_size": 100_000},
    SIMS["highway-lane"]: {
        **_STEADY,
        "steps": 40_000,
        "gamma": 0.97,
        "buffer_size": 40_000,
        "target_update_interval": 1_000,
    },
}
"""By the sim's id: what differs from the algorithm's own defaults."""


def settings_for(config_type: type, sim: str, sim_options: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that a sim is learnt with; none for other environments, rules or pictures.

    Args:
        config_type: the algorithm's settings; those that it does not have are left out.
        sim: short name or Gymnasium id.
        sim_options: arguments to the environment.
    """
    known = {field.name for field in fields(config_type)}
    default_rules = sim_options.get("rules", "default") == "default"
    from_vectors = sim_options.get("observation", "state") in ("state", "rays")
    if not (default_rules and from_vectors and {"n_steps", "buffer_size"} <= known):
        return {}
    return dict(SIM_SETTINGS.get(SIMS.get(sim, sim), {}))
