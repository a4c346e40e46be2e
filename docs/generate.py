"""Writes what the docs show and nobody should type: `make docs`.

docs/cli.md                    the commands and their options, from the program itself
docs/images/SIM-frames.png     what the sims look like, from above and to their depth cameras
docs/images/comparison.png     from the last `make demo`, if there was one
docs/images/trajectories.png   likewise
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import click
import numpy as np
from matplotlib.figure import Figure

from mcaprl.cli import cli
from mcaprl.sims import make_sim
from mcaprl.sims.pilots import make_pilot

DOCS = Path(__file__).parent
IMAGES = DOCS / "images"
DEMO_REPORT = DOCS.parent / "demo" / "report"
# Columns of a contact sheet, and decisions of each sim's pilot between two of them.
FRAMES = 6
FRAME_EVERY = {"lane": 30, "powerline": 40, "racer": 25}


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


def frames_of(sim: str, every: int, **arguments: Any) -> Figure:
    """A contact sheet of the pilot's drive: from above, and what the depth camera sees, if any.

    Args:
        sim: short name.
        every: decisions between two columns.
        **arguments: of the sim.
    """
    env = make_sim(sim, render_mode="rgb_array", **arguments)
    observation, _ = env.reset(seed=1)
    pilot = make_pilot(env)
    has_depth = hasattr(env.unwrapped, "depth_image_m")
    figure = Figure(figsize=(2.4 * FRAMES, 5.2 if has_depth else 2.2), dpi=110)
    grid = figure.subplots(1 + has_depth, FRAMES, squeeze=False)
    sim_: Any = env.unwrapped
    for column in range(FRAMES):
        seconds = column * every * sim_.step_duration_s
        title = f"{seconds:.0f} s, {sim_.telemetry()['speed_m_s']:.0f} m/s"
        _show(grid[0, column], np.asarray(env.render()), title)
        if has_depth:
            depth_m = sim_.depth_image_m()
            _show(grid[1, column], np.log(np.minimum(depth_m, 200.0)), "")
        for _ in range(every):
            observation = env.step(pilot.act(np.asarray(observation)[None])[0])[0]
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
    for sim, every in FRAME_EVERY.items():
        frames_of(sim, every, start="line").savefig(IMAGES / f"{sim}-frames.png", facecolor="white")
    for name in ("comparison.png", "trajectories.png"):
        if (DEMO_REPORT / name).exists():
            shutil.copy(DEMO_REPORT / name, IMAGES / name)
    print(f"wrote {DOCS / 'cli.md'} and {IMAGES}")


if __name__ == "__main__":
    main()
