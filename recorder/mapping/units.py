"""Units of the numbers in commands of common message types (REP 103)."""

from __future__ import annotations

import re
from typing import Final

_TWIST = {r"linear\.[xyz]": "m/s", r"angular\.[xyz]": "rad/s"}
_DRIVE = {
    "steering_angle": "rad",
    "steering_angle_velocity": "rad/s",
    "speed": "m/s",
    "acceleration": "m/s^2",
    "jerk": "m/s^3",
}
_UNITS: Final = {
    "Twist": _TWIST,
    "TwistStamped": _TWIST,
    "Accel": {r"linear\.[xyz]": "m/s^2", r"angular\.[xyz]": "rad/s^2"},
    "Wrench": {r"force\.[xyz]": "N", r"torque\.[xyz]": "N m"},
    "AckermannDrive": _DRIVE,
    "AckermannDriveStamped": _DRIVE,
}


def unit_of(type_name: str, field: str) -> str:
    """Return the unit of a field by the name of the message type; empty if it is not known.

    >>> unit_of("geometry_msgs/msg/Twist", "linear.x"), unit_of("std_msgs/msg/Float64", "data")
    ('m/s', '')
    >>> unit_of("geometry_msgs/msg/TwistStamped", "twist.angular.z")
    'rad/s'
    """
    known = _UNITS.get(re.split(r"[/.]", type_name)[-1], {})
    found = (unit for name, unit in known.items() if re.fullmatch(rf"(.*\.)?{name}", field))
    return next(found, "")
