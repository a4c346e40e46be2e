"""Plot the steering of two logged drives of the lane sim: with buttons, and with a steering wheel.

    python examples/experiments/commands.py buttons.mcap wheel.mcap commands.png

A button turns the wheels to a fixed angle; the wheel's position is a number from -1 to 1.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import mcaprl
from mcaprl.page import COLORS, new_figure, save_png

STEPS, STEP_S = 120, 0.25
FULL_STEERING = 2.0
"""Observed steering of the wheels at their full angle."""


def main() -> None:
    """Draw both drives, one above the other."""
    parser = argparse.ArgumentParser()
    parser.add_argument("logs", nargs=2, type=Path, metavar="LOG")
    parser.add_argument("out", type=Path)
    given = parser.parse_args()
    figure, axes = new_figure((7.0, 3.4), 2)
    for k, (panel, name) in enumerate(zip(axes, ("buttons", "wheel"), strict=True)):
        data = mcaprl.open(given.logs[k])
        first = data.episodes[0]
        after = first.next_observations[:STEPS, data.observation_names.index("steering")]
        steering = after / FULL_STEERING
        change = np.abs(np.diff(steering)).mean()
        panel.step(STEP_S * np.arange(len(steering)), steering, where="post", color=COLORS[k])
        panel.set_title(f"{name}: return {first.total_reward:.0f}, mean change a step {change:.3f}")
        panel.set_ylim(-1.05, 1.05)
        panel.set_ylabel("steering")
    axes[-1].set_xlabel("time, s")
    save_png(figure, given.out)


if __name__ == "__main__":
    main()
