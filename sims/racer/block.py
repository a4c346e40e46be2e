"""Step of N cars of the racer sim.

Whether a wall is near, and the codes of the rays' lengths, are computed in vectorized loops. The
results are bit-identical to those of `rules.advance` and `rules.observe`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled, inlined
from mcaprl.sims.geometry import log_code
from mcaprl.sims.racer.course import METERS_PER_PX, Track, car_at, store_car
from mcaprl.sims.racer.rays import BLOCK_SIZE, LENGTH, RAYS, measure
from mcaprl.sims.racer.rules import (
    CORNER_PX_2,
    MAX_SPEED_PX,
    Command,
    drive,
    edges_hit,
    observe_with,
    outcome_with,
    speed_of,
)

REACH_PX_2 = 1.0001 * CORNER_PX_2
"""Squared distance of a wall from which it cannot touch the car, with a margin for rounding."""
StepResult = tuple[float, int, float, float, float, float, int]


@compiled
def step_cars(
    track: Track,
    cars: NDArray[np.float64],
    commands: NDArray[np.float64],
    rewards: NDArray[np.float64],
    ends: NDArray[np.int64],
    observations: NDArray[np.float32],
    classic: bool,
    drift: bool,
) -> None:
    """Advance N independent cars by one step each, in place."""
    # cars is (N, 13), a `Car` and its start along the path, commands (N, 2), observations (N, 19).
    # With `drift`, the direction of travel lags behind the heading.
    lines, block = _lines_of(track.walls_px), np.empty(BLOCK_SIZE)
    lengths_px = np.empty((len(cars), RAYS))
    for i in range(len(cars)):
        before = car_at(cars[i])
        command = Command(commands[i, 0], commands[i, 1])
        after = drive(track, before, command, classic, drift)
        store_car(after, cars[i])
        hits = edges_hit(track, after) if _is_any_near(lines, after.x_px, after.y_px) else 0
        rewards[i], ends[i] = outcome_with(hits, before, after, classic)
        if classic:
            observe_with(track, after, classic, block, observations[i])
            continue
        measure(track.walls_px, after, classic, block)
        for ray in range(RAYS):
            lengths_px[i, ray] = block[LENGTH + ray]
        observations[i, RAYS] = after.speed_px / MAX_SPEED_PX
    if not classic:
        _write_codes(lengths_px.reshape(-1), observations)


@inlined
def _lines_of(walls_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return walls (W, 4) as rows (5, W): x and y of a point, a vector, and 1 / its square."""
    lines = np.empty((5, len(walls_px)))
    for wall in range(len(walls_px)):
        x1, y1, x2, y2 = walls_px[wall, 0], walls_px[wall, 1], walls_px[wall, 2], walls_px[wall, 3]
        lines[0, wall], lines[1, wall], lines[2, wall], lines[3, wall] = x1, y1, x2 - x1, y2 - y1
        lines[4, wall] = 1.0 / ((x2 - x1) * (x2 - x1) + (y2 - y1) * (y2 - y1))
    return lines


@inlined
def _is_any_near(lines: NDArray[np.float64], x_px: float, y_px: float) -> bool:
    """Return whether any wall may touch a car with its center at this point."""
    near = 0
    for wall in range(lines.shape[1]):
        along_x, along_y = lines[2, wall], lines[3, wall]
        x, y = x_px - lines[0, wall], y_px - lines[1, wall]
        share = min(max((x * along_x + y * along_y) * lines[4, wall], 0.0), 1.0)
        away_x, away_y = x - share * along_x, y - share * along_y
        near += 1 if away_x * away_x + away_y * away_y <= REACH_PX_2 else 0
    return near > 0


@inlined
def _write_codes(lengths_px: NDArray[np.float64], observations: NDArray[np.float32]) -> None:
    """Write the codes of N times 18 rays."""
    for k in range(len(lengths_px)):
        lengths_px[k] = log_code(METERS_PER_PX * lengths_px[k])
    for i in range(len(observations)):
        for ray in range(RAYS):
            observations[i, ray] = lengths_px[i * RAYS + ray]


@compiled
def step_only_car(
    track: Track,
    cars: NDArray[np.float64],
    commands: NDArray[np.float64],
    rewards: NDArray[np.float64],
    ends: NDArray[np.int64],
    observations: NDArray[np.float32],
    classic: bool,
    drift: bool,
    acceleration: float,
    turn: float,
) -> StepResult:
    """Advance a car; return reward, end, offset, heading error, speed, progress and gates."""
    commands[0, 0], commands[0, 1] = acceleration, turn
    step_cars(track, cars, commands, rewards, ends, observations, classic, drift)
    car = car_at(cars[0])
    info = (car.offset_m, car.heading_error_rad, speed_of(car), car.along_m - cars[0, -1])
    return rewards[0], ends[0], *info, int(car.gates)


@compiled
def car_info(cars: NDArray[np.float64], info: NDArray[np.float64]) -> None:
    """Compute the `info` (5, N) of cars: offsets, heading errors, speeds, progress and gates."""
    for i in range(len(cars)):
        car = car_at(cars[i])
        info[0, i], info[1, i], info[2, i] = car.offset_m, car.heading_error_rad, speed_of(car)
        info[3, i], info[4, i] = car.along_m - cars[i, -1], car.gates
