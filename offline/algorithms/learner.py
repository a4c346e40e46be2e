"""Base class of all algorithms: networks, optimizer, samplers, and their state.

On a GPU, the kernels of an update are launched by two calls, as CUDA graphs. Launching the kernels
of a small network one by one takes several times as long as they run.
"""

from __future__ import annotations

import gc
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from mcaprl.architecture import Architecture
from mcaprl.networks import ImageInput, Network
from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.algorithms.losses import allowed_only
from mcaprl.offline.algorithms.models import ALIGNMENT, Model, TargetNetwork, build_model
from mcaprl.offline.batches.buffer import Batch, TransitionBuffer
from mcaprl.offline.batches.observations import Observations

Terms = dict[str, Tensor]
_WARM_UPS = 3


class CapturedUpdate:
    """An update of fixed shape that was recorded once and is replayed with other rows."""

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
            self.terms = gradients(self._rows)  # Terms of the loss; each replay overwrites them
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


N_CRITICS = 2  # Number of networks of a critic: the twins of TD3
_MOMENTS = ("exp_avg", "exp_avg_sq")
_STEPS = "steps"


class NotFiniteError(ArithmeticError):
    """A term of the loss is NaN or infinite."""

    def __init__(self, message: str, update: int) -> None:
        """Store the message and the number of the update."""
        super().__init__(message)
        self.update = update  # Number of the update that computed the term, from 1


class Learner(ABC):
    """Training of K seeds on one dataset; a subclass defines the networks and losses.

    All randomness comes from the seeds. The same seed, data and machine produce the same weights,
    no matter which other seeds are trained in parallel. Networks are on the device of the buffer.

    Attributes:
        name: Name of the algorithm in commands and in `mcaprl.train`.
        config_type: Dataclass of the algorithm's settings.
        acts_by: Key of `heads.HEADS`: how the policy selects actions.
        policy_models: Names of the models that the policy needs.
        continuous: Whether actions are those of a Box instead of a finite space.
        critics: Names of the models that are ensembles of `N_CRITICS` networks Q(s, a), with an
            action as an additional input.
        can_be_captured: Whether `losses` can be part of a CUDA graph: tensors have shapes that do
            not depend on values, and no value is read by the CPU.
        seeds: K seeds.
        models: Models by name; each contains K networks.
        target_networks: Target networks by the name of the model that they copy.
        scalars: Learned numbers by name, one per seed; see `add_scalar`.
        step: Number of finished updates.
        learning_rate_at: Function from the number of finished updates to the learning rate.
        max_grad_norm: Largest norm of the gradient of each seed's networks.
    """

    name: ClassVar[str]
    config_type: ClassVar[type[TrainingConfig]]
    acts_by: str
    policy_models: ClassVar[tuple[str, ...]]
    continuous: ClassVar[bool] = False
    critics: ClassVar[tuple[str, ...]] = ()
    can_be_captured: ClassVar[bool] = False
    config: TrainingConfig

    def __init__(
        self, config: TrainingConfig, buffer: TransitionBuffer, seeds: Sequence[int]
    ) -> None:
        """Initialize the networks with random weights."""
        assert isinstance(config, self.config_type)
        self.config = config
        self.buffer = buffer
        self.seeds = tuple(seeds)
        self.step = 0
        self.learning_rate_at: Callable[[int], float] = config.learning_rate_at
        self.max_grad_norm = math.inf
        self.n_actions = buffer.n_actions
        channels = [image.shape[2] for image in buffer.encoder.image_inputs]
        self.architecture = config.architecture_for(channels)
        states = [np.random.SeedSequence(seed).generate_state(2, np.uint32) for seed in seeds]
        self.samplers = [torch.Generator().manual_seed(int(second)) for _, second in states]
        networks = [self._random_networks(int(first)) for first, _ in states]
        self.models: dict[str, Model] = {
            name: build_model([each for mine in networks for each in mine[name]], len(members))
            for name, members in networks[0].items()
        }
        self.target_networks: dict[str, TargetNetwork] = {}
        self._sync_interval = 0
        weights = [model.weights for model in self.models.values()]
        self.scalars: dict[str, nn.Parameter] = {}
        groups = [{"params": weights, "rate_factor": 1.0, "weight_decay": config.weight_decay}]
        on_gpu = buffer.device.type == "cuda"
        self.optimizer = torch.optim.AdamW(
            groups, lr=self._new_rate(), fused=True, capturable=on_gpu
        )
        self._reset_moments(weights)
        # Kernels of images take longer than their launches.
        vectors = not buffer.encoder.image_inputs
        self._is_captured = on_gpu and vectors and self.can_be_captured
        self._captured: CapturedUpdate | None = None

    @abstractmethod
    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the output shape of each model for one observation, such as (A,)."""

    @abstractmethod
    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the terms (R,) to log, by name. The last term, `loss`, is minimized.

        `loss` is backpropagated to every weight that it depends on, so compute targets under
        `torch.no_grad()`.
        """

    def inputs(self, observations: Observations) -> Observations:
        """Return what the networks receive; default: the observations themselves."""
        return observations

    def encoded(self, batch: Batch) -> Batch:
        """Return a batch of the buffer with the `inputs` of the networks, for `losses`."""
        return batch

    def validate(self, batch: Batch) -> dict[str, Tensor]:
        """Return metrics (R,) of a held-out batch, by name.

        Algorithms with Q-values return two metrics in units of the logged rewards: `q`, the value
        of the logged action, and `td_error`, the absolute difference between `q` and the target.
        """
        return self.losses(batch)

    def update(self) -> dict[str, Tensor]:
        """Run one gradient step on one random batch per seed.

        Update target networks if this is due.

        Returns:
            The terms of `losses`, detached. On a GPU, the next update overwrites them.

        Raises:
            NotFiniteError: The loss is NaN or infinite; the weights have not changed.
        """
        buffer = self.buffer
        rows = buffer.draw(self.config.batch_size, self.samplers)
        if self._is_captured and self._captured is None:
            self._captured = CapturedUpdate(self._gradients, self.optimizer, rows)
        if self._captured is None:
            terms = self._gradients(rows.to(buffer.device))
        else:
            terms = self._captured.gradients(rows)
        if not math.isfinite(terms["loss"].sum().item()):
            raise self._not_finite(self.seed_means(terms))
        for group in self.optimizer.param_groups:
            rate = self.learning_rate_at(self.step) * group["rate_factor"]
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate
        if self._captured is None:
            self.optimizer.step()
        else:
            self._captured.step()
        self.step += 1
        if self.target_networks and self.step % self._sync_interval == 0:
            self.sync_targets()
        return terms

    def sync_targets(self) -> None:
        """Copy the weights of all models to their target networks."""
        for name, target in self.target_networks.items():
            target.sync(self.models[name])

    @torch.no_grad()
    def load_targets(self) -> None:
        """Copy the weights of all models to their target networks, even those that are averages."""
        for name, target in self.target_networks.items():
            target.model.weights.copy_(self.models[name].weights)
            target.reset()

    def _gradients(self, rows: Tensor) -> dict[str, Tensor]:
        """Compute the gradients of all weights for rows (R,); return the detached terms."""
        terms = self.losses(self.encoded(self.buffer.batch(rows)))
        self.optimizer.zero_grad()
        # A seed's loss depends only on that seed's weights, so one sum yields all gradients.
        torch.autograd.backward(terms["loss"].sum() / (len(rows) // len(self.seeds)))
        if self.max_grad_norm < math.inf:
            self._clip_gradients()
        return {name: term.detach() for name, term in terms.items()}

    @torch.no_grad()
    def _clip_gradients(self) -> None:
        """Scale the gradients of each seed's networks down to the largest norm."""
        found = [model.weights.grad for model in self.models.values()]
        gradients = [gradient for gradient in found if gradient is not None]
        norms = [torch.linalg.vector_norm(gradient, dim=1) for gradient in gradients]
        norm = norms[0] if len(norms) == 1 else torch.linalg.vector_norm(torch.stack(norms), dim=0)
        factors = (self.max_grad_norm / (norm + 1e-6)).clamp_(max=1.0).unsqueeze(1)
        for gradient in gradients:
            gradient.mul_(factors)

    def add_target_network(
        self, name: str, interval: int, *, next_states: bool = True, polyak: float = 1.0
    ) -> TargetNetwork:
        """Add a target network, synced with a model now and every `interval` updates.

        Args:
            name: Name of the model.
            interval: Number of updates between two syncs, the same for all target networks.
            next_states: Whether the target network evaluates next states instead of states.
            polyak: Weight of the model in a sync, in which the rest is the earlier target network.
        """
        # An average changes too often for a table, and an ensemble also depends on actions.
        has_table = polyak == 1 and name not in self.critics
        rows = self.config.batch_size * interval if has_table else 0
        self._sync_interval = interval
        self.target_networks[name] = TargetNetwork(
            self.models[name], self.buffer, rows, next_states=next_states, polyak=polyak
        )
        return self.target_networks[name]

    def add_scalar(
        self, name: str, start: float, rate_factor: float, size: int = 1
    ) -> nn.Parameter:
        """Add numbers that each seed learns by its own Adam, such as a Lagrange multiplier.

        The numbers are saved in checkpoints. Weight decay does not apply to them. A loss reads them
        with `scalar_rows`.

        Args:
            name: Name in `scalars` and in checkpoints.
            start: Value before the first update.
            rate_factor: Learning rate, as a multiple of the learning rate of the networks.
            size: Number of numbers of each seed.

        Returns:
            The numbers as (K, P); only the first `size` columns are used, see `models`.
        """
        width = size + -size % ALIGNMENT
        scalar = nn.Parameter(
            torch.full((len(self.seeds), width), start, device=self.buffer.device)
        )
        group = {
            "params": [scalar],
            "lr": self._new_rate(),
            "rate_factor": rate_factor,
            "weight_decay": 0.0,
        }
        self.optimizer.add_param_group(group)
        self._reset_moments([scalar])
        self.scalars[name] = scalar
        return scalar

    def set_rate_factor(self, name: str, factor: float) -> None:
        """Set the learning rate of a model as a multiple of the others'; call it once for each."""
        weights = self.models[name].weights
        shared = self.optimizer.param_groups[0]
        shared["params"] = [each for each in shared["params"] if each is not weights]
        self.optimizer.add_param_group(
            {**shared, "params": [weights], "lr": self._new_rate(), "rate_factor": factor}
        )

    def scalar_rows(self, name: str, batch: Batch, size: int | None = None) -> Tensor:
        """Return a learned number of `add_scalar` for each row of a batch, (R,) or (R, size)."""
        rows = len(batch.actions) // len(self.seeds)
        found = self.scalars[name][:, None, : size or 1].expand(-1, rows, -1).flatten(0, 1)
        return found.squeeze(1) if size is None else found

    def noise(self, scale: float) -> Tensor:
        """Draw normal noise (R, n) for the actions of a batch, from the generators of the seeds."""
        shape = (self.config.batch_size, self.n_actions)
        draws = [torch.randn(shape, generator=one) for one in self.samplers]
        return torch.cat(draws).mul_(scale).to(self.buffer.device)

    def is_due(self, interval: int) -> bool:
        """Return whether the current update is the last one of `interval` updates.

        Parts of the loss that are due less often, such as that of a delayed actor, are left out of
        other updates. Weights without a gradient stay the same.
        """
        return (self.step + 1) % interval == 0

    @property
    def is_reported(self) -> bool:
        """Whether the terms of the current update are written to the metrics."""
        config, last = self.config, self.step + 1 == self.config.updates
        return last or self.is_due(config.log_interval) or self.is_due(config.checkpoint_interval)

    def seed_means(self, terms: Mapping[str, Tensor]) -> list[dict[str, float]]:
        """Return the mean of each term for each seed.

        Each term (R,) contains the rows of all seeds.
        """
        means = {name: self.batch_means(term).tolist() for name, term in terms.items()}
        return [{name: means[name][k] for name in means} for k in range(len(self.seeds))]

    def batch_means(self, values: Tensor) -> Tensor:
        """Return each seed's mean (K,) of values (R,)."""
        return values.view(len(self.seeds), -1).mean(1)

    def divided(self, values: Tensor, divisors: Tensor) -> Tensor:
        """Divide the values (R,) of each seed by the seed's divisor (K,)."""
        return (values.view(len(self.seeds), -1) / divisors.unsqueeze(1)).flatten()

    def outputs(self, name: str, observations: Observations) -> Tensor:
        """Return a model's outputs, with minus infinity for actions that are not allowed."""
        return allowed_only(self.models[name](observations), observations.mask)

    def in_reward_units(self, values: Tensor) -> Tensor:
        """Convert values (R,) from a batch's scaled rewards to units of the logged rewards."""
        return values * self.buffer.reward_scale

    def all_models(self) -> dict[str, Model]:
        """Return the learning models and the target networks by name."""
        targets = {f"{name}_target": target.model for name, target in self.target_networks.items()}
        return {**self.models, **targets}

    def network(self, name: str, seed: int, member: int = 0) -> Network:
        """Return one seed's network, or one of its ensemble, with its current weights."""
        model = self.models[name]
        return model.networks[self.seeds.index(seed) * model.members + member]

    def policy_networks(self, seed: int) -> dict[str, Network]:
        """Return the networks of one seed that its policy needs, with their current weights."""
        return {name: self.network(name, seed) for name in self.policy_models}

    def architecture_of(self, name: str) -> Architecture:
        """Return the architecture of a model's networks; default: the same one for all models."""
        return self.architecture

    def state(self, seed: int) -> dict[str, Tensor]:
        """Return the state of the training of one seed, without `step`.

        The state consists of the weights and learned numbers, the moments of the optimizer, and the
        state of the random generator.
        """
        k = self.seeds.index(seed)
        tensors = {
            f"{name}.weights": weights.detach()[k] for name, weights in self._weights().items()
        }
        for name, weights in self._learned().items():
            moments = self.optimizer.state[weights]
            tensors |= {f"{name}.{moment}": moments[moment][k] for moment in _MOMENTS}
            if int(moments["step"]) != self.step:
                tensors[f"{name}.{_STEPS}"] = moments["step"]
        tensors["generator.sampler"] = self.samplers[k].get_state()
        return tensors

    @torch.no_grad()
    def load_state(self, seed: int, tensors: Mapping[str, Tensor], step: int) -> None:
        """Restore the tensors that `state` returned, and the number of finished updates.

        All seeds share this number, so `step` must be the same in the calls for all seeds.

        Raises:
            KeyError: A tensor is missing.
            RuntimeError: A tensor has another shape.
        """
        k = self.seeds.index(seed)
        for name, weights in self._weights().items():
            _copy(weights[k], tensors[f"{name}.weights"])
        for name, weights in self._learned().items():
            state = self.optimizer.state[weights]
            # Weights that had no gradient in some updates have their own number of steps.
            state["step"].copy_(tensors.get(f"{name}.{_STEPS}", torch.tensor(float(step))))
            for moment in _MOMENTS:
                _copy(state[moment][k], tensors[f"{name}.{moment}"])
        for target in self.target_networks.values():
            target.reset()
        self.samplers[k].set_state(tensors["generator.sampler"])
        self.step = step

    def _new_rate(self) -> Tensor | float:
        """Return a learning rate, which each update sets; CUDA graphs read it from a tensor."""
        device = self.buffer.device
        return torch.zeros((), device=device) if device.type == "cuda" else 0.0

    def _learned(self) -> dict[str, nn.Parameter]:
        """Return everything that the optimizer changes, (K, P) by name."""
        return {name: model.weights for name, model in self.models.items()} | self.scalars

    def _weights(self) -> dict[str, nn.Parameter]:
        """Return the weights (K, P) of all models, and the learned numbers, by name."""
        return {name: model.weights for name, model in self.all_models().items()} | self.scalars

    def _reset_moments(self, parameters: Sequence[nn.Parameter]) -> None:
        """Create the optimizer state, so that a checkpoint can be loaded before the first step."""
        for tensor in parameters:
            moments = {name: torch.zeros_like(tensor) for name in _MOMENTS}
            step = torch.tensor(0.0, device=tensor.device)
            self.optimizer.state[tensor] = {"step": step, **moments}

    def _random_networks(self, seed: int) -> dict[str, list[Network]]:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return {
                name: [self._random_network(name, shape) for _ in range(self._members(name))]
                for name, shape in self.output_shapes().items()
            }

    def _members(self, name: str) -> int:
        return N_CRITICS if name in self.critics else 1

    def _random_network(self, name: str, shape: tuple[int, ...]) -> Network:
        width, images = self.inputs_of(name)
        network = Network(width, images, shape, self.architecture_of(name))
        return network.to(self.buffer.device)

    def inputs_of(self, name: str) -> tuple[int, Sequence[ImageInput]]:
        """Return the length of the vectors and the images that a model receives."""
        buffer = self.buffer
        actions = self.n_actions if name in self.critics else 0
        return buffer.vector_width + actions, buffer.image_inputs

    def _not_finite(self, seed_means: Sequence[Mapping[str, float]]) -> NotFiniteError:
        """Return an error that names the first term of `losses` that is not finite."""
        for seed, means in zip(self.seeds, seed_means, strict=True):
            for name, value in means.items():
                if not math.isfinite(value):
                    return NotFiniteError(f"{name} of seed {seed} is {value}", self.step + 1)
        return NotFiniteError("the sum of the losses overflows float32", self.step + 1)


def _copy(into: Tensor, tensor: Tensor) -> None:
    """Copy a tensor of the same shape, without broadcasting."""
    if into.shape != tensor.shape:
        raise RuntimeError(f"a tensor has shape {tuple(tensor.shape)}, not {tuple(into.shape)}")
    into.copy_(tensor)
