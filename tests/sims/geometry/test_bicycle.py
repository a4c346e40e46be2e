"""Tests of the lane sim's car against highway-env's implementation of the same equations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from highway_env.vehicle.kinematics import Vehicle
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaprl.sims.geometry import moving, roll, slip_of
from mcaprl.sims.lane.rules import (
    ACTION_COMMANDS,
    ACTION_MEANINGS,
    BRAKE_M_S2,
    MAX_SPEED_M_S,
    SUBSTEP_S,
    SUBSTEPS,
    THROTTLE_M_S2,
    WHEELBASE_M,
    Command,
    drive,
    located,
    wheel_angle,
)


def their_car(x_m: float, y_m: float, yaw_rad: float, speed_m_s: float) -> Vehicle:
    """Return a car whose length is our wheelbase. highway-env uses the length as the wheelbase."""
    car = Vehicle(None, np.array([x_m, y_m]), yaw_rad, speed_m_s)
    car.LENGTH = WHEELBASE_M
    return car


COMMANDS = st.lists(st.tuples(st.floats(-0.6, 0.6), st.floats(-8.0, 4.0)), min_size=1, max_size=60)


@given(st.floats(0.0, 30.0), st.floats(-3.0, 3.0), COMMANDS)
@settings(max_examples=50)
def test_each_step_of_a_trajectory_agrees(
    speed_m_s: float, yaw_rad: float, commands: list[tuple[float, float]]
) -> None:
    """Both cars have the same start, wheelbase, time step, steering and acceleration."""
    theirs = their_car(3.0, -2.0, yaw_rad, speed_m_s)
    ours = moving(3.0, -2.0, yaw_rad, speed_m_s)
    for steering_rad, acceleration_m_s2 in commands:
        theirs.act({"steering": steering_rad, "acceleration": acceleration_m_s2})
        theirs.step(SUBSTEP_S)
        slip_sine = slip_of(steering_rad, 0.0, 9.0, WHEELBASE_M)
        ours = roll(ours, slip_sine, acceleration_m_s2, WHEELBASE_M, SUBSTEP_S)
        expected = (*theirs.position, theirs.heading, theirs.speed)
        assert ours[:4] == pytest.approx(expected, rel=1e-9, abs=1e-9)


DECISIONS = st.sampled_from(ACTION_COMMANDS) | st.builds(
    Command, st.floats(-1, 1), st.floats(-1, 1)
)


@given(st.floats(0.0, 30.0), st.lists(DECISIONS, min_size=1, max_size=40))
@settings(max_examples=50)
def test_each_decision_of_a_drive_agrees(speed_m_s: float, commands: list[Command]) -> None:
    """Both cars also have the same wheel angle (`wheel_angle`), throttle and brake."""
    theirs = their_car(20.0, 1.0, 0.0, speed_m_s)
    ours = located(moving(20.0, 1.0, 0.0, speed_m_s), 0.0, 20.0, 0.0)
    steering = 0.0
    for command in commands:
        steering = steering if math.isnan(command.steering) else command.steering
        for _ in range(SUBSTEPS):
            push_m_s2 = command.pedal * THROTTLE_M_S2 * (1 - theirs.speed / MAX_SPEED_M_S)
            stop_m_s2 = -min(-command.pedal * BRAKE_M_S2, theirs.speed / SUBSTEP_S)
            acceleration_m_s2 = stop_m_s2 if command.pedal < 0 else push_m_s2
            angle_rad = wheel_angle(steering, theirs.speed)
            theirs.act({"steering": angle_rad, "acceleration": acceleration_m_s2})
            theirs.step(SUBSTEP_S)
        ours = drive(ours, command)
        assert (ours.x_m, ours.y_m) == pytest.approx(tuple(theirs.position), abs=1e-6)
        assert np.cos(ours.yaw_rad) == pytest.approx(np.cos(theirs.heading), abs=1e-6)
        assert np.sin(ours.yaw_rad) == pytest.approx(np.sin(theirs.heading), abs=1e-6)
        assert ours.speed_m_s == pytest.approx(theirs.speed, abs=1e-9)


@pytest.mark.parametrize("action", range(len(ACTION_MEANINGS)))
def test_actions_turn_in_the_named_direction(action: int) -> None:
    after = drive(located(moving(20.0, 1.0, 0.0, 8.0), 0.0, 20.0, 0.0), ACTION_COMMANDS[action])
    meaning = ACTION_MEANINGS[action]
    assert (after.yaw_rad > 0) == ("left" in meaning)
    assert (after.yaw_rad < 0) == ("right" in meaning)
    assert (after.speed_m_s < 8.0) == (meaning == "brake")
