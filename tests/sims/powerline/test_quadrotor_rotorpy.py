"""Tests of our quadrotor against rotorpy's rigid body, an independent implementation with SciPy.

Both have the same mass, inertia, arms, and torque per thrust. rotorpy has no linear drag, so the
test adds our drag to its forces. rotorpy's axes are x forward, y left and z up: our axes rotated by
half a turn about x.
"""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mcaprl.sims.geometry import Quaternion, Vector
from mcaprl.sims.powerline.quadrotor import (
    DRAG_PER_S,
    INERTIA_KG_M2,
    MASS_KG,
    MAX_ROTOR_THRUST_N,
    QUAD,
    ROTOR_OFFSET_M,
    TIME_STEP_S,
    TORQUE_PER_THRUST_M,
    Drone,
    Rotors,
    advance,
    cruising,
    fly,
    move,
)
from tests.conftest import need

Floats = NDArray[np.float64]

ZERO = Vector(0.0, 0.0, 0.0)
HALF_TURN = np.array([1.0, -1.0, -1.0])
THRUST_PER_SPEED2 = 1e-6


def their_body() -> Any:
    """Return a rotorpy multirotor with our drone's parameters."""
    need(importlib.util.find_spec("rotorpy") is not None, "pip install rotorpy")
    from rotorpy.vehicles.multirotor import Multirotor

    o = ROTOR_OFFSET_M
    places = {"r1": (o, -o, 0), "r2": (-o, o, 0), "r3": (o, o, 0), "r4": (-o, -o, 0)}
    parameters = {
        "mass": MASS_KG,
        **dict(zip(("Ixx", "Iyy", "Izz"), INERTIA_KG_M2, strict=True)),
        **dict.fromkeys(("Ixy", "Ixz", "Iyz"), 0.0),
        "num_rotors": 4,
        "rotor_pos": {name: np.array(place, dtype=float) for name, place in places.items()},
        "rotor_directions": np.array([-1, -1, 1, 1]),
        "rotor_speed_min": 0.0,
        "rotor_speed_max": 1e4,
        "k_eta": THRUST_PER_SPEED2,
        "k_m": THRUST_PER_SPEED2 * TORQUE_PER_THRUST_M,
        "tau_m": 0.02,
    }
    body = Multirotor(parameters, aero=False)
    wrench_without_drag = body.compute_body_wrench

    def wrench(rates: Floats, rotors: Floats, body_airspeed_m_s: Floats) -> tuple[Floats, Floats]:
        force, moment = wrench_without_drag(rates, rotors, body_airspeed_m_s)
        return force - MASS_KG * DRAG_PER_S * body_airspeed_m_s, moment

    body.compute_body_wrench = wrench
    return body


def to_theirs(drone: Drone, wind: Vector) -> dict[str, Floats]:
    """Return the state of a drone in rotorpy's format."""
    w, x, y, z = drone.attitude
    return {
        "x": HALF_TURN * drone.position_m,
        "v": HALF_TURN * drone.velocity_m_s,
        "q": np.array([x, -y, -z, w]),
        "w": HALF_TURN * drone.rates_rad_s,
        "wind": HALF_TURN * wind,
        "rotor_speeds": np.sqrt(np.array(drone.thrusts_n) / THRUST_PER_SPEED2),
    }


def moved_by_theirs(body: Any, drone: Drone, command: Vector, wind: Vector) -> Drone:
    """Advance a drone by 2 ms with our controllers and rotors, but with rotorpy's body."""
    ours = advance(drone, command, wind)
    state = to_theirs(drone, wind) | {"rotor_speeds": to_theirs(ours, wind)["rotor_speeds"]}
    after = body.step(state, {"cmd_motor_speeds": state["rotor_speeds"]}, TIME_STEP_S)
    x, y, z, w = after["q"].tolist()
    return ours._replace(
        position_m=Vector(*(HALF_TURN * after["x"]).tolist()),
        velocity_m_s=Vector(*(HALF_TURN * after["v"]).tolist()),
        attitude=Quaternion(w, x, -y, -z),
        rates_rad_s=Vector(*(HALF_TURN * after["w"]).tolist()),
    )


@pytest.mark.parametrize(
    ("command", "wind"),
    [
        (Vector(2.0, 0.0, 0.0), ZERO),
        (ZERO, Vector(3.0, -2.0, 0.0)),
        (Vector(4.0, 1.0, 2.0), Vector(-2.0, 3.0, 0.0)),
    ],
    ids=["step", "hover in wind", "step in wind"],
)
def test_rotorpys_body_with_our_controllers_flies_equally(command: Vector, wind: Vector) -> None:
    """The velocities differ by at most 2 cm/s, and the attitudes by at most 1 degree.

    In the end, rotorpy's velocity differs from the command by less than 2 % of the sum of the
    speeds of the command and the wind.
    """
    body, ours = their_body(), cruising(ZERO, ZERO)
    theirs = ours
    for _ in range(30):
        ours = fly(QUAD, ours, command, wind, 0.1)
        for _ in range(50):
            theirs = moved_by_theirs(body, theirs, command, wind)
        np.testing.assert_allclose(theirs.velocity_m_s, ours.velocity_m_s, atol=0.02)
        assert abs(np.dot(theirs.attitude, ours.attitude)) > np.cos(np.radians(0.5))
    scale_m_s = np.linalg.norm(command) + np.linalg.norm(wind)
    error_m_s = np.linalg.norm(np.subtract(theirs.velocity_m_s, command))
    assert error_m_s < 0.02 * scale_m_s


def test_unequal_rotors_turn_rotorpys_body_equally() -> None:
    """Five random sets of unequal thrusts act for a tenth of a second each."""
    random = np.random.default_rng(2)
    body = their_body()
    for _ in range(5):
        thrusts = Rotors(*random.uniform(0.3, 0.6, 4).tolist())
        thrusts = Rotors(*(MAX_ROTOR_THRUST_N * np.array(thrusts)).tolist())
        ours = cruising(ZERO, Vector(1.0, -2.0, 0.5))._replace(thrusts_n=thrusts)
        state = to_theirs(ours, ZERO)
        for _ in range(50):
            ours = move(ours, thrusts, ZERO)
            state = body.step(state, {"cmd_motor_speeds": state["rotor_speeds"]}, TIME_STEP_S)
        np.testing.assert_allclose(HALF_TURN * state["w"], ours.rates_rad_s, atol=0.02, rtol=0.01)
        np.testing.assert_allclose(HALF_TURN * state["v"], ours.velocity_m_s, atol=0.01)
