"""What all algorithms share: a network, its optimiser, the sampler, and their state."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn

from mcaprl.offline.buffer import Batch, TransitionBuffer
from mcaprl.offline.config import TrainingConfig
from mcaprl.offline.networks import build_network

Outputs = Literal["q_values", "logits"]
"""What a network's outputs mean."""


class NotFiniteError(ArithmeticError):
    """A term of the loss is NaN or infinite."""


class Learner(ABC):
    """One algorithm at work on one data set; a subclass says what its loss is.

    Everything random comes from `seed`: the same seed, data and machine give the same weights.

    Attributes:
        name: of the algorithm, as a user writes it.
        config_type: the dataclass of its settings.
        outputs: what the network's outputs mean.
        step: updates done.
    """

    name: ClassVar[str]
    config_type: ClassVar[type[TrainingConfig]]
    outputs: ClassVar[Outputs]
    config: TrainingConfig

    def __init__(self, config: TrainingConfig, buffer: TransitionBuffer, seed: int) -> None:
        """Start with random weights. This seeds torch's global generator too."""
        assert isinstance(config, self.config_type)
        weights_seed, sampler_seed = np.random.SeedSequence(seed).generate_state(2, np.uint32)
        torch.manual_seed(int(weights_seed))
        self.config = config
        self.buffer = buffer
        self.step = 0
        self.sampler = torch.Generator().manual_seed(int(sampler_seed))
        n_actions = int(buffer.action_space.n)
        self.network = build_network(buffer.observation_space, n_actions, config.hidden)
        self.optimizer = torch.optim.Adam(self.network.parameters(), fused=True)

    @abstractmethod
    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """The terms to log, scalars by name; `loss`, the last, is the one to minimise."""

    def update(self) -> dict[str, Tensor]:
        """Make one gradient step on one random batch.

        Returns:
            The terms of `losses`.

        Raises:
            NotFiniteError: the loss is NaN or infinite; the weights are as before.
        """
        terms = self.losses(self.buffer.sample(self.config.batch_size, self.sampler))
        _check_finite(terms)
        self.optimizer.param_groups[0]["lr"] = self.config.learning_rate_at(self.step)
        self.optimizer.zero_grad()
        torch.autograd.backward(terms["loss"])
        self.optimizer.step()
        self.step += 1
        return terms

    def networks(self) -> dict[str, nn.Module]:
        """Every network with weights of its own, by name."""
        return {"network": self.network}

    def state(self) -> dict[str, Tensor]:
        """All that the next update depends on, save `step`: weights, optimiser, generators."""
        tensors = {
            f"{name}.{key}": value
            for name, network in self.networks().items()
            for key, value in network.state_dict().items()
        }
        for index, moments in self.optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{index}.{key}": value for key, value in moments.items()}
        tensors["generator.sampler"] = self.sampler.get_state()
        tensors["generator.torch"] = torch.get_rng_state()
        return tensors

    def load_state(self, tensors: Mapping[str, Tensor], step: int) -> None:
        """Go back to what `state` returned after `step` updates.

        Raises:
            KeyError: a tensor is missing.
            RuntimeError: a tensor has another shape.
        """
        for name, network in self.networks().items():
            network.load_state_dict(_below(tensors, name))
        moments: dict[int, dict[str, Tensor]] = {}
        for name, value in _below(tensors, "optimizer").items():
            index, key = name.split(".")
            moments.setdefault(int(index), {})[key] = value
        groups = self.optimizer.state_dict()["param_groups"]
        self.optimizer.load_state_dict({"state": moments, "param_groups": groups})
        self.sampler.set_state(tensors["generator.sampler"])
        torch.set_rng_state(tensors["generator.torch"])
        self.step = step


def _below(tensors: Mapping[str, Tensor], name: str) -> dict[str, Tensor]:
    prefix = f"{name}."
    return {key.removeprefix(prefix): t for key, t in tensors.items() if key.startswith(prefix)}


def _check_finite(terms: Mapping[str, Tensor]) -> None:
    """Name the first bad term; the loss is last and bad whenever one of its parts is."""
    if not math.isfinite(terms["loss"].item()):
        bad = next(name for name, term in terms.items() if not math.isfinite(term.item()))
        raise NotFiniteError(f"{bad} is {terms[bad].item()}")
