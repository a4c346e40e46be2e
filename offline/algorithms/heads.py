"""Heads: the policy that the outputs of networks define.

    q_values            argmax_a Q(s, a)                                      dqn, double-dqn, cql
    logits              pi(a|s) = softmax(logits)                             bc, iql
    filtered_q_values   argmax_a Q(s, a) of actions likely under the logits   bcq
    deterministic       tanh(output), in a Box                                td3-bc, rebrac, bc
    gaussian            normal distribution, truncated to a Box               iql, bc
    mixture             mixture of such distributions                         bc
    squashed_gaussian   tanh of a normal distribution, scaled to a Box        sac

The last four heads act by the mode of the distribution, or of its most likely component; after a
tanh, by that of the mean. Inside, actions are numbers in [-1, 1]. A normal distribution that is
truncated to this interval has a finite density at the bounds, where sticks and pilots often are.
After a tanh, the density there would be infinite: it is that of an action slightly inside.

A policy uses the members of `Head` alone, so a head for another kind of action space is a class
here and an entry in `HEADS`.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, Final, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mcaprl.actions import BoxActions
from mcaprl.errors import PolicyError
from mcaprl.offline.algorithms.losses import (
    allowed_only,
    likely_actions,
    mean_values,
    squashed_normal_log_density,
    truncated_normal_log_density,
    truncated_normal_probability,
)
from mcaprl.offline.batches.buffer import discrete_actions
from mcaprl.offline.batches.observations import Observations
from mcaprl.offline.batches.relative import RelativeActions


class Head(nn.Module):
    """Networks and the policy that they define, for B observations."""

    def __init__(self, networks: Mapping[str, nn.Module], chunk: int = 1) -> None:
        """Wrap the networks."""
        super().__init__()
        # Number of actions H that are predicted from one observation. With more than one, only
        # `actions` and `scores` are defined.
        # Networks by name, such as `q` and `logits`.
        self.networks, self.chunk = nn.ModuleDict(networks), chunk

    @abstractmethod
    def actions(self, observations: Observations) -> Tensor:
        """Return the best actions (B, *shape) of the space; with chunks (B, H, *shape)."""

    @abstractmethod
    def log_prob(self, observations: Observations, actions: NDArray[Any]) -> Tensor:
        """Return the log probabilities, or log densities, (B,) of actions (B, *shape)."""

    def scores(self, observations: Observations) -> Tensor | None:
        """Return a score of each action (B, A), the largest of the best; None without numbers."""

    def q_values(self, observations: Observations) -> Tensor | None:
        """Return the values (B, A) of all actions; None if the networks have no such output."""

    def probabilities(self, observations: Observations) -> Tensor | None:
        """Return the probabilities (B, A) of all actions; None if they are not finite in number."""

    def action_values(self, observations: Observations, actions: NDArray[Any]) -> Tensor | None:
        """Return the values (B,) of actions (B, *shape); None without a network of values."""


class DiscreteHead(Head):
    """Head for a finite action space."""

    _values: Tensor

    def __init__(
        self,
        networks: Mapping[str, nn.Module],
        action_space: spaces.Space[Any],
        threshold: float = 0.0,
        chunk: int = 1,
    ) -> None:
        """Wrap the networks; `threshold` is that of `FilteredQ`."""
        super().__init__(networks, chunk)
        # Numbering of the actions: the order of the axis A.
        self.joint = discrete_actions(action_space)
        self.threshold = threshold
        values = torch.from_numpy(self.joint.values(np.arange(self.joint.count)))
        self.register_buffer("_values", values, persistent=False)

    @abstractmethod
    def scores(self, observations: Observations) -> Tensor:
        """Return action scores (B, A), or (B, H, A) of chunks; minus infinity if masked."""

    def outputs(self, name: str, observations: Observations) -> Tensor:
        """Return a network's outputs (B, A), with minus infinity for masked actions."""
        outputs = mean_values(self.networks[name](observations))
        return allowed_only(outputs, observations.mask)

    def actions(self, observations: Observations) -> Tensor:
        """Return the actions with the largest score; a tie selects the first one."""
        return self.best(self.scores(observations))

    def best(self, scores: Tensor) -> Tensor:
        """Return the actions (B, *shape) with the largest scores (B, A), or of chunks (B, H, A)."""
        best = scores.argmax(-1)
        return self._values.index_select(0, best.flatten()).view(*best.shape, *self.joint.shape)

    def log_prob(self, observations: Observations, actions: NDArray[Any]) -> Tensor:
        """Return the log probabilities (B,) of actions (B, *shape)."""
        numbers = torch.from_numpy(self.joint.indexes(actions)).unsqueeze(1)
        return self.log_probabilities(observations).gather(1, numbers).squeeze(1)

    def q_values(self, observations: Observations) -> Tensor | None:
        """Return the values (B, A) of all actions; None without a network of values."""
        return self.outputs("q", observations) if "q" in self.networks else None

    def action_values(self, observations: Observations, actions: NDArray[Any]) -> Tensor | None:
        """Return the values (B,) of actions (B, *shape); None without a network of values."""
        values = self.q_values(observations)
        if values is None:
            return None
        numbers = torch.from_numpy(self.joint.indexes(actions)).unsqueeze(1)
        return values.gather(1, numbers).squeeze(1)

    def probabilities(self, observations: Observations) -> Tensor:
        """Return the probabilities (B, A) of all actions: 0 or 1 if the head is greedy."""
        scores = self.scores(observations)
        return nn.functional.one_hot(scores.argmax(1), scores.shape[1]).float()

    def log_probabilities(self, observations: Observations) -> Tensor:
        """Return the logarithms (B, A) of the probabilities."""
        return self.probabilities(observations).log()


class Categorical(DiscreteHead):
    """Probabilities as the softmax of logits."""

    def scores(self, observations: Observations) -> Tensor:
        """Return the logits (B, A), or (B, H, A) of chunks."""
        if self.chunk > 1:
            return cast(Tensor, self.networks["logits"](observations))
        return self.outputs("logits", observations)

    def probabilities(self, observations: Observations) -> Tensor:
        """Return the softmax (B, A) of the logits."""
        return self.scores(observations).softmax(1)

    def log_probabilities(self, observations: Observations) -> Tensor:
        """Return the logarithms (B, A) of the softmax."""
        return self.scores(observations).log_softmax(1)


class GreedyQ(DiscreteHead):
    """Action with the largest value."""

    def scores(self, observations: Observations) -> Tensor:
        """Return the values (B, A)."""
        return self.outputs("q", observations)


class FilteredQ(DiscreteHead):
    """Action with the largest value of those that the logits rate as likely."""

    def scores(self, observations: Observations) -> Tensor:
        """Return the values (B, A), with minus infinity for unlikely actions."""
        likely = likely_actions(self.outputs("logits", observations), self.threshold)
        return allowed_only(self.outputs("q", observations), likely)


class BoxHead(Head):
    """Head for the actions of a Box, from the outputs of the network `actor`."""

    # If there is a network `encoder`, the others receive its features in place of images.

    # (n,) logarithms of the standard deviations, if they are the same in all states.
    log_std: Tensor | None
    _low: Tensor
    _high: Tensor

    def __init__(
        self,
        networks: Mapping[str, nn.Module],
        box: BoxActions,
        log_std: Tensor | None = None,
        chunk: int = 1,
        relative: RelativeActions | None = None,
    ) -> None:
        """Wrap the networks."""
        super().__init__(networks, chunk)
        # Scaling of actions to [-1, 1], and conversion of numbers relative to the observations.
        self.box, self.relative = box, relative
        self.register_buffer("log_std", log_std)
        # In float64, so that the bounds are the same numbers as in the space.
        self.register_buffer("_low", torch.from_numpy(box.low), persistent=False)
        self.register_buffer("_high", torch.from_numpy(box.high), persistent=False)

    @staticmethod
    @abstractmethod
    def output_shape(size: int) -> tuple[int, ...]:
        """Return the shape of the outputs for actions of n numbers."""

    @staticmethod
    @abstractmethod
    def best(outputs: Tensor) -> Tensor:
        """Return the best actions (B, n), in [-1, 1]."""

    @staticmethod
    def log_density(
        outputs: Tensor, actions: Tensor, log_std: Tensor | None = None, known: Tensor | None = None
    ) -> Tensor:
        """Return log densities (B,) of actions (B, n), of the numbers with a 1 in `known`."""
        raise PolicyError("a deterministic policy has no density of actions")

    def actions(self, observations: Observations) -> Tensor:
        """Return the best actions (B, *shape) in the space's units; with chunks (B, H, *shape)."""
        numbers = self.best(self._outputs(observations)).double()
        numbers = numbers.view(-1, self.chunk, self.box.size)
        if self.relative is not None:
            numbers = self.relative.actions(numbers, observations.vector)
        values = self._low + (numbers + 1) / 2 * (self._high - self._low)
        dtype = getattr(torch, str(self.box.space.dtype))
        chunk = (self.chunk,) if self.chunk > 1 else ()
        return values.clamp(self._low, self._high).to(dtype).view(-1, *chunk, *self.box.shape)

    def log_prob(self, observations: Observations, actions: NDArray[Any]) -> Tensor:
        """Return the log densities (B,) of actions (B, *shape), in their own units."""
        if self.relative is not None:
            raise PolicyError("actions that are relative to observations have no density")
        outputs = self._outputs(observations)
        numbers = torch.from_numpy(self.box.scaled(actions)).clamp(-1, 1)
        log_density = self.log_density(outputs, numbers, self.log_std) + self.box.log_scale
        inside = torch.from_numpy(self.box.contain(actions))
        return log_density.masked_fill(~inside, -torch.inf)

    def action_values(self, observations: Observations, actions: NDArray[Any]) -> Tensor | None:
        """Return the values (B,) of actions (B, *shape); None without a network of values."""
        if "q" not in self.networks:
            return None
        numbers = torch.from_numpy(self.box.scaled(actions))
        found: Tensor = self.networks["q"](self._inputs(observations).with_actions(numbers))
        return found.squeeze(1)

    def _outputs(self, observations: Observations) -> Tensor:
        return cast(Tensor, self.networks["actor"](self._inputs(observations)))

    def _inputs(self, observations: Observations) -> Observations:
        if ENCODER not in self.networks:
            return observations
        return encoded(self.networks[ENCODER], observations)


class Deterministic(BoxHead):
    """One action per state, as the tanh of the outputs (B, n)."""

    @staticmethod
    def output_shape(size: int) -> tuple[int, ...]:
        """Return the shape of the outputs for actions of n numbers."""
        return (size,)

    @staticmethod
    def best(outputs: Tensor) -> Tensor:
        """Return the actions (B, n)."""
        return outputs.tanh()


class Gaussian(BoxHead):
    """Independent normal distributions, truncated to the Box: outputs are means and deviations."""

    # Outputs (B, n) are means before a tanh; (B, 2, n) have the logarithms of deviations that
    # depend on the state, too.

    @staticmethod
    def output_shape(size: int) -> tuple[int, ...]:
        """Return the shape of the outputs for actions of n numbers, with deviations."""
        return (2, size)

    @staticmethod
    def best(outputs: Tensor) -> Tensor:
        """Return the modes (B, n), which are the means before the truncation."""
        return (outputs if outputs.ndim == 2 else outputs[:, 0]).tanh()

    @staticmethod
    def log_density(
        outputs: Tensor, actions: Tensor, log_std: Tensor | None = None, known: Tensor | None = None
    ) -> Tensor:
        """Return the log densities (B,) of actions (B, n) in [-1, 1]."""
        raw = outputs[:, 1] if log_std is None else log_std
        mean, log_std = Gaussian.best(outputs), bounded_log_std(raw)
        return known_sum(truncated_normal_log_density(actions, mean, log_std), known)


class SquashedGaussian(Gaussian):
    """Tanh of independent normal distributions; outputs (B, 2, n) are means and deviations."""

    @staticmethod
    def log_density(
        outputs: Tensor, actions: Tensor, log_std: Tensor | None = None, known: Tensor | None = None
    ) -> Tensor:
        """Return the log densities (B,) of actions (B, n) in [-1, 1]."""
        mean, raw = outputs.unbind(1)
        found = squashed_normal_log_density(unsquashed(actions), mean, bounded_log_std(raw))
        return known_sum(found, known)

    @staticmethod
    def sample(outputs: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions (B, n) from normal noise, and their log densities, with gradients."""
        mean, raw = outputs.unbind(1)
        log_std = bounded_log_std(raw)
        pre = torch.addcmul(mean, log_std.exp(), noise)
        return pre.tanh(), squashed_normal_log_density(pre, mean, log_std).sum(1)


class Mixture(BoxHead):
    """Mixture of `COMPONENTS` truncated normals, for demonstrations with several ways."""

    # Outputs (B, C * (1 + 2 n)) are C logits, means before a tanh, and logarithms of deviations.
    # The action is the mode of the component with the largest weight.

    @staticmethod
    def output_shape(size: int) -> tuple[int, ...]:
        """Return the shape of the outputs for actions of n numbers."""
        return (COMPONENTS * (1 + 2 * size),)

    @staticmethod
    def best(outputs: Tensor) -> Tensor:
        """Return the modes (B, n) of the components with the largest weights."""
        means = Mixture._components(outputs)[:, :, 0]
        largest = outputs[:, :COMPONENTS].argmax(1)
        places = largest[:, None, None].expand(-1, 1, means.shape[2])
        return means.gather(1, places).squeeze(1).tanh()

    @staticmethod
    def log_density(
        outputs: Tensor, actions: Tensor, log_std: Tensor | None = None, known: Tensor | None = None
    ) -> Tensor:
        """Return the log densities (B,) of actions (B, n) in [-1, 1]."""
        mean, raw = Mixture._components(outputs).unbind(2)
        log_densities = truncated_normal_log_density(
            actions.unsqueeze(1), mean.tanh(), bounded_log_std(raw)
        )
        log_weights = outputs[:, :COMPONENTS].log_softmax(1)
        mask = None if known is None else known.unsqueeze(1)
        return (log_weights + known_sum(log_densities, mask)).logsumexp(1)

    @staticmethod
    def pit(outputs: Tensor, actions: Tensor, uniform_share: float = 0.0) -> Tensor:
        """Return the probability (B, n) of a smaller number than that of actions (B, n).

        The probability of each number is given those before it, so that the results of actions of
        this distribution are independent and uniform. See Rosenblatt, "Remarks on a multivariate
        transformation", 1952. With a share, the uniform distribution is one more component.
        """
        mean, raw = Mixture._components(outputs).unbind(2)
        mean, log_std = mean.tanh(), bounded_log_std(raw)
        numbers = actions.unsqueeze(1)
        below = truncated_normal_probability(numbers, mean, log_std)
        log_densities = truncated_normal_log_density(numbers, mean, log_std)
        below = torch.cat([below, (numbers + 1) / 2], 1)
        uniform = torch.full_like(log_densities[:, :1], -math.log(2))
        log_densities = torch.cat([log_densities, uniform], 1)
        # The weights of the components, given the numbers before each number.
        earlier = log_densities.cumsum(2) - log_densities
        shares = outputs.new_tensor([1 - uniform_share] * COMPONENTS + [uniform_share]).log()
        own = functional.pad(outputs[:, :COMPONENTS].log_softmax(1), (0, 1))
        log_weights = (own + shares).unsqueeze(2)
        return ((log_weights + earlier).softmax(1) * below).sum(1)

    @staticmethod
    def _components(outputs: Tensor) -> Tensor:
        """Return the means and deviations (B, C, 2, n) before they are bounded."""
        size = (outputs.shape[1] // COMPONENTS - 1) // 2
        return outputs[:, COMPONENTS:].reshape(-1, COMPONENTS, 2, size)


ENCODER: Final = "encoder"
"""Name of the network that maps the images of all other networks to features."""
FEATURES: Final = 64  # Number of these features


def encoded(encoder: Callable[[Observations], Tensor], observations: Observations) -> Observations:
    """Return observations with the normalized outputs of an encoder in place of images."""
    outputs = encoder(observations)
    features = functional.layer_norm(outputs, outputs.shape[1:]).tanh()
    return Observations(torch.cat((features, observations.vector), 1), (), observations.mask)


COMPONENTS: Final = 5  # Number of components of a mixture
_LOG_STD_CENTER, _LOG_STD_HALF = -2.0, 3.0
_LARGEST: Final = 1 - 1e-6
"""Largest action of which a tanh has a density; larger ones have the same."""


def known_sum(log_densities: Tensor, known: Tensor | None) -> Tensor:
    """Return the sums (...,) of log densities (..., n), or of those that are known."""
    return (log_densities if known is None else log_densities * known).sum(-1)


def bounded_log_std(raw: Tensor) -> Tensor:
    """Return log standard deviations from -5 to 1, and -2 for raw numbers of 0."""
    return _LOG_STD_CENTER + _LOG_STD_HALF * (raw / _LOG_STD_HALF).tanh()


def unsquashed(actions: Tensor) -> Tensor:
    """Return the numbers whose tanh are actions, which are moved slightly inside at the bounds."""
    return actions.clamp(-_LARGEST, _LARGEST).atanh()


BOX_HEADS: Final[dict[str, type[BoxHead]]] = {
    "deterministic": Deterministic,
    "gaussian": Gaussian,
    "mixture": Mixture,
    "squashed_gaussian": SquashedGaussian,
}
"""Heads for the actions of a Box."""
HEADS: Final[dict[str, type[DiscreteHead]]] = {
    "q_values": GreedyQ,
    "logits": Categorical,
    "filtered_q_values": FilteredQ,
}
"""Heads by the value of `Learner.acts_by`, which policy files contain."""


def build_head(
    acts_by: str,
    networks: Mapping[str, nn.Module],
    action_space: spaces.Space[Any],
    threshold: float = 0.0,
    *,
    box: BoxActions | None = None,
    log_std: Tensor | None = None,
    chunk: int = 1,
    relative: RelativeActions | None = None,
) -> Head:
    """Return the head of a policy file or learner, by `Learner.acts_by`."""
    if box is not None and acts_by in BOX_HEADS:
        return BOX_HEADS[acts_by](networks, box, log_std, chunk, relative)
    if acts_by not in HEADS or (chunk > 1 and acts_by != "logits"):
        raise ValueError(f"acts_by {acts_by!r} is not supported")
    return HEADS[acts_by](networks, action_space, threshold, chunk)
