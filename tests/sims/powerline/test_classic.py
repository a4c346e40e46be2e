"""Tests of the published rules of the powerline sim: numbers worked by hand, and known faults."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from mcaprl.sims import make_sim
from mcaprl.sims.geometry import Vector
from mcaprl.sims.powerline.course import LEG_LENGTHS_M, LENGTH_M, POINTS_M, TANGENTS, point_on_line
from mcaprl.sims.powerline.env import PowerlineEnv
from mcaprl.sims.powerline.quadrotor import POINT
from mcaprl.sims.powerline.rules import (
    COLLISION,
    DIRECTIONS,
    FLYING,
    OFF_LINE,
    begin,
    classic_decide,
    classic_distance,
    classic_end,
    classic_reward,
)

ZERO = Vector(0.0, 0.0, 0.0)
NORTH, SOUTH, NOTHING = 0, 3, 6


def changed(action: int) -> Vector:
    """Return the velocity change of an action, m/s."""
    return Vector(*(0.25 * DIRECTIONS[action]).tolist())


def beside(leg: int, along_m: float, distance_m: float) -> Vector:
    """Return a point at a horizontal distance to the right of a leg or of the leg's extension."""
    across = np.cross([0.0, 0.0, 1.0], TANGENTS[leg])
    across /= np.linalg.norm(across)
    return Vector(*(POINTS_M[leg] + along_m * TANGENTS[leg] + distance_m * across).tolist())


@pytest.mark.parametrize(
    ("place", "speed_m_s", "hit", "reward", "end"),
    [
        # At distance d and speed v, the reward is (e^-d - .5) + (v - .5).
        # On the line, at rest: (1 - .5) + (0 - .5) = 0.
        (beside(0, 30.0, 0.0), 0.0, False, 0.0, FLYING),
        # On the line, at the speed after the start.
        (beside(0, 30.0, 0.0), 1.445, False, 1.445, FLYING),
        # 1 m beside the line, at 2 m/s: (e^-1 - .5) + 1.5.
        (beside(1, 60.0, 1.0), 2.0, False, 1.367879, FLYING),
        # 1 m beside the line, at rest: (e^-1 - .5) - .5.
        (beside(1, 60.0, 1.0), 0.0, False, -0.632121, FLYING),
        # 3 m beside the line, at 0.5 m/s: (e^-3 - .5) + 0.
        (beside(2, 100.0, -3.0), 0.5, False, -0.450213, FLYING),
        # 6.99 m beside the line, at 10 m/s in any direction: (e^-6.99 - .5) + 9.5.
        (beside(3, 100.0, 6.99), 10.0, False, 9.000921, FLYING),
        # Beyond 7 m, the reward is -10 and the episode ends, at any speed.
        (beside(3, 100.0, 7.01), 10.0, False, -10.0, OFF_LINE),
        (beside(0, -30.0, 7.5), 1.0, False, -10.0, OFF_LINE),
        # A collision has priority.
        (beside(1, 60.0, 0.0), 3.0, True, -100.0, COLLISION),
        (beside(1, 60.0, 9.0), 3.0, True, -100.0, COLLISION),
        # The first leg is part of an infinite line. 50 m before the start, the distance is 0.
        (beside(0, -50.0, 0.0), 1.0, False, 1.0, FLYING),
        # On the same infinite line, 100 m past the first tower, the distance is also 0.
        (beside(0, LEG_LENGTHS_M[0] + 100.0, 0.0), 1.0, False, 1.0, FLYING),
        # 300 m beyond the last tower, 2 m beside the last leg's line: (e^-2 - .5) + .5.
        (beside(3, LEG_LENGTHS_M[3] + 300.0, 2.0), 1.0, False, 0.135335, FLYING),
    ],
)
def test_rewards_and_ends_by_hand(
    place: Vector, speed_m_s: float, hit: bool, reward: float, end: int
) -> None:
    assert classic_reward(place, speed_m_s, hit) == pytest.approx(reward, abs=2e-6)
    assert classic_end(place, hit) == end


def test_the_distance_is_the_published_formula() -> None:
    """The distance is |(p - a) x (p - b)| / |a - b|, the minimum over all legs."""
    random = np.random.default_rng(0)
    for place in random.uniform([-50, -150, -90], [600, 200, 0], size=(50, 3)):
        published = min(
            np.linalg.norm(np.cross(place - a, place - b)) / np.linalg.norm(a - b)
            for a, b in itertools.pairwise(POINTS_M)
        )
        assert classic_distance(Vector(*place.tolist())) == pytest.approx(published)


def classic() -> PowerlineEnv:
    """Return the sim without wrappers, after a reset."""
    sim = make_sim("powerline", rules="classic").unwrapped
    assert isinstance(sim, PowerlineEnv)
    sim.reset(seed=0)
    return sim


def test_an_action_changes_the_measured_velocity() -> None:
    """The command is .25 m/s above the measured 1 m/s.

    The 5 s of a decision are ten lags, after which e^-10 of the .25 m/s is missing.
    """
    flight = begin(point_on_line(150.0), Vector(1.0, 0.0, 0.0), ZERO)
    flight = flight._replace(command_m_s=Vector(4.0, 4.0, 4.0))
    after, hit = classic_decide(POINT, flight, changed(NORTH))
    assert not hit
    assert after.drone.velocity_m_s == pytest.approx((1.25 - 0.25 * math.exp(-10), 0.0, 0.0))


def test_a_decision_lasts_5_seconds() -> None:
    flight = begin(point_on_line(150.0), Vector(1.0, 0.0, 0.0), ZERO)
    after, _ = classic_decide(POINT, flight, changed(NOTHING))
    assert after.drone.position_m.x == pytest.approx(flight.drone.position_m.x + 5.0)
    assert classic().step_duration_s == 5.0


def test_it_starts_with_5_seconds_at_the_published_velocity() -> None:
    drone = classic().flight.drone
    assert drone.velocity_m_s == pytest.approx((1.0, -0.67, -0.8), abs=1e-3)
    flown = np.subtract(drone.position_m, POINTS_M[0])
    # The drone flies for 5 s, minus the lag of half a second.
    np.testing.assert_allclose(flown, 4.5 * np.array([1.0, -0.67, -0.8]), atol=0.25)


def test_fault_flying_past_the_first_tower_is_rewarded_for_100_m() -> None:
    sim = classic()
    paid_until_m = 0.0
    for _ in range(60):
        _, reward, terminated, _, _ = sim.step(NOTHING)
        if terminated:
            break
        assert reward > 0.4
        along = np.subtract(sim.flight.drone.position_m, POINTS_M[0]) @ TANGENTS[0]
        paid_until_m = float(along - LEG_LENGTHS_M[0])
    assert paid_until_m > 90.0


def test_fault_flying_to_and_fro_has_a_higher_return_than_following() -> None:
    """The reward per decision is 10 at 10 m/s in any direction, but 2 when following at 2 m/s."""
    place = beside(2, 100.0, 0.0)
    assert classic_reward(place, 10.0, False) == pytest.approx(10.0)
    assert classic_reward(place, 2.0, False) == pytest.approx(2.0)
    backwards = begin(place, Vector(-2.0, -1.0, 0.0), ZERO)
    after, _ = classic_decide(POINT, backwards, changed(SOUTH))
    assert classic_reward(after.drone.position_m, 2.25, False) > 0.0


def test_fault_flying_on_beyond_the_end_is_rewarded() -> None:
    sim = classic()
    end = POINTS_M[-1] - TANGENTS[-1]
    sim.reset(options={"pose": (*end, *(2.0 * TANGENTS[-1]))})
    for _ in range(10):
        _, reward, terminated, _, info = sim.step(NOTHING)
        assert not terminated
        assert reward == pytest.approx(2.0, abs=0.01)
    assert info["line_distance_m"] > 90.0
    assert LENGTH_M < 622.0


def test_fault_hovering_on_the_line_costs_nothing_and_never_ends() -> None:
    sim = classic()
    sim.reset(options={"pose": tuple(point_on_line(150.0))})
    for _ in range(400):
        _, reward, terminated, _, _ = sim.step(NOTHING)
        assert (round(reward, 9), terminated) == (0.0, False)


def test_fault_commands_keep_the_effect_of_wind() -> None:
    """Each decision starts from the measured velocity, which wind has changed."""
    sim = make_sim("powerline", rules="classic", plant="quad").unwrapped
    assert isinstance(sim, PowerlineEnv)
    flight = begin(point_on_line(300.0), ZERO, Vector(0.0, 4.0, 0.0))
    drift = classic_decide(0, flight, changed(NOTHING))[0].drone.velocity_m_s
    assert abs(drift.y) > 1e-3


def test_fault_in_5_seconds_nothing_can_be_corrected() -> None:
    """At 2 m/s sideways, the next decision is 10 m from the line, whatever the action."""
    sim = classic()
    for action in range(7):
        sim.reset(options={"pose": (*beside(2, 100.0, 0.0), -0.9, 1.8, 0.0)})
        assert sim.step(action)[4]["reason"] == "off_line"
