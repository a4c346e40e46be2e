"""Online training in which sims, replay buffer and networks of all seeds stay on one device.

Importing this package does not import torch; the first use of one of its names does.
"""

from typing import TYPE_CHECKING

from mcaprl.lazy import lazy_attributes

if TYPE_CHECKING:
    from mcaprl.device.replay import ReplayBuffer
    from mcaprl.device.training import Agents, device_task, fast_products, train

__all__ = ["Agents", "ReplayBuffer", "device_task", "fast_products", "train"]

__getattr__ = lazy_attributes(
    __name__,
    {
        "mcaprl.device.replay": ("ReplayBuffer",),
        "mcaprl.device.training": ("Agents", "device_task", "fast_products", "train"),
    },
)
