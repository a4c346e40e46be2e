"""Record reinforcement learning episodes as MCAP logs, learn from logs, and replay them.

    env = mcaprl.RecordMcap(gym.make("mcaprl/LaneKeeping-v0"), "lane.mcap")   # records each step
    data = mcaprl.open("lane.mcap")                                           # arrays and episodes
    mcaprl.train(data, "runs/cql")                                            # trained policy
    policy = mcaprl.load_policy("runs/cql")                                   # loaded policy

Most commands of the program have a function of the same name. `train-offline` is `train` or
`sweep`, `evaluate --data` is `estimate`, `convert --suggest` is `suggest_mapping`, and `replay` is
`replay`, `browse`, `save_page`, `verify` or `render`; `completion` has no function. Importing this
package does not import torch or numba; functions import them when called.
"""

from typing import TYPE_CHECKING

from mcaprl._interrupt import is_program  # first, because the other imports take up to a second
from mcaprl._version import __version__
from mcaprl.errors import LogError, McaprlError, PolicyError, UsageError
from mcaprl.lazy import lazy_attributes

# The program imports the environments with `mcaprl.api`, so that its help is fast.
if not is_program():
    import mcaprl.sims  # noqa: F401  (registers the environments)

if TYPE_CHECKING:
    from mcaprl import ray, torch
    from mcaprl.api.action_errors import action_errors
    from mcaprl.api.convert import convert, suggest_mapping
    from mcaprl.api.drive import drive_robot
    from mcaprl.api.edit import annotate, filter, label, merge, relabel, select, slice, split
    from mcaprl.api.estimate import estimate, estimate_behavior
    from mcaprl.api.evaluate import evaluate
    from mcaprl.api.logs import check, info, recover
    from mcaprl.api.policies import Run, export, load_policy
    from mcaprl.api.ranges import ClusterOptions
    from mcaprl.api.record import record
    from mcaprl.api.replay import browse, layout, render, replay, save_page, verify
    from mcaprl.api.sweep import sweep
    from mcaprl.api.train import train, train_online
    from mcaprl.drive.driver import Driver
    from mcaprl.recorder.bags.bag import OpenBag, open_bag
    from mcaprl.recorder.dataset.dataset import Dataset
    from mcaprl.recorder.dataset.format_registry import Format
    from mcaprl.recorder.dataset.transitions import Episode
    from mcaprl.recorder.record.vector_wrapper import RecordVecMcap
    from mcaprl.recorder.record.wrapper import RecordMcap
    from mcaprl.recorder.source import open_data as open
    from mcaprl.sims import make_sim

__all__ = [
    "ClusterOptions",
    "Dataset",
    "Driver",
    "Episode",
    "Format",
    "LogError",
    "McaprlError",
    "OpenBag",
    "PolicyError",
    "RecordMcap",
    "RecordVecMcap",
    "Run",
    "UsageError",
    "__version__",
    "action_errors",
    "annotate",
    "browse",
    "check",
    "convert",
    "drive_robot",
    "estimate",
    "estimate_behavior",
    "evaluate",
    "export",
    "filter",
    "info",
    "label",
    "layout",
    "load_policy",
    "make_sim",
    "merge",
    "open",
    "open_bag",
    "ray",
    "record",
    "recover",
    "relabel",
    "render",
    "replay",
    "save_page",
    "select",
    "slice",
    "split",
    "suggest_mapping",
    "sweep",
    "torch",
    "train",
    "train_online",
    "verify",
]
_PUBLIC = __all__
# `from mcaprl import *` must not replace functions of Python, or PyTorch and Ray.
if not TYPE_CHECKING:
    __all__ = [name for name in _PUBLIC if name not in {"filter", "open", "ray", "slice", "torch"}]

# These names are imported on first use: their modules take long to import.
__getattr__ = lazy_attributes(
    __name__,
    {f"mcaprl.api.{name}": [name] for name in ("evaluate", "record", "sweep")}
    | {
        "mcaprl.api.estimate": ["estimate", "estimate_behavior"],
        "mcaprl.api.convert": ["convert", "suggest_mapping"],
        "mcaprl.recorder.source": ["open_data as open"],
        "mcaprl.api.edit": [
            "annotate",
            "filter",
            "label",
            "merge",
            "relabel",
            "select",
            "slice",
            "split",
        ],
        "mcaprl.api.action_errors": ["action_errors"],
        "mcaprl.api.logs": ["check", "info", "recover"],
        "mcaprl.api.policies": ["Run", "export", "load_policy"],
        "mcaprl.api.ranges": ["ClusterOptions"],
        "mcaprl.api.replay": ["browse", "layout", "render", "replay", "save_page", "verify"],
        "mcaprl.api.train": ["train", "train_online"],
        "mcaprl.api.drive": ["drive_robot"],
        "mcaprl.drive.driver": ["Driver"],
        "mcaprl.ray": ["ray"],
        "mcaprl.torch": ["torch"],
        "mcaprl.recorder.bags.bag": ["OpenBag", "open_bag"],
        "mcaprl.recorder.dataset.dataset": ["Dataset"],
        "mcaprl.recorder.dataset.transitions": ["Episode"],
        "mcaprl.recorder.dataset.format_registry": ["Format"],
        "mcaprl.recorder.record.wrapper": ["RecordMcap"],
        "mcaprl.recorder.record.vector_wrapper": ["RecordVecMcap"],
        "mcaprl.sims": ["make_sim"],
    },
)


def __dir__() -> list[str]:
    """List the public names."""
    return _PUBLIC
