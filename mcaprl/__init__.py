"""The robot's log is the dataset: record, learn from and replay MCAP files.

    env = mcaprl.RecordMcap(gym.make("mcaprl/LaneKeeping-v0"), "lane.mcap")   # records what it does
    data = mcaprl.open("lane.mcap")                                           # arrays and episodes
    policy = mcaprl.load_policy("runs/cql")                                   # a trained policy

Importing this package loads neither torch nor numba; what needs them imports them when called.
"""

from typing import TYPE_CHECKING, Any

import mcaprl.sims  # noqa: F401  (registers the environments)
from mcaprl._version import __version__
from mcaprl.errors import McaprlError
from mcaprl.recorder.dataset import Dataset
from mcaprl.recorder.episode import Episode
from mcaprl.recorder.reader import open_logs as open
from mcaprl.recorder.vector_wrapper import RecordVecMcap
from mcaprl.recorder.wrapper import RecordMcap

if TYPE_CHECKING:
    from mcaprl.offline.policy import load_policy

__all__ = [
    "Dataset",
    "Episode",
    "McaprlError",
    "RecordMcap",
    "RecordVecMcap",
    "__version__",
    "load_policy",
    "open",
]


def __getattr__(name: str) -> Any:
    """Import what needs torch only when it is asked for."""
    if name == "load_policy":
        from mcaprl.offline.policy import load_policy

        return load_policy
    raise AttributeError(f"module 'mcaprl' has no attribute '{name}'")
