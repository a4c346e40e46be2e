"""Rules of the powerline sim: flight, rewards, episode ends and observations.

The published rules include the faults that `PowerlineEnv` lists. Axes are NED, as in
`mcaprl.sims.powerline.course`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled
from mcaprl.sims.geometry import Vector, minus, norm, plus, times
from mcaprl.sims.powerline.block import fly_all
from mcaprl.sims.powerline.course import (
    ALONG_M,
    LEGS,
    LENGTH_M,
    TANGENTS,
    Place,
    distance_to_infinite_line,
    ground_height,
    nearest_on_line,
    tower_distance,
    wire_distance,
)
from mcaprl.sims.powerline.quadrotor import DRONE_SIZE, Drone, cruising, drone_at, fly, store

ACTION_MEANINGS = (
    "faster north (+x)",
    "faster east (+y)",
    "faster down (+z)",
    "faster south (-x)",
    "faster west (-y)",
    "faster up (-z)",
    "no change",
)
DIRECTIONS: NDArray[np.float64] = np.vstack([np.eye(3), -np.eye(3), np.zeros((1, 3))])
"""(7, 3) velocity change of each action along x, y and z, in units of the velocity step."""
AXES = ("north", "east", "down")

DECISION_S = 0.5
CHECK_S = 0.1  # Interval of the checks for collisions and other episode ends
VELOCITY_STEP_M_S = 0.5
MAX_COMMAND_M_S = 8.0
APPROACH_S = 5.0
"""Duration of the approach: the flight from the first point before the first decision."""
FIRST_COMMAND_M_S = (1.0, -0.5, -1.0)
"""Command of the approach, in multiples of 0.5 m/s, so that actions can change it to 0. From the
published (1, -0.67, -0.8), actions could not command hovering."""

MAX_DISTANCE_M = 7.0
WIRE_CLEARANCE_M = 0.6
TOWER_CLEARANCE_M = 1.2
GROUND_CLEARANCE_M = 0.3
FINISH_M = 1.0  # Distance from the line's end at which an episode is finished
FAILURE_REWARD = -5.0
FINISH_REWARD = 5.0
BEST_PROGRESS_M = 2.5  # Progress per decision that has the highest reward; corresponds to 5 m/s
DISTANCE_SCALE_M = 4.0
FLYING, OFF_LINE, COLLISION, FINISHED = 0, 1, 2, 3
REASONS = ("", "off_line", "collision", "finished")

GUST_TIME_S = 2.0

_OBSERVED_VECTORS = ("offset", "velocity", "command_error", "tangent", "next_tangent")
OBSERVATION_NAMES = (
    *(f"{name}_{axis}" for name in _OBSERVED_VECTORS for axis in "xyz"),
    "to_corner",
    "corner_nearness",
    "lost_progress",
)
OBSERVATION_LIMIT = np.array([2] * 3 + [4] * 3 + [8] * 3 + [1] * 8 + [10], dtype=np.float32)

COMMAND, WIND, GUST, FURTHEST = DRONE_SIZE, DRONE_SIZE + 3, DRONE_SIZE + 6, DRONE_SIZE + 9
FLIGHT_SIZE = DRONE_SIZE + 10  # Number of floats in the array row of a `Flight`


class Flight(NamedTuple):
    """State of one drone on the line."""

    drone: Drone
    command_m_s: Vector  # Last commanded velocity
    wind_m_s: Vector  # Steady wind of the episode
    gust_m_s: Vector  # Current gust, in addition to the steady wind
    furthest_m: float  # Maximum progress along the line so far


@compiled
def vector_at(row: NDArray[np.float64], start: int) -> Vector:
    """Read a vector from three consecutive numbers of a row."""
    return Vector(row[start], row[start + 1], row[start + 2])


@compiled
def flight_at(row: NDArray[np.float64]) -> Flight:
    """Read a flight from a row of 33 floats."""
    return Flight(
        drone_at(row),
        vector_at(row, COMMAND),
        vector_at(row, WIND),
        vector_at(row, GUST),
        row[FURTHEST],
    )


@compiled
def store_flight(flight: Flight, row: NDArray[np.float64]) -> None:
    """Write a flight into a row of 33 floats."""
    store(flight.drone, row)
    for k in range(3):
        row[COMMAND + k] = flight.command_m_s[k]
        row[WIND + k] = flight.wind_m_s[k]
        row[GUST + k] = flight.gust_m_s[k]
    row[FURTHEST] = flight.furthest_m


@compiled
def begin(position_m: Vector, command_m_s: Vector, wind_m_s: Vector) -> Flight:
    """Return a flight that begins at a position, already at its commanded velocity."""
    drone = cruising(position_m, command_m_s)
    place = nearest_on_line(position_m)
    return Flight(drone, command_m_s, wind_m_s, Vector(0.0, 0.0, 0.0), place.along_m)


@compiled
def approach(plant: int, position_m: Vector, command_m_s: Vector, wind_m_s: Vector) -> Flight:
    """Return the flight of a drone that hovers at a position, then follows a command for 5 s."""
    drone = cruising(position_m, Vector(0.0, 0.0, 0.0))
    drone = fly(plant, drone, command_m_s, wind_m_s, APPROACH_S)
    along_m = nearest_on_line(drone.position_m).along_m
    return Flight(drone, command_m_s, wind_m_s, Vector(0.0, 0.0, 0.0), along_m)


@compiled
def commanded(velocity_m_s: Vector, command: Vector, is_change: bool) -> Vector:
    """Return the commanded velocity after a command."""
    # A change beyond 8 m/s is ignored; a velocity, in units of 8 m/s, is shortened to 8 m/s.
    if is_change:
        changed = plus(velocity_m_s, command)
        return changed if norm(changed) <= MAX_COMMAND_M_S else velocity_m_s
    return times(MAX_COMMAND_M_S / max(norm(command), 1.0), command)


@compiled
def next_gust(gust_m_s: Vector, strength_m_s: float, noise: NDArray[np.float64]) -> Vector:
    """Return the gust of the next decision, an Ornstein-Uhlenbeck process on each axis.

    The new gust is g' = g e + sigma sqrt(1 - e^2) n, whose stationary standard deviation is sigma.
    A decision lasts 0.5 s and the time constant is 2 s, so e = exp(-0.5 / 2).
    """
    kept = math.exp(-DECISION_S / GUST_TIME_S)
    fresh = strength_m_s * math.sqrt(1.0 - kept * kept)
    return plus(times(kept, gust_m_s), times(fresh, vector_at(noise, 0)))


@compiled
def collides(position_m: Vector) -> bool:
    """Return whether a drone at a position touches a conductor, a tower or the ground."""
    height_m = -position_m.z - ground_height(position_m.x, position_m.y)
    return (
        wire_distance(position_m) < WIRE_CLEARANCE_M
        or tower_distance(position_m) < TOWER_CLEARANCE_M
        or height_m < GROUND_CLEARANCE_M
    )


@compiled
def end_of(position_m: Vector, place: Place) -> int:
    """Return the outcome of a decision: FLYING, OFF_LINE, COLLISION or FINISHED."""
    if collides(position_m):
        return COLLISION
    if place.distance_m > MAX_DISTANCE_M:
        return OFF_LINE
    return FINISHED if place.along_m > LENGTH_M - FINISH_M else FLYING


@compiled
def reward_of(furthest_m: float, after: Flight, end: int) -> float:
    """Return the reward of a decision.

    The reward is min(x, 2 - x) exp(-d / 4 m) with x = ds / 2.5 m. The drone is at distance d from
    the line, and ds is its progress beyond `furthest_m`, the maximum before the decision. Finishing
    adds 5; a failure has the reward -5 instead. Above 5 m/s, the reward decreases with the
    speed. If the reward were constant above 5 m/s, an agent that discounts rewards would fly too
    fast, although it gets no rewards after a crash.
    """
    if end in (OFF_LINE, COLLISION):
        return FAILURE_REWARD
    distance_m = nearest_on_line(after.drone.position_m).distance_m
    progress = (after.furthest_m - furthest_m) / BEST_PROGRESS_M
    progress = min(progress, 2.0 - progress)
    bonus = FINISH_REWARD if end == FINISHED else 0.0
    return progress * math.exp(-distance_m / DISTANCE_SCALE_M) + bonus


@compiled
def observe(flight: Flight, observation: NDArray[np.float32]) -> None:
    """Write the 18 observed numbers; see "Observation Space" of `PowerlineEnv`."""
    drone = flight.drone
    place = nearest_on_line(drone.position_m)
    following = min(place.leg + 1, LEGS - 1)
    for k in range(3):
        observation[k] = (drone.position_m[k] - place.point_m[k]) / MAX_DISTANCE_M
        observation[3 + k] = drone.velocity_m_s[k] / 5.0
        observation[6 + k] = flight.command_m_s[k] - drone.velocity_m_s[k]
        observation[9 + k] = TANGENTS[place.leg, k]
        observation[12 + k] = TANGENTS[following, k]
    to_corner_m = ALONG_M[place.leg + 1] - place.along_m
    observation[15] = min(to_corner_m, 60.0) / 60.0
    observation[16] = math.exp(-to_corner_m / 10.0)
    observation[17] = (flight.furthest_m - place.along_m) / 10.0
    for i in range(len(observation)):
        limit = OBSERVATION_LIMIT[i]
        observation[i] = min(max(observation[i], -limit), limit)


@compiled
def store_bearings(flights: NDArray[np.float64], bearings: NDArray[np.float64]) -> None:
    """Compute (N, 5) offsets left and above, distance, speed, and way along the line."""
    for i in range(len(flights)):
        drone = drone_at(flights[i])
        place = nearest_on_line(drone.position_m)
        away = minus(drone.position_m, place.point_m)
        forward_x, forward_y = TANGENTS[place.leg, 0], TANGENTS[place.leg, 1]
        level = math.hypot(forward_x, forward_y)
        bearings[i, 0] = (forward_y * away.x - forward_x * away.y) / level
        bearings[i, 1], bearings[i, 2] = -away.z, place.distance_m
        bearings[i, 3], bearings[i, 4] = norm(drone.velocity_m_s), place.along_m


@compiled
def step_flights(
    plant: int,
    flights: NDArray[np.float64],
    commands: NDArray[np.float64],
    is_change: bool,
    gust_m_s: float,
    noise: NDArray[np.float64],
    rewards: NDArray[np.float64],
    ends: NDArray[np.int64],
    observations: NDArray[np.float32],
) -> None:
    """Advance drones (N, 33), rows of `Flight`, by one decision each, in place."""
    # commands is (N, 3), observations (N, 18), noise (N, 3) standard normal or (N, 0) without
    # gusts.
    if gust_m_s > 0.0:
        for i in range(len(flights)):
            gust = next_gust(vector_at(flights[i], GUST), gust_m_s, noise[i])
            for k in range(3):
                flights[i, GUST + k] = gust[k]
    befores_m = flights[:, FURTHEST].copy()
    decide_all(plant, flights, commands, is_change, ends)
    for i in range(len(flights)):
        after = flight_at(flights[i])
        rewards[i] = reward_of(befores_m[i], after, ends[i])
        observe(after, observations[i])


@compiled
def decide_all(
    plant: int,
    flights: NDArray[np.float64],
    commands: NDArray[np.float64],
    is_change: bool,
    ends: NDArray[np.int64],
) -> None:
    """Fly N drones for half a second or until their episodes end; see `step_flights`."""
    count = len(flights)
    velocities_m_s, winds = flights[:, COMMAND : COMMAND + 3], np.empty((count, 3))
    for i in range(count):
        before = vector_at(flights[i], COMMAND)
        velocity = commanded(before, vector_at(commands[i], 0), is_change)
        for k in range(3):
            velocities_m_s[i, k] = velocity[k]
            winds[i, k] = flights[i, WIND + k] + flights[i, GUST + k]
        ends[i] = FLYING
    for _ in range(round(DECISION_S / CHECK_S)):
        flying = np.flatnonzero(ends == FLYING)
        fly_all(plant, flights, flying, velocities_m_s, winds, CHECK_S)
        for number in flying:
            position_m = vector_at(flights[number], 0)
            place = nearest_on_line(position_m)
            flights[number, FURTHEST] = max(flights[number, FURTHEST], place.along_m)
            ends[number] = end_of(position_m, place)


CLASSIC_DECISION_S = 5.0
CLASSIC_VELOCITY_STEP_M_S = 0.25
CLASSIC_FIRST_COMMAND_M_S = (1.0, -0.67, -0.8)
COLLISION_REWARD = -100.0
OFF_LINE_REWARD = -10.0


@compiled
def classic_distance(position_m: Vector) -> float:
    """Return the distance to the nearest of the infinite lines through the legs, meters."""
    nearest_m = math.inf
    for leg in range(LEGS):
        nearest_m = min(nearest_m, distance_to_infinite_line(position_m, leg))
    return nearest_m


@compiled
def classic_end(position_m: Vector, hit: bool) -> int:
    """Return the outcome of a decision: FLYING, OFF_LINE or COLLISION."""
    if hit:
        return COLLISION
    return OFF_LINE if classic_distance(position_m) > MAX_DISTANCE_M else FLYING


@compiled
def classic_reward(position_m: Vector, speed_m_s: float, hit: bool) -> float:
    """Return -100 for a collision, -10 beyond 7 m, else (exp(-d) - 0.5) + speed - 0.5."""
    # The distance d to the nearest infinite line is in meters, and the speed is in m/s.
    end = classic_end(position_m, hit)
    if end == COLLISION:
        return COLLISION_REWARD
    if end == OFF_LINE:
        return OFF_LINE_REWARD
    return (math.exp(-classic_distance(position_m)) - 0.5) + (speed_m_s - 0.5)


@compiled
def classic_decide(plant: int, flight: Flight, change_m_s: Vector) -> tuple[Flight, bool]:
    """Fly for 5 s at the measured velocity plus a change; return whether it collided, too."""
    command = plus(flight.drone.velocity_m_s, change_m_s)
    wind = plus(flight.wind_m_s, flight.gust_m_s)
    drone, furthest_m, hit = flight.drone, flight.furthest_m, False
    for _ in range(round(CLASSIC_DECISION_S / CHECK_S)):
        drone = fly(plant, drone, command, wind, CHECK_S)
        furthest_m = max(furthest_m, nearest_on_line(drone.position_m).along_m)
        hit = collides(drone.position_m)
        if hit:
            break
    return Flight(drone, command, flight.wind_m_s, flight.gust_m_s, furthest_m), hit


@compiled
def step_classic(
    plant: int,
    flights: NDArray[np.float64],
    changes_m_s: NDArray[np.float64],
    rewards: NDArray[np.float64],
    ends: NDArray[np.int64],
    observations: NDArray[np.float32],
) -> None:
    """Advance N drones by one decision each, in place, like `step_flights`, with constant wind."""
    for i in range(len(flights)):
        change_m_s = vector_at(changes_m_s[i], 0)
        after, hit = classic_decide(plant, flight_at(flights[i]), change_m_s)
        position_m = after.drone.position_m
        rewards[i] = classic_reward(position_m, norm(after.drone.velocity_m_s), hit)
        ends[i] = classic_end(position_m, hit)
        observe(after, observations[i])
        store_flight(after, flights[i])
