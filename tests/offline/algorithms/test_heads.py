"""Tests of the policies for Box actions: densities, units, bounds."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor, nn

from mcaprl.actions import BoxActions
from mcaprl.errors import PolicyError, SpaceError
from mcaprl.offline.algorithms.heads import (
    COMPONENTS,
    BoxHead,
    Deterministic,
    Gaussian,
    Mixture,
    build_head,
)
from mcaprl.offline.algorithms.losses import truncated_normal_log_density
from mcaprl.offline.batches.observations import Observations

ONE = BoxActions.of(spaces.Box(-3.0, 5.0, (1,), np.float64))
TWO = BoxActions.of(spaces.Box(np.array([-1.0, 0.0]), np.array([1.0, 0.5]), dtype=np.float64))
EXTREMES = [0.0, 1.0, -3.0, 30.0, -30.0]


class Constant(nn.Module):
    """Network whose outputs are the same for all observations."""

    def __init__(self, outputs: Tensor) -> None:
        super().__init__()
        self.outputs = outputs

    def forward(self, observations: Observations) -> Tensor:
        return self.outputs.expand(len(observations), *self.outputs.shape)


def head_of(kind: type[BoxHead], box: BoxActions, outputs: Any, log_std: Any = None) -> BoxHead:
    values = torch.tensor(outputs, dtype=torch.float32)
    deviations = None if log_std is None else torch.tensor(log_std)
    return kind({"actor": Constant(values)}, box, deviations)


def mixture(means: list[list[float]], log_stds: list[list[float]]) -> list[float]:
    """Return outputs with equal weights; the given components are repeated."""
    count = len(means)
    parts = [[means[k % count], log_stds[k % len(log_stds)]] for k in range(COMPONENTS)]
    return [0.0] * COMPONENTS + np.array(parts).ravel().tolist()


def seen(count: int) -> Observations:
    return Observations(torch.zeros(count, 1))


def integral(head: BoxHead) -> float:
    """Integrate the density over the Box, with a grid that is dense at the bounds."""
    # Substitute a = sin(t), whose derivative is 0 at the bounds.
    angles, weights = np.polynomial.legendre.leggauss(1_200 if head.box.size == 1 else 500)
    angles, weights = angles * math.pi / 2, weights * math.pi / 2
    points, weights = np.sin(angles), weights * np.cos(angles)
    half = (head.box.high - head.box.low) / 2
    grid = np.stack(np.meshgrid(*[points] * head.box.size, indexing="ij"), -1)
    actions = head.box.low + (grid.reshape(-1, head.box.size) + 1) * half
    volume = np.prod(np.stack(np.meshgrid(*[weights] * head.box.size, indexing="ij")), 0)
    densities = np.exp(head.log_prob(seen(len(actions)), actions).numpy().astype(np.float64))
    return float((densities * volume.ravel()).sum() * half.prod())


@pytest.mark.parametrize("mean", EXTREMES)
@pytest.mark.parametrize("log_std", [0.0, 5.0, -3.0])
def test_densities_of_one_number_integrate_to_one(mean: float, log_std: float) -> None:
    heads = [
        head_of(Gaussian, ONE, [[mean], [log_std]]),
        head_of(Gaussian, ONE, [mean], [log_std]),
        head_of(Mixture, ONE, mixture([[mean], [-mean]], [[log_std], [0.5]])),
    ]
    for head in heads:
        assert integral(head) == pytest.approx(1, abs=2e-3)


@pytest.mark.parametrize("mean", EXTREMES)
def test_densities_of_two_numbers_integrate_to_one(mean: float) -> None:
    heads = [
        head_of(Gaussian, TWO, [[mean, -0.3], [0.2, -1.0]]),
        head_of(Gaussian, TWO, [mean, -mean], [0.5, -1.0]),
        head_of(Mixture, TWO, mixture([[mean, 0.5], [0.1, -mean]], [[0, 0.5], [-1, 0]])),
    ]
    for head in heads:
        assert integral(head) == pytest.approx(1, abs=2e-3)


def test_a_density_by_hand() -> None:
    # Mean 0 and deviation exp(-2), in a Box from -3 to 5: the mean is 1, the deviation 4 exp(-2).
    head = head_of(Gaussian, ONE, [0.0], [0.0])
    std = 4 * math.exp(-2)
    inside = math.erf(1 / (math.sqrt(2) * math.exp(-2)))
    peak = -math.log(std * math.sqrt(2 * math.pi)) - math.log(inside)
    found = head.log_prob(seen(2), np.array([[1.0], [1.0 + std]]))
    torch.testing.assert_close(found, torch.tensor([peak, peak - 0.5]))


@pytest.mark.parametrize("mean", EXTREMES)
def test_densities_at_the_bounds_are_finite(mean: float) -> None:
    bounds = np.array([[-3.0], [5.0]])
    for head in (
        head_of(Gaussian, ONE, [[mean], [0.0]]),
        head_of(Mixture, ONE, mixture([[mean]], [[-8.0]])),
    ):
        assert head.log_prob(seen(2), bounds).isfinite().all()
        outside = head.log_prob(seen(3), np.array([[-3.001], [5.001], [math.nan]]))
        assert (outside == -math.inf).all()


@pytest.mark.parametrize("mean", EXTREMES)
@pytest.mark.parametrize("kind", [Deterministic, Gaussian, Mixture])
def test_actions_are_in_the_box(kind: type[BoxHead], mean: float) -> None:
    outputs = {
        Deterministic: [mean, mean],
        Gaussian: [[mean, mean], [0, 0]],
        Mixture: mixture([[mean, mean]], [[0, 0]]),
    }[kind]
    low, high = np.array([[0.1, -0.3], [0.7, 1e6]], np.float32)
    space = spaces.Box(low, high)
    actions = head_of(kind, BoxActions.of(space), outputs).actions(seen(3)).numpy()
    assert actions.shape == (3, 2)
    assert all(space.contains(action) for action in actions)
    share = (math.tanh(mean) + 1) / 2
    np.testing.assert_allclose(actions[0], space.low + share * (space.high - space.low), rtol=1e-5)


def test_a_mixture_acts_by_its_most_likely_component() -> None:
    outputs = mixture([[0.1], [0.2], [0.3], [0.4], [0.5]], [[0.0]])
    outputs[3] = 1.0
    head = head_of(Mixture, ONE, outputs)
    assert head.actions(seen(1)).item() == pytest.approx(-3 + 4 * (math.tanh(0.4) + 1))


def test_one_action_has_no_density() -> None:
    with pytest.raises(PolicyError, match="no density"):
        head_of(Deterministic, ONE, [0.0]).log_prob(seen(1), np.zeros((1, 1)))


def test_the_density_has_the_gradient_of_differences() -> None:
    mean = torch.tensor([0.3, -0.9], dtype=torch.float64, requires_grad=True)
    log_std = torch.tensor([-1.0, 0.5], dtype=torch.float64, requires_grad=True)
    actions = torch.tensor([1.0, -0.2], dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda m, s: truncated_normal_log_density(actions, m, s), (mean, log_std)
    )


def test_a_head_for_a_box_needs_a_box() -> None:
    networks: dict[str, nn.Module] = {"actor": Constant(torch.zeros(2))}
    with pytest.raises(ValueError, match="gaussian"):
        build_head("gaussian", networks, spaces.Discrete(2))
    with pytest.raises(SpaceError, match="needs discrete actions"):
        build_head("q_values", networks, TWO.space, box=TWO)


def test_scaling_is_inverted() -> None:
    random = np.random.default_rng(0)
    actions: NDArray[Any] = random.uniform(TWO.low, TWO.high, (100, 2))
    np.testing.assert_allclose(TWO.unscaled(TWO.scaled(actions)), actions, atol=1e-6)
    bounds = np.stack([TWO.low, TWO.high])
    assert TWO.scaled(bounds).tolist() == [[-1, -1], [1, 1]]
    assert TWO.unscaled(np.array([[-1, -1], [1, 1]])).tolist() == bounds.tolist()
    assert TWO.log_scale == pytest.approx(-math.log(1 * 0.25))
