"""Tests of the pilot of the racer sim."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mcaprl.sims import make_sim
from mcaprl.sims.evaluation.pilots import make_pilot


def drive_through(seed: int, **kwargs: Any) -> tuple[float, str]:
    """Let the pilot drive one episode; return its total reward and reason."""
    env = make_sim("racer", **kwargs)
    pilot = make_pilot(env)
    observation, info = env.reset(seed=seed)
    total, done = 0.0, False
    while not done:
        actions = pilot.act(observation[np.newaxis])
        observation, reward, terminated, truncated, info = env.step(actions[0])
        total, done = total + float(reward), terminated or truncated
    return total, info["reason"]


def test_it_drives_on_from_anywhere() -> None:
    ends = [drive_through(seed) for seed in range(100)]
    assert sum(reason == "time_limit" for _, reason in ends) >= 98
    assert 150.0 < np.mean([total for total, _ in ends]) < 162.0


@pytest.mark.parametrize(
    "kwargs",
    [{"actions": 5}, {"actions": 8}, {"drift": True}, {"track_seed": 0}, {"track_seed": 1}],
)
def test_it_drives_by_other_actions_and_on_other_tracks(kwargs: dict[str, Any]) -> None:
    ends = [drive_through(seed, **kwargs) for seed in range(20)]
    assert sum(reason == "time_limit" for _, reason in ends) >= 19


def test_it_races_by_the_classic_rules_for_10_000_steps() -> None:
    total, reason = drive_through(0, rules="classic")
    assert reason == "time_limit"
    assert total > 1_400.0


def test_its_actions_have_a_leading_dimension_of_one() -> None:
    env = make_sim("racer")
    observation, _ = env.reset(seed=0)
    pilot = make_pilot(env)
    actions = pilot.act(observation[np.newaxis])
    assert pilot.name == "pilot"
    assert actions.shape == (1,)
    assert actions.dtype == np.int64
    with pytest.raises(ValueError, match="not 2"):
        pilot.act(np.stack([observation, observation]))
