"""K networks of the same shape, one per seed, trained in parallel, and their target networks.

The P weights of each network are a row of one matrix (K, P), which is a leaf tensor of autograd.
Therefore, the optimizer, the target network and a checkpoint each handle one tensor. Batches
contain the rows of all seeds, ordered by seed: R = K * B rows.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, cast

import torch
from torch import Tensor, nn
from torch.func import functional_call

from mcaprl.networks import Network
from mcaprl.offline.batches.buffer import Batch, TransitionBuffer
from mcaprl.offline.batches.observations import Observations

ALIGNMENT = 16
"""Number of floats in a vector register.

Rows of weights are padded to a multiple of this number, so that the results of a seed do not depend
on the number of seeds K.
"""
_ROWS_AT_ONCE = 1024


class Model(ABC):
    """K networks whose weights are rows of one matrix, which is a leaf tensor of autograd.

    Attributes:
        networks: K networks; their parameters share memory with `weights`.
        weights: (K, P), one row of weights per network.
        bulk_gain: Time per row in a small batch, divided by the time per row in a batch of a
            thousand rows.
    """

    bulk_gain: ClassVar[float] = 1.0

    def __init__(self, networks: Sequence[Network]) -> None:
        """Move the weights of networks of one shape into one matrix."""
        self.networks = list(networks)
        parameters = dict(networks[0].named_parameters())
        self._names, self._shapes = list(parameters), [p.shape for p in parameters.values()]
        length = sum(parameter.numel() for parameter in parameters.values())
        self._sizes = [*(shape.numel() for shape in self._shapes), -length % ALIGNMENT]
        device = next(iter(parameters.values())).device
        weights = torch.zeros(len(networks), sum(self._sizes), device=device)
        for row, network in zip(weights, networks, strict=True):
            parts = zip(network.parameters(), row.split_with_sizes(self._sizes), strict=False)
            for parameter, part in parts:
                part.copy_(parameter.detach().flatten())
                parameter.data = part.view_as(parameter)
        self.weights = nn.Parameter(weights)

    @abstractmethod
    def __call__(self, observations: Observations) -> Tensor:
        """Map the observations of all seeds to outputs (R, *output_shape)."""

    def clone(self) -> Model:
        """Return another model with the same weights."""
        return type(self)([copy.deepcopy(network) for network in self.networks])


class AnyModel(Model):
    """Networks of any kind, evaluated one after the other."""

    def __call__(self, observations: Observations) -> Tensor:
        """Map the observations of all seeds to outputs (R, *output_shape)."""
        parts = observations.split(len(observations) // len(self.networks))
        seeds = zip(self.networks, self.weights.unbind(), parts, strict=True)
        return torch.cat([self._apply(network, row, part) for network, row, part in seeds])

    def _apply(self, network: Network, row: Tensor, observations: Observations) -> Tensor:
        """Apply one network with the weights in `row`; gradients flow back to the weight matrix."""
        if not torch.is_grad_enabled():
            return cast(Tensor, network(observations))
        parts = zip(self._names, self._shapes, row.split_with_sizes(self._sizes), strict=False)
        weights = {name: part.view(shape) for name, shape, part in parts}
        return cast(Tensor, functional_call(network, weights, (observations,)))


class StackedMLP(Model):
    """Fully connected networks on vectors, computed with one batched matrix product per layer."""

    bulk_gain = 2.0

    @staticmethod
    def fits(network: Network) -> bool:
        """Return whether a network consists of linear layers and ReLU only.

        Layers with a single input or output are excluded on the CPU, because matrix-vector products
        round differently for one seed than for several.
        """
        kinds = (Network, nn.ModuleList, nn.Sequential, nn.Linear, nn.ReLU)
        plain = len(network.stems) == 1 and all(isinstance(m, kinds) for m in network.modules())
        matrices = [weights for weights in network.parameters() if weights.ndim == 2]
        return plain and all(one.is_cuda or min(one.shape) > 1 for one in matrices)

    def __call__(self, observations: Observations) -> Tensor:
        """Map the observations of all seeds to outputs (R, *output_shape)."""
        # Store observations as columns (K, width, B). Autograd's weight gradients, dy x^T, then
        # have the layout of the weights and need no transposition.
        seeds = len(self.networks)
        columns = observations.vector.view(seeds, -1, observations.vector.shape[1]).mT
        count = columns.shape[2]
        if count == 1:
            # Add a second column, because matrix-vector products round differently for one seed
            # than for several.
            columns = columns.expand(-1, -1, 2)
        parts = self.weights.split_with_sizes(self._sizes, 1)[:-1]
        last = len(parts) // 2 - 1
        for layer, (matrix, bias) in enumerate(zip(parts[::2], parts[1::2], strict=True)):
            matrices = matrix.view(seeds, *self._shapes[2 * layer])
            columns = torch.baddbmm(bias.unsqueeze(2), matrices, columns)
            columns = columns if layer == last else columns.relu_()
        return columns[:, :, :count].mT.reshape(-1, *self.networks[0].output_shape)


def build_model(networks: Sequence[Network]) -> Model:
    """Return the fastest model for networks of one shape."""
    return StackedMLP(networks) if StackedMLP.fits(networks[0]) else AnyModel(networks)


class TargetNetwork:
    """Copy of a model in training. The copy is updated at intervals.

    Between two updates, the outputs do not change. Therefore, the outputs for the whole dataset are
    computed once after each update and then looked up, unless a forward pass for each batch is
    faster.

    Attributes:
        model: K target networks.
    """

    def __init__(
        self, model: Model, buffer: TransitionBuffer, rows_per_sync: int, *, next_states: bool
    ) -> None:
        """Copy `model`, to evaluate the states or next states of a buffer.

        `rows_per_sync` is the approximate number of rows per seed between two calls of `sync`.
        """
        self.model = model.clone()
        self._buffer = buffer
        self._next_states = next_states
        # On a GPU, a CUDA graph contains the forward pass, which takes hardly any time there.
        fixed = buffer.is_fixed and buffer.device.type == "cpu"
        self._use_table = fixed and len(buffer) <= rows_per_sync * model.bulk_gain
        self._table: Tensor | None = None
        seeds = torch.arange(len(model.weights), device=buffer.device)
        self._offsets = seeds.unsqueeze(1) * len(buffer)

    @torch.no_grad()
    def sync(self, model: Model) -> None:
        """Copy the weights of `model`."""
        self.model.weights.copy_(model.weights)
        self.reset()

    def reset(self) -> None:
        """Drop the computed outputs. Call this method after each change of the weights."""
        self._table = None

    @torch.no_grad()
    def outputs(self, batch: Batch) -> Tensor:
        """Return the outputs (R, ...) for the states or next states of a batch.

        No gradients are computed.
        """
        if not self._use_table:
            return self.model(batch.next_observations if self._next_states else batch.observations)
        if self._table is None:
            self._table = outputs_of_buffer(self.model, self._buffer, next_states=self._next_states)
        rows = batch.rows.view(len(self._offsets), -1) + self._offsets
        return self._table.index_select(0, rows.flatten())


@torch.no_grad()
def outputs_of_buffer(model: Model, buffer: TransitionBuffer, *, next_states: bool) -> Tensor:
    """Return the outputs (K * N, ...) of K networks for the N states or next states of a buffer."""
    seeds, parts = len(model.weights), []
    for places in torch.split(buffer.places[int(next_states)], _ROWS_AT_ONCE):
        outputs = model(buffer.observe(places.repeat(seeds)))
        parts.append(outputs.view(seeds, len(places), *outputs.shape[1:]))
    return torch.cat(parts, 1).flatten(0, 1)
