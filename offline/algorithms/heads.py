"""Heads: the policy that the outputs of networks define.

    q_values            argmax_a Q(s, a)                                      dqn, double-dqn, cql
    logits              pi(a|s) = softmax(logits)                             bc, iql
    filtered_q_values   argmax_a Q(s, a) of actions likely under the logits   bcq

A policy uses the members of `Head` alone, so a head for another kind of action space is a class
here and an entry in `HEADS`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor, nn

from mcaprl.offline.algorithms.losses import allowed_only, likely_actions, mean_values
from mcaprl.offline.batches.buffer import discrete_actions
from mcaprl.offline.batches.observations import Observations


class Head(nn.Module):
    """Networks and the policy that they define, for B observations.

    Attributes:
        networks: Networks by name, such as `q` and `logits`.
    """

    def __init__(self, networks: Mapping[str, nn.Module]) -> None:
        """Wrap the networks."""
        super().__init__()
        self.networks = nn.ModuleDict(networks)

    @abstractmethod
    def actions(self, observations: Observations) -> Tensor:
        """Return the best actions (B, *shape), as values of the action space."""

    @abstractmethod
    def log_prob(self, observations: Observations, actions: NDArray[Any]) -> Tensor:
        """Return the log probabilities, or log densities, (B,) of actions (B, *shape)."""

    def scores(self, observations: Observations) -> Tensor | None:
        """Return a score of each action (B, A), the largest of the best; None without numbers."""

    def q_values(self, observations: Observations) -> Tensor | None:
        """Return the values (B, A) of all actions; None if the networks have no such output."""

    def probabilities(self, observations: Observations) -> Tensor | None:
        """Return the probabilities (B, A) of all actions; None if they are not finite in number."""


class DiscreteHead(Head):
    """Head for a finite action space.

    Attributes:
        joint: Numbering of the actions: the order of the axis A.
    """

    _values: Tensor

    def __init__(
        self,
        networks: Mapping[str, nn.Module],
        action_space: spaces.Space[Any],
        threshold: float = 0.0,
    ) -> None:
        """Wrap the networks; `threshold` is that of `FilteredQ`.

        Raises:
            SpaceError: The action space is not finite, or has too many actions.
        """
        super().__init__(networks)
        self.joint = discrete_actions(action_space)
        self.threshold = threshold
        values = torch.from_numpy(self.joint.values(np.arange(self.joint.count)))
        self.register_buffer("_values", values, persistent=False)

    @abstractmethod
    def scores(self, observations: Observations) -> Tensor:
        """Return a score of each action (B, A); minus infinity for masked actions."""

    def outputs(self, name: str, observations: Observations) -> Tensor:
        """Return a network's outputs (B, A), with minus infinity for masked actions."""
        outputs = mean_values(self.networks[name](observations))
        return allowed_only(outputs, observations.mask)

    def actions(self, observations: Observations) -> Tensor:
        """Return the actions with the largest score; a tie selects the first one."""
        return self.best(self.scores(observations))

    def best(self, scores: Tensor) -> Tensor:
        """Return the actions (B, *shape) with the largest scores (B, A)."""
        return self._values.index_select(0, scores.argmax(1))

    def log_prob(self, observations: Observations, actions: NDArray[Any]) -> Tensor:
        """Return the log probabilities (B,) of actions (B, *shape)."""
        numbers = torch.from_numpy(self.joint.indexes(actions)).unsqueeze(1)
        return self.log_probabilities(observations).gather(1, numbers).squeeze(1)

    def q_values(self, observations: Observations) -> Tensor | None:
        """Return the values (B, A) of all actions; None without a network of values."""
        return self.outputs("q", observations) if "q" in self.networks else None

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
        """Return the logits (B, A)."""
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
) -> DiscreteHead:
    """Return the head of a policy file or learner.

    Raises:
        ValueError: There is no such head.
        SpaceError: The head does not support the action space.
    """
    if acts_by not in HEADS:
        raise ValueError(f"acts_by {acts_by!r} is not supported")
    return HEADS[acts_by](networks, action_space, threshold)
