"""`mcaprl train-online`: a policy out of a sim, while its log fills."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mcaprl.api.policies import TrainedPolicy, is_policy, load_policies
from mcaprl.cli.options import sim_options
from mcaprl.cli.settings import setting_options
from mcaprl.cli.show import print_table
from mcaprl.errors import UsageError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.open import open_logs

if TYPE_CHECKING:
    from mcaprl.online.live import LiveTraining
    from mcaprl.online.task import Task


class _TrainCommand(click.Command):
    """Has an option for each setting of the algorithms; loads them when it is asked for options."""

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        from mcaprl.online.algorithms import ALGORITHMS

        configs = [algorithm.config_type() for algorithm in ALGORITHMS.values()]
        return [*super().get_params(ctx), *setting_options(configs)]


@click.command(cls=_TrainCommand)
@click.argument("sim", required=False)
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Run folder to make.")
@click.option("--algo", help="dqn, double-dqn, ppo or a2c.  [default: double-dqn]")
@click.option(
    "--preset", help="Published settings: autonomysim-car, autonomysim-drone, ddqn-racer."
)
@click.option(
    "--seeds",
    default=1,
    show_default=True,
    type=click.IntRange(1),
    help="How many agents to train.",
)
@click.option(
    "--seed", default=0, show_default=True, type=click.IntRange(0), help="Of the first one."
)
@click.option(
    "--threads",
    default=1,
    show_default=True,
    type=click.IntRange(1),
    help="Of torch; more than one pays only with pictures on an idle machine.",
)
@click.option(
    "--record",
    type=click.Path(path_type=Path),
    help="Log every transition while training; with several seeds a folder.",
)
@click.option(
    "--from",
    "sources",
    multiple=True,
    metavar="DATA|POLICY",
    help="Begin with logs in the replay buffer, or with a policy's weights (of a run with several"
    " seeds, one for each); may be given twice.",
)
@click.option("--resume", is_flag=True, help="Go on from the checkpoints in OUT.")
@click.option("--live", is_flag=True, help="Show it to Foxglove meanwhile; frames are dropped.")
@click.option(
    "--port",
    default=8765,
    show_default=True,
    type=click.IntRange(0, 65535),
    help="With --live: of 127.0.0.1, to listen on; 0 takes any that is free.",
)
@sim_options
def train_online(
    sim: str | None,
    out: Path,
    algo: str | None,
    preset: str | None,
    seeds: int,
    seed: int,
    threads: int,
    record: Path | None,
    sources: tuple[str, ...],
    resume: bool,
    live: bool,
    port: int,
    sim_arguments: dict[str, Any],
    **settings: Any,
) -> None:
    """Learn a policy by acting in SIM: lane, powerline, racer, highway-lane, or any Gymnasium id.

    Settings that are not given are the preset's or, without one, those that SIM was seen to be
    learnt with, or else Stable-Baselines3's; with --resume, the run's. The best checkpoint is kept,
    chosen by episodes of its own and scored on others.
    """
    import torch

    from mcaprl.online.task import choose_task
    from mcaprl.online.train import train

    torch.set_num_threads(threads)
    given = {name: value for name, value in settings.items() if value is not None}
    task = choose_task(
        sim, algo, sim_arguments, given, preset=preset, resumed=out if resume else None
    )
    data, policy = _experience(sources)
    with _shown(task, out, port) if live else nullcontext() as shown:
        summaries = train(
            task,
            out,
            seeds=seeds,
            seed=seed,
            record=record,
            data=data,
            policy=policy,
            resume=resume,
            live=shown,
        )
    rows = [
        [
            str(summary.folder),
            f"{summary.steps}",
            f"{summary.best_step}",
            f"{summary.mean_return:.2f}",
            "" if math.isnan(summary.score) else f"{summary.score:.3f}",
            ", ".join(f"{count} {reason}" for reason, count in summary.ends.items()),
        ]
        for summary in summaries
    ]
    print_table(
        f"{task.algo} in {task.sim}: the best checkpoint of each seed on fresh episodes",
        ["run", "steps", "best at", "mean return", "random 0, pilot 1", "ends"],
        rows,
    )
    click.echo(f"curves: {out / 'curve.png'}, or tensorboard --logdir {out}")


@contextmanager
def _shown(task: Task, out: Path, port: int) -> Iterator[LiveTraining]:
    """Listen for viewers, and tell the user where."""
    from mcaprl.online.live import LiveTraining
    from mcaprl.recorder.record.layout import LAYOUT_NAME

    with closing(LiveTraining(task, port=port)) as live:
        click.echo(f"open {live.stream.app_url}")
        click.echo(f"or connect any viewer of the Foxglove protocol to {live.stream.url}")
        click.echo(f"layout to import: {out / LAYOUT_NAME}")
        yield live


def _experience(sources: tuple[str, ...]) -> tuple[Dataset | None, list[TrainedPolicy] | None]:
    """The logs, and the policies of a run's seeds, among what is to be begun with."""
    policies = [source for source in sources if is_policy(Path(source))]
    if len(policies) > 1:
        raise UsageError(f"an agent begins with one policy, not with {' and '.join(policies)}")
    logs = [source for source in sources if source not in policies]
    data = open_logs(logs) if logs else None
    return data, load_policies(policies[0]) if policies else None
