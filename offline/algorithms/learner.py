"""What all algorithms share: networks, their optimiser, the samplers, and their state."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mcaprl.offline.algorithms.captured import StaticUpdate
from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.algorithms.losses import allowed_only
from mcaprl.offline.algorithms.models import Model, build_model
from mcaprl.offline.algorithms.networks import Network
from mcaprl.offline.algorithms.optimizer import MOMENTS, AdamW
from mcaprl.offline.algorithms.target import HardTarget
from mcaprl.offline.batches.buffer import Batch, TransitionBuffer
from mcaprl.offline.batches.observations import Observations

ActsBy = Literal["q_values", "logits", "filtered_q_values"]
"""What a trained policy takes the best action of: see `policy`."""


class Losses(NamedTuple):
    """What one batch of R transitions says.

    Attributes:
        terms: (R,) each, by name, to be logged; `loss`, the last, is what is minimised.
        slopes: by model, the derivative of `loss` with respect to its outputs.
    """

    terms: dict[str, Tensor]
    slopes: dict[str, Tensor]


class NotFiniteError(ArithmeticError):
    """A term of the loss is NaN or infinite.

    Attributes:
        update: number of the update, from 1, that met it.
    """

    def __init__(self, message: str, update: int) -> None:
        """Say which term, and when."""
        super().__init__(message)
        self.update = update


class Learner(ABC):
    """One algorithm at work on one data set with K seeds; a subclass says what its losses are.

    Everything random comes from the seeds: the same seed, data and machine give the same weights,
    whichever seeds learn beside it. Networks live where the buffer is; on a GPU an update is one
    CUDA graph (see `captured`), and a loss that is not finite is told by `check` alone.

    Attributes:
        name: of the algorithm, as a user writes it.
        config_type: the dataclass of its settings.
        acts_by: which outputs the policy acts by.
        policy_models: names of the models that the policy needs.
        seeds: K of them.
        models: K networks each, by name.
        copies: targets of some of them, which stand still between two synchronisations, by name.
        step: updates done.
        static_update: makes the updates where nothing may wait for the device; None on a CPU.
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
        self.copies: dict[str, HardTarget] = {}
        self._sync_interval = 0
        weights = [model.weights for model in self.models.values()]
        self.optimizer = AdamW(weights, config.learning_rate, config.weight_decay)
        on_gpu = buffer.device.type == "cuda"
        self.static_update: StaticUpdate | None = StaticUpdate(self) if on_gpu else None

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

        Copies of the weights into targets are made behind it when they are due.

        Returns:
            The terms of `losses`.

        Raises:
            NotFiniteError: the loss is NaN or infinite; the weights are as before.
        """
        size = self.config.batch_size
        rows = torch.cat([self.buffer.sample_rows(size, sampler) for sampler in self.samplers])
        for target in self.copies.values():
            target.prepare()
        if self.static_update is not None:
            terms = self.static_update(rows, self.config.learning_rate_at(self.step))
        else:
            terms = self.find_gradients(rows)
            if not math.isfinite(terms["loss"].sum().item()):
                raise self.not_finite(self.seed_means(terms), self.step + 1)
            self.optimizer.learning_rate = self.config.learning_rate_at(self.step)
            self.optimizer.step()
        self.step += 1
        if self.copies and self.step % self._sync_interval == 0:
            for name, target in self.copies.items():
                target.sync(self.models[name])
        return terms

    def find_gradients(self, rows: Tensor) -> dict[str, Tensor]:
        """Set the gradients of all models from a batch, given by its rows (R,); gives the terms."""
        terms, slopes = self.losses(self.buffer.batch(rows))
        for name, slope in slopes.items():
            self.models[name].backward(slope.div_(self.config.batch_size))
        return terms

    def check(self) -> None:
        """Tell if a loss was not finite since the last call, where `update` did not wait to see.

        Raises:
            NotFiniteError: it was; the weights are of no use.
        """
        if self.static_update is not None:
            self.static_update.check()

    def add_target(self, name: str, interval: int, *, next_states: bool = True) -> HardTarget:
        """Give a model a target, which gets its weights now and every `interval` updates.

        Args:
            name: of the model.
            interval: the same for all targets.
            next_states: whether it is asked for values of the next states, or of the states.
        """
        rows = self.config.batch_size * interval
        self._sync_interval = interval
        self.copies[name] = HardTarget(
            self.models[name], self.buffer, rows, next_states=next_states
        )
        return self.copies[name]

    def seed_means(self, terms: Mapping[str, Tensor]) -> list[dict[str, float]]:
        """The means of (R,) terms over each seed's own rows."""
        means = {
            name: term.view(len(self.seeds), -1).mean(1).tolist() for name, term in terms.items()
        }
        return [{name: means[name][k] for name in means} for k in range(len(self.seeds))]

    def learn(self, name: str, observations: Observations) -> Tensor:
        """A model's outputs for observations that it is to learn from."""
        return allowed_only(self.models[name].learn_from(observations), observations.mask)

    def learn_with_next(self, name: str, batch: Batch) -> tuple[Tensor, Tensor]:
        """As `learn` for a batch's observations, and `outputs` for its next observations."""
        here, there = batch.observations, batch.next_observations
        outputs, next_outputs = self.models[name].learn_beside(here, there)
        return allowed_only(outputs, here.mask), allowed_only(next_outputs, there.mask)

    def outputs(self, name: str, observations: Observations) -> Tensor:
        """A model's outputs."""
        return allowed_only(self.models[name](observations), observations.mask)

    def everything(self) -> dict[str, Model]:
        """Every model with weights of its own, by name: those that learn, and the targets."""
        targets = {f"{name}_target": target.model for name, target in self.copies.items()}
        return {**self.models, **targets}

    def network(self, name: str, seed: int) -> Network:
        """One seed's network, with its present weights."""
        return self.models[name].networks[self.seeds.index(seed)]

    def changed_by_updates(self) -> list[Tensor]:
        """The tensors on the device that an update changes, synchronisations aside."""
        weights = [model.weights for model in self.models.values()]
        moments = [tensor for mine in self.optimizer.moments for tensor in mine.values()]
        return [*weights, *self.optimizer.steps, *moments]

    def state(self, seed: int) -> dict[str, Tensor]:
        """All that a seed's next update depends on, save `step`: weights, optimiser, generator."""
        k = self.seeds.index(seed)
        tensors = {f"{name}.weights": model.weights[k] for name, model in self.everything().items()}
        for name, moments in zip(self.models, self.optimizer.moments, strict=True):
            tensors |= {f"{name}.{moment}": moments[moment][k] for moment in MOMENTS}
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
        for steps in self.optimizer.steps:
            steps.fill_(step)
        for name, moments in zip(self.models, self.optimizer.moments, strict=True):
            for moment in MOMENTS:
                _copy(moments[moment][k], tensors[f"{name}.{moment}"])
        for target in self.copies.values():
            target.forget()
        self.samplers[k].set_state(tensors["generator.sampler"])
        self.step = step

    def _random_networks(self, seed: int) -> dict[str, Network]:
        buffer, architecture = self.buffer, self.config.architecture
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return {
                name: Network(buffer.vector_width, buffer.image_inputs, shape, architecture).to(
                    buffer.device
                )
                for name, shape in self.output_shapes().items()
            }

    def not_finite(self, seed_means: Sequence[Mapping[str, float]], update: int) -> NotFiniteError:
        """Name the first bad term; the loss is last and bad whenever one of its parts is."""
        for seed, means in zip(self.seeds, seed_means, strict=True):
            for name, value in means.items():
                if not math.isfinite(value):
                    return NotFiniteError(f"{name} of seed {seed} is {value}", update)
        return NotFiniteError("the sum of the losses is beyond float32", update)


def _copy(into: Tensor, tensor: Tensor) -> None:
    """Copy a tensor of the same shape; one that would broadcast is none."""
    if into.shape != tensor.shape:
        raise RuntimeError(f"a tensor has shape {tuple(tensor.shape)}, not {tuple(into.shape)}")
    into.copy_(tensor)
