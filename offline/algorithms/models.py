"""K networks of one shape, one for each seed, that learn side by side.

Their weights are the rows of one matrix (K, P), and so are their gradients: the optimiser, the copy
into a target and a checkpoint each deal with one tensor. Batches hold the rows of all seeds, those
of the first seed first: R = K * B rows.

Nothing here asks what a loss is. A loss hands back its slope, its derivative with respect to the
outputs; `backward` takes it from there.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from mcaprl.offline.algorithms.networks import Network
from mcaprl.offline.batches.observations import Observations

_ALIGNMENT = 16
"""Floats in a vector register: rows of this length get the same arithmetic whatever K is."""


class Model(ABC):
    """K networks whose weights and gradients are matrices.

    Attributes:
        networks: the K networks; their parameters are views of `weights`.
        weights: (K, P).
        gradients: (K, P), set by `backward`.
        bulk_gain: how many times less a row takes among a thousand than in a small batch.
    """

    bulk_gain: ClassVar[float] = 1.0

    def __init__(self, networks: Sequence[Network]) -> None:
        """Gather the networks' weights; they must be of one shape."""
        self.networks = list(networks)
        length = sum(parameter.numel() for parameter in networks[0].parameters())
        padded = -(-length // _ALIGNMENT) * _ALIGNMENT
        device = next(networks[0].parameters()).device
        self.weights = torch.zeros(len(networks), padded, device=device)
        self.gradients = torch.zeros_like(self.weights)
        self.weights.grad = self.gradients
        for row, network in zip(self.weights, networks, strict=True):
            start = 0
            for parameter in network.parameters():
                stop = start + parameter.numel()
                row[start:stop] = parameter.detach().flatten()
                parameter.data = row[start:stop].view_as(parameter)
                start = stop

    @abstractmethod
    def __call__(self, observations: Observations) -> Tensor:
        """The outputs (R, *output_shape), with nothing remembered."""

    @abstractmethod
    def learn_from(self, observations: Observations) -> Tensor:
        """The outputs (R, *output_shape); remembers what `backward` needs."""

    def learn_beside(
        self, observations: Observations, others: Observations
    ) -> tuple[Tensor, Tensor]:
        """As `learn_from`, and the outputs for others, as many, which nothing is learned from."""
        return self.learn_from(observations), self(others)

    @abstractmethod
    def backward(self, slope: Tensor) -> None:
        """Set `gradients` from d loss / d outputs (R, *output_shape) of the last `learn_from`."""

    def clone(self) -> Model:
        """Another model with the same weights."""
        return type(self)([copy.deepcopy(network) for network in self.networks])


class AnyModel(Model):
    """Networks of any kind, one after the other, by automatic differentiation."""

    @torch.no_grad()
    def __call__(self, observations: Observations) -> Tensor:
        """The outputs, with nothing remembered."""
        return self._forward(observations)

    def learn_from(self, observations: Observations) -> Tensor:
        """The outputs, detached; the graph stays here."""
        with torch.enable_grad():
            self._outputs = self._forward(observations)
        return self._outputs.detach()

    def backward(self, slope: Tensor) -> None:
        """Let autograd go on from the outputs."""
        counts = [len(list(network.parameters())) for network in self.networks]
        parameters = [p for network in self.networks for p in network.parameters()]
        found = iter(torch.autograd.grad(self._outputs, parameters, slope))
        for row, count in zip(self.gradients, counts, strict=True):
            flat = [next(found).flatten() for _ in range(count)]
            torch.cat(flat, out=row[: sum(map(len, flat))])

    def _forward(self, observations: Observations) -> Tensor:
        parts = observations.split(len(observations) // len(self.networks))
        return torch.cat([net(part) for net, part in zip(self.networks, parts, strict=True)])


class StackedMLP(Model):
    """Plain fully connected networks on vectors, all seeds in one matrix product for each layer.

    The backward pass is written out: a third of the time of a small update is autograd's
    bookkeeping, which none of these tensors asks for. Results are those of `AnyModel`, against
    which the tests hold it.
    """

    bulk_gain = 2.0

    def __init__(self, networks: Sequence[Network]) -> None:
        """Stack networks for which `fits` is true."""
        super().__init__(networks)
        self._output_shape = networks[0].output_shape
        self._layers = _layer_views(networks[0], self.weights)
        self._slopes = _layer_views(networks[0], self.gradients)
        self._inputs: list[Tensor] = []

    @staticmethod
    def fits(network: Network) -> bool:
        """Whether a network has nothing but linear layers and ReLU.

        Layers with a single input or output are left to others: a product with a vector is
        computed in another way for one seed than for several, and ends in other bits.
        """
        kinds = (Network, nn.ModuleList, nn.Sequential, nn.Linear, nn.ReLU)
        plain = len(network.stems) == 1 and all(isinstance(m, kinds) for m in network.modules())
        return plain and all(min(p.shape) > 1 for p in network.parameters() if p.ndim == 2)

    def __call__(self, observations: Observations) -> Tensor:
        """The outputs, with nothing remembered."""
        return self._forward(self._by_seed(observations))[-1].view(-1, *self._output_shape)

    def learn_from(self, observations: Observations) -> Tensor:
        """The outputs; remembers what went into each layer."""
        *self._inputs, outputs = self._forward(self._by_seed(observations))
        return outputs.view(-1, *self._output_shape)

    def learn_beside(
        self, observations: Observations, others: Observations
    ) -> tuple[Tensor, Tensor]:
        """One pass for both: twice the rows take less than twice the time."""
        rows = torch.cat([self._by_seed(observations), self._by_seed(others)], 1)
        half = rows.shape[1] // 2
        *inputs, outputs = self._forward(rows)
        self._inputs = [values[:, :half] for values in inputs]
        mine, theirs = outputs[:, :half], outputs[:, half:]
        shape = self._output_shape
        return mine.reshape(-1, *shape), theirs.reshape(-1, *shape)

    def backward(self, slope: Tensor) -> None:
        """The chain rule, layer by layer: y = x W^T + b, so dW = dy^T x, db = sum dy, dx = dy W."""
        slope = slope.reshape(len(self.weights), -1, self._layers[-1][0].shape[1])
        for index in reversed(range(len(self._layers))):
            inputs = self._inputs[index]
            matrix, bias = self._slopes[index]
            torch.bmm(slope.mT, inputs, out=matrix)
            torch.sum(slope, 1, keepdim=True, out=bias)
            if index > 0:
                # ReLU lets through what was above 0.
                slope = torch.bmm(slope, self._layers[index][0]).mul_(inputs > 0)

    def _by_seed(self, observations: Observations) -> Tensor:
        """(K, B, V)."""
        return observations.vector.view(len(self.weights), -1, observations.vector.shape[1])

    def _forward(self, rows: Tensor) -> list[Tensor]:
        """What goes into each layer (K, B, width), and what comes out of the last."""
        values = [rows]
        last = len(self._layers) - 1
        for index, (matrix, bias) in enumerate(self._layers):
            outputs = torch.baddbmm(bias, values[-1], matrix.mT)
            values.append(outputs if index == last else outputs.relu_())
        return values


def build_model(networks: Sequence[Network]) -> Model:
    """The fastest model for networks of one shape."""
    return StackedMLP(networks) if StackedMLP.fits(networks[0]) else AnyModel(networks)


def _layer_views(network: Network, flat: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Matrix (K, outputs, inputs) and bias (K, 1, outputs) of each linear layer."""
    views, start = [], 0
    for layer in network.modules():
        if isinstance(layer, nn.Linear):
            middle = start + layer.weight.numel()
            stop = middle + layer.out_features
            matrix = flat[:, start:middle].view(-1, *layer.weight.shape)
            views.append((matrix, flat[:, middle:stop].unsqueeze(1)))
            start = stop
    return views
