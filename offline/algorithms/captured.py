"""Updates on a GPU as CUDA graphs: the kernels of an update are launched by two calls.

Launching the kernels of a small network one by one takes several times as long as they run.
"""

from __future__ import annotations

import gc
from collections.abc import Callable

import torch
from torch import Tensor

Terms = dict[str, Tensor]
_WARM_UPS = 3


class CapturedUpdate:
    """An update of fixed shape that was recorded once and is replayed with other rows.

    Attributes:
        terms: Terms of the loss; each replay overwrites them.
    """

    def __init__(
        self, gradients: Callable[[Tensor], Terms], optimizer: torch.optim.Optimizer, rows: Tensor
    ) -> None:
        """Record an update; weights and optimizer do not change."""
        device = next(iter(optimizer.state)).device
        self._rows = rows.to(device, copy=True)
        # PyTorch requires some calls on another stream before a capture.
        stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(stream):
            for _ in range(_WARM_UPS):
                gradients(self._rows)
        torch.cuda.current_stream(device).wait_stream(stream)
        # The capture allocates new gradients, which the graph overwrites instead of adding to them.
        optimizer.zero_grad()
        # A learner is a reference cycle. If the garbage collector destroyed the graphs of an
        # earlier learner during a capture, the capture would fail.
        gc.collect()
        self._gradients, self._step = torch.cuda.CUDAGraph(), torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._gradients):
            self.terms = gradients(self._rows)
        with torch.cuda.graph(self._step):
            optimizer.step()

    def gradients(self, rows: Tensor) -> Terms:
        """Compute the gradients for these rows of the buffer; return the terms of the loss."""
        self._rows.copy_(rows)
        self._gradients.replay()
        return self.terms

    def step(self) -> None:
        """Change the weights by the gradients, with the current learning rates."""
        self._step.replay()
