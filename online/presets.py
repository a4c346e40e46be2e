"""Published settings, as they were, for the sims with their published rules.

What they have in common: pictures or rays, one environment, classic rules. docs/online.md says
which faults of the published programs they keep and which they leave behind.

    autonomysim-car, autonomysim-drone      https://github.com/nervosys/AutonomySim
    ddqn-racer                              Double DQN on a ray-cast track
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from mcaprl.errors import UnknownNameError


@dataclass(frozen=True)
class Preset:
    """One of them.

    Attributes:
        algo: the algorithm's name.
        sim: short name.
        sim_options: arguments to the sim.
        settings: that differ from the algorithm's own defaults.
    """

    algo: str
    sim: str
    sim_options: dict[str, Any]
    settings: dict[str, Any]


_AUTONOMYSIM: Final[dict[str, Any]] = {
    "steps": 500_000,
    "envs": 1,
    "learning_rate": 2.5e-4,
    # The features of the convolutions, 512, go straight to the Q-values.
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


def find_preset(name: str) -> Preset:
    """Find a preset by its name.

    Raises:
        UnknownNameError: there is no such preset.
    """
    if name not in PRESETS:
        raise UnknownNameError("preset", name, PRESETS)
    return PRESETS[name]
