"""Tests of the pilot of the highway-lane sim."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mcaprl.sims import make_sim
from mcaprl.sims.evaluation.evaluate import make_pilot
from mcaprl.sims.highway.env import STEERING_RAD
from tests.support.sims import piloted


@pytest.mark.parametrize("actions", ["discrete", "continuous"])
def test_it_finishes_from_anywhere(actions: str) -> None:
    drives = [piloted("highway-lane", seed, actions=actions) for seed in range(25)]
    assert sum(reason == "finished" for _, reason, _ in drives) >= 24
    offsets = [np.mean([abs(info["lateral_offset_m"]) for info in infos]) for *_, infos in drives]
    assert np.mean(offsets) < 0.6


@pytest.mark.parametrize("actions", ["discrete", "continuous"])
@pytest.mark.parametrize("road", ["racetrack-v0", "racetrack-oval-v0"])
def test_it_laps_the_racetracks_around_other_cars(road: str, actions: str) -> None:
    kwargs: dict[str, Any] = {"road": road, "actions": actions, "max_episode_steps": 200}
    reasons = [piloted("highway-lane", seed, **kwargs)[1] for seed in range(4)]
    assert reasons == ["time_limit"] * 4


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
