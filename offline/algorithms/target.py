"""The target network: a copy that stands still between two synchronisations."""

from __future__ import annotations

import torch
from torch import Tensor

from mcaprl.offline.algorithms.models import Model
from mcaprl.offline.batches.buffer import Batch, TransitionBuffer

_ROWS_AT_ONCE = 1024


class HardTarget:
    """Values under a model that is copied every so many updates.

    Between two copies the values do not change. So, where that takes less time than to compute them
    for each batch, they are computed once for the whole data set and then looked up.

    Attributes:
        model: the copy.
    """

    def __init__(
        self,
        model: Model,
        buffer: TransitionBuffer,
        rows_per_sync: int,
        *,
        next_states: bool = True,
    ) -> None:
        """Copy `model`.

        Args:
            model: that learns.
            buffer: what it learns from.
            rows_per_sync: about how many rows of a seed are asked for between two calls of `sync`.
            next_states: whether the values are those of the next states, or of the states.
        """
        self.model = model.clone()
        self._buffer = buffer
        self._next_states = next_states
        self._use_table = len(buffer) <= rows_per_sync * model.bulk_gain
        self._table: Tensor | None = None
        self._is_fresh = False
        self._seeds = len(model.weights)
        numbers = torch.arange(self._seeds, device=buffer.device)
        self._offsets = numbers.unsqueeze(1) * len(buffer)

    def sync(self, model: Model) -> None:
        """Copy the weights of `model`."""
        self.model.weights.copy_(model.weights)
        self.forget()

    def forget(self) -> None:
        """Compute values anew before they are next asked for: the weights have changed."""
        self._is_fresh = False

    def prepare(self) -> None:
        """Compute the values that `outputs` looks up, if the weights have changed.

        They stay where they are in memory, so that an update that was captured once as a CUDA graph
        finds them.
        """
        if not self._use_table or self._is_fresh:
            return
        values = outputs_everywhere(self.model, self._buffer, next_states=self._next_states)
        if self._table is None:
            self._table = values
        else:
            self._table.copy_(values)
        self._is_fresh = True

    def outputs(self, batch: Batch) -> Tensor:
        """(R, ...) the model's outputs for the batch's states, or next states."""
        if not self._use_table:
            return self.model(batch.next_observations if self._next_states else batch.observations)
        self.prepare()
        assert self._table is not None
        rows = batch.rows
        if self._seeds > 1:
            rows = (rows.view(self._seeds, -1) + self._offsets).flatten()
        return self._table.index_select(0, rows)


def outputs_everywhere(model: Model, buffer: TransitionBuffer, *, next_states: bool) -> Tensor:
    """(K * N, ...) the outputs of K networks for the N states of a buffer, or its next states."""
    seeds, parts = len(model.weights), []
    for places in torch.split(buffer.places[int(next_states)], _ROWS_AT_ONCE):
        outputs = model(buffer.observe(places.repeat(seeds)))
        parts.append(outputs.view(seeds, len(places), *outputs.shape[1:]))
    return torch.cat(parts, 1).flatten(0, 1)
