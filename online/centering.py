"""Pictures around zero for SB3's convolutions, in files that are plain SB3's all the same.

SB3 hands the first convolution bytes / 255. A depth picture's bytes lie far from 0 and close
together, so that every weight of a channel is pulled the same way, and what a picture shows is
learned late. Here that layer gets 4 (x - 1/2) instead, -2 to 2. A convolution is linear:

    V * 4 (x - 1/2) + c  =  W * x + b,    W = 4 V,  b = c - 2 sum(V)

so a file is written with W and b, and whoever loads it needs to know nothing of this.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from stable_baselines3.common.torch_layers import NatureCNN
from torch import Tensor, nn

_FACTOR = 4.0
_MIDDLE = 0.5


def center_images(policy: nn.Module) -> None:
    """Let the first convolution of each picture see it around zero, from now on."""
    for convolution in _first_convolutions(policy):
        convolution.register_forward_pre_hook(_centered)


def take_plain_weights(policy: nn.Module) -> None:
    """Turn weights that were loaded from a plain policy into those for centered pictures."""
    with torch.no_grad():
        for convolution in _centered_convolutions(policy):
            convolution.weight /= _FACTOR
            convolution.bias += _offset(convolution)


@contextmanager
def plain_weights(policy: nn.Module) -> Iterator[None]:
    """Show the weights W and b for a while; those that learn are back afterwards, bit for bit."""
    changed = _centered_convolutions(policy)
    kept = [(layer.weight.detach().clone(), layer.bias.detach().clone()) for layer in changed]
    with torch.no_grad():
        for convolution in changed:
            convolution.bias -= _offset(convolution)
            convolution.weight *= _FACTOR
    try:
        yield
    finally:
        with torch.no_grad():
            for convolution, (weight, bias) in zip(changed, kept, strict=True):
                convolution.weight.copy_(weight)
                convolution.bias.copy_(bias)


def _centered(_: nn.Module, inputs: tuple[Tensor]) -> tuple[Tensor]:
    return ((inputs[0] - _MIDDLE) * _FACTOR,)


def _offset(convolution: Any) -> Tensor:
    """What the middle of the range, taken off each pixel, changes in each output."""
    total: Tensor = convolution.weight.sum((1, 2, 3)) * (_FACTOR * _MIDDLE)
    return total


def _first_convolutions(policy: nn.Module) -> list[Any]:
    return [module.cnn[0] for module in policy.modules() if isinstance(module, NatureCNN)]


def _centered_convolutions(policy: nn.Module) -> list[Any]:
    return [
        convolution
        for convolution in _first_convolutions(policy)
        if _centered in convolution._forward_pre_hooks.values()
    ]
