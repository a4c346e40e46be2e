"""`mcaprl train-offline`: logs in, a policy out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from mcaprl.cli.settings import setting_options
from mcaprl.cli.show import counted
from mcaprl.errors import MissingExtraError
from mcaprl.runs import CONFIG_NAME, read_config
from mcaprl.settings import check_settings, settings_from_json


class _TrainCommand(click.Command):
    """Has an option for each setting of the algorithms; loads them when it is asked for options."""

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        from mcaprl.offline.algorithms.registry import all_algorithms

        configs = [learner.config_type() for learner in all_algorithms().values()]
        return [*super().get_params(ctx), *setting_options(configs)]


@click.command(cls=_TrainCommand)
@click.argument("data", nargs=-1, required=True, metavar="DATA...")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Run folder to make.")
@click.option(
    "--algo",
    help="dqn, double-dqn, cql, bc, bcq, iql, or an installed package's.  [default: cql]",
)
@click.option(
    "--seeds",
    default=1,
    show_default=True,
    type=click.IntRange(1),
    help="How many networks to train.",
)
@click.option(
    "--seed", default=0, show_default=True, type=click.IntRange(0), help="Of the first one."
)
@click.option(
    "--threads",
    default=1,
    show_default=True,
    type=click.IntRange(1),
    help="Of torch, and to read with; more than one pays with big batches on an idle machine.",
)
@click.option(
    "--device",
    default="cpu",
    show_default=True,
    help="Device of data and networks: cpu or cuda.",
)
@click.option("--resume", is_flag=True, help="Go on from the checkpoints in OUT.")
@click.option("--follow", is_flag=True, help="Learn from logs that are still being written, too.")
@click.option("--other-data", is_flag=True, help="When resuming, go on even with other DATA.")
def train_offline(
    data: tuple[str, ...],
    out: Path,
    algo: str | None,
    seeds: int,
    seed: int,
    threads: int,
    device: str,
    resume: bool,
    follow: bool,
    other_data: bool,
    **settings: Any,
) -> None:
    """Learn a policy from DATA: files, folders or globs of logs.

    A number behind a name is a weight: with good.mcap:2 rest/, transitions of good.mcap are drawn
    twice as often as others. With --follow, another process may still write DATA: each episode is
    taken up when it is finished, until all updates are made. All seeds are trained side by side and
    do not depend on each other. Settings that are not given have the algorithm's own defaults; with
    --resume, the run's.
    """
    import torch

    from mcaprl.offline.algorithms.registry import choose_algorithm
    from mcaprl.offline.batches.sources import open_weighted
    from mcaprl.offline.training.curves import draw_curves
    from mcaprl.offline.training.follow import GrowingLogs
    from mcaprl.offline.training.metrics import describe_seeds
    from mcaprl.offline.training.train import train

    torch.set_num_threads(threads)
    given = {name: value for name, value in settings.items() if value is not None}
    if resume and (out / CONFIG_NAME).exists():
        earlier = read_config(out)
        algo = algo or earlier.get("algo")
        given = {**settings_from_json(earlier.get("config")), **given}
    algo = algo or "cql"
    _, defaults = choose_algorithm(algo)
    check_settings(algo, defaults, given)
    config = type(defaults)(**given)
    growing = GrowingLogs(data) if follow else None
    dataset, weights = (growing.dataset, None) if growing else open_weighted(data, threads=threads)
    click.echo(
        f"{algo} learns from {counted(len(dataset.episodes), 'episode')},"
        f" {counted(len(dataset), 'transition')}, mean return {dataset.statistics.mean_return:.2f}"
    )
    summaries = train(
        dataset,
        config,
        out,
        seeds=seeds,
        seed=seed,
        weights=weights,
        resume=resume,
        # Logs that grew since are not what the checkpoints are of.
        other_data=other_data or follow,
        follow=growing,
        device=device,
    )
    for line in describe_seeds(summaries):
        click.echo(line)
    try:
        click.echo(f"curves: {draw_curves(out)}, or tensorboard --logdir {out}")
    except MissingExtraError as error:
        click.echo(f"curves: tensorboard --logdir {out}; for a picture: {error}")
