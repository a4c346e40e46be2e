"""Tests of the equations of offline learning with values and gradients calculated by hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays
from numpy import float32, int64
from numpy.typing import NDArray
from torch import Tensor

from mcaprl.offline.algorithms.losses import (
    allowed_only,
    chosen,
    cross_entropy,
    double_q_learning_target,
    expected_sarsa_target,
    expectile_regression,
    huber_regression,
    likely_actions,
    mean_values,
    q_learning_target,
    quantile_regression,
    square_penalty,
    square_regression,
)

# Three transitions with two actions each: the first is in the middle of an episode, the second
# terminates, and the third has gamma 0.
Q_TM1 = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
A_TM1 = torch.tensor([0, 1, 0])
R_T = torch.tensor([0.5, -1.0, 2.0])
DISCOUNT_T = torch.tensor([0.9, 0.0, 0.0])
Q_T = torch.tensor([[10.0, 20.0], [30.0, 40.0], [50.0, 60.0]])
SELECTOR_T = torch.tensor([[7.0, 3.0], [1.0, 2.0], [2.0, 1.0]])

finite_values = arrays(float32, (4, 3), elements=st.floats(-50, 50, width=32))
actions_of_three = arrays(int64, (4,), elements=st.integers(0, 2))


def test_q_learning_bootstraps_from_the_largest_value() -> None:
    target = q_learning_target(R_T, DISCOUNT_T, Q_T)
    torch.testing.assert_close(target, torch.tensor([0.5 + 0.9 * 20, -1.0, 2.0]))


def test_double_q_learning_values_the_action_that_the_other_network_selects() -> None:
    target = double_q_learning_target(R_T, DISCOUNT_T, Q_T, SELECTOR_T)
    torch.testing.assert_close(target, torch.tensor([0.5 + 0.9 * 10, -1.0, 2.0]))


def test_expected_sarsa_weights_the_next_values_with_the_policy() -> None:
    pi_t = torch.tensor([[0.25, 0.75], [0.5, 0.5], [1.0, 0.0]])
    target = expected_sarsa_target(R_T, DISCOUNT_T, Q_T, pi_t)
    torch.testing.assert_close(target, torch.tensor([0.5 + 0.9 * 17.5, -1.0, 2.0]))


def test_quantile_targets_are_those_of_the_largest_mean() -> None:
    # The means are 2 and 2.5; the first action has the largest quantile.
    z_t = torch.tensor([[[0.0, 4.0], [2.0, 3.0]]])
    target = q_learning_target(torch.tensor([1.0]), torch.tensor([0.5]), z_t)
    torch.testing.assert_close(target, torch.tensor([[2.0, 2.5]]))


def test_masked_actions_are_not_bootstrapped_from() -> None:
    q_t = allowed_only(torch.tensor([[5.0, 1.0]]), torch.tensor([[False, True]]))
    assert q_learning_target(torch.tensor([0.0]), torch.tensor([1.0]), q_t).item() == 1.0


def gradient(loss_of: Callable[[Tensor], Tensor], outputs: Tensor) -> Tensor:
    """Return the gradient of the summed loss with respect to a network's outputs."""
    leaf = outputs.clone().requires_grad_()
    (found,) = torch.autograd.grad(loss_of(leaf).sum(), leaf)
    return found


def test_huber_is_squared_near_zero_and_linear_beyond_one() -> None:
    error = torch.tensor([[0.0], [0.5], [-0.5], [1.0], [3.0], [-3.0]])
    first = torch.zeros(6, dtype=torch.int64)

    def loss_of(q_tm1: Tensor) -> Tensor:
        return huber_regression(q_tm1, first, torch.zeros(6))

    expected = torch.tensor([0.0, 0.125, 0.125, 0.5, 2.5, 2.5])
    torch.testing.assert_close(loss_of(error), expected)
    expected = torch.tensor([[0.0], [0.5], [-0.5], [1.0], [1.0], [-1.0]])
    torch.testing.assert_close(gradient(loss_of, error), expected)


def test_huber_regression_has_a_gradient_only_at_the_action_taken() -> None:
    def loss_of(q_tm1: Tensor) -> Tensor:
        return huber_regression(q_tm1, A_TM1, torch.tensor([1.5, 9.0, 5.0]))

    torch.testing.assert_close(loss_of(Q_TM1), torch.tensor([0.125, 4.5, 0.0]))
    expected = torch.tensor([[-0.5, 0.0], [0.0, -1.0], [0.0, 0.0]])
    torch.testing.assert_close(gradient(loss_of, Q_TM1), expected, rtol=0, atol=0)


def test_square_regression_by_hand() -> None:
    def loss_of(q_tm1: Tensor) -> Tensor:
        return square_regression(chosen(q_tm1, A_TM1), torch.tensor([1.5, 9.0, 5.0]))

    torch.testing.assert_close(loss_of(Q_TM1), torch.tensor([0.125, 12.5, 0.0]))
    expected = torch.tensor([[-0.5, 0.0], [0.0, -5.0], [0.0, 0.0]])
    torch.testing.assert_close(gradient(loss_of, Q_TM1), expected)


def test_square_penalty_ignores_actions_that_are_not_allowed() -> None:
    logits = torch.tensor([[1.0, -2.0], [3.0, -math.inf]])
    torch.testing.assert_close(square_penalty(logits), torch.tensor([2.5, 4.5]))
    expected = torch.tensor([[1.0, -2.0], [3.0, 0.0]])
    torch.testing.assert_close(gradient(square_penalty, logits), expected)


def test_quantile_regression_by_hand() -> None:
    # The quantiles at tau 1/4 and 3/4 are both 0, and the samples are -2 and 1. In the loss of
    # quantile 1, the sample above has the weight 1/4 and the Huber loss 1/2. The sample below has
    # the weight 3/4 and the Huber loss 3/2.
    z_tm1 = torch.zeros(1, 2, 2)

    def loss_of(z_tm1: Tensor) -> Tensor:
        return quantile_regression(z_tm1, torch.tensor([1]), torch.tensor([[-2.0, 1.0]]))

    first = (0.75 * 1.5 + 0.25 * 0.5) / 2
    second = (0.25 * 1.5 + 0.75 * 0.5) / 2
    torch.testing.assert_close(loss_of(z_tm1), torch.tensor([first + second]))
    expected = [[[0.0, 0.0], [(0.75 - 0.25) / 2, (0.25 - 0.75) / 2]]]
    torch.testing.assert_close(gradient(loss_of, z_tm1), torch.tensor(expected))


def test_quantile_regression_converges_to_sample_quantiles() -> None:
    # A third of the samples is 0, and the rest is 10. The quantiles are 0 at tau 1/8, and 10 at 3/8
    # and above. The Huber loss shifts them, because its gradient is smaller within 1 of a sample.
    # At 3/8, for example, the result is 10 - u, where 2/3 * 3/8 * u = 1/3 * 5/8.
    z_tm1 = torch.full((3, 1, 4), 5.0)
    target = torch.tensor([[0.0] * 4, [10.0] * 4, [10.0] * 4])
    first = torch.zeros(3, dtype=torch.int64)
    for _ in range(400):
        found = gradient(lambda z: quantile_regression(z, first, target), z_tm1)
        z_tm1 = z_tm1 - 0.2 * found.sum(0)
    expected = torch.tensor([2 / 7, 10 - 5 / 6, 10 - 3 / 10, 10 - 1 / 14])
    torch.testing.assert_close(z_tm1[0, 0], expected, rtol=0, atol=1e-3)


def test_conservative_penalty_by_hand() -> None:
    q_tm1 = torch.tensor([[0.0, 0.0], [math.log(3.0), 0.0]])
    # The penalty is log sum exp(q) - q(a): log(1 + 1) - 0 in row 0, log(3 + 1) - log 3 in row 1.
    expected = torch.tensor([math.log(2.0), math.log(4.0 / 3.0)])
    torch.testing.assert_close(cross_entropy(q_tm1, torch.tensor([1, 0])), expected)


def test_conservative_penalty_lowers_unseen_actions_and_raises_the_logged_one() -> None:
    q_tm1 = torch.tensor([[1.0, 0.0, -1.0]])
    found = gradient(lambda q: cross_entropy(q, torch.tensor([1])), q_tm1)[0]
    # softmax(q) - onehot(a); gradient descent moves the opposite way.
    weights = [math.exp(q) / (math.e + 1 + 1 / math.e) for q in (1.0, 0.0, -1.0)]
    torch.testing.assert_close(found, torch.tensor([weights[0], weights[1] - 1, weights[2]]))
    assert found[1] < 0 < found[2] < found[0]


def test_cross_entropy_by_hand() -> None:
    logits_tm1 = torch.log(torch.tensor([[0.25, 0.75], [0.5, 0.5]]))
    expected = torch.tensor([math.log(4.0), math.log(2.0)])
    torch.testing.assert_close(cross_entropy(logits_tm1, torch.tensor([0, 1])), expected)


def test_masked_actions_do_not_enter_the_penalty() -> None:
    def loss_of(q_tm1: Tensor) -> Tensor:
        allowed = allowed_only(q_tm1, torch.tensor([[True, False, True]]))
        return cross_entropy(allowed, torch.tensor([0]))

    q_tm1 = torch.tensor([[1.0, 9.0, 1.0]])
    torch.testing.assert_close(loss_of(q_tm1), torch.tensor([math.log(2.0)]))
    torch.testing.assert_close(gradient(loss_of, q_tm1), torch.tensor([[-0.5, 0.0, 0.5]]))


def test_expectile_regression_weights_positive_errors_more() -> None:
    def loss_of(v_tm1: Tensor) -> Tensor:
        return expectile_regression(v_tm1, torch.tensor([2.0, -2.0]), 0.9)

    v_tm1 = torch.zeros(2, 1)
    torch.testing.assert_close(loss_of(v_tm1), torch.tensor([0.9 * 4, 0.1 * 4]))
    torch.testing.assert_close(gradient(loss_of, v_tm1), torch.tensor([[-0.9 * 4], [0.1 * 4]]))


def test_likely_actions_are_relative_to_the_most_likely() -> None:
    logits = torch.log(torch.tensor([[0.6, 0.3, 0.1]]))
    assert likely_actions(logits, 0.4).tolist() == [[True, True, False]]
    assert likely_actions(logits, 0.0).all()
    assert likely_actions(logits, 1.0).tolist() == [[True, False, False]]


def losses_to_check() -> dict[str, tuple[Callable[[Tensor], Tensor], tuple[int, ...]]]:
    a_tm1, target = torch.tensor([0, 2, 1, 1]), torch.tensor([0.3, -4.0, 2.0, 0.0]).double()
    samples = torch.linspace(-3, 3, 20).double().view(4, 5)
    return {
        "huber": (lambda q: huber_regression(q, a_tm1, target), (4, 3)),
        "square regression": (lambda q: square_regression(chosen(q, a_tm1), target), (4, 3)),
        "quantiles": (lambda z: quantile_regression(z, a_tm1, samples), (4, 3, 5)),
        "cross entropy": (lambda q: cross_entropy(q, a_tm1), (4, 3)),
        "penalty of quantiles": (lambda z: cross_entropy(mean_values(z), a_tm1), (4, 3, 5)),
        "square": (square_penalty, (4, 3)),
        "expectile": (lambda v: expectile_regression(v, target, 0.8), (4, 1)),
    }


@pytest.mark.parametrize("name", losses_to_check())
@settings(max_examples=25)
@given(data=st.data())
def test_gradients_are_finite_differences(name: str, data: st.DataObject) -> None:
    loss_of, shape = losses_to_check()[name]
    # Multiples of 1/8, shifted away from the kinks at integers.
    grid = arrays(int64, shape, elements=st.integers(-40, 40))
    outputs = (torch.from_numpy(data.draw(grid)) / 8 + 0.03).double().requires_grad_()
    assert torch.autograd.gradcheck(loss_of, outputs, eps=1e-6, atol=1e-5)


@given(values=finite_values, shift=st.floats(-10, 10, width=32), actions=actions_of_three)
def test_penalty_is_never_negative_and_ignores_a_common_shift(
    values: NDArray[Any], shift: float, actions: NDArray[Any]
) -> None:
    q_tm1, a_tm1 = torch.from_numpy(values), torch.from_numpy(actions)
    penalty = cross_entropy(q_tm1, a_tm1)
    assert (penalty >= 0).all()
    torch.testing.assert_close(cross_entropy(q_tm1 + shift, a_tm1), penalty, rtol=1e-4, atol=1e-4)


@given(q_t=finite_values, selector=finite_values)
def test_double_q_learning_targets_never_exceed_q_learning(
    q_t: NDArray[Any], selector: NDArray[Any]
) -> None:
    zeros, q_t_value = torch.zeros(4), torch.from_numpy(q_t)
    plain = q_learning_target(zeros, zeros + 0.97, q_t_value)
    double = double_q_learning_target(zeros, zeros + 0.97, q_t_value, torch.from_numpy(selector))
    assert (double <= plain).all()


def test_noise_biases_q_learning_but_not_double_q_learning() -> None:
    # Ten actions have the value 0. Two networks estimate these values with independent noise.
    generator = torch.Generator().manual_seed(0)
    noise, other_noise = torch.randn(2, 20_000, 10, generator=generator)
    r_t, discount_t = torch.zeros(len(noise)), torch.ones(len(noise))
    plain = q_learning_target(r_t, discount_t, noise)
    double = double_q_learning_target(r_t, discount_t, noise, other_noise)
    # The largest of ten standard normal numbers is 1.539 on average.
    assert plain.mean().item() == pytest.approx(1.539, abs=0.02)
    assert double.mean().item() == pytest.approx(0.0, abs=0.03)


@pytest.mark.parametrize("wrong", ["r_t", "discount_t"])
def test_a_shape_that_would_broadcast_is_refused(wrong: str) -> None:
    tensors = {"r_t": R_T, "discount_t": DISCOUNT_T, "q_t": Q_T}
    tensors[wrong] = tensors[wrong][:1]
    with pytest.raises(AssertionError, match=wrong):
        q_learning_target(**tensors)


def test_a_column_of_actions_is_refused() -> None:
    with pytest.raises(AssertionError, match="actions"):
        cross_entropy(Q_TM1, A_TM1.unsqueeze(1))
