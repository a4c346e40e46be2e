"""Track for which rewards, ends and rays can be computed by hand."""

from __future__ import annotations

import math

import numpy as np

from mcaprl.sims.geometry import closed_path
from mcaprl.sims.racer.course import Car, Track, placed
from mcaprl.sims.racer.rules import ACTION_COMMANDS, drive, outcome_of


def corridor(top_px: float = 100.0, bottom_px: float = 200.0) -> Track:
    """Return a box of 1000 pixels in length with gates at 300 and 600; cars drive to the right."""
    right_px = 1000.0
    corners = [(0.0, top_px), (right_px, top_px), (right_px, bottom_px), (0.0, bottom_px)]
    walls = np.array([(*corners[i], *corners[(i + 1) % 4]) for i in range(4)])
    gates = np.array([(x, top_px, x, bottom_px) for x in (300.0, 600.0)])
    path = closed_path([(0, 45), (100, 45), (100, 20), (0, 20), (0, 45)])
    return Track(walls, gates, path, (50.0, 150.0, 0.0))


def car_in(
    track: Track, x_px: float, y_px: float, heading_deg: float = 0.0, speed_px: float = 0.0
) -> Car:
    """Return a car at a position; its next gate is the first gate."""
    car = placed(track, x_px, y_px, math.radians(heading_deg), speed_px, x_px / 10)
    return car._replace(next_gate=0.0)


def outcome(before: Car, action: int, *, classic: bool) -> tuple[float, int]:
    """Return the reward and the end of one step in the corridor."""
    track = corridor()
    after = drive(track, before, ACTION_COMMANDS[action], classic, False)
    return outcome_of(track, before, after, classic)
