"""The equations of offline learning: pure functions of a batch, without networks or state.

The suffix `_tm1` marks the state in which an action was taken, `_t` the next state. B is the batch
size, A the number of actions, N the number of quantiles.

    r_t             rewards (B,)
    discount_t      gamma (B,), to the power of n for n-step returns, or 0 after termination
    q_t             values (B, A) of the target network, or quantiles (B, A, N)
    q_t_selector    values (B, A) or quantiles (B, A, N) of the network that selects the next action
    q_t_value       values (B, A) or quantiles (B, A, N) of the network that evaluates this action
    a_t             next actions (B,), int64
    pi_t            probabilities (B, A) of the evaluated policy in the next states
    q_tm1, z_tm1    values (B, A) or quantiles (B, A, N) of the learning network
    a_tm1           actions taken (B,), int64
    target_tm1      targets (B,) of Q(s, a), or target samples (B, N)
    v_tm1           values (B, 1) of states
    logits_tm1      unnormalized log probabilities (B, A)

Actions of a Box are numbers in [-1, 1], n of them per action. With E critics:

    q_t_twins       values (E, B) of the next states and actions
    q_tm1_twins     values (E, B) of the logged states and actions

In the equations, s' and a' are the next state and action, and Q' is the network that evaluates
them. With quantiles, the action with the largest mean is selected. Outputs of actions that are not
allowed are minus infinity. A loss returns one value per transition; autograd computes its gradient.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

_LOG_SQRT_TAU = 0.5 * math.log(2 * math.pi)


def q_learning_target(r_t: Tensor, discount_t: Tensor, q_t: Tensor) -> Tensor:
    """Return the Q-learning target (B,): r + discount max_a Q'(s', a).

    See "Human-level control through deep reinforcement learning",
    https://doi.org/10.1038/nature14236.
    """
    return bellman_target(r_t, discount_t, q_t, best_actions(q_t))


def double_q_learning_target(
    r_t: Tensor, discount_t: Tensor, q_t_value: Tensor, q_t_selector: Tensor
) -> Tensor:
    """Return the Double DQN target (B,): r + discount Q'(s', argmax_a Q(s', a)).

    One network selects the next action and the other evaluates it, so a value is overestimated
    only if both overestimate it. See "Deep Reinforcement Learning with Double Q-learning",
    https://arxiv.org/abs/1509.06461.
    """
    _check_shape("q_t_selector", q_t_selector, q_t_value.shape)
    return bellman_target(r_t, discount_t, q_t_value, best_actions(q_t_selector))


def bellman_target(r_t: Tensor, discount_t: Tensor, q_t: Tensor, a_t: Tensor) -> Tensor:
    """Return the target (B,) for given next actions: r + discount Q'(s', a')."""
    _check_actions(q_t, a_t)
    _check_shape("r_t", r_t, (len(q_t),))
    _check_shape("discount_t", discount_t, (len(q_t),))
    value_t = chosen(q_t, a_t)
    if q_t.ndim == 3:
        return r_t.unsqueeze(1) + discount_t.unsqueeze(1) * value_t
    return r_t + discount_t * value_t


def expected_sarsa_target(r_t: Tensor, discount_t: Tensor, q_t: Tensor, pi_t: Tensor) -> Tensor:
    """Return the target (B,) for evaluating a policy pi: r + discount sum_a pi(a|s') Q'(s', a).

    See "A theoretical and empirical analysis of expected Sarsa",
    https://doi.org/10.1109/ADPRL.2009.4927542.
    """
    _check_shape("r_t", r_t, (len(q_t),))
    _check_shape("discount_t", discount_t, (len(q_t),))
    _check_shape("pi_t", pi_t, q_t.shape)
    return r_t + discount_t * (pi_t * q_t).sum(1)


def square_regression(v_tm1: Tensor, target_tm1: Tensor) -> Tensor:
    """Return half the squared error (B,) of values (B,), whose minimum is at the mean target."""
    _check_shape("target_tm1", target_tm1, v_tm1.shape)
    return 0.5 * (v_tm1 - target_tm1).square()


def temporal_difference_loss(q_tm1: Tensor, a_tm1: Tensor, target_tm1: Tensor) -> Tensor:
    """Return `huber_regression` for values (B, A), or `quantile_regression` for quantiles."""
    regression = huber_regression if q_tm1.ndim == 2 else quantile_regression
    return regression(q_tm1, a_tm1, target_tm1)


def huber_regression(q_tm1: Tensor, a_tm1: Tensor, target_tm1: Tensor) -> Tensor:
    """Return the Huber loss (B,) of Q(s, a) - target: quadratic up to 1, linear beyond.

    This is the error clipping of the DQN paper: the gradient is never larger than at an error
    of 1. This limits the effect of rare, large errors, such as those after a crash or after a
    change of the target network.
    """
    _check_actions(q_tm1, a_tm1)
    _check_shape("target_tm1", target_tm1, (len(q_tm1),))
    return functional.huber_loss(chosen(q_tm1, a_tm1), target_tm1, reduction="none")


def quantile_regression(z_tm1: Tensor, a_tm1: Tensor, target_tm1: Tensor) -> Tensor:
    """Return the quantile Huber loss (B,) between N quantiles of Z(s, a) and N target samples.

    Quantile i belongs to the probability tau_i = (i + 1/2) / N. Samples above the quantile have
    the weight tau_i, and samples below it 1 - tau_i. See "Distributional Reinforcement Learning
    with Quantile Regression", equation 10, https://arxiv.org/abs/1710.10044.
    """
    _check_actions(z_tm1, a_tm1)
    n_quantiles = z_tm1.shape[2]
    _check_shape("target_tm1", target_tm1, (len(z_tm1), n_quantiles))
    tau = (torch.arange(n_quantiles, device=z_tm1.device) + 0.5) / n_quantiles
    # The axes of all tensors below are (B, quantile i, sample j).
    quantiles = chosen(z_tm1, a_tm1).unsqueeze(2).expand(-1, -1, n_quantiles)
    samples = target_tm1.unsqueeze(1).expand_as(quantiles)
    weight = (tau.unsqueeze(1) - (quantiles > samples).float()).abs()
    loss: Tensor = functional.huber_loss(quantiles, samples, reduction="none")
    return (weight * loss).mean(2).sum(1)


def cross_entropy(logits_tm1: Tensor, a_tm1: Tensor) -> Tensor:
    """Return -log pi(a_data | s) (B,) with pi = softmax(logits): the loss of behavior cloning.

    With Q-values as logits, this is the CQL(H) penalty logsumexp_a Q(s, a) - Q(s, a_data), which
    is never negative. A gradient step lowers all values and raises the value of the logged
    action. See "Conservative Q-Learning for Offline Reinforcement Learning", equation 4,
    https://arxiv.org/abs/2006.04779.
    """
    _check_actions(logits_tm1, a_tm1)
    return functional.cross_entropy(logits_tm1, a_tm1, reduction="none")


def square_penalty(logits_tm1: Tensor) -> Tensor:
    """Return a penalty on large logits: their mean square (B,); masked actions count as 0."""
    return logits_tm1.masked_fill(logits_tm1.isinf(), 0).square().mean(1)


def expectile_regression(v_tm1: Tensor, target_tm1: Tensor, expectile: float) -> Tensor:
    """Return the asymmetric square loss |expectile - 1{u < 0}| u^2 (B,), where u = target - V(s).

    At expectile 0.5, the best V(s) is the mean target. As the expectile approaches 1, the best V(s)
    approaches the largest target.
    See "Offline Reinforcement Learning with Implicit Q-Learning", equation 5,
    https://arxiv.org/abs/2110.06169.
    """
    _check_shape("v_tm1", v_tm1, (len(target_tm1), 1))
    error = target_tm1 - v_tm1.squeeze(1)
    return (expectile - (error < 0).float()).abs() * error.square()


def clipped_double_q_target(
    r_t: Tensor, discount_t: Tensor, q_t_twins: Tensor, penalty_t: Tensor | float = 0.0
) -> Tensor:
    """Return the target (B,) of TD3: r + discount (min_e Q'_e(s', a') - penalty).

    See "Addressing Function Approximation Error in Actor-Critic Methods",
    https://arxiv.org/abs/1802.09477. With the penalty on next actions unlike the logged ones, it is
    that of "Revisiting the Minimalist Approach to Offline Reinforcement Learning", equation 3,
    https://arxiv.org/abs/2305.09836.
    """
    _check_shape("r_t", r_t, (q_t_twins.shape[1],))
    _check_shape("discount_t", discount_t, (q_t_twins.shape[1],))
    return r_t + discount_t * (q_t_twins.amin(0) - penalty_t)


def twin_regression(q_tm1_twins: Tensor, target_tm1: Tensor) -> Tensor:
    """Return the sum over the critics of the squared errors (B,) of Q_e(s, a) - target."""
    _check_shape("target_tm1", target_tm1, (q_tm1_twins.shape[1],))
    return (q_tm1_twins - target_tm1).square().sum(0)


def smoothed_actions(a_t: Tensor, noise: Tensor, limit: float) -> Tensor:
    """Return actions (B, n) in [-1, 1] with noise that is clipped to `limit`: TD3's smoothing.

    See "Addressing Function Approximation Error in Actor-Critic Methods", section 5.3,
    https://arxiv.org/abs/1802.09477.
    """
    _check_shape("noise", noise, a_t.shape)
    return (a_t + noise.clamp(-limit, limit)).clamp(-1, 1)


def truncated_normal_log_density(actions: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Return the log densities of actions in [-1, 1], with the shape of the broadcast arguments.

    The distribution is the normal one, given that the result is in [-1, 1]:

        phi((a - mean) / std) / std / (Phi((1 - mean) / std) - Phi((-1 - mean) / std))

    The mean is in [-1, 1], too. Then the difference of Phi is the sum of two numbers of at least 0,
    and its logarithm is finite.
    """
    scaled = (actions - mean) * (-log_std).exp()
    width = (-log_std).exp() * math.sqrt(0.5)
    inside = 0.5 * (torch.erf((1 - mean) * width) + torch.erf((1 + mean) * width))
    return -0.5 * scaled.square() - log_std - _LOG_SQRT_TAU - inside.log()


def truncated_normal_probability(actions: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Return the probability of a smaller action, of `truncated_normal_log_density`."""
    width = (-log_std).exp() * math.sqrt(0.5)
    low = torch.erf((-1 - mean) * width)
    return (torch.erf((actions - mean) * width) - low) / (torch.erf((1 - mean) * width) - low)


def squashed_normal_log_density(pre: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Return the log densities of actions tanh(pre), where `pre` is normal.

    They are log N(pre; mean, std) - log(1 - tanh(pre)^2). See "Soft Actor-Critic Algorithms and
    Applications", appendix C, https://arxiv.org/abs/1812.05905.
    """
    scaled = (pre - mean) * (-log_std).exp()
    # log(1 - tanh(x)^2), without the difference of two almost equal numbers.
    log_gradient = 2 * (math.log(2) - pre - functional.softplus(-2 * pre))
    return -0.5 * scaled.square() - log_std - _LOG_SQRT_TAU - log_gradient


def temperature_loss(log_alpha: Tensor, log_pi: Tensor, target_entropy: float) -> Tensor:
    """Return the loss (B,) of SAC's log temperature: log alpha * (entropy - target entropy).

    Here, -log pi(a|s) (B,) of the policy's action is the estimate of its entropy. The gradient is
    0 at the target entropy. See "Soft Actor-Critic Algorithms and Applications", equation 18,
    https://arxiv.org/abs/1812.05905, with log alpha instead of alpha, as in the authors' code.
    """
    _check_shape("log_pi", log_pi, log_alpha.shape)
    return -log_alpha * (log_pi + target_entropy)


def allowed_only(outputs: Tensor, mask: Tensor | None) -> Tensor:
    """Set outputs (B, A) or (B, A, N) of actions that are not allowed to minus infinity.

    `mask` (B, A), bool, marks the allowed actions; None allows all.
    """
    if mask is None:
        return outputs
    return outputs.masked_fill(~(mask if outputs.ndim == 2 else mask.unsqueeze(2)), -torch.inf)


def likely_actions(logits: Tensor, threshold: float) -> Tensor:
    """Return a mask (B, A) of the actions with pi(a|s) / max_a pi(a|s) >= threshold.

    The policy pi is softmax(logits). This is the filter of discrete BCQ; a threshold of 0 admits
    all actions, and 1 admits only the most likely one. See "Benchmarking Batch Deep
    Reinforcement Learning Algorithms", algorithm 1, https://arxiv.org/abs/1910.01708.
    """
    return (logits - logits.amax(1, keepdim=True)).exp() >= threshold


def mean_values(q: Tensor) -> Tensor:
    """Return values (B, A) unchanged, or the means of quantiles (B, A, N)."""
    return q.mean(2) if q.ndim == 3 else q


def best_actions(q: Tensor) -> Tensor:
    """Return the actions (B,) with the largest mean value. In a tie, return the first one."""
    return mean_values(q).argmax(1)


def chosen(values: Tensor, actions: Tensor) -> Tensor:
    """Return the values (B,), or the quantiles (B, N), of the given actions."""
    if values.ndim == 2:
        return values.gather(1, actions.unsqueeze(1)).squeeze(1)
    return values[torch.arange(len(values), device=values.device), actions]


def _check_actions(values: Tensor, actions: Tensor) -> None:
    assert values.ndim in (2, 3), f"values must be (B, A) or (B, A, N), got {tuple(values.shape)}"
    _check_shape("actions", actions, (values.shape[0],))
    assert actions.dtype == torch.int64, f"actions must be int64, got {actions.dtype}"


def _check_shape(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    assert tensor.shape == shape, f"{name} must be {shape}, got {tuple(tensor.shape)}"
