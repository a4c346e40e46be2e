"""Generate the command reference and the images of the docs: `make docs`.

docs/cli.md                    the commands and their options, from the help of the program
docs/images/SIM-pilot.png      an episode of the pilot in each sim: from above, and its depth images
docs/images/SIM-random.png     the same with random actions
docs/images/comparison.png     copied from the last `make demo`, if there is one
docs/images/trajectories.png   copied from the last `make demo`, if there is one
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import click
import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

from mcaprl.api import SCRIPTED
from mcaprl.cli import cli
from mcaprl.sims import make_pilot, make_sim

DOCS = Path(__file__).parent
IMAGES = DOCS / "images"
DEMO_REPORT = DOCS.parent / "demo" / "report"
SEED = 1
SHEET_WIDTH = 14.4
# Range of the color scale of depth images, which is logarithmic.
NEAREST_M, FARTHEST_M = 2.0, 200.0


class Sheet(NamedTuple):
    """A contact sheet of an episode.

    Attributes:
        sim: Short name of the sim.
        steps: Maximum number of steps.
        start: Name of the start.
        columns: Number of frames.
        cameras: Arguments that select a depth camera, for each row.
        road: Road of highway-lane.
    """

    sim: str
    steps: int
    start: str = "line"
    columns: int = 6
    cameras: tuple[dict[str, str], ...] = ()
    road: str | None = None


SHEETS = {
    "lane": Sheet("lane", 175, cameras=({},)),
    "powerline": Sheet("powerline", 270, cameras=({"camera": "down"}, {"camera": "front"})),
    "racer": Sheet("racer", 130, columns=4),
    "highway-lane": Sheet("highway-lane", 580, start="anywhere"),
    "highway-racetrack": Sheet("highway-lane", 90, road="racetrack-v0"),
}


def command_reference() -> str:
    """Return the help of every command, as Markdown."""
    parts = ["# The commands\n\nWritten by `make docs` from the program's own help.\n"]
    with click.Context(cli, info_name="mcaprl", terminal_width=100, **cli.context_settings) as top:
        parts.append(_section("mcaprl", cli.get_help(top)))
        for name in cli.list_commands(top):
            command = cli.get_command(top, name)
            assert command is not None
            with click.Context(command, info_name=name, parent=top) as inner:
                parts.append(_section(f"mcaprl {name}", command.get_help(inner)))
    return "\n".join(parts)


def contact_sheet(sheet: Sheet, policy: str) -> Figure:
    """Draw frames of an episode from above, and depth images in the rows below.

    Args:
        sheet: Contact sheet to draw.
        policy: `pilot` or `random`.
    """
    arguments = {"start": sheet.start} | ({"road": sheet.road} if sheet.road else {})
    # They differ in the camera only: the same seed and actions produce the same episode.
    envs = [
        make_sim(sheet.sim, render_mode="rgb_array", **arguments, **camera)
        for camera in sheet.cameras or ({},)
    ]
    steps = sum(1 for _ in _episode(envs, policy, sheet.steps)) - 1
    shown = np.unique(np.linspace(0, steps, sheet.columns).round()).tolist()
    rows, side = 1 + len(sheet.cameras), SHEET_WIDTH / sheet.columns
    figure = Figure(figsize=(side * len(shown), side * rows + 0.3), dpi=110)
    grid = figure.subplots(rows, len(shown), squeeze=False)
    for step, reason in enumerate(_episode(envs, policy, sheet.steps)):
        if step not in shown:
            continue
        column = grid[:, shown.index(step)]
        _show(column[0], envs[0].render(), _title(envs[0].unwrapped, step, reason))
        for axes, env in zip(column[1:], envs, strict=False):
            depth_m = np.asarray(env.get_wrapper_attr("depth_image_m")())
            _show(axes, np.log(np.minimum(depth_m, FARTHEST_M)), "")
    figure.tight_layout()
    return figure


def _episode(envs: list[gym.Env[Any, Any]], policy: str, steps: int) -> Iterator[str]:
    """Run one episode in all environments; yield the reason of the end after each observation."""
    pilot, actions = make_pilot(envs[0]), envs[0].action_space
    actions.seed(SEED)
    for env in envs:
        env.reset(seed=SEED)
    yield ""
    for _ in range(steps):
        # Pilots read the state of the sim, not the observation.
        action = actions.sample() if policy == "random" else pilot.act(np.zeros((1, 1)))[0]
        ends = [env.step(action)[2:] for env in envs]
        terminated, truncated, info = ends[0]
        yield str(info.get("reason", ""))
        if terminated or truncated:
            return


def _title(sim: Any, step: int, reason: str) -> str:
    seconds = step * sim.step_duration_s
    title = f"{seconds:.1f} s, {sim.telemetry()['speed_m_s']:.0f} m/s"
    return f"{title}, {reason}" if reason else title


def _show(axes: Any, image: Any, title: str) -> None:
    if image.ndim == 2:
        axes.imshow(image, cmap="turbo_r", vmin=np.log(NEAREST_M), vmax=np.log(FARTHEST_M))
    else:
        axes.imshow(image)
    axes.set_title(title, fontsize=9)
    axes.set_axis_off()


def _section(title: str, text: str) -> str:
    return f"## {title}\n\n```text\n{text.rstrip()}\n```\n"


def main() -> None:
    """Write the reference and the images."""
    IMAGES.mkdir(exist_ok=True)
    (DOCS / "cli.md").write_text(command_reference())
    for name, sheet in SHEETS.items():
        for policy in SCRIPTED:
            path = IMAGES / f"{name}-{policy}.png"
            contact_sheet(sheet, policy).savefig(path, facecolor="white", bbox_inches="tight")
    for name in ("comparison.png", "trajectories.png"):
        if (DEMO_REPORT / name).exists():
            shutil.copy(DEMO_REPORT / name, IMAGES / name)
    print(f"wrote {DOCS / 'cli.md'} and {IMAGES}")


if __name__ == "__main__":
    main()
