"""K networks of the same shape, one per seed, trained in parallel, and their target networks.

The P weights of each network are a row of one matrix (K, P), which is a leaf tensor of autograd.
Therefore, the optimizer, the target network and a checkpoint each handle one tensor. Batches
contain the rows of all seeds, ordered by seed: R = K * B rows.

An ensemble has E networks for each seed, whose weights are successive parts of the seed's row.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, cast

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn import functional

from mcaprl.networks import Network
from mcaprl.offline.batches.buffer import Batch, TransitionBuffer
from mcaprl.offline.batches.observations import Observations

ALIGNMENT = 16
"""Number of floats in a vector register.

Rows of weights, and the batches of stacked networks, are padded to a multiple of this number, so
that the results of a seed do not depend on the number of seeds K.
"""
_ROWS_AT_ONCE = 1024
_NORM_EPSILON = 1e-5


class Model(ABC):
    """K networks whose weights are rows of one matrix, which is a leaf tensor of autograd."""

    # Time per row in a small batch, divided by the time per row in a batch of a thousand rows.
    bulk_gain: ClassVar[float] = 1.0

    def __init__(self, networks: Sequence[Network], members: int = 1) -> None:
        """Move the weights of networks of one shape into one matrix."""
        # K networks, or K * E networks of ensembles, ordered by seed; their parameters share memory
        # with `weights`.
        self.networks = list(networks)
        # Number of networks E of an ensemble; 1 if there is one network per seed.
        self.members = members
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
        # (K, P), one row of weights per seed.
        self.weights = nn.Parameter(weights.view(-1, members * weights.shape[1]))

    def __call__(
        self, observations: Observations, *, frozen: bool = False, members: int | None = None
    ) -> Tensor:
        """Map observations of all seeds to outputs (R, *output_shape), or (E, R) of ensembles."""
        # `frozen` stops gradients at the weights; `members` evaluates only these of an ensemble.
        weights = self.weights.detach() if frozen else self.weights
        if self.members == 1:
            return self._outputs(observations, weights, 1)
        count = members or self.members
        used = weights.view(len(weights), self.members, -1)[:, :count]
        found = self._outputs(observations, used.flatten(0, 1), count)
        # The rows are ordered by seed, then by network.
        by_member = found.view(len(weights), count, -1).transpose(0, 1)
        return by_member.reshape(count, len(observations))

    @abstractmethod
    def _outputs(self, observations: Observations, weights: Tensor, members: int) -> Tensor:
        """Return the outputs of networks with weights (K * members, P), ordered by network."""

    def clone(self) -> Model:
        """Return another model with the same weights."""
        return type(self)([copy.deepcopy(network) for network in self.networks], self.members)


class AnyModel(Model):
    """Networks of any kind, evaluated one after the other."""

    def _outputs(self, observations: Observations, weights: Tensor, members: int) -> Tensor:
        seeds = len(weights) // members
        parts = observations.split(len(observations) // seeds)
        outputs = []
        for number, row in enumerate(weights.unbind()):
            seed, member = divmod(number, members)
            network = self.networks[seed * self.members + member]
            outputs.append(self._apply(network, row, parts[seed]))
        return torch.cat(outputs)

    def _apply(self, network: Network, row: Tensor, observations: Observations) -> Tensor:
        """Apply one network with the weights in `row`; gradients flow back to the weight matrix."""
        if not torch.is_grad_enabled():
            # The parameters of the network share memory with the row.
            return cast(Tensor, network(observations))
        parts = zip(self._names, self._shapes, row.split_with_sizes(self._sizes), strict=False)
        weights = {name: part.view(shape) for name, shape, part in parts}
        return cast(Tensor, functional_call(network, weights, (observations,)))


class StackedMLP(Model):
    """Fully connected networks on vectors, computed with one batched matrix product per layer."""

    bulk_gain = 2.0

    def __init__(self, networks: Sequence[Network], members: int = 1) -> None:
        """Move the weights of networks of one shape into one matrix."""
        super().__init__(networks, members)
        self._is_normed = any(isinstance(m, nn.LayerNorm) for m in networks[0].modules())

    @staticmethod
    def fits(network: Network) -> bool:
        """Return whether a network consists of linear layers, layer normalization and ReLU only."""
        # On the CPU, layers with a single input or output are excluded, because matrix-vector
        # products round differently for one seed than for several.
        kinds = (Network, nn.ModuleList, nn.Sequential, nn.Linear, nn.LayerNorm, nn.ReLU)
        plain = len(network.stems) == 1 and all(isinstance(m, kinds) for m in network.modules())
        matrices = [weights for weights in network.parameters() if weights.ndim == 2]
        return plain and all(one.is_cuda or one.shape[1] > 1 for one in matrices)

    def _outputs(self, observations: Observations, weights: Tensor, members: int) -> Tensor:
        # Store observations as columns (C, width, B) of C networks. Autograd's weight gradients,
        # dy x^T, then have the layout of the weights and need no transposition.
        count, seeds = len(weights), len(weights) // members
        columns = observations.vector.view(seeds, -1, observations.vector.shape[1]).mT
        if members > 1:
            columns = columns.unsqueeze(1).expand(-1, members, -1, -1).flatten(0, 1)
        # With columns that do not fill registers, or with another layout, products round
        # differently for one seed than for several.
        rows = columns.shape[2]
        columns = functional.pad(columns, (0, -rows % ALIGNMENT)).contiguous()
        sizes_and_shapes = zip(weights.split_with_sizes(self._sizes, 1), self._shapes, strict=False)
        parts = [part.view(count, *shape) for part, shape in sizes_and_shapes]
        step = 4 if self._is_normed else 2
        for matrix, bias, *norm in (parts[k : k + step] for k in range(0, len(parts) - 2, step)):
            columns = torch.baddbmm(bias.unsqueeze(2), matrix, columns)
            if norm:
                columns = _normalized(columns, *norm)
            columns = columns.relu_()
        matrix, bias = parts[-2:]
        outputs = matrix.shape[1]
        if outputs == 1:
            # Matrix-vector products round differently for one network than for several.
            matrix = matrix.expand(-1, 2, -1)
        columns = torch.baddbmm(bias.unsqueeze(2), matrix, columns)
        shape = self.networks[0].output_shape
        # The copy gives the gradient the same layout for one seed as for several.
        return columns[:, :outputs, :rows].mT.contiguous().view(-1, *shape)


class _ColumnNorm(torch.autograd.Function):
    """Layer normalization of columns: `torch.nn.functional.layer_norm` would have to copy them."""

    @staticmethod
    def forward(ctx: Any, columns: Tensor) -> Tensor:
        """Normalize columns (C, width, B) to mean 0 and variance 1 over the width."""
        centered = columns - columns.mean(1, keepdim=True)
        scale = (centered.square().mean(1, keepdim=True) + _NORM_EPSILON).rsqrt_()
        normal = centered.mul_(scale)
        ctx.save_for_backward(normal, scale)
        return normal

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        """Return the gradient of the columns."""
        normal, scale = ctx.saved_tensors
        along = (gradient * normal).mean(1, keepdim=True)
        result = torch.addcmul(gradient, normal, along, value=-1)
        return result.sub_(gradient.mean(1, keepdim=True)).mul_(scale)


def _normalized(columns: Tensor, gain: Tensor, shift: Tensor) -> Tensor:
    """Normalize columns (C, width, B), and apply gains and shifts (C, width)."""
    normal: Tensor = _ColumnNorm.apply(columns)  # type: ignore[no-untyped-call]
    return torch.addcmul(shift.unsqueeze(2), gain.unsqueeze(2), normal)


def build_model(networks: Sequence[Network], members: int = 1) -> Model:
    """Return the fastest model for networks of one shape; those of ensembles are (E,) per seed."""
    kind = StackedMLP if StackedMLP.fits(networks[0]) else AnyModel
    return kind(networks, members)


class TargetNetwork:
    """Copy of a model in training. At intervals, the copy is updated, or moved toward the model."""

    # Outputs do not change between updates: those of all data are computed once and looked up,
    # unless a pass for each batch is faster.

    def __init__(
        self,
        model: Model,
        buffer: TransitionBuffer,
        rows_per_sync: int,
        *,
        next_states: bool,
        polyak: float = 1.0,
    ) -> None:
        """Copy `model`, for a buffer's states or next states; `rows_per_sync` are per seed."""
        self.model = model.clone()
        self.polyak = polyak  # Weight of the learning network in an update; 1 copies it
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
        """Copy the weights of `model`, or average them with a weight of `polyak`."""
        if self.polyak == 1:
            self.model.weights.copy_(model.weights)
        else:
            self.model.weights.lerp_(model.weights, self.polyak)
        self.reset()

    def reset(self) -> None:
        """Drop the computed outputs. Call this method after each change of the weights."""
        self._table = None

    @torch.no_grad()
    def outputs(self, batch: Batch) -> Tensor:
        """Return outputs (R, ...) for the states or next states of a batch, without gradients."""
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
