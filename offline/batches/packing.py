"""Settings for building transitions from a log. Importing this module loads no torch."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Packing:
    """Settings for building transitions from a log.

    Attributes:
        frame_stack: Number of successive observations in one network input; an episode's
            first observation also pads the stacks.
        normalize: Whether network inputs are normalized to mean 0 and standard deviation 1.
        center_images: Whether images are normalized even if `normalize` is False.
        gamma: Discount per step.
        n_steps: Number of rewards in a return; returns at the end of an episode have fewer.
        scale_rewards: Whether rewards are divided by the standard deviation of the discounted
            returns of all transitions.
        clip_actions: Whether logged actions outside a Box are clipped to its bounds.
        chunk: Number of successive actions that are learned from one observation.
        relative: Whether actions are learned relative to observations, where the data declare it.
    """

    frame_stack: int = 1
    normalize: bool = False
    center_images: bool = False
    gamma: float = 1.0
    n_steps: int = 1
    scale_rewards: bool = False
    clip_actions: bool = False
    chunk: int = 1
    relative: bool = False
