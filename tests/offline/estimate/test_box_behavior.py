"""Tests of estimated behavior densities of Box actions, and of their PIT."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from gymnasium import spaces
from scipy.stats import kstest, truncnorm

import mcaprl
from mcaprl.errors import SpaceError, UsageError
from mcaprl.offline.algorithms.heads import COMPONENTS, Mixture, bounded_log_std
from mcaprl.offline.estimate.behavior import (
    LARGEST_PIT_ERROR,
    PIT_RANGES,
    estimate_behavior,
    pit_shares,
)
from mcaprl.offline.estimate.box import BoxEvaluator
from mcaprl.offline.estimate.off_policy import BY_ESTIMATES
from tests.offline.estimate.test_box import NO_MODEL, Linear, by_name, episodes
from tests.support.offline_tasks import BOX_LQ


def outputs_of(log_weights: list[float], means: list[list[float]]) -> torch.Tensor:
    """Return one row of outputs of a mixture, with the deviations for raw numbers of 0."""
    components = torch.tensor(
        [[[math.atanh(m) for m in mean], [0.0] * len(mean)] for mean in means]
    )
    return torch.cat([torch.tensor(log_weights), components.flatten()]).unsqueeze(0)


def samples(outputs: torch.Tensor, count: int, seed: int = 0) -> torch.Tensor:
    """Draw actions (count, n) of a mixture by SciPy."""
    random = np.random.default_rng(seed)
    means = Mixture._components(outputs)[0, :, 0].tanh().numpy()
    weights = outputs[0, :COMPONENTS].softmax(0).double().numpy()
    std = math.exp(float(bounded_log_std(torch.zeros(()))))
    drawn = means[random.choice(COMPONENTS, size=count, p=weights / weights.sum())]
    low, high = (-1 - drawn) / std, (1 - drawn) / std
    found = truncnorm.rvs(low, high, loc=drawn, scale=std, random_state=random)
    return torch.from_numpy(found.astype(np.float32))


TWO_WAYS = outputs_of(
    [0.0, 0.5, -9.0, -9.0, -9.0], [[-0.6, 0.9], [0.5, -0.4], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]]
)
OTHER = outputs_of([0.0] * 5, [[0.1, 0.1], [0.5, -0.4], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])


def test_the_pit_of_the_true_density_is_uniform_and_that_of_another_is_not() -> None:
    actions = samples(TWO_WAYS, 4_000)
    pit = Mixture.pit(TWO_WAYS.expand(len(actions), -1), actions).numpy()
    for part in pit.T:
        assert kstest(part, "uniform").pvalue > 0.01
    # The parts of the transform are independent, although those of the actions are not.
    assert abs(np.corrcoef(actions.T.numpy())[0, 1]) > 0.8
    assert abs(np.corrcoef(pit.T)[0, 1]) < 0.05
    assert np.abs(pit_shares(pit) - 1 / PIT_RANGES).sum() / 2 < LARGEST_PIT_ERROR
    wrong = Mixture.pit(OTHER.expand(len(actions), -1), actions).numpy()
    assert kstest(wrong[:, 0], "uniform").pvalue < 1e-9
    assert np.abs(pit_shares(wrong) - 1 / PIT_RANGES).sum() / 2 > LARGEST_PIT_ERROR


def test_the_pit_is_the_integral_of_the_density() -> None:
    # One part: the trapezoid rule over the density, up to three actions.
    outputs = outputs_of([0.3, 0.0, -1.0, -2.0, 0.1], [[-0.9], [0.2], [0.0], [0.7], [0.99]])
    grid = torch.linspace(-1, 1, 20_001, dtype=torch.float64).float()[:, None]
    density = Mixture.log_density(outputs.expand(len(grid), -1), grid).exp().double().numpy()
    area = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2) * 1e-4])
    assert area[-1] == pytest.approx(1, abs=1e-4)
    for row in (4_000, 10_000, 17_500):
        found = float(Mixture.pit(outputs, grid[row : row + 1]))
        assert found == pytest.approx(area[row], abs=1e-4)


def test_the_pit_with_a_uniform_share_by_hand() -> None:
    # One component at 0, and half the actions uniform. A first number of .9 is out of the reach of
    # the component, so that the second number is uniform: its PIT is (.2 + 1) / 2.
    outputs = outputs_of([9.0] + [-99.0] * 4, [[0.0, 0.0]] * 5)
    found = Mixture.pit(outputs, torch.tensor([[0.9, 0.2]]), 0.5)[0]
    torch.testing.assert_close(found, torch.tensor([0.5 + 0.5 * 0.95, 0.6]), atol=1e-4, rtol=0)
    torch.testing.assert_close(
        Mixture.pit(outputs, torch.tensor([[0.9, 0.9]])), torch.ones(1, 2), atol=1e-4, rtol=0
    )


def test_shares_of_the_pit_by_hand() -> None:
    shares = pit_shares(np.array([[0.0, 1.0], [0.05, 0.95], [0.55, 0.5], [0.31, 0.39]]))
    expected = np.array([2, 0, 0, 2, 0, 2, 0, 0, 0, 2]) / 8
    np.testing.assert_allclose(shares, expected)


def test_estimated_densities_approach_those_of_the_policy_and_are_marked() -> None:
    torch.set_num_threads(1)
    data = episodes(60, 25)
    found = estimate_behavior(data, folds=3, updates=400)
    true, estimated = data.behavior_log_probs, found.dataset.behavior_log_probs
    assert np.abs(true - estimated).mean() < 0.25
    # The entropy of a normal distribution with a deviation of .5: log(.5 sqrt(2 pi e)).
    assert found.log_likelihood == pytest.approx(
        -math.log(0.5 * math.sqrt(2 * math.pi * math.e)), abs=0.15
    )
    assert found.calibration_error < LARGEST_PIT_ERROR
    assert sum(found.pit) == pytest.approx(1)
    assert len(found.pit) == PIT_RANGES
    assert found.reliability == ()
    for fold in found.folds:
        assert fold.uniform == pytest.approx(-math.log(8))
        assert fold.log_likelihood > fold.marginal > fold.uniform
    assert "PIT differs from uniform by 0.0" in str(found)
    assert "wrong" not in str(found)
    assert found.to_json()["pit"] == list(found.pit)
    assert found.dataset.has_estimated_probs
    every = by_name(BoxEvaluator(found.dataset, NO_MODEL).evaluate(Linear(1.0, 0.5), "normal"))
    assert every["PDIS"].verdict.endswith(BY_ESTIMATES)
    assert not every["FQE"].verdict.endswith(BY_ESTIMATES)


def test_densities_of_actions_at_the_stops_are_called_wrong() -> None:
    # Bang-bang actions have no density: every PIT is 0 or 1, or in the middle of a steep rise.
    data = episodes(30, 10)
    actions = np.where(np.random.default_rng(0).random((300, 1)) < 0.5, -4, 4).astype(np.float32)
    bang = mcaprl.Dataset.from_arrays(
        observations=data.observations,
        actions=actions,
        rewards=data.rewards,
        terminated=data.terminated,
        truncated=data.truncated,
        next_observations=data.next_observations,
        action_space=BOX_LQ,
    )
    found = mcaprl.estimate_behavior(bang, folds=2, updates=60)
    assert str(found).endswith("the densities are wrong")


def test_actions_outside_the_box_are_clipped_if_wanted() -> None:
    data = episodes(6, 4)
    actions = data.actions.copy()
    actions[0] = 5.0
    outside = mcaprl.Dataset.from_arrays(
        observations=data.observations,
        actions=actions,
        rewards=data.rewards,
        terminated=data.terminated,
        truncated=data.truncated,
        next_observations=data.next_observations,
        action_space=BOX_LQ,
    )
    with pytest.raises(SpaceError, match="`clip_actions=True`"):
        mcaprl.estimate("random", outside, updates=2)
    found = mcaprl.estimate("random", outside, updates=2, clip_actions=True, estimate_behavior=True)
    assert found.behavior_estimate is not None
    assert [one.estimator for one in found.estimates] == ["FQE", "PDIS", "WPDIS"]


def test_integers_and_few_episodes_are_refused() -> None:
    data = episodes(2, 3)
    with pytest.raises(UsageError, match="estimating behavior_log_prob in 2 folds needs 3"):
        estimate_behavior(data, folds=2)
    with pytest.raises(SpaceError, match="integers"):
        estimate_behavior(
            mcaprl.Dataset.from_arrays(
                observations=np.zeros((6, 1), np.float32),
                actions=np.arange(6, dtype=np.int64)[:, None],
                rewards=np.zeros(6),
                terminated=np.ones(6, bool),
                truncated=np.zeros(6, bool),
                next_observations=np.ones((6, 1), np.float32),
                action_space=spaces.Box(0, 9, (1,), np.int64),
            ),
            folds=3,
        )
