"""Online learning with recording: Double DQN, SAC, TD3, and algorithms of Stable-Baselines3.

Importing this package does not import torch; the first use of one of its names does.

    import mcaprl

    mcaprl.train_online("lane", "runs/lane", algo="double-dqn", seeds=4)

Raises:
    MissingExtraError: The packages of the `online` extra are not installed.
"""

from typing import TYPE_CHECKING

from mcaprl.errors import require_extra
from mcaprl.lazy import lazy_attributes

if TYPE_CHECKING:
    from mcaprl.online.agent import Agent
    from mcaprl.online.collector import Collector
    from mcaprl.online.config import SIM_SETTINGS
    from mcaprl.online.curves import VALUES, CurvePoint, curve_figure, draw_curves, read_run
    from mcaprl.online.evaluation import FRESH_SEED, SELECTION_SEED, measure_scale
    from mcaprl.online.learning import LearningAgent
    from mcaprl.online.live import LiveTraining
    from mcaprl.online.replay import ReplayBuffer
    from mcaprl.online.task import Task
    from mcaprl.online.zip_file import describe_run, read_policy, save_policy

require_extra("online", "stable_baselines3", "tensorboard")

__all__ = [
    "FRESH_SEED",
    "SELECTION_SEED",
    "SIM_SETTINGS",
    "VALUES",
    "Agent",
    "Collector",
    "CurvePoint",
    "LearningAgent",
    "LiveTraining",
    "ReplayBuffer",
    "Task",
    "curve_figure",
    "describe_run",
    "draw_curves",
    "measure_scale",
    "read_policy",
    "read_run",
    "save_policy",
]

# These names are imported on first use.
__getattr__ = lazy_attributes(
    __name__,
    {
        "mcaprl.online.agent": ("Agent",),
        "mcaprl.online.collector": ("Collector",),
        "mcaprl.online.curves": ("VALUES", "CurvePoint", "curve_figure", "draw_curves", "read_run"),
        "mcaprl.online.evaluation": ("FRESH_SEED", "SELECTION_SEED", "measure_scale"),
        "mcaprl.online.learning": ("LearningAgent",),
        "mcaprl.online.live": ("LiveTraining",),
        "mcaprl.online.replay": ("ReplayBuffer",),
        "mcaprl.online.config": ("SIM_SETTINGS",),
        "mcaprl.online.task": ("Task",),
        "mcaprl.online.zip_file": ("describe_run", "read_policy", "save_policy"),
    },
)
