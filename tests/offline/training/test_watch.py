"""Tests of validation during training: held-out episodes, short horizons, diverging values."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mcaprl.offline.algorithms.config import DQNConfig
from mcaprl.offline.training.train import train
from mcaprl.offline.training.watch import choose_held_out, divergence_warning, monte_carlo_returns
from mcaprl.recorder.dataset.dataset import Dataset
from tests.offline.training.test_train import SHORT, SHORT_CQL, silent
from tests.support.offline_tasks import corridor, crossing


def test_held_out_episodes_are_evaluated_but_not_trained_on(tmp_path: Path) -> None:
    # Rewards are 1 in the 12 held-out episodes, and 0 in the other 12 episodes.
    held_out = choose_held_out(np.arange(24), 0.5)
    data = crossing((10,) * 24)
    paid = np.isin(np.arange(24), held_out).repeat(10)
    columns = {
        name: getattr(data, name)
        for name in ("observations", "actions", "terminated", "truncated", "next_observations")
    }
    data = Dataset.from_arrays(rewards=paid.astype(float), **columns)
    config = DQNConfig(**{**SHORT, "held_out": 0.5}, gamma=0.0, learning_rate=0.01)
    (summary,) = train(data, config, tmp_path / "run", progress=silent)
    assert summary.terms["mean_q"] == pytest.approx(0.0, abs=0.1)
    assert summary.terms["held_out_return"] == 1.0
    assert summary.terms["held_out_td_error"] == pytest.approx(1.0, abs=0.1)


def test_returns_of_episodes_by_hand() -> None:
    data = crossing((3, 2))
    returns = monte_carlo_returns(data, np.array([0, 1]), 0.5)
    assert returns.tolist() == [1.75, 1.5, 1, 1.5, 1]
    assert monte_carlo_returns(data, np.array([1]), 0.0).tolist() == [1, 1]


def test_returns_of_short_truncated_episodes_are_unknown() -> None:
    observations = np.zeros((6, 1), np.float32)
    data = Dataset.from_arrays(
        observations=observations,
        actions=np.zeros(6, np.int64),
        rewards=np.ones(6),
        terminated=np.zeros(6, bool),
        truncated=np.arange(6) == 5,
        next_observations=observations,
    )
    returns = monte_carlo_returns(data, np.array([0]), 0.5)
    # The first missing reward has the discount 1/32 in the return of step 1, which is valid, and
    # the discount 1/16 in the return of step 2, which is NaN.
    assert np.isnan(returns).tolist() == [False, False, True, True, True, True]


@pytest.mark.parametrize(("episodes", "count"), [(1, 0), (9, 0), (10, 1), (200, 10)])
def test_about_a_twentieth_of_the_episodes_is_held_out(episodes: int, count: int) -> None:
    assert len(choose_held_out(np.arange(episodes), 0.05)) == count


def test_too_few_target_syncs_for_the_horizon_are_reported(tmp_path: Path) -> None:
    config = replace(SHORT_CQL, gamma=0.99)
    with pytest.warns(
        UserWarning, match="3 updates of the target network .* 3% of the horizon of gamma 0.99"
    ):
        train(corridor(), config, tmp_path / "run", progress=silent)


def test_diverging_values_are_reported_once(tmp_path: Path) -> None:
    # The second action is never logged, so its value can grow without limit.
    data = crossing((50,), n_actions=2)
    config = DQNConfig(**{**SHORT, "updates": 400, "learning_rate": 0.01}, gamma=0.99)
    with pytest.warns(UserWarning, match="values diverge") as caught:
        train(data, replace(config, target_interval=1), tmp_path / "run", progress=silent)
    (warning,) = caught
    # All rewards are 1, so no return is above 1 / (1 - .99).
    assert "exceed 100;" in str(warning.message)


@pytest.mark.parametrize(
    ("before", "value", "warns"),
    [(10.0, 21.0, True), (10.0, 19.0, False), (30.0, 25.0, False), (-10.0, -21.0, True)],
)
def test_values_beyond_twice_the_possible_return_diverge(
    before: float, value: float, warns: bool
) -> None:
    assert (divergence_warning(before, value, 10.0) is not None) == warns
