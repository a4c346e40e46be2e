"""Settings of each preset and of each sim.

A preset contains published settings without changes. Its sim is set up as published: observations
are images or rays, there is one environment, and the rules are classic. Presets also reproduce the
faults of the published programs; docs/online.md lists these faults.

    autonomysim-car, autonomysim-drone      https://github.com/nervosys/AutonomySim
    ddqn-racer                              Double DQN on a ray-cast track

`SIM_SETTINGS` are tuned for learning each sim from vectors with its default rules; docs/results.md
has the command and the scores of four seeds. Important settings are:

- A learning rate that decays to 4 % of its initial value. With a constant learning rate, the policy
  oscillates until the end.
- `n_steps` is 3 for powerline and racer, whose rewards are sparse or late. Their target networks
  are updated only every 2,000 steps (powerline, `gamma` 0.95) or 4,000 steps (racer, `gamma` 0.98).
- Checkpoints are compared on separate episodes and the best one is stored, because scores can still
  drop during training.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Final

from mcaprl.errors import UnknownNameError


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
    # There are no hidden layers. The output layer follows the 512 features of SB3's `NatureCNN`.
    "hidden": (),
    "encoder": "nature",
    "center_images": False,
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
    "lane": {
        **_STEADY,
        "steps": 80_000,
        "gamma": 0.97,
        "buffer_size": 100_000,
        "target_update_interval": 1_000,
    },
    "racer": {**_LONG_HORIZON, "steps": 100_000, "buffer_size": 100_000},
    "powerline": {
        **_LONG_HORIZON,
        "steps": 150_000,
        "gamma": 0.95,
        "target_update_interval": 2_000,
        "buffer_size": 150_000,
    },
    "highway-lane": {
        **_STEADY,
        "steps": 40_000,
        "gamma": 0.97,
        "buffer_size": 40_000,
        "target_update_interval": 1_000,
    },
}
"""Settings that differ from the algorithm's defaults, by the sim's short name."""


_FROM_IMAGES: Final[dict[str, Any]] = {
    **_STEADY,
    "batch_size": 64,
    "buffer_size": 100_000,
    "exploration_fraction": 0.15,
    "eval_interval": 20_000,
}
_LANE_IMAGES: Final[dict[str, Any]] = {
    **_FROM_IMAGES,
    "dueling": True,
    "layer_norm": True,
    "steps": 200_000,
    "gamma": 0.97,
    "target_update_interval": 4_000,
}
IMAGE_SETTINGS: Final[dict[tuple[str, str], dict[str, Any]]] = {
    ("lane", "dashboard"): _LANE_IMAGES,
    ("lane", "depth"): {**_LANE_IMAGES, "frame_stack": 4},
    ("lane", "depth-commands"): {**_LANE_IMAGES, "frame_stack": 4},
    ("powerline", "depth"): {
        **_FROM_IMAGES,
        "steps": 240_000,
        "gamma": 0.95,
        "n_steps": 3,
        "target_update_interval": 2_000,
    },
}
"""Settings for learning from images, by the sim's short name and its argument `observation`."""


def find_preset(name: str) -> Preset:
    """Find a preset by its name."""
    if name not in PRESETS:
        raise UnknownNameError("preset", name, PRESETS)
    return PRESETS[name]


def settings_for(config_type: type, sim: str, sim_options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tuned settings of a sim.

    The dict is empty for classic rules and for other environments.
    """
    known = {field.name for field in fields(config_type)}
    default_rules = sim_options.get("rules", "default") == "default"
    if not (default_rules and {"n_steps", "buffer_size"} <= known):
        return {}
    from mcaprl.sims import SIMS

    spec = SIMS.find(SIMS.get(sim, sim), loads=False)
    name, observation = spec.name if spec else sim, sim_options.get("observation", "state")
    if observation in ("state", "rays"):
        return dict(SIM_SETTINGS.get(name, {}))
    return dict(IMAGE_SETTINGS.get((name, observation), {}))
