"""Tests of the pilot of the powerline sim."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mcaprl.sims.powerline.course import TANGENTS, point_on_line
from mcaprl.sims.powerline.pilot import corner_speed, wanted_velocity
from tests.support.sims import piloted


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"wind_m_s": 3.0, "gust_m_s": 1.0},
        {"plant": "point", "start": "line"},
        {"actions": "continuous"},
        {"actions": "continuous", "wind_m_s": 3.0, "gust_m_s": 1.0},
        {"actions": "increments"},
    ],
)
def test_it_finishes_from_anywhere(kwargs: dict[str, Any]) -> None:
    flights = [piloted("powerline", seed, **kwargs) for seed in range(100)]
    assert sum(reason == "finished" for _, reason, _ in flights) >= 98
    distances = [np.mean([info["line_distance_m"] for info in infos]) for _, _, infos in flights]
    assert np.mean(distances) < 0.4


@pytest.mark.parametrize(("actions", "expected"), [("discrete", 237.0), ("continuous", 248.0)])
def test_the_return_of_the_whole_line(actions: str, expected: float) -> None:
    returns = [piloted("powerline", seed, start="line", actions=actions)[0] for seed in range(5)]
    assert abs(np.mean(returns) - expected) < 7.0


def test_corners_are_flown_slowly_and_the_end_is_not() -> None:
    speeds = [corner_speed(leg) for leg in range(4)]
    angles = [np.arccos(TANGENTS[leg] @ TANGENTS[leg + 1]) for leg in range(3)]
    assert np.argmin(speeds[:3]) == np.argmax(angles)
    assert 1.9 < min(speeds) < 2.3
    assert speeds[3] == 5.0


def test_on_the_line_the_wanted_velocity_is_along_it() -> None:
    wanted = wanted_velocity(point_on_line(300.0))
    np.testing.assert_allclose(np.array(wanted), 5.0 * TANGENTS[2], atol=1e-6)
