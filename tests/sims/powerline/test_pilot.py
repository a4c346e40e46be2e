"""Tests of the pilot of the powerline sim."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mcaprl.sims import make_sim
from mcaprl.sims.evaluation.pilots import make_pilot
from mcaprl.sims.powerline.course import TANGENTS, point_on_line
from mcaprl.sims.powerline.pilot import corner_speed, wanted_velocity


def fly_through(seed: int, **kwargs: Any) -> tuple[float, str, float]:
    """Let the pilot fly one episode; return its total reward, reason and mean distance."""
    env = make_sim("powerline", **kwargs)
    pilot = make_pilot(env)
    observation, info = env.reset(seed=seed)
    total, done, distances = 0.0, False, []
    while not done:
        actions = pilot.act(observation[np.newaxis])
        observation, reward, terminated, truncated, info = env.step(actions[0])
        total, done = total + float(reward), terminated or truncated
        distances.append(info["line_distance_m"])
    return total, info.get("reason", "time_limit"), float(np.mean(distances))


@pytest.mark.parametrize(
    "kwargs", [{}, {"wind_m_s": 3.0, "gust_m_s": 1.0}, {"plant": "point", "start": "line"}]
)
def test_it_finishes_from_anywhere(kwargs: dict[str, Any]) -> None:
    flights = [fly_through(seed, **kwargs) for seed in range(100)]
    assert sum(reason == "finished" for _, reason, _ in flights) >= 98
    assert np.mean([distance_m for _, _, distance_m in flights]) < 0.4


def test_the_return_of_the_whole_line_is_about_237() -> None:
    returns = [fly_through(seed, start="line")[0] for seed in range(5)]
    assert 230.0 < np.mean(returns) < 243.0


def test_corners_are_flown_slowly_and_the_end_is_not() -> None:
    speeds = [corner_speed(leg) for leg in range(4)]
    angles = [np.arccos(TANGENTS[leg] @ TANGENTS[leg + 1]) for leg in range(3)]
    assert np.argmin(speeds[:3]) == np.argmax(angles)
    assert 1.9 < min(speeds) < 2.3
    assert speeds[3] == 5.0


def test_on_the_line_the_wanted_velocity_is_along_it() -> None:
    wanted = wanted_velocity(point_on_line(300.0))
    np.testing.assert_allclose(np.array(wanted), 5.0 * TANGENTS[2], atol=1e-6)


def test_it_flies_on_images_too_and_one_drone_at_a_time() -> None:
    env = make_sim("powerline", observation="depth")
    observation, _ = env.reset(seed=0)
    pilot = make_pilot(env)
    one: Any = {key: value[np.newaxis] for key, value in observation.items()}
    assert pilot.act(one).dtype == np.int64
    two = np.zeros((2, 18))
    with pytest.raises(ValueError, match="not 2"):
        pilot.act(two)
