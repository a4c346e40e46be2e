"""`mcaprl train-online`: train a policy in a sim."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import click

import mcaprl
from mcaprl.cli.completion import Name, sims
from mcaprl.cli.options import integer_option, origin_option, seed_options, sim_options
from mcaprl.cli.progress import checkpoints_kept, hint, training_progress
from mcaprl.cli.settings import SettingsCommand
from mcaprl.cli.show import print_address, print_table
from mcaprl.settings import Settings


def _configs() -> dict[str, Settings]:
    from mcaprl.online.config import CONFIGS

    return {name: config_type() for name, config_type in CONFIGS.items()}


def _presets() -> Iterable[str]:
    from mcaprl.online.config import PRESETS

    return PRESETS


def _engines() -> Iterable[str]:
    from mcaprl.online.config import ENGINES

    return ENGINES


def _tuned() -> dict[str, dict[str, Any]]:
    from mcaprl.online.config import BOX_SETTINGS, SIM_SETTINGS

    continuous = {f"{sim} (continuous)": settings for sim, settings in BOX_SETTINGS.items()}
    return {**SIM_SETTINGS, **continuous}


@click.command(cls=SettingsCommand, configs=_configs, tuned=_tuned)
@click.argument("sim", required=False, type=Name(sims))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Run folder to create.")
@click.option(
    "--algo",
    type=Name(_configs),
    help="double-dqn or dqn for discrete actions; sac, td3 or tqc for those of a Box; ppo or a2c"
    " for both.  [default: double-dqn or sac]",
)
@click.option(
    "--engine",
    type=Name(_engines),
    help="mcaprl, with the learners of train-offline, or sb3 for Stable-Baselines3.  [default:"
    " mcaprl if it has the algorithm]",
)
@click.option(
    "--preset",
    type=Name(_presets),
    help="Published settings: autonomysim-car, autonomysim-drone, ddqn-racer.",
)
@seed_options("agent")
@integer_option(
    "--threads", "Number of threads of PyTorch; useful only for images on an idle machine.", least=1
)
@click.option(
    "--record",
    type=click.Path(path_type=Path),
    help="Log to write with all transitions; with several seeds, a folder of logs.",
)
@click.option(
    "--from",
    "sources",
    multiple=True,
    metavar="DATA|POLICY",
    help="Logs to learn from, or a policy that initializes the agents (each agent from one seed of"
    " the run); may be given twice.",
)
@click.option("--resume", is_flag=True, help="Resume training from the checkpoints in OUT.")
@click.option("--live", is_flag=True, help="Show the training in Foxglove.")
@click.option("--upload", metavar="URL", help="With --record: copy the finished log to a URL.")
@click.option(
    "--live-speed",
    default=2.0,
    show_default=True,
    type=click.FloatRange(0, min_open=True),
    help="With --live: speed of the shown episodes, in simulated seconds per second.",
)
@integer_option(
    "--port",
    "With --live: port on 127.0.0.1; 0 for any free port.",
    least=0,
    most=65535,
    default=8765,
)
@origin_option
@click.option(
    "--device",
    help="Train all seeds at once, with sims, replay buffers and networks on this device: cuda or"
    " cpu. For double-dqn in lane and racer, with other default settings; the last policy is saved."
    " Without it, one seed is trained after the other.",
)
@click.option(
    "--max-steps",
    type=click.IntRange(1),
    help="Steps after which an episode is truncated.  [default: no limit; in evaluations, 27000 if"
    " SIM has no time limit]",
)
@sim_options
def train_online(sim: str | None, out: Path, **request: Any) -> None:
    """Train a policy in SIM: lane, powerline, racer, highway-lane, or any Gymnasium id.

    An omitted setting has the value of the preset, else the value tuned for SIM, else the default
    of Stable-Baselines3. With --resume, it has the value of the run. Settings are tuned only for
    dqn, double-dqn, sac and td3 with default rules. The best checkpoint is kept. It is selected on
    one set of episodes and scored on another set.
    """
    given = {name: value for name, value in request.items() if value is not None}
    on_device = request["device"] is not None
    with (
        training_progress("steps", "score", "mean_return", "mean_reward") as progress,
        nullcontext() if on_device else checkpoints_kept(out, given["resume"]),
    ):
        found = mcaprl.train_online(sim, out, on_live=print_address, progress=progress, **given)
    rows = [
        [
            str(summary.folder),
            f"{summary.steps}",
            f"{summary.best_step}",
            f"{summary.mean_return:.2f}",
            "" if math.isnan(summary.score) else f"{summary.score:.3f}",
            ", ".join(f"{count} {reason}" for reason, count in summary.ends.items()),
        ]
        for summary in found
    ]
    from mcaprl.runs import read_config

    config = read_config(out)
    policy = "last policy" if on_device else "best checkpoint"
    print_table(
        f"{config['algo']} in {config['sim']}: the {policy} of each seed on new episodes",
        ["run", "steps", "saved at", "mean return", "random 0, pilot 1", "ends"],
        rows,
    )
    image = out / "curve.png"
    curves = f"{image}, or " if image.exists() else ""
    hint(f"curves: {curves}tensorboard --logdir {out}")
