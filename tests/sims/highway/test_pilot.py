"""Tests of the pilot of the highway-lane sim."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mcaprl.sims import make_sim
from mcaprl.sims.evaluation.pilots import make_pilot
from mcaprl.sims.highway.env import STEERING_RAD


def drive_through(seed: int, **kwargs: Any) -> tuple[str, float]:
    """Let the pilot drive one episode; return the reason, and the mean offset from the lane."""
    env = make_sim("highway-lane", **kwargs)
    pilot = make_pilot(env)
    seen, info = env.reset(seed=seed)
    offsets, done = [], False
    while not done:
        seen, _, terminated, truncated, info = env.step(pilot.act(seen[np.newaxis])[0])
        offsets.append(abs(info["lateral_offset_m"]))
        done = terminated or truncated
    return info.get("reason", "time_limit"), float(np.mean(offsets))


def test_it_finishes_from_anywhere() -> None:
    drives = [drive_through(seed) for seed in range(25)]
    assert sum(reason == "finished" for reason, _ in drives) >= 24
    assert np.mean([offset_m for _, offset_m in drives]) < 0.6


@pytest.mark.parametrize("road", ["racetrack-v0", "racetrack-oval-v0"])
def test_it_laps_the_racetracks_around_other_cars(road: str) -> None:
    kwargs = {"road": road, "max_episode_steps": 200}
    assert [drive_through(seed, **kwargs)[0] for seed in range(4)] == ["time_limit"] * 4


def test_in_the_middle_it_drives_straight_and_from_the_side_it_returns() -> None:
    sim: Any = make_sim("highway-lane", road="racetrack-v0").unwrapped
    pilot = make_pilot(sim)
    signs = []
    for left_m in (0.0, 1.5, -1.5):
        seen, _ = sim.reset(seed=0, options={"pose": (45.0, left_m, 0.0)})
        # There is no car within 30 m ahead.
        assert sim.others[0].x_m > 75.0
        signs.append(np.sign(STEERING_RAD[pilot.act(seen[np.newaxis])[0]]))
    assert signs == [0.0, -1.0, 1.0]


def test_its_actions_have_a_leading_dimension_of_one() -> None:
    env = make_sim("highway-lane")
    seen, _ = env.reset(seed=0)
    pilot = make_pilot(env)
    actions = pilot.act(seen[np.newaxis])
    assert pilot.name == "pilot"
    assert actions.shape == (1,)
    assert actions.dtype == np.int64
    with pytest.raises(ValueError, match="not 2"):
        pilot.act(np.stack([seen, seen]))
