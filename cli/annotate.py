"""`mcaprl annotate`: values of policies, or the scene of the sim, in a copy of a log."""

from __future__ import annotations

from pathlib import Path

import click

import mcaprl
from mcaprl.cli.options import trust_option
from mcaprl.cli.show import echo
from mcaprl.progress import terminal_bar
from mcaprl.texts import counted


@click.command()
@click.argument("file", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option("--policy", multiple=True, help="Path of a trained run; may be repeated.")
@click.option("--gamma", type=click.FloatRange(0, 1), help="Discount. [default: that of the run]")
@click.option("--scene", is_flag=True, help="Step the sim again and add its scene.")
@click.option("--camera", is_flag=True, help="With --scene: add metric depth images.")
@click.option("--sim", help="With --scene: sim to step instead of the logged one.")
@trust_option
@click.option("--out", required=True, type=click.Path(path_type=Path), help="File to write.")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
def annotate(
    file: Path,
    policy: tuple[str, ...],
    gamma: float | None,
    scene: bool,
    camera: bool,
    sim: str | None,
    trust_env: bool,
    out: Path,
    overwrite: bool,
) -> None:
    """Copy FILE and add a policy's values or the scene of the sim to each step."""
    found = mcaprl.annotate(
        file,
        out,
        policy=policy,
        gamma=gamma,
        scene=scene,
        camera=camera,
        sim=sim,
        trust_env=trust_env,
        overwrite=overwrite,
        progress=terminal_bar,
    )
    for name, topic in found.topics.items():
        echo(f"{out}: {topic} has the values of {name} for {found.steps} steps")
    if found.scene is not None:
        episodes, steps = found.scene.episodes, found.scene.steps
        echo(f"{out}: the scene of {counted(episodes, 'episode')}, {counted(steps, 'step')}")
