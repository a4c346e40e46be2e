"""The equations of offline learning, against numbers worked by hand."""

from __future__ import annotations

import math
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from torch import Tensor

from mcaprl.offline.losses import (
    behavior_cloning,
    conservative_penalty,
    double_q_learning,
    huber,
    q_learning,
)

# Three transitions, two actions: one in mid-episode, one that terminated, one with gamma 0.
Q_TM1 = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
A_TM1 = torch.tensor([0, 1, 0])
R_T = torch.tensor([0.5, -1.0, 2.0])
DISCOUNT_T = torch.tensor([0.9, 0.0, 0.0])
Q_T = torch.tensor([[10.0, 20.0], [30.0, 40.0], [50.0, 60.0]])
SELECTOR_T = torch.tensor([[7.0, 3.0], [1.0, 2.0], [2.0, 1.0]])

finite_values = arrays(np.float32, (4, 3), elements=st.floats(-50, 50, width=32))
actions_of_three = arrays(np.int64, (4,), elements=st.integers(0, 2))


def test_q_learning_bootstraps_from_the_largest_value() -> None:
    td = q_learning(Q_TM1, A_TM1, R_T, DISCOUNT_T, Q_T)
    torch.testing.assert_close(td.target, torch.tensor([0.5 + 0.9 * 20, -1.0, 2.0]))
    torch.testing.assert_close(td.error, torch.tensor([18.5 - 1, -1.0 - 4, 2.0 - 5]))


def test_double_q_learning_values_the_action_that_the_other_network_selects() -> None:
    td = double_q_learning(Q_TM1, A_TM1, R_T, DISCOUNT_T, Q_T, SELECTOR_T)
    torch.testing.assert_close(td.target, torch.tensor([0.5 + 0.9 * 10, -1.0, 2.0]))
    torch.testing.assert_close(td.error, torch.tensor([9.5 - 1, -1.0 - 4, 2.0 - 5]))


def test_no_gradient_flows_through_a_target() -> None:
    q_tm1, q_t, selector = (x.clone().requires_grad_() for x in (Q_TM1, Q_T, SELECTOR_T))
    td = double_q_learning(q_tm1, A_TM1, R_T, DISCOUNT_T, q_t, selector)
    torch.autograd.backward(td.error.sum())
    assert q_t.grad is None
    assert selector.grad is None
    # d(target - q[a])/dq is -1 at the action taken and 0 elsewhere.
    torch.testing.assert_close(
        q_tm1.grad, torch.tensor([[-1.0, 0.0], [0.0, -1.0], [-1.0, 0.0]]), rtol=0, atol=0
    )


def test_huber_is_squared_near_zero_and_straight_beyond_one() -> None:
    error = torch.tensor([0.0, 0.5, -0.5, 1.0, 3.0, -3.0])
    expected = torch.tensor([0.0, 0.125, 0.125, 0.5, 2.5, 2.5])
    torch.testing.assert_close(huber(error), expected)


def test_conservative_penalty_by_hand() -> None:
    q_tm1 = torch.tensor([[0.0, 0.0], [math.log(3.0), 0.0]])
    # Row 0: log(1 + 1) - 0. Row 1: log(3 + 1) - log 3.
    expected = torch.tensor([math.log(2.0), math.log(4.0 / 3.0)])
    torch.testing.assert_close(conservative_penalty(q_tm1, torch.tensor([1, 0])), expected)


def test_conservative_penalty_pushes_unseen_actions_down_and_the_logged_one_up() -> None:
    q_tm1 = torch.tensor([[1.0, 0.0, -1.0]], requires_grad=True)
    torch.autograd.backward(conservative_penalty(q_tm1, torch.tensor([1])).sum())
    assert q_tm1.grad is not None
    pull = q_tm1.grad[0]
    # The gradient is softmax(q) - onehot(a); descent goes against it.
    weights = [math.exp(q) / (math.e + 1 + 1 / math.e) for q in (1.0, 0.0, -1.0)]
    torch.testing.assert_close(pull, torch.tensor([weights[0], weights[1] - 1, weights[2]]))
    assert pull[1] < 0 < pull[2] < pull[0]


def test_behavior_cloning_by_hand() -> None:
    logits_tm1 = torch.log(torch.tensor([[0.25, 0.75], [0.5, 0.5]]))
    expected = torch.tensor([math.log(4.0), math.log(2.0)])
    torch.testing.assert_close(behavior_cloning(logits_tm1, torch.tensor([0, 1])), expected)


@given(values=finite_values, shift=st.floats(-10, 10, width=32), actions=actions_of_three)
def test_penalty_is_never_negative_and_ignores_a_common_shift(
    values: NDArray[Any], shift: float, actions: NDArray[Any]
) -> None:
    q_tm1, a_tm1 = torch.from_numpy(values), torch.from_numpy(actions)
    penalty = conservative_penalty(q_tm1, a_tm1)
    assert (penalty >= 0).all()
    torch.testing.assert_close(
        conservative_penalty(q_tm1 + shift, a_tm1), penalty, rtol=1e-4, atol=1e-4
    )


@given(q_t=finite_values, selector=finite_values, actions=actions_of_three)
def test_double_q_learning_never_aims_above_q_learning(
    q_t: NDArray[Any], selector: NDArray[Any], actions: np.ndarray
) -> None:
    zeros, a_tm1 = torch.zeros(4), torch.from_numpy(actions)
    q_t_value, q_t_selector = torch.from_numpy(q_t), torch.from_numpy(selector)
    plain = q_learning(q_t_value, a_tm1, zeros, zeros + 0.97, q_t_value)
    double = double_q_learning(q_t_value, a_tm1, zeros, zeros + 0.97, q_t_value, q_t_selector)
    assert (double.target <= plain.target).all()


def test_noise_in_the_values_lifts_q_learning_but_not_double_q_learning() -> None:
    # Ten actions are all worth 0 and two networks guess them with independent noise.
    generator = torch.Generator().manual_seed(0)
    noise, other_noise = torch.randn(2, 20_000, 10, generator=generator)
    n_rows = len(noise)
    a_tm1, r_t = torch.zeros(n_rows, dtype=torch.int64), torch.zeros(n_rows)
    plain = q_learning(noise, a_tm1, r_t, torch.ones(n_rows), noise)
    double = double_q_learning(noise, a_tm1, r_t, torch.ones(n_rows), noise, other_noise)
    # The largest of ten standard normal numbers is 1.539 on average.
    assert plain.target.mean().item() == pytest.approx(1.539, abs=0.02)
    assert double.target.mean().item() == pytest.approx(0.0, abs=0.03)


@pytest.mark.parametrize("wrong", ["a_tm1", "r_t", "discount_t", "q_t"])
def test_a_shape_that_would_broadcast_is_refused(wrong: str) -> None:
    tensors: dict[str, Tensor] = {
        "q_tm1": Q_TM1,
        "a_tm1": A_TM1,
        "r_t": R_T,
        "discount_t": DISCOUNT_T,
        "q_t": Q_T,
    }
    tensors[wrong] = tensors[wrong][:1]
    with pytest.raises(AssertionError, match=wrong):
        q_learning(**tensors)


def test_a_column_of_actions_is_refused() -> None:
    with pytest.raises(AssertionError, match="a_tm1"):
        conservative_penalty(Q_TM1, A_TM1.unsqueeze(1))
