"""Images centered at zero for SB3's convolutions, in files that plain SB3 loads.

In SB3 the input x of the first convolution is bytes / 255. The bytes of a depth image are far from
0 and close to each other, so the gradients of a channel's weights have the same sign, and learning
is slow. Here the input of that layer is 4 (x - 1/2), from -2 to 2. A convolution is linear:

    V * 4 (x - 1/2) + c  =  W * x + b,    W = 4 V,  b = c - 2 sum(V)

so files contain W and b, and load in plain SB3 without any change.
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
    """Center the input of the first convolution of each image."""
    for convolution in _first_convolutions(policy):
        convolution.register_forward_pre_hook(_centered)


def take_plain_weights(policy: nn.Module) -> None:
    """Convert weights loaded from a plain policy into weights for centered images."""
    with torch.no_grad():
        for convolution in _centered_convolutions(policy):
            convolution.weight /= _FACTOR
            convolution.bias += _offset(convolution)


@contextmanager
def plain_weights(policy: nn.Module) -> Iterator[None]:
    """Replace the weights by W and b inside a `with` block; restore them exactly afterwards."""
    changed = _centered_convolutions(policy)
    saved = [(layer.weight.detach().clone(), layer.bias.detach().clone()) for layer in changed]
    with torch.no_grad():
        for convolution in changed:
            convolution.bias -= _offset(convolution)
            convolution.weight *= _FACTOR
    try:
        yield
    finally:
        with torch.no_grad():
            for convolution, (weight, bias) in zip(changed, saved, strict=True):
                convolution.weight.copy_(weight)
                convolution.bias.copy_(bias)


def _centered(_: nn.Module, inputs: tuple[Tensor]) -> tuple[Tensor]:
    return ((inputs[0] - _MIDDLE) * _FACTOR,)


def _offset(convolution: Any) -> Tensor:
    """Return the change of each output when 1/2 is subtracted from each pixel."""
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
