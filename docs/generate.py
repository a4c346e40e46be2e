"""Writes what the docs show and nobody should type: `make docs`.

docs/cli.md                    the commands and their options, from the program itself
docs/images/lane-frames.png    what the lane sim looks like, from above and to its depth camera
docs/images/comparison.png     from the last `make demo`, if there was one
docs/images/trajectories.png   likewise
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import click
import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import mcaprl.sims  # noqa: F401  (registers the environments)
from mcaprl.cli import cli
from mcaprl.sims.pilots import make_pilot

DOCS = Path(__file__).parent
IMAGES = DOCS / "images"
DEMO_REPORT = DOCS.parent / "demo" / "report"
# Decisions of the pilot between two columns of the contact sheet, and where it starts.
FRAME_EVERY, FRAMES = 30, 6
START = (110.0, 1.0, 0.0, 10.0)


def command_reference() -> str:
    """The help of every command, as Markdown."""
    parts = ["# The commands\n\nWritten by `make docs` from the program's own help.\n"]
    with click.Context(cli, info_name="mcaprl", terminal_width=100, **cli.context_settings) as top:
        parts.append(_section("mcaprl", cli.get_help(top)))
        for name in cli.list_commands(top):
            command = cli.get_command(top, name)
            assert command is not None
            with click.Context(command, info_name=name, parent=top) as inner:
                parts.append(_section(f"mcaprl {name}", command.get_help(inner)))
    return "\n".join(parts)


def lane_frames() -> Figure:
    """A contact sheet: the pilot's drive from above, and what the depth camera sees."""
    env = gym.make("mcaprl/LaneKeeping-v0", render_mode="rgb_array", observation="depth")
    observation, _ = env.reset(seed=1, options={"pose": START})
    pilot = make_pilot(env)
    figure = Figure(figsize=(2.4 * FRAMES, 5.2), dpi=110)
    grid = figure.subplots(2, FRAMES)
    for column in range(FRAMES):
        telemetry = env.unwrapped.telemetry()  # type: ignore[attr-defined]
        title = f"{column * FRAME_EVERY * 0.25:.0f} s, {telemetry['speed_m_s']:.0f} m/s"
        _show(grid[0, column], np.asarray(env.render()), title)
        _show(grid[1, column], observation[:, :, 0], "")
        for _ in range(FRAME_EVERY):
            observation = env.step(pilot.act(observation[None])[0])[0]
    env.close()
    figure.tight_layout()
    return figure


def _show(axes: Any, picture: np.ndarray[Any, Any], title: str) -> None:
    axes.imshow(picture, cmap="turbo_r" if picture.ndim == 2 else None)
    axes.set_title(title, fontsize=9)
    axes.set_axis_off()


def _section(title: str, text: str) -> str:
    return f"## {title}\n\n```text\n{text.rstrip()}\n```\n"


def main() -> None:
    """Write all of it."""
    IMAGES.mkdir(exist_ok=True)
    (DOCS / "cli.md").write_text(command_reference())
    lane_frames().savefig(IMAGES / "lane-frames.png", facecolor="white")
    for name in ("comparison.png", "trajectories.png"):
        if (DEMO_REPORT / name).exists():
            shutil.copy(DEMO_REPORT / name, IMAGES / name)
    print(f"wrote {DOCS / 'cli.md'} and {IMAGES}")


if __name__ == "__main__":
    main()
