"""Online training in which sims, replay buffer and networks of all seeds stay on one device.

Importing this package does not import torch; the first use of one of its names does.
"""

from typing import TYPE_CHECKING

from mcaprl.lazy import lazy_attributes

if TYPE_CHECKING:
    from mcaprl.device.training import device_task, fast_products, make_agents, train

__all__ = ["device_task", "fast_products", "make_agents", "train"]

__getattr__ = lazy_attributes(
    __name__, {"mcaprl.device.training": ("device_task", "fast_products", "make_agents", "train")}
)
