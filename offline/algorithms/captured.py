"""One update on tensors that stay where they are, so that a GPU can repeat it as one CUDA graph.

A small network's update is some eighty kernels of a few microseconds each, and launching them one
by one takes longer than running them. A graph launches them all at once. For that, all that changes
from update to update (the rows of the batch, the learning rate, the number of the update) stands in
tensors of its own, and nothing may wait for the device: a loss that is not finite is noted there,
and told when `check` asks.

    https://docs.pytorch.org/docs/stable/notes/cuda.html#cuda-graphs
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor

from mcaprl.errors import UnknownNameError, UsageError

if TYPE_CHECKING:
    from mcaprl.offline.algorithms.learner import Learner

DEVICES = ("cpu", "cuda")

_WARM_UPS = 3
"""Updates before the capture, in which libraries choose their kernels and get their memory."""


def choose_device(name: str) -> torch.device:
    """The device that a user means.

    Raises:
        UnknownNameError: it is none of `DEVICES`.
        UsageError: torch finds no such device here.
    """
    if name not in DEVICES:
        raise UnknownNameError("device", name, DEVICES)
    if name == "cuda" and not torch.cuda.is_available():
        raise UsageError(
            f"device cuda: torch {torch.__version__} finds none here; install a torch that is built"
            " for CUDA, or leave --device out"
        )
    return torch.device(name)


class StaticUpdate:
    """A learner's update, captured at its first call; on a CPU it runs as it is.

    Attributes:
        terms: of the last update, (R,) each; the next update overwrites them.
    """

    terms: dict[str, Tensor]

    def __init__(self, learner: Learner) -> None:
        """Make the tensors through which it is told what to do."""
        self._learner = learner
        device = learner.buffer.device
        size = len(learner.seeds) * learner.config.batch_size
        self._rows = torch.zeros(size, dtype=torch.int64, device=device)
        self._rate = torch.tensor(learner.config.learning_rate, device=device)
        learner.optimizer.learning_rate = self._rate
        self._updates = torch.zeros((), dtype=torch.int64, device=device)
        self._bad_update = torch.full_like(self._updates, -1)
        self._bad_means: Tensor | None = None
        self._run: Callable[[], Any] | None = None

    def __call__(self, rows: Tensor, learning_rate: float) -> dict[str, Tensor]:
        """Make one update on the rows (R,) of a batch."""
        # Without pinned memory, the copy has left `rows` when this returns.
        self._rows.copy_(rows, non_blocking=True)
        self._rate.fill_(learning_rate)
        self._updates.fill_(self._learner.step + 1)
        if self._run is None:
            self._run = self._captured() if self._rows.is_cuda else self._update
        self._run()
        return self.terms

    def check(self) -> None:
        """Wait for the device, and tell of the first loss that was not finite.

        Raises:
            NotFiniteError: there was one.
        """
        update = int(self._bad_update)
        if update < 0:
            return
        assert self._bad_means is not None
        means = [dict(zip(self.terms, mine, strict=True)) for mine in self._bad_means.T.tolist()]
        raise self._learner.not_finite(means, update)

    def _update(self) -> None:
        """All that the device does."""
        self.terms = self._learner.find_gradients(self._rows)
        self._learner.optimizer.step()
        self._note_bad()

    def _note_bad(self) -> None:
        """Keep the terms of the first update whose loss is not finite, and its number."""
        seeds = len(self._learner.seeds)
        means = torch.stack([term.view(seeds, -1).mean(1) for term in self.terms.values()])
        if self._bad_means is None:
            self._bad_means = torch.zeros_like(means)
        is_first = ~means[-1].isfinite().all() & (self._bad_update < 0)
        self._bad_means.copy_(torch.where(is_first, means, self._bad_means))
        self._bad_update.copy_(torch.where(is_first, self._updates, self._bad_update))

    def _captured(self) -> Callable[[], Any]:
        """The update as a CUDA graph; nothing has changed when this returns."""
        changing = [*self._learner.changed_by_updates(), self._bad_update]
        kept = [tensor.clone() for tensor in changing]
        cuda: Any = torch.cuda  # Its streams have no types.
        stream = cuda.Stream()
        stream.wait_stream(cuda.current_stream())
        with cuda.stream(stream):
            for _ in range(_WARM_UPS):
                self._update()
        cuda.current_stream().wait_stream(stream)
        graph = cuda.CUDAGraph()
        with cuda.graph(graph):
            self._update()
        for tensor, value in zip(changing, kept, strict=True):
            tensor.copy_(value)
        return cast(Callable[[], Any], graph.replay)
