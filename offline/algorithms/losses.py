"""The equations of offline learning: pure functions of a batch, without networks or state.

`_tm1` marks what belongs to the state an action was taken in, `_t` to the state it led to. B is the
batch size, A the number of actions, N that of quantiles. `discount_t` is gamma, to the power of n
for n-step returns, or 0 where the episode terminated. Outputs of actions that are not allowed are
minus infinity.

What a network is to minimise comes as a `Loss`: the value, and its slope, the derivative with
respect to the network's outputs. The tests hold each slope against automatic differentiation.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Loss(NamedTuple):
    """A loss of each transition, as a function of a network's outputs for it.

    Attributes:
        value: (B,).
        slope: in the outputs' shape, the derivative of `value` with respect to them.
    """

    value: Tensor
    slope: Tensor


def q_learning_target(r_t: Tensor, discount_t: Tensor, q_t: Tensor) -> Tensor:
    """(B,) the Q-learning target r + discount max_a Q'(s', a).

    See "Human-level control through deep reinforcement learning",
    https://doi.org/10.1038/nature14236.

    Args:
        r_t: (B,) rewards.
        discount_t: (B,) discounts.
        q_t: (B, A) values of the target network, or (B, A, N) quantiles: then the target is (B, N),
            those of the action whose mean is largest.
    """
    return bellman_target(r_t, discount_t, q_t, best_actions(q_t))


def double_q_learning_target(
    r_t: Tensor, discount_t: Tensor, q_t_value: Tensor, q_t_selector: Tensor
) -> Tensor:
    """(B,) the Double DQN target r + discount Q'(s', argmax_a Q(s', a)).

    One network chooses the next action and the other judges it, so an overestimate has to be made
    twice to count. See "Deep Reinforcement Learning with Double Q-learning",
    https://arxiv.org/abs/1509.06461.

    Args:
        r_t: (B,) rewards.
        discount_t: (B,) discounts.
        q_t_value: (B, A) values of the target network, or (B, A, N) quantiles, as above.
        q_t_selector: likewise, of the network that learns.
    """
    _check_shape("q_t_selector", q_t_selector, q_t_value.shape)
    return bellman_target(r_t, discount_t, q_t_value, best_actions(q_t_selector))


def bellman_target(r_t: Tensor, discount_t: Tensor, q_t: Tensor, a_t: Tensor) -> Tensor:
    """(B,) r + discount Q'(s', a') for next actions a' that are chosen already.

    Args:
        r_t: (B,) rewards.
        discount_t: (B,) discounts.
        q_t: (B, A) values of the target network, or (B, A, N) quantiles: then the target is (B, N).
        a_t: (B,) int64 next actions.
    """
    _check_actions(q_t, a_t)
    _check_shape("r_t", r_t, (len(q_t),))
    _check_shape("discount_t", discount_t, (len(q_t),))
    value_t = chosen(q_t, a_t)
    if q_t.ndim == 3:
        return r_t.unsqueeze(1) + discount_t.unsqueeze(1) * value_t
    return r_t + discount_t * value_t


def expected_sarsa_target(r_t: Tensor, discount_t: Tensor, q_t: Tensor, pi_t: Tensor) -> Tensor:
    """(B,) the target r + discount sum_a pi(a|s') Q'(s', a) of evaluating a policy pi.

    See "A theoretical and empirical analysis of expected Sarsa",
    https://doi.org/10.1109/ADPRL.2009.4927542.

    Args:
        r_t: (B,) rewards.
        discount_t: (B,) discounts.
        q_t: (B, A) values of the target network.
        pi_t: (B, A) probabilities of the policy in the next states.
    """
    _check_shape("r_t", r_t, (len(q_t),))
    _check_shape("discount_t", discount_t, (len(q_t),))
    _check_shape("pi_t", pi_t, q_t.shape)
    return r_t + discount_t * (pi_t * q_t).sum(1)


def square_regression(q_tm1: Tensor, a_tm1: Tensor, target_tm1: Tensor) -> Loss:
    """Half the squared error of Q(s, a): its minimum is the mean target, as Huber's is not.

    Args:
        q_tm1: (B, A) values of the network that learns.
        a_tm1: (B,) int64 actions taken.
        target_tm1: (B,) what Q(s, a) should be.
    """
    _check_actions(q_tm1, a_tm1)
    _check_shape("target_tm1", target_tm1, (len(q_tm1),))
    error = chosen(q_tm1, a_tm1) - target_tm1
    return Loss(0.5 * error.square(), _at_actions(q_tm1, a_tm1, error))


def huber(error: Tensor) -> Loss:
    """Half the squared error up to 1, the absolute error minus a half beyond; any shape.

    One rare, large error (a crash, a fresh target) then pulls no harder than an error of 1: the
    clipped error of the DQN paper, as a loss.
    """
    slope = error.clamp(-1, 1)
    return Loss(slope * (error - 0.5 * slope), slope)


def huber_regression(q_tm1: Tensor, a_tm1: Tensor, target_tm1: Tensor) -> Loss:
    """The Huber loss of Q(s, a) - target.

    Args:
        q_tm1: (B, A) values of the network that learns.
        a_tm1: (B,) int64 actions taken.
        target_tm1: (B,) what Q(s, a) should be.
    """
    _check_actions(q_tm1, a_tm1)
    _check_shape("target_tm1", target_tm1, (len(q_tm1),))
    value, slope = huber(chosen(q_tm1, a_tm1) - target_tm1)
    return Loss(value, _at_actions(q_tm1, a_tm1, slope))


def quantile_regression(z_tm1: Tensor, a_tm1: Tensor, target_tm1: Tensor) -> Loss:
    """The quantile Huber loss between the N quantiles of Z(s, a) and N samples of their target.

    Quantile i, at tau_i = (i + 1/2) / N, is pulled up with weight tau_i by samples above it and
    down with weight 1 - tau_i by those below. See "Distributional Reinforcement Learning with
    Quantile Regression", equation 10, https://arxiv.org/abs/1710.10044.

    Args:
        z_tm1: (B, A, N) quantiles of the network that learns.
        a_tm1: (B,) int64 actions taken.
        target_tm1: (B, N) samples of the target.
    """
    _check_actions(z_tm1, a_tm1)
    n_quantiles = z_tm1.shape[2]
    _check_shape("target_tm1", target_tm1, (len(z_tm1), n_quantiles))
    tau = (torch.arange(n_quantiles, device=z_tm1.device) + 0.5) / n_quantiles
    # (B, quantile i, sample j)
    error = chosen(z_tm1, a_tm1).unsqueeze(2) - target_tm1.unsqueeze(1)
    weight = (tau.unsqueeze(1) - (error > 0).float()).abs()
    value, slope = huber(error)
    value = (weight * value).mean(2).sum(1)
    return Loss(value, _at_actions(z_tm1, a_tm1, (weight * slope).mean(2)))


def cross_entropy(logits_tm1: Tensor, a_tm1: Tensor) -> Loss:
    """-log pi(a_data | s) with pi = softmax(logits): behavior cloning.

    Of Q-values it is the CQL(H) penalty logsumexp_a Q(s, a) - Q(s, a_data), never negative: it
    pushes all values down and that of the logged action up. See "Conservative Q-Learning for
    Offline Reinforcement Learning", equation 4, https://arxiv.org/abs/2006.04779.

    Args:
        logits_tm1: (B, A) unnormalised log probabilities, or values.
        a_tm1: (B,) int64 actions of the data.
    """
    _check_actions(logits_tm1, a_tm1)
    log_pi = logits_tm1.log_softmax(1)
    index = a_tm1.unsqueeze(1)
    slope = log_pi.detach().exp().scatter_add_(1, index, log_pi.new_full(index.shape, -1))
    return Loss(-chosen(log_pi, a_tm1), slope)


def square_penalty(logits_tm1: Tensor) -> Loss:
    """The mean square of the logits of allowed actions: keeps them from growing without end.

    Args:
        logits_tm1: (B, A).
    """
    finite = logits_tm1.masked_fill(logits_tm1.isinf(), 0)
    return Loss(finite.square().mean(1), 2 * finite.detach() / logits_tm1.shape[1])


def expectile_regression(v_tm1: Tensor, target_tm1: Tensor, expectile: float) -> Loss:
    """|expectile - 1{u < 0}| u^2 with u = target - V(s): a square loss that leans upwards.

    With 0.5 its minimum is half the mean's; towards 1 it nears the largest target that the data
    show. See "Offline Reinforcement Learning with Implicit Q-Learning", equation 5,
    https://arxiv.org/abs/2110.06169.

    Args:
        v_tm1: (B, 1) values of states.
        target_tm1: (B,) values of the actions taken there.
        expectile: from 0 to 1.
    """
    _check_shape("v_tm1", v_tm1, (len(target_tm1), 1))
    error = target_tm1.unsqueeze(1) - v_tm1
    weight = (expectile - (error < 0).float()).abs()
    return Loss((weight * error.square()).squeeze(1), -2 * weight * error.detach())


def allowed_only(outputs: Tensor, mask: Tensor | None) -> Tensor:
    """Outputs (B, A) or (B, A, N) with minus infinity for actions that are not allowed.

    Args:
        outputs: of a network.
        mask: (B, A) bool, or None if all are allowed.
    """
    if mask is None:
        return outputs
    return outputs.masked_fill(~(mask if outputs.ndim == 2 else mask.unsqueeze(2)), -torch.inf)


def likely_actions(logits: Tensor, threshold: float) -> Tensor:
    """(B, A) whether pi(a|s) / max_a pi(a|s) >= threshold, with pi = softmax(logits).

    The filter of discrete BCQ. See "Benchmarking Batch Deep Reinforcement Learning Algorithms",
    algorithm 1, https://arxiv.org/abs/1910.01708.

    Args:
        logits: (B, A).
        threshold: from 0, which lets all actions through, to 1, which leaves only the likeliest.
    """
    return (logits - logits.amax(1, keepdim=True)).exp() >= threshold


def scaled(loss: Loss, factor: Tensor | float) -> Loss:
    """A loss times a number, or times one (B,) for each transition."""
    if isinstance(factor, float):
        return Loss(factor * loss.value, factor * loss.slope)
    return Loss(factor * loss.value, factor.unsqueeze(1) * loss.slope)


def mean_values(q: Tensor) -> Tensor:
    """(B, A) values of (B, A) values themselves, or of (B, A, N) quantiles, which it averages."""
    return q.mean(2) if q.ndim == 3 else q


def best_actions(q: Tensor) -> Tensor:
    """(B,) the action of the largest value, the first of equal ones; q as in `mean_values`."""
    return mean_values(q).argmax(1)


def chosen(values: Tensor, actions: Tensor) -> Tensor:
    """(B,) of values (B, A), or (B, N) of (B, A, N), those of one action each."""
    if values.ndim == 2:
        return values.gather(1, actions.unsqueeze(1)).squeeze(1)
    return values[torch.arange(len(values), device=values.device), actions]


def _at_actions(outputs: Tensor, actions: Tensor, slope: Tensor) -> Tensor:
    """A slope that is 0 but at the actions taken."""
    whole = torch.zeros_like(outputs)
    if outputs.ndim == 2:
        return whole.scatter_(1, actions.unsqueeze(1), slope.unsqueeze(1))
    whole[torch.arange(len(outputs), device=outputs.device), actions] = slope
    return whole


def _check_actions(values: Tensor, actions: Tensor) -> None:
    assert values.ndim in (2, 3), f"values must be (B, A) or (B, A, N), got {tuple(values.shape)}"
    _check_shape("actions", actions, (values.shape[0],))
    assert actions.dtype == torch.int64, f"actions must be int64, got {actions.dtype}"


def _check_shape(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    assert tensor.shape == shape, f"{name} must be {shape}, got {tuple(tensor.shape)}"
