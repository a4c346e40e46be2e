"""Settings of each preset and of each sim.

A preset contains published settings without changes, for a sim with the published rules: images or
rays, one environment, classic rules. Presets also reproduce faults of the published programs, which
docs/online.md lists.

    autonomysim-car, autonomysim-drone      https://github.com/nervosys/AutonomySim
    ddqn-racer                              Double DQN on a ray-cast track

`SIM_SETTINGS` are tuned for learning each sim from vectors with its default rules; docs/results.md
has the command and the scores of four seeds. Important settings are:

- A learning rate that decays to 4 % of its initial value. With a constant learning rate, the policy
  oscillates until the end.
- `n_steps` 3 for powerline and racer, whose rewards are sparse or late, and an update of the target
  network only every 4,000 steps, or 2,000 with a shorter horizon.
- Checkpoints are compared on separate episodes and the best one is stored, because scores can still
  drop during training.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Final

from mcaprl.errors import UnknownNameError
from mcaprl.sims import SIMS


@dataclass(frozen=True)
class Preset:
    """Published settings of one program.

    Attributes:
        algo: Name of the algorithm.
        sim: Short name of the sim.
        sim_options: Arguments of the sim.
        settings: Settings that differ from the algorithm's defaults.
    """

    algo: str
    sim: str
    sim_options: dict[str, Any]
    settings: dict[str, Any]


_AUTONOMYSIM: Final[dict[str, Any]] = {
    "steps": 500_000,
    "envs": 1,
    "learning_rate": 2.5e-4,
    # The output layer follows the 512 features of the convolutions directly.
    "hidden": (),
    "batch_size": 32,
    "buffer_size": 500_000,
    "steps_per_update": 4,
    "target_update_interval": 10_000,
    "max_grad_norm": 10.0,
    "exploration_fraction": 0.1,
    "exploration_final_eps": 0.01,
    "eval_interval": 10_000,
    "eval_episodes": 5,
}

PRESETS: Final[dict[str, Preset]] = {
    "autonomysim-car": Preset(
        "dqn",
        "lane",
        {"rules": "classic", "observation": "depth"},
        {**_AUTONOMYSIM, "learning_starts": 200_000},
    ),
    "autonomysim-drone": Preset(
        "dqn",
        "powerline",
        {"rules": "classic", "observation": "depth"},
        {**_AUTONOMYSIM, "learning_starts": 10_000},
    ),
    "ddqn-racer": Preset(
        "double-dqn",
        "racer",
        {"rules": "classic"},
        {
            "steps": 200_000,
            "envs": 1,
            "learning_rate": 5e-4,
            "gamma": 0.99,
            "hidden": (256,),
            "batch_size": 512,
            "buffer_size": 25_000,
            "learning_starts": 512,
            "steps_per_update": 1,
            "target_update_episodes": 50,
            "exploration_decay": 0.9995,
            "exploration_final_eps": 0.1,
            "eval_interval": 10_000,
            "eval_episodes": 5,
        },
    ),
}


_STEADY: Final[dict[str, Any]] = {
    "learning_rate": 5e-4,
    "final_learning_rate_fraction": 0.04,
    "hidden": (256, 256),
    "batch_size": 128,
    "learning_starts": 2_000,
    "exploration_fraction": 0.3,
}
_LONG_HORIZON: Final[dict[str, Any]] = {
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
        **_LONG_HORIZON,
        "steps": 150_000,
        "gamma": 0.95,
        "target_update_interval": 2_000,
        "buffer_size": 150_000,
    },
    SIMS["racer"]: {**_LONG_HORIZON, "steps": 100_000, "buffer_size": 100_000},
    SIMS["highway-lane"]: {
        **_STEADY,
        "steps": 40_000,
        "gamma": 0.97,
        "buffer_size": 40_000,
        "target_update_interval": 1_000,
    },
}
"""Settings that differ from the algorithm's defaults, by the sim's id."""


def find_preset(name: str) -> Preset:
    """Find a preset by its name.

    Raises:
        UnknownNameError: There is no such preset.
    """
    if name not in PRESETS:
        raise UnknownNameError("preset", name, PRESETS)
    return PRESETS[name]


def settings_for(config_type: type, sim: str, sim_options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tuned settings of a sim; for other environments, classic rules or images, none.

    Args:
        config_type: Type of the algorithm's settings; only algorithms with `n_steps` and
            `buffer_size` have settings here.
        sim: Short name or Gymnasium id.
        sim_options: Arguments of the environment.
    """
    known = {field.name for field in fields(config_type)}
    default_rules = sim_options.get("rules", "default") == "default"
    from_vectors = sim_options.get("observation", "state") in ("state", "rays")
    if not (default_rules and from_vectors and {"n_steps", "buffer_size"} <= known):
        return {}
    return dict(SIM_SETTINGS.get(SIMS.get(sim, sim), {}))
