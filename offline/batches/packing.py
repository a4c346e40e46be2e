"""Settings for building transitions from a log. Importing this module loads no torch."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Packing:
    """Settings for building transitions from a log."""

    # Number of successive observations in one network input; an episode's first observation also
    # pads the stacks.
    frame_stack: int = 1
    # Whether network inputs are normalized to mean 0 and standard deviation 1.
    normalize: bool = False
    center_images: bool = False  # Whether images are normalized even if `normalize` is False
    gamma: float = 1.0  # Discount per step
    n_steps: int = 1  # Number of rewards in a return; returns at the end of an episode have fewer
    # Whether rewards are divided by the standard deviation of the discounted returns of all
    # transitions.
    scale_rewards: bool = False
    clip_actions: bool = False  # Whether logged actions outside a Box are clipped to its bounds
    chunk: int = 1  # Number of successive actions that are learned from one observation
    # Whether actions are learned relative to observations, where the data declare it.
    relative: bool = False
