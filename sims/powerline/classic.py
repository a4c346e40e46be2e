"""Published rules of the powerline sim, including the faults that `PowerlineEnv` lists.

Axes are NED, as in `mcaprl.sims.powerline.course`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled
from mcaprl.sims.geometry.vectors import Vector, norm, plus, times
from mcaprl.sims.powerline.course import LEGS, distance_to_infinite_line, nearest_on_line
from mcaprl.sims.powerline.quadrotor import fly
from mcaprl.sims.powerline.rules import (
    CHECK_S,
    COLLISION,
    DIRECTIONS,
    FLYING,
    MAX_DISTANCE_M,
    OFF_LINE,
    Flight,
    collides,
    flight_at,
    observe,
    store_flight,
    vector_at,
)

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
    """Return the reward: -100 for a collision, -10 beyond 7 m, else (exp(-d) - 0.5) + speed - 0.5.

    The distance d to the nearest infinite line is in meters, and the speed is in m/s.
    """
    end = classic_end(position_m, hit)
    if end == COLLISION:
        return COLLISION_REWARD
    if end == OFF_LINE:
        return OFF_LINE_REWARD
    return (math.exp(-classic_distance(position_m)) - 0.5) + (speed_m_s - 0.5)


@compiled
def classic_decide(plant: int, flight: Flight, action: int) -> tuple[Flight, bool]:
    """Fly for 5 s; the command is the measured velocity plus the velocity change of the action.

    Returns:
        State of the drone, and whether the drone collided.
    """
    step = times(CLASSIC_VELOCITY_STEP_M_S, vector_at(DIRECTIONS[action], 0))
    command = plus(flight.drone.velocity_m_s, step)
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
    actions: NDArray[np.int64],
    rewards: NDArray[np.float64],
    ends: NDArray[np.int64],
    observations: NDArray[np.float32],
) -> None:
    """Advance N drones by one decision each, in place; see `step_flights` for the arguments.

    The wind is constant within an episode.
    """
    for i in range(len(flights)):
        after, hit = classic_decide(plant, flight_at(flights[i]), actions[i])
        position_m = after.drone.position_m
        rewards[i] = classic_reward(position_m, norm(after.drone.velocity_m_s), hit)
        ends[i] = classic_end(position_m, hit)
        observe(after, observations[i])
        store_flight(after, flights[i])
