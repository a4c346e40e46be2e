"""The equations of offline learning: pure functions of a batch, without networks or state.

`_tm1` marks what belongs to the state an action was taken in, `_t` to the state it led to. B is the
batch size and A the number of actions. `discount_t` is gamma, or 0 where the episode terminated.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional


class TemporalDifference(NamedTuple):
    """What a bootstrapped update knows of each transition of a batch.

    Attributes:
        target: (B,) the value that Q(s, a) should have; no gradient flows through it.
        error: (B,) target minus Q(s, a).
    """

    target: Tensor
    error: Tensor


def q_learning(
    q_tm1: Tensor, a_tm1: Tensor, r_t: Tensor, discount_t: Tensor, q_t: Tensor
) -> TemporalDifference:
    """The Q-learning error r + discount max_a Q'(s', a) - Q(s, a).

    See "Human-level control through deep reinforcement learning",
    https://doi.org/10.1038/nature14236.

    Args:
        q_tm1: (B, A) values of the network that learns.
        a_tm1: (B,) int64 actions taken.
        r_t: (B,) rewards.
        discount_t: (B,) discounts.
        q_t: (B, A) values of the target network.
    """
    _check_transitions(q_tm1, a_tm1, r_t, discount_t, q_t)
    target = r_t + discount_t * q_t.amax(1)
    return _difference(q_tm1, a_tm1, target)


def double_q_learning(
    q_tm1: Tensor,
    a_tm1: Tensor,
    r_t: Tensor,
    discount_t: Tensor,
    q_t_value: Tensor,
    q_t_selector: Tensor,
) -> TemporalDifference:
    """The Double DQN error r + discount Q'(s', argmax_a Q(s', a)) - Q(s, a).

    One network chooses the next action and the other judges it, so an overestimate has to be made
    twice to count. See "Deep Reinforcement Learning with Double Q-learning",
    https://arxiv.org/abs/1509.06461.

    Args:
        q_tm1: (B, A) values of the network that learns.
        a_tm1: (B,) int64 actions taken.
        r_t: (B,) rewards.
        discount_t: (B,) discounts.
        q_t_value: (B, A) values of the target network.
        q_t_selector: (B, A) values of the network that learns.
    """
    _check_transitions(q_tm1, a_tm1, r_t, discount_t, q_t_value)
    _check_shape("q_t_selector", q_t_selector, tuple(q_tm1.shape))
    target = r_t + discount_t * _chosen(q_t_value, q_t_selector.argmax(1))
    return _difference(q_tm1, a_tm1, target)


def expected_sarsa(
    q_tm1: Tensor, a_tm1: Tensor, r_t: Tensor, discount_t: Tensor, q_t: Tensor, pi_t: Tensor
) -> TemporalDifference:
    """The error r + discount sum_a pi(a|s') Q'(s', a) - Q(s, a) of evaluating a policy pi.

    See "A theoretical and empirical analysis of expected Sarsa",
    https://doi.org/10.1109/ADPRL.2009.4927542.

    Args:
        q_tm1: (B, A) values of the network that learns.
        a_tm1: (B,) int64 actions taken.
        r_t: (B,) rewards.
        discount_t: (B,) discounts.
        q_t: (B, A) values of the target network.
        pi_t: (B, A) probabilities of the policy in the next states.
    """
    _check_transitions(q_tm1, a_tm1, r_t, discount_t, q_t)
    _check_shape("pi_t", pi_t, tuple(q_t.shape))
    target = r_t + discount_t * (pi_t * q_t).sum(1)
    return _difference(q_tm1, a_tm1, target)


def huber(error: Tensor) -> Tensor:
    """(B,) half the squared error up to 1, the absolute error minus a half beyond.

    One rare, large error (a crash, a fresh target) then pulls no harder than an error of 1: the
    clipped error of the DQN paper, as a loss.
    """
    return functional.huber_loss(error, torch.zeros_like(error), reduction="none")


def conservative_penalty(q_tm1: Tensor, a_tm1: Tensor) -> Tensor:
    """(B,) the CQL(H) penalty logsumexp_a Q(s, a) - Q(s, a_data), never negative.

    It is the negative log likelihood of the data's action under softmax(Q): it pushes all values
    down and that of the logged action up. See "Conservative Q-Learning for Offline Reinforcement
    Learning", equation 4, https://arxiv.org/abs/2006.04779.

    Args:
        q_tm1: (B, A) values of the network that learns.
        a_tm1: (B,) int64 actions of the data.
    """
    _check_actions(q_tm1, a_tm1)
    return functional.cross_entropy(q_tm1, a_tm1, reduction="none")


def behavior_cloning(logits_tm1: Tensor, a_tm1: Tensor) -> Tensor:
    """(B,) the cross entropy -log pi(a_data | s) with pi = softmax(logits).

    Args:
        logits_tm1: (B, A) unnormalised log probabilities.
        a_tm1: (B,) int64 actions of the data.
    """
    _check_actions(logits_tm1, a_tm1)
    return functional.cross_entropy(logits_tm1, a_tm1, reduction="none")


def _difference(q_tm1: Tensor, a_tm1: Tensor, target: Tensor) -> TemporalDifference:
    target = target.detach()
    return TemporalDifference(target, target - _chosen(q_tm1, a_tm1))


def _chosen(values: Tensor, actions: Tensor) -> Tensor:
    return values.gather(1, actions.unsqueeze(1)).squeeze(1)


def _check_transitions(
    q_tm1: Tensor, a_tm1: Tensor, r_t: Tensor, discount_t: Tensor, q_t: Tensor
) -> None:
    _check_actions(q_tm1, a_tm1)
    _check_shape("r_t", r_t, tuple(a_tm1.shape))
    _check_shape("discount_t", discount_t, tuple(a_tm1.shape))
    _check_shape("q_t", q_t, tuple(q_tm1.shape))


def _check_actions(values: Tensor, a_tm1: Tensor) -> None:
    assert values.ndim == 2, f"values must be (B, A), got {tuple(values.shape)}"
    _check_shape("a_tm1", a_tm1, (values.shape[0],))
    assert a_tm1.dtype == torch.int64, f"a_tm1 must be int64, got {a_tm1.dtype}"


def _check_shape(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    assert tuple(tensor.shape) == shape, f"{name} must be {shape}, got {tuple(tensor.shape)}"
