"""Rotations, compared with matrices."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from mcaprl.recorder.mapping.transforms import euler_of, product, rotated, unit, upper

HALF = math.sqrt(0.5)


def about(axis: int, angle: float) -> NDArray[np.float64]:
    """Return the matrix of a rotation about x, y or z."""
    i, j = [k for k in range(3) if k != axis]
    matrix = np.eye(3)
    sine = math.sin(angle) if axis != 1 else -math.sin(angle)
    matrix[i, i] = matrix[j, j] = math.cos(angle)
    matrix[i, j], matrix[j, i] = -sine, sine
    return matrix


def matrix_of(roll: float, pitch: float, yaw: float) -> NDArray[np.float64]:
    """Return the matrix of rotations about the fixed axes x, y and z, in this order."""
    return about(2, yaw) @ about(1, pitch) @ about(0, roll)


def matrix_of_quaternion(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.column_stack(
        [rotated(quaternion[np.newaxis], axis[np.newaxis])[0] for axis in np.eye(3)]
    )


ANGLES = st.floats(-math.pi, math.pi)


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4))
def test_angles_and_quaternions_are_the_same_rotation(numbers: list[float]) -> None:
    quaternion = unit(np.array([numbers]))
    assume(not np.isnan(quaternion).any())
    matrix = matrix_of_quaternion(quaternion[0])
    np.testing.assert_allclose(matrix_of(*euler_of(quaternion)[0]), matrix, atol=3e-6)
    positive = upper(quaternion)
    assert positive[0, 3] >= 0
    np.testing.assert_allclose(matrix_of_quaternion(positive[0]), matrix, atol=1e-12)


@given(ANGLES, st.floats(-1.57, 1.57), ANGLES)
def test_angles_are_found_again(roll: float, pitch: float, yaw: float) -> None:
    turn = np.array([[0.0, 0.0, 0.0, 1.0]])
    for axis, angle in enumerate((roll, pitch, yaw)):
        step = np.zeros((1, 4))
        step[0, axis], step[0, 3] = math.sin(angle / 2), math.cos(angle / 2)
        turn = product(step, turn)
    np.testing.assert_allclose(
        matrix_of_quaternion(turn[0]), matrix_of(roll, pitch, yaw), atol=1e-12
    )
    found = euler_of(turn)[0]
    # -pi and pi are the same angle.
    error = (found - [roll, pitch, yaw] + math.pi) % (2 * math.pi) - math.pi
    np.testing.assert_allclose(error, 0, atol=1e-6)


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2])
def test_the_yaw_is_0_if_the_pitch_is_90_degrees(pitch: float) -> None:
    tilt = np.array([[0.0, math.sin(pitch / 2), 0.0, math.cos(pitch / 2)]])
    # Seen from the base, a roll before the tilt is a turn about the vertical axis.
    roll = np.array([[math.sin(0.2), 0.0, 0.0, math.cos(0.2)]])
    np.testing.assert_allclose(euler_of(product(tilt, roll)), [[0.4, pitch, 0]], atol=1e-7)
    # A yaw of 0.4 after the tilt is the opposite roll if the pitch is up, and this roll if down.
    yaw = np.array([[0.0, 0.0, math.sin(0.2), math.cos(0.2)]])
    expected = [[-math.copysign(0.4, pitch), pitch, 0]]
    np.testing.assert_allclose(euler_of(product(yaw, tilt)), expected, atol=1e-7)


def test_invalid_and_long_quaternions() -> None:
    quaternions = np.array([[0, 0, 0, 0], [0, 0, np.nan, 1], [0, 0, np.inf, 1], [0, 0, 3, 3.0]])
    np.testing.assert_allclose(unit(quaternions)[3], [0, 0, HALF, HALF])
    assert np.isnan(unit(quaternions)[:3]).all()
    assert np.isnan(euler_of(quaternions)[:3]).all()
    np.testing.assert_allclose(euler_of(quaternions)[3], [0, 0, math.pi / 2])


def test_the_sign_of_half_turns() -> None:
    found = upper(np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 1.0, 0.0, -0.0], [0.0, 0.6, 0.0, -0.8]]))
    assert found.tolist() == [[0, 1, 0, 0], [0, 1, 0, 0], [0, -0.6, 0, 0.8]]
    assert not np.signbit(found[:2]).any()
