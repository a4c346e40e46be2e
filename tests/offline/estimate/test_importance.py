"""Tests of the equations of off-policy estimation, by hand and on a task with known values."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mcaprl.offline.estimate.importance import (
    ESTIMATORS,
    EpisodeTable,
    effective_sample_size,
    effective_sample_sizes,
    mean_weight,
)
from tests.support.two_state_task import EVALUATED, TRUE_Q, TRUE_V, play, true_value

# There are two episodes, and gamma is 1/2. The first episode has two steps. The second has one step
# and one column of padding.
BY_HAND = EpisodeTable(
    rewards=np.array([[1.0, 4.0, 0.0], [2.0, 0.0, 0.0]]),
    ratios=np.array([[2.0, 0.5, 1.0], [3.0, 1.0, 1.0]]),
    q=np.array([[1.0, 2.0, 0.0], [1.0, 0.0, 0.0]]),
    v=np.array([[3.0, 2.0, 0.0], [3.0, 0.0, 0.0]]),
    gamma=0.5,
)
ONCE = np.ones((1, 2))


@pytest.mark.parametrize("estimator", ["PDIS", "WPDIS", "DR", "WDR"])
def test_without_later_rewards_later_weights_do_not_count(estimator: str) -> None:
    """With gamma 0, the sizes are (1 + 3)^2 / (1 + 9), although no weight is left at step 1."""
    ratios = np.array([[1.0, 0.0], [3.0, 0.0]])
    table = EpisodeTable(np.ones((2, 2)), ratios, np.zeros((2, 2)), np.zeros((2, 2)), gamma=0.0)
    assert effective_sample_size(estimator, table) == pytest.approx(1.6)


@pytest.mark.parametrize(
    ("estimator", "value"),
    [
        # The returns of the two episodes are 1 + 4 / 2 = 3 and 2; rho_T is 2 x 0.5 = 1 and 3.
        ("TIS", (1 * 3 + 3 * 2) / 2),
        ("WIS", (1 * 3 + 3 * 2) / 4),
        # The sums of gamma^t rho_t r_t are 2 x 1 + 1/2 x 1 x 4 = 4, and 3 x 2 = 6.
        ("PDIS", (4 + 6) / 2),
        # Weighted mean rewards: (2 x 1 + 3 x 2) / (2 + 3) at step 0, and at step 1
        # (1 x 4 + 3 x 0) / (1 + 3), which is discounted by 1/2.
        ("WPDIS", 8 / 5 + 0.5 * 4 / 4),
        # The terms are gamma^t (rho_{t-1} V + rho_t (r - Q)).
        # First episode: 3 + 2 (1 - 1) + 1/2 (2 x 2 + 1 (4 - 2)) = 6. Second: 3 + 3 (2 - 1) = 6.
        ("DR", (6 + 6) / 2),
        # Step 0: the mean V is 3, and the weighted mean of r - Q is (2 x 0 + 3 x 1) / 5. Step 1:
        # they are (2 x 2 + 3 x 0) / 5 and (1 x 2 + 3 x 0) / 4, and are discounted by 1/2.
        ("WDR", 3 + 3 / 5 + 0.5 * (4 / 5 + 2 / 4)),
    ],
)
def test_estimators_by_hand(estimator: str, value: float) -> None:
    assert ESTIMATORS[estimator](BY_HAND).values(ONCE) == pytest.approx([value])


def test_a_resampling_counts_an_episode_as_often_as_it_was_drawn() -> None:
    twice_the_second = np.array([[0.0, 2.0]])
    alone = EpisodeTable(
        BY_HAND.rewards[1:], BY_HAND.ratios[1:], BY_HAND.q[1:], BY_HAND.v[1:], BY_HAND.gamma
    )
    for estimate in ESTIMATORS.values():
        assert estimate(BY_HAND).values(twice_the_second) == pytest.approx(
            estimate(alone).values(np.ones((1, 1)))
        )


def test_effective_sample_sizes_by_hand() -> None:
    # Step 0 has the weights 2 and 3, and the size (2 + 3)^2 / (4 + 9) = 25 / 13.
    # Step 1 has the weights 1 and 3, and the size (1 + 3)^2 / (1 + 9) = 16 / 10.
    assert effective_sample_sizes(BY_HAND) == pytest.approx([25 / 13, 1.6, 1.6])
    assert effective_sample_size("WIS", BY_HAND) == pytest.approx(1.6)
    mean = 1.75 / (13 / 25 + 0.5 / 1.6 + 0.25 / 1.6)
    assert effective_sample_size("PDIS", BY_HAND) == pytest.approx(mean)


def test_mean_weights_by_hand() -> None:
    # In the two episodes, rho is 2, 1, 1 and 3, 3, 3. The discounts are 1, 1/2, 1/4.
    whole, steps = mean_weight("TIS", BY_HAND), mean_weight("PDIS", BY_HAND)
    assert whole is not None
    assert whole.values(ONCE) == pytest.approx([(1 + 3) / 2])
    assert steps is not None
    assert steps.values(ONCE) == pytest.approx([(2.75 + 5.25) / 2 / 1.75])
    assert mean_weight("WIS", BY_HAND) is None


def test_one_huge_late_weight_leaves_one_effective_episode_without_normalization() -> None:
    """The weight of 1e30 is in the last of 21 steps, whose discount is 2^-20, about 1e-6."""
    shape = (50, 21)
    ratios = np.ones(shape)
    ratios[0, -1] = 1e30
    table = EpisodeTable(np.ones(shape), ratios, np.zeros(shape), np.zeros(shape), 0.5)
    assert effective_sample_size("WPDIS", table) > 49
    for name in ("PDIS", "DR", "TIS"):
        assert effective_sample_size(name, table) == pytest.approx(1.0)


def test_zero_weights_have_an_effective_sample_size_of_zero() -> None:
    never = EpisodeTable(BY_HAND.rewards, 0 * BY_HAND.ratios, 0 * BY_HAND.q, 0 * BY_HAND.v, 0.5)
    assert effective_sample_size("TIS", never) == 0.0
    for estimate in ESTIMATORS.values():
        assert estimate(never).values(ONCE) == pytest.approx([0.0])


shapes = st.tuples(st.integers(1, 6), st.integers(2, 8))
numbers = st.floats(-10, 10)


@st.composite
def tables(draw: st.DrawFn) -> EpisodeTable:
    shape = draw(shapes)
    rewards, q, v = (draw(arrays(np.float64, shape, elements=numbers)) for _ in range(3))
    ratios = draw(arrays(np.float64, shape, elements=st.sampled_from([0.0, 0.1, 0.5, 1.0, 3.0])))
    return EpisodeTable(rewards, ratios, q, v, draw(st.floats(0, 1)))


@given(tables())
def test_doubly_robust_without_a_model_is_per_decision_bit_for_bit(table: EpisodeTable) -> None:
    nothing = np.zeros_like(table.rewards)
    unmodeled = EpisodeTable(table.rewards, table.ratios, nothing, nothing, table.gamma)
    counts = np.ones((1, len(table.rewards)))
    assert ESTIMATORS["DR"](unmodeled).values(counts) == ESTIMATORS["PDIS"](unmodeled).values(
        counts
    )
    assert ESTIMATORS["WDR"](unmodeled).values(counts) == ESTIMATORS["WPDIS"](unmodeled).values(
        counts
    )


@given(tables())
def test_on_policy_estimators_without_a_model_equal_the_mean_return(table: EpisodeTable) -> None:
    nothing, ones = np.zeros_like(table.rewards), np.ones_like(table.rewards)
    own = EpisodeTable(table.rewards, ones, nothing, nothing, table.gamma)
    mean = (table.rewards @ own.discounts).mean()
    counts = np.ones((1, len(table.rewards)))
    for estimate in ESTIMATORS.values():
        assert estimate(own).values(counts) == pytest.approx([mean], abs=1e-9)


@given(tables())
def test_weighted_estimates_ignore_a_common_factor_of_the_first_weights(
    table: EpisodeTable,
) -> None:
    doubled = table.ratios.copy()
    doubled[:, 0] *= 2
    counts = np.ones((1, len(table.rewards)))
    other = EpisodeTable(table.rewards, doubled, table.q, table.v, table.gamma)
    for name in ("WIS", "WPDIS"):
        mine, others = (
            ESTIMATORS[name](table).values(counts),
            ESTIMATORS[name](other).values(counts),
        )
        assert mine == pytest.approx(others, rel=1e-9, abs=1e-9)


def test_the_task_agrees_with_its_linear_equations() -> None:
    # V = sum_a pi(a|s) Q(s, a), and the policy's mean return is V of the start.
    assert pytest.approx((EVALUATED * TRUE_Q).sum(1)) == TRUE_V
    own = play(EVALUATED, episodes=20_000, seed=0)
    returns = own.rewards @ own.discounts
    error = returns.std() / np.sqrt(len(returns))
    assert abs(returns.mean() - true_value()) < 4 * error


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_estimates_converge_to_the_true_value(estimator: str) -> None:
    counts = np.ones((1, 4_000))
    means = [
        ESTIMATORS[estimator](play(None, episodes=4_000, seed=seed)).values(counts)[0]
        for seed in range(12)
    ]
    error = np.std(means, ddof=1) / np.sqrt(len(means))
    assert abs(np.mean(means) - true_value()) < 4 * error


def test_a_true_model_removes_most_of_the_variance() -> None:
    counts = np.ones((1, 200))
    tables_of_200 = [play(None, episodes=200, seed=seed) for seed in range(60)]
    spread = {
        name: np.std([ESTIMATORS[name](table).values(counts)[0] for table in tables_of_200])
        for name in ("TIS", "PDIS", "DR")
    }
    assert spread["DR"] < 0.7 * spread["PDIS"] < 0.7 * spread["TIS"]


@given(tables())
def test_the_order_of_the_episodes_does_not_matter(table: EpisodeTable) -> None:
    order = np.arange(len(table.rewards))[::-1]
    turned = EpisodeTable(
        table.rewards[order], table.ratios[order], table.q[order], table.v[order], table.gamma
    )
    counts = np.ones((1, len(order)))
    for estimate in ESTIMATORS.values():
        assert estimate(table).values(counts) == pytest.approx(
            estimate(turned).values(counts), rel=1e-6, abs=1e-6
        )


def test_with_gamma_zero_only_the_first_reward_counts() -> None:
    table = EpisodeTable(BY_HAND.rewards, BY_HAND.ratios, BY_HAND.q, BY_HAND.v, 0.0)
    assert ESTIMATORS["PDIS"](table).values(ONCE) == pytest.approx([(2 * 1 + 3 * 2) / 2])
