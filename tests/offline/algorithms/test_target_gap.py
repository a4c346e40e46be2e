"""Tests of CQL whose alpha is tuned to a target gap."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mcaprl.errors import TrainingError, UsageError
from mcaprl.offline.algorithms.config import ALPHA_RANGE, CQLConfig
from mcaprl.offline.algorithms.cql import CQL
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.policy import read_policy
from mcaprl.offline.training.train import train
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.runs import read_curve
from tests.support.offline_tasks import GAMMA, corridor

SMALL: dict[str, Any] = {
    "updates": 600,
    "batch_size": 64,
    "learning_rate": 5e-3,
    "hidden": (32,),
    "gamma": GAMMA,
    "target_interval": 20,
}
LEFT_ENTROPY = -(2 * math.log(2 / 3) + math.log(1 / 3)) / 3
"""Mean penalty of a clone of `mostly_left`: the entropy of its actions, 0.637."""


def mostly_left() -> Dataset:
    return corridor({(cell, action): 2 - action for cell in (1, 2, 3) for action in (0, 1)})


def learner_of(config: CQLConfig, data: Dataset, *seeds: int) -> CQL:
    torch.set_num_threads(1)
    return CQL(config, TransitionBuffer.from_dataset(data, config.packing), seeds or (0,))


def alphas_and_gaps(learner: CQL, updates: int) -> tuple[list[float], list[float]]:
    """Train; return alpha and the mean penalty of the first seed's batch at each update."""
    found = [learner.seed_means(learner.update())[0] for _ in range(updates)]
    return [one["alpha"] for one in found], [one["conservative_penalty"] for one in found]


@pytest.mark.parametrize("scale_rewards", [False, True])
@pytest.mark.parametrize("gap", [LEFT_ENTROPY + 0.02, 0.7])
def test_the_gap_converges_to_its_target_from_any_alpha(gap: float, scale_rewards: bool) -> None:
    ends = []
    for start in (0.1, 3.0):
        config = CQLConfig(**SMALL, alpha=start, target_gap=gap, scale_rewards=scale_rewards)
        alphas, gaps = alphas_and_gaps(learner_of(config, mostly_left()), config.updates)
        assert alphas[0] == pytest.approx(start)
        assert np.mean(gaps[-200:]) == pytest.approx(gap, abs=0.01)
        ends.append(alphas[-1])
    assert ends[0] == pytest.approx(ends[1], rel=0.1)
    assert 0.2 < ends[0] < 5


def test_alpha_rises_above_the_target_and_falls_below_it() -> None:
    # No policy has a smaller penalty than a clone, so alpha rises to its limit; a target above the
    # penalty of Double DQN makes it fall to its limit.
    for gap, limit in ((0.5 * LEFT_ENTROPY, ALPHA_RANGE[1]), (2.0, ALPHA_RANGE[0])):
        config = CQLConfig(**{**SMALL, "final_learning_rate_fraction": 1.0}, target_gap=gap)
        alphas, gaps = alphas_and_gaps(learner_of(config, mostly_left()), 300)
        steps = np.diff(alphas[:50])
        assert ((steps > 0) if np.mean(gaps) > gap else (steps < 0)).all()
        assert alphas[-1] == pytest.approx(limit, rel=1e-3)


def test_each_seed_has_its_own_alpha_that_does_not_depend_on_other_seeds() -> None:
    config = CQLConfig(**{**SMALL, "updates": 40}, target_gap=0.7, weight_decay=0.5)
    alone, together = learner_of(config, mostly_left(), 3), learner_of(config, mostly_left(), 4, 3)
    for learner in (alone, together):
        for _ in range(40):
            learner.update()
    assert all(torch.equal(one, together.state(3)[key]) for key, one in alone.state(3).items())
    assert not torch.equal(together.scalars["log_alpha"][0], together.scalars["log_alpha"][1])


def test_weight_decay_does_not_apply_to_alpha() -> None:
    alphas = []
    for weight_decay in (0.0, 1e4):
        config = CQLConfig(**SMALL, alpha=10.0, target_gap=0.7, weight_decay=weight_decay)
        learner = learner_of(config, mostly_left())
        learner.update()
        alphas.append(learner.scalars["log_alpha"][0, 0].item())
    assert alphas[0] == alphas[1] != math.log(10)


def test_metrics_have_alpha_and_checkpoints_need_it(tmp_path: Path) -> None:
    short: dict[str, Any] = {**SMALL, "updates": 40, "log_interval": 10, "target_interval": 5}
    config = CQLConfig(**short, target_gap=0.7)
    train(mostly_left(), config, tmp_path / "run", progress=lambda _: None)
    alphas = read_curve(tmp_path / "run" / "seed-0" / "metrics.csv")["alpha"]
    assert len(alphas) == 4
    assert (alphas != 1).all()
    assert read_policy(tmp_path / "run" / "seed-0").head.networks.keys() == {"q"}
    train(mostly_left(), CQLConfig(**short), tmp_path / "fixed", progress=lambda _: None)
    assert "alpha" not in read_curve(tmp_path / "fixed" / "seed-0" / "metrics.csv")
    other = CQLConfig(**short, target_gap=0.6)
    with pytest.raises(TrainingError, match=r"target_gap 0\.7, not 0\.6"):
        train(mostly_left(), other, tmp_path / "run", resume=True, progress=lambda _: None)
    without_alpha = learner_of(CQLConfig(**short), mostly_left()).state(0)
    learner = learner_of(config, mostly_left())
    with pytest.raises(KeyError, match="log_alpha"):
        learner.load_state(0, without_alpha, 1)


@pytest.mark.parametrize("alpha", [0.0, 1e3])
def test_an_alpha_that_cannot_be_learned_from_is_refused(alpha: float) -> None:
    assert CQLConfig(alpha=alpha).alpha == alpha
    with pytest.raises(UsageError, match=r"alpha must be within \[0\.0001, 100\] with a target"):
        CQLConfig(alpha=alpha, target_gap=1.0)
