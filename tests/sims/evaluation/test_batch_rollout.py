"""Tests that batched episodes equal episodes that run one after the other."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mcaprl.sims import make_sim, make_sims
from mcaprl.sims.evaluation.evaluate import evaluate
from mcaprl.sims.evaluation.rollout import EpsilonGreedy, batch_rollout, run_episode


class Swaying:
    """Policy that uses only the first number of each row, so that batching has no effect."""

    name = "swaying"

    def __init__(self, actions: int) -> None:
        self._actions = actions

    def act(self, observations: Any) -> NDArray[np.int64]:
        codes: NDArray[np.int64] = (np.abs(observations[:, 0]) * 1e4).astype(np.int64)
        return codes % self._actions


@pytest.mark.parametrize(
    ("sim", "arguments"),
    [
        ("lane", {}),
        ("powerline", {"wind_m_s": 3.0, "gust_m_s": 1.0}),
        ("racer", {}),
        ("CartPole-v1", {}),
    ],
)
def test_batched_episodes_equal_single_episodes(sim: str, arguments: dict[str, Any]) -> None:
    env, envs = make_sim(sim, **arguments), make_sims(sim, 5, **arguments)
    actions = int(env.action_space.n)  # type: ignore[attr-defined]
    policy, seeds = Swaying(actions), [3, 1, 4, 1, 5]
    reported: list[int] = []
    together = batch_rollout(envs, policy, seeds, lambda result: reported.append(result.seed))
    behavior = EpsilonGreedy(policy, 0.0, env.action_space)
    for seed, result in zip(seeds, together, strict=True):
        alone = run_episode(env, behavior, seed=seed)
        assert (result.seed, result.length, result.reason) == (seed, alone.length, alone.reason)
        assert result.total_reward == pytest.approx(alone.total_reward, rel=1e-12)
        np.testing.assert_allclose(result.positions, alone.positions, atol=1e-9)
    assert sorted(reported) == sorted(seeds)


def test_scores_are_equal_and_success_is_reported() -> None:
    env = make_sim("lane", max_episode_steps=8)
    envs = make_sims("lane", 6, max_episode_steps=8)
    options: dict[str, Any] = {"name": "swaying", "episodes": 6, "seed": 2}
    one_by_one = evaluate(env, [Swaying(6)], **options)
    together = evaluate(env, [Swaying(6)], envs=envs, **options)
    np.testing.assert_allclose(together.returns, one_by_one.returns)
    assert together.ends == one_by_one.ends
    assert together.success_rate == together.ends.get("time_limit", 0) / 6
    assert evaluate(make_sim("CartPole-v1"), [None], **options).success_rate is None
