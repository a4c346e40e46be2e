"""Tests of the scores for choosing a policy: values, pessimistic values and support."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mcaprl.base_policy import BasePolicy
from mcaprl.errors import PolicyError, UsageError
from mcaprl.offline.estimate.evidence import EvidenceCollector, fqe_config
from mcaprl.recorder.dataset.dataset import Dataset
from tests.offline.estimate.test_off_policy import Table, log
from tests.support import two_state_task as task

CONFIG = fqe_config(task.GAMMA, 1_200, (32,))


class Fixed(BasePolicy):
    """A policy of the two-state task with one action for each state, and values if given."""

    def __init__(self, actions: list[int], q: list[list[float]] | None = None) -> None:
        self._actions, self._q = np.array(actions), q

    def act(self, observations: Any) -> NDArray[np.int64]:
        actions: NDArray[np.int64] = self._actions[observations.argmax(1)]
        return actions

    def q_values(self, observations: Any) -> NDArray[np.float64]:
        if self._q is None:
            raise PolicyError("no values")
        values: NDArray[np.float64] = np.array(self._q)[observations.argmax(1)]
        return values


def true_values(actions: list[int]) -> NDArray[np.float64]:
    """Return V (2,) of a policy with one action for each state."""
    to_one = task.TO_ONE[[0, 1], actions]
    step = np.stack([1 - to_one, to_one], axis=-1)
    paid = task.PAYS[[0, 1], actions]
    return np.linalg.solve(np.eye(2) - task.GAMMA * (1 - task.ENDS) * step, paid)


def test_values_of_policies_side_by_side_are_the_true_ones() -> None:
    data = log(1_000)
    policies = [[0, 0], [0, 1], [1, 0], [1, 1]]
    collector = EvidenceCollector(data, Table(task.BEHAVIOR), CONFIG)
    found = collector.collect([Fixed(actions) for actions in policies])
    for actions, evidence in zip(policies, found, strict=True):
        values = true_values(actions)
        assert evidence.first_value == pytest.approx(values[0], rel=0.1, abs=0.1)
        in_one = data.observations[:, 1].mean()
        mean = (1 - in_one) * values[0] + in_one * values[1]
        assert evidence.mean_value == pytest.approx(mean, rel=0.1, abs=0.1)
        assert evidence.support == 1
        taken = np.array(actions)[data.observations.argmax(1)]
        assert evidence.agreement == (taken == data.actions).mean()
        assert (evidence.own_value, evidence.bellman_error) == (None, None)
        to_one = task.TO_ONE
        q = task.PAYS + task.GAMMA * (1 - task.ENDS) * (
            (1 - to_one) * values[0] + to_one * values[1]
        )
        logged = q[data.observations.argmax(1), data.actions]
        np.testing.assert_allclose(evidence.logged_values, logged, rtol=0.15, atol=0.15)
        best = q.max(1)[data.next_observations.argmax(1)]
        np.testing.assert_allclose(evidence.next_values, best, rtol=0.15, atol=0.15)
        assert evidence.to_json().keys().isdisjoint({"agrees", "first_values", "next_values"})
    best = max(range(4), key=lambda k: found[k].first_value)
    assert policies[best] == max(policies, key=lambda actions: true_values(actions)[0])


def test_a_rare_action_ends_the_episode_at_a_low_value() -> None:
    # In state 1, the clone's probability of action 1 is a hundredth of that of action 0.
    clone = Table(np.array([[0.5, 0.5], [0.99, 0.0099]]))
    data = log(1_000)
    both = [Fixed([0, 0]), Fixed([1, 1])]
    likely, rare = EvidenceCollector(data, clone, CONFIG).collect(both)
    _, trusted = EvidenceCollector(data, clone, CONFIG, pessimistic=False).collect(both)
    assert likely.support == 1
    assert rare.support == pytest.approx(data.observations[:, 0].mean())
    low = EvidenceCollector(data, clone, CONFIG).low_value
    # V(0) = r + gamma (1 - ends) ((1 - p) V(0) + p low). A step from state 0 that does not end the
    # episode leads to state 1 with probability p. There, the episode ends with the value `low`.
    stays = task.GAMMA * (1 - task.ENDS) * np.array([1 - task.TO_ONE[0, 1], task.TO_ONE[0, 1]])
    expected = (task.PAYS[0, 1] + stays[1] * low) / (1 - stays[0])
    assert rare.first_value == pytest.approx(expected, abs=0.15)
    assert trusted.first_value == pytest.approx(true_values([1, 1])[0], rel=0.1)
    assert rare.first_value < likely.first_value < trusted.first_value


def test_own_values_and_bellman_error_by_hand() -> None:
    # Each of the two episodes has one step in state 0. Q is 3 for action 0 and 1 for action 1.
    data = Dataset.from_arrays(
        observations=np.array([[1, 0], [1, 0]], np.float32),
        actions=[0, 1],
        rewards=[5.0, 1.0],
        terminated=[True, True],
        truncated=[False, False],
        next_observations=np.array([[0, 1], [0, 1]], np.float32),
    )
    policy = Fixed([0, 0], [[3.0, 1.0], [0.0, 0.0]])
    collector = EvidenceCollector(data, Table(task.BEHAVIOR), fqe_config(0.5, 10, (4,)))
    (found,) = collector.collect([policy])
    assert found.own_value == 3
    # The errors r - Q are 5 - 3 and 1 - 1, so their root mean square is sqrt(2). It is divided by
    # the standard deviation of Q, which is 1.
    assert found.bellman_error == pytest.approx(np.sqrt(2))
    assert found.agreement == 0.5


def test_one_episode_is_refused() -> None:
    with pytest.raises(UsageError, match="needs 2 episodes"):
        EvidenceCollector(log(1), Table(task.BEHAVIOR), CONFIG)
