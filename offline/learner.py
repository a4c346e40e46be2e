"""What all algorithms share: networks, their optimiser, the samplers, and their state."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mcaprl.offline.buffer import Batch, TransitionBuffer
from mcaprl.offline.config import TrainingConfig
from mcaprl.offline.losses import allowed_only
from mcaprl.offline.models import Model, build_model
from mcaprl.offline.networks import Network
from mcaprl.offline.observations import Observations

ActsBy = Literal["q_values", "logits", "filtered_q_values"]
"""What a trained policy takes the best action of: see `policy`."""
_MOMENTS = ("exp_avg", "exp_avg_sq")


class Losses(NamedTuple):
    """What one batch of R transitions says.

    Attributes:
        terms: (R,) each, by name, to be logged; `loss`, the last, is what is minimised.
        slopes: by model, the derivative of `loss` with respect to its outputs.
    """

    terms: dict[str, Tensor]
    slopes: dict[str, Tensor]


class NotFiniteError(ArithmeticError):
    """A term of the loss is NaN or infinite."""


class Learner(ABC):
    """One algorithm at work on one data set with K seeds; a subclass says what its losses are.

    Everything random comes from the seeds: the same seed, data and machine give the same weights,
    whichever seeds learn beside it.

    Attributes:
        name: of the algorithm, as a user writes it.
        config_type: the dataclass of its settings.
        acts_by: which outputs the policy acts by.
        policy_models: names of the models that the policy needs.
        seeds: K of them.
        models: K networks each, by name.
        step: updates done.
    """

    name: ClassVar[str]
    config_type: ClassVar[type[TrainingConfig]]
    acts_by: ClassVar[ActsBy]
    policy_models: ClassVar[tuple[str, ...]]
    config: TrainingConfig

    def __init__(
        self, config: TrainingConfig, buffer: TransitionBuffer, seeds: Sequence[int]
    ) -> None:
        """Start with random weights."""
        assert isinstance(config, self.config_type)
        self.config = config
        self.buffer = buffer
        self.seeds = tuple(seeds)
        self.step = 0
        self.n_actions = int(buffer.action_space.n)
        states = [np.random.SeedSequence(seed).generate_state(2, np.uint32) for seed in seeds]
        self.samplers = [torch.Generator().manual_seed(int(second)) for _, second in states]
        networks = [self._random_networks(int(first)) for first, _ in states]
        self.models: dict[str, Model] = {
            name: build_model([mine[name] for mine in networks]) for name in networks[0]
        }
        self._weights = [model.weights for model in self.models.values()]
        self.optimizer = torch.optim.AdamW(
            self._weights, weight_decay=config.weight_decay, fused=True
        )
        for weights in self._weights:
            moments = {name: torch.zeros_like(weights) for name in _MOMENTS}
            self.optimizer.state[weights] = {"step": torch.tensor(0.0), **moments}

    @abstractmethod
    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """The outputs of each model for one observation, such as (A,)."""

    @abstractmethod
    def losses(self, batch: Batch) -> Losses:
        """The terms and slopes of a batch, whose rows count alike."""

    def judge(self, batch: Batch) -> dict[str, Tensor]:
        """What tells how well a batch is predicted that was not learned from: (R,) each, by name.

        Learners of values give `q`, that of the logged action, and `td_error`, how far it is from
        its target.
        """
        return self.losses(batch).terms

    def update(self) -> dict[str, Tensor]:
        """Make one gradient step on one random batch for each seed.

        Returns:
            The terms of `losses`.

        Raises:
            NotFiniteError: the loss is NaN or infinite; the weights are as before.
        """
        size = self.config.batch_size
        rows = [self.buffer.sample_rows(size, sampler) for sampler in self.samplers]
        terms, slopes = self.losses(self.buffer.batch(torch.cat(rows)))
        if not math.isfinite(terms["loss"].sum().item()):
            raise NotFiniteError(self._first_bad(terms))
        for name, slope in slopes.items():
            self.models[name].backward(slope.div_(size))
        self.optimizer.param_groups[0]["lr"] = self.config.learning_rate_at(self.step)
        self.optimizer.step()
        self.step += 1
        return terms

    def seed_means(self, terms: Mapping[str, Tensor]) -> list[dict[str, float]]:
        """The means of (R,) terms over each seed's own rows."""
        means = {
            name: term.view(len(self.seeds), -1).mean(1).tolist() for name, term in terms.items()
        }
        return [{name: means[name][k] for name in means} for k in range(len(self.seeds))]

    def learn(self, name: str, observations: Observations) -> Tensor:
        """A model's outputs for observations that it is to learn from."""
        return allowed_only(self.models[name].learn_from(observations), observations.mask)

    def outputs(self, name: str, observations: Observations) -> Tensor:
        """A model's outputs."""
        return allowed_only(self.models[name](observations), observations.mask)

    def everything(self) -> dict[str, Model]:
        """Every model with weights of its own, by name; not only those that learn."""
        return dict(self.models)

    def network(self, name: str, seed: int) -> Network:
        """One seed's network, with its present weights."""
        return self.models[name].networks[self.seeds.index(seed)]

    def state(self, seed: int) -> dict[str, Tensor]:
        """All that a seed's next update depends on, save `step`: weights, optimiser, generator."""
        k = self.seeds.index(seed)
        tensors = {f"{name}.weights": model.weights[k] for name, model in self.everything().items()}
        for name, model in self.models.items():
            moments = self.optimizer.state[model.weights]
            tensors |= {f"{name}.{moment}": moments[moment][k] for moment in _MOMENTS}
        tensors["generator.sampler"] = self.samplers[k].get_state()
        return tensors

    def load_state(self, seed: int, tensors: Mapping[str, Tensor], step: int) -> None:
        """Go back to what `state` returned after `step` updates; all seeds to the same step.

        Raises:
            KeyError: a tensor is missing.
            RuntimeError: a tensor has another shape.
        """
        k = self.seeds.index(seed)
        for name, model in self.everything().items():
            _copy(model.weights[k], tensors[f"{name}.weights"])
        for name, model in self.models.items():
            moments = self.optimizer.state[model.weights]
            moments["step"].fill_(step)
            for moment in _MOMENTS:
                _copy(moments[moment][k], tensors[f"{name}.{moment}"])
        self.samplers[k].set_state(tensors["generator.sampler"])
        self.step = step

    def _random_networks(self, seed: int) -> dict[str, Network]:
        buffer, architecture = self.buffer, self.config.architecture
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return {
                name: Network(buffer.vector_width, buffer.image_shapes, shape, architecture)
                for name, shape in self.output_shapes().items()
            }

    def _first_bad(self, terms: Mapping[str, Tensor]) -> str:
        """Name the first bad term; the loss is last and bad whenever one of its parts is."""
        for seed, means in zip(self.seeds, self.seed_means(terms), strict=True):
            for name, value in means.items():
                if not math.isfinite(value):
                    return f"{name} of seed {seed} is {value}"
        return "the sum of the losses is beyond float32"


def _copy(into: Tensor, tensor: Tensor) -> None:
    """Copy a tensor of the same shape; one that would broadcast is none."""
    if into.shape != tensor.shape:
        raise RuntimeError(f"a tensor has shape {tuple(tensor.shape)}, not {tuple(into.shape)}")
    into.copy_(tensor)
