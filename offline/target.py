"""The target network: a copy that stands still between two synchronisations."""

from __future__ import annotations

import copy
from typing import cast

import torch
from torch import Tensor, nn

from mcaprl.offline.buffer import Batch, TransitionBuffer

_ROWS_AT_ONCE = 1024


class HardTarget:
    """Values of the next states under a network copied every so many updates.

    Between two copies the values do not change. So, where the data set is smaller than what is
    sampled in that time, each is computed once for the whole data set and then looked up.
    """

    def __init__(self, network: nn.Module, buffer: TransitionBuffer, rows_per_sync: int) -> None:
        """Copy `network`; about `rows_per_sync` rows are asked for between two calls of `sync`."""
        self.network = copy.deepcopy(network).requires_grad_(False)
        self._next_observations = buffer.next_observations
        self._table: Tensor | None = None
        self._use_table = len(buffer) <= rows_per_sync
        self.refresh()

    def sync(self, network: nn.Module) -> None:
        """Copy the weights of `network`."""
        self.network.load_state_dict(network.state_dict())
        self.refresh()

    @torch.no_grad()
    def refresh(self) -> None:
        """Compute the table anew, after the weights have changed."""
        if self._use_table:
            parts = torch.split(self._next_observations, _ROWS_AT_ONCE)
            self._table = torch.cat([self.network(part) for part in parts])

    @torch.no_grad()
    def values(self, batch: Batch) -> Tensor:
        """(B, A) values of the batch's next states."""
        if self._table is not None:
            return self._table.index_select(0, batch.rows)
        return cast(Tensor, self.network(batch.next_observations))
