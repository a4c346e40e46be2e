"""The robot's log is the dataset: record, learn from and replay MCAP files.

    env = mcaprl.RecordMcap(gym.make("mcaprl/LaneKeeping-v0"), "lane.mcap")   # records what it does
    data = mcaprl.open("lane.mcap")                                           # arrays and episodes
    policy = mcaprl.load_policy("runs/cql")                                   # a trained policy

Importing this package loads neither torch nor numba; what needs them imports them when called.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import mcaprl.sims  # noqa: F401  (registers the environments)
from mcaprl._version import __version__
from mcaprl.errors import McaprlError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.episode import Episode
from mcaprl.recorder.dataset.open import open_logs as open

if TYPE_CHECKING:
    from mcaprl.api.policies import load_policy
    from mcaprl.recorder.record.vector_wrapper import RecordVecMcap
    from mcaprl.recorder.record.wrapper import RecordMcap

# Imported on first use, because they load torch or the writer.
_LAZY = {
    "RecordMcap": "mcaprl.recorder.record.wrapper",
    "RecordVecMcap": "mcaprl.recorder.record.vector_wrapper",
    "load_policy": "mcaprl.api.policies",
}

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
    """Import a public name on first use."""
    if name not in _LAZY:
        raise AttributeError(f"module 'mcaprl' has no attribute '{name}'")
    value = getattr(import_module(_LAZY[name]), name)
    globals()[name] = value
    return value
