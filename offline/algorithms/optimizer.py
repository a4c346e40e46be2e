"""AdamW on a few flat tensors: https://arxiv.org/abs/1711.05101."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.optim.adamw import adamw

MOMENTS = ("exp_avg", "exp_avg_sq")


class AdamW:
    """torch's fused step without the bookkeeping of its optimizers.

    That takes as long as the step itself where all weights are one tensor.

    Attributes:
        learning_rate: of the next step; a tensor where a step is captured once and repeated.
        steps: made so far, of each of the weights, a tensor of no dimension.
        moments: of each of the weights, by the names of `MOMENTS`, and of their shape.
    """

    def __init__(
        self, weights: Sequence[Tensor], learning_rate: float, weight_decay: float
    ) -> None:
        """Begin; weights have their gradients in `grad` when `step` is called."""
        self.learning_rate: float | Tensor = learning_rate
        self._weights = list(weights)
        self._weight_decay = weight_decay
        self._on_gpu = weights[0].is_cuda
        self.steps = [torch.tensor(0.0, device=one.device) for one in weights]
        self.moments = [{name: torch.zeros_like(one) for name in MOMENTS} for one in weights]

    @torch.no_grad()
    def step(self) -> None:
        """Move the weights against their gradients."""
        gradients = [one.grad for one in self._weights if one.grad is not None]
        first, second = ([mine[name] for mine in self.moments] for name in MOMENTS)
        adamw(
            self._weights,
            gradients,
            first,
            second,
            [],
            self.steps,
            fused=True,
            capturable=self._on_gpu,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=self.learning_rate,
            weight_decay=self._weight_decay,
            eps=1e-8,
            maximize=False,
        )
