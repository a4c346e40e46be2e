"""Motion of frames within a step, reduced to a few poses between which viewers interpolate.

A message of `/tf` at the log_time of a step contains the poses of the frames until the end of the
step, each with its own stamp. A viewer interpolates between two poses, so it needs the pose after
the current time, too. Because a message includes the pose at the end of the step, the viewer can
draw any moment of the step.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.record.scene import Frame, timed_transforms

Moment = tuple[int, Sequence[Frame]]
"""log_time in nanoseconds, and the moving coordinate frames at that time."""

_TOLERANCE_M = 0.04
_TOLERANCE_ROTATION = 0.01
"""Maximum error of a quaternion component. For small angles, it is a rotation of 0.02 rad."""


def motion_transforms(moments: Sequence[Moment], *, thins: bool = True) -> bytes:
    """Encode the moments of a step as one `tf2_msgs/msg/TFMessage`, in order of time.

    Args:
        moments: Moments in order of time; all contain the same frames.
        thins: Whether to omit an intermediate pose if linear interpolation between the remaining
            poses differs from it by at most 0.04 m and 0.02 rad.
    """
    times = np.array([time_ns for time_ns, _ in moments], np.float64) - moments[0][0]
    kept = []
    for number in range(len(moments[0][1])):
        frames = [each[number] for _, each in moments]
        every = range(len(moments))
        for k in knots(times, _scaled(frames)) if thins and len(moments) > 1 else every:
            kept.append((moments[k][0], number, frames[k]))
    kept.sort(key=lambda each: each[:2])
    return timed_transforms([(time_ns, frame) for time_ns, _, frame in kept])


def knots(times: NDArray[np.float64], values: NDArray[np.float64]) -> list[int]:
    """Select rows from which linear interpolation reproduces the others with errors up to 1.

    Args:
        times: (N,) increasing times; N is at least 2.
        values: (N, K) numbers.

    Returns:
        Increasing indices of the selected rows; the first is 0 and the last N - 1.

    >>> times = np.arange(5.0)
    >>> knots(times, times[:, None] * 7), knots(times, np.array([[0.0], [0], [0], [4], [8]]))
    ([0, 4], [0, 2, 4])
    """
    if len(times) == 2:
        return [0, 1]
    share = ((times - times[0]) / (times[-1] - times[0]))[:, None]
    missed = np.abs(values - values[0] - share * (values[-1] - values[0])).max(axis=1)
    worst = int(missed.argmax())
    if missed[worst] <= 1.0:
        return [0, len(times) - 1]
    after = knots(times[worst:], values[worst:])
    return knots(times[: worst + 1], values[: worst + 1]) + [worst + k for k in after[1:]]


def _scaled(frames: Sequence[Frame]) -> NDArray[np.float64]:
    """Return (N, 7) positions and quaternions in units of their tolerances."""
    positions = np.array([frame.position for frame in frames]) / _TOLERANCE_M
    rotations = np.array([frame.rotation for frame in frames])
    # A quaternion and its negative are the same rotation.
    rotations *= np.where(rotations @ rotations[0] < 0.0, -1.0, 1.0)[:, None]
    return np.column_stack([positions, rotations / _TOLERANCE_ROTATION])
